"""A rolling shutter is found, measured and remove_rolling_shutter; a global one is left alone."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, NOTHING, adjusted, scenes_of, solved, z_of
from synthetic import LENS

from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.solve.shutter import readout, remove_rolling_shutter, row_shift

pytestmark = pytest.mark.usefixtures('no_profile')


@pytest.mark.parametrize('readout_s', [0.03, -0.02])
def test_a_rolling_shutter_is_measured_and_undone(readout_s):
    scenes = scenes_of(3, readout_s=readout_s, noise_px=0.15)
    # p1 and p2, a crop that moves, or a field would take up a part of what is ignored
    ignored = solved(scenes, CONFIG.replace({'intrinsics.shutter_rounds': 0,
                                             'intrinsics.crop_rounds': 0, 'model': 'radial',
                                             'intrinsics.least_field_nats': 1e6}))
    assert ignored.readout_s == 0.0
    found = solved(scenes)
    assert found.readout_s == pytest.approx(readout_s, rel=0.1)
    assert 0 < found.readout_sigma_s < 0.3 * abs(readout_s)
    error = np.abs(found.camera.params - LENS.params)
    before = np.abs(ignored.camera.params - LENS.params)
    # the true path between keyframes is not quite the one that is taken for it
    assert error[0] < 0.008 * LENS.fx and error[1] < 0.3 * before[1]
    assert found.reprojection_error_px < 0.7 * ignored.reprojection_error_px


def test_a_global_shutter_stays_one():
    scenes = scenes_of(3)
    found, held = solved(scenes), solved(scenes, CONFIG.replace({'intrinsics.shutter_rounds': 0}))
    assert found.readout_s == found.readout_sigma_s == 0.0
    np.testing.assert_array_equal(found.camera.params, held.camera.params)
    assert np.abs(z_of(found)).max() < 3.5


def test_what_is_undone_is_what_was_there():
    scenes, camera = adjusted(scenes_of(2, start=LENS, noise_px=0.05), 0.5)
    rolling = [replace(scene, tracks=replace(
        scene.tracks, xy=scene.tracks.xy + 0.01 * row_shift(scene, camera))) for scene in scenes]
    settled, other = adjusted(rolling, 0.5)
    step, sigma = readout(settled, other, 0.5, NOTHING)
    assert abs(step) > 3 * sigma and step == pytest.approx(0.01, rel=0.5)
    for scene, was in zip(rolling, scenes, strict=True):
        back = remove_rolling_shutter(scene, scene, camera, 0.01)
        assert np.nanmax(np.abs(back.tracks.xy - was.tracks.xy)) < 0.1
        np.testing.assert_array_equal(back.tracks.seen, was.tracks.seen)


def test_rows_do_not_shift_without_movement():
    [scene] = scenes_of(1, start=LENS)
    shift = row_shift(scene, LENS)
    assert np.isfinite(shift).all() and np.abs(shift).max() > 1
    # the middle row is on time
    late = (scene.tracks.xy[:, :, 1] + 0.5) / LENS.image_size[1] - 0.5
    middle = np.abs(late) < 0.01
    assert np.abs(shift[middle]).max() < 0.05 * np.abs(shift).max()
    still = replace(scene, tracks=replace(
        scene.tracks, stamps_ns=np.zeros_like(scene.tracks.stamps_ns)))
    assert not row_shift(still, LENS).any()
    assert readout([still], LENS, 0.5, NOTHING) == (0.0, np.inf)
    alone = replace(scene, structure=replace(
        scene.structure, registered=np.arange(len(scene.tracks.frames)) == 3))
    assert not row_shift(alone, LENS).any()


def test_a_readout_that_no_shutter_has_is_weak():
    solution = solved(scenes_of(2, tracks=110, keyframes=12))
    assert not any('rows' in reason for reason in judge(solution, CONFIG.verdict).reasons)
    slow = replace(solution, readout_s=-0.08)
    verdict = judge(slow, CONFIG.verdict)
    assert verdict.level != 'accepted' and any('80 ms' in reason for reason in verdict.reasons)
