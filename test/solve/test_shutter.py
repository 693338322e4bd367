# SPDX-License-Identifier: Apache-2.0
"""A rolling shutter is found and measured, also in a car that shakes; a global one stays one."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from solving import CONFIG, START, scenes_of, solved, z_of
from synthetic import LENS, SIZE, path_of, synthetic_turn

from dashcalib_ros.camera import Fisheye
from dashcalib_ros.camera.mapping import mapping_error
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.problem.blocks import Readout, Shake, imaging_with
from dashcalib_ros.reconstruct.scene import residuals_px

pytestmark = pytest.mark.usefixtures('no_profile')

# keyframes that show how a car turns between them
DENSE = {'keyframes': 24, 'keyframe_s': 0.15, 'noise_px': 0.1, 'tracks': 120}


@pytest.mark.parametrize(('readout_s', 'shaking_deg_s'), [
    pytest.param(0.03, 0.0, marks=pytest.mark.thorough), (-0.02, 0.0), (0.02, 3.0)])
def test_a_rolling_shutter_is_measured(readout_s, shaking_deg_s):
    found = solved(scenes_of(3, readout_s=readout_s, shaking_deg_s=shaking_deg_s, **DENSE))
    assert found.rolling
    assert found.readout_s == pytest.approx(readout_s, rel=0.02)
    assert abs(found.readout_s - readout_s) < 2 * found.readout_sigma_s < 0.06 * abs(readout_s)
    assert np.abs(z_of(found)).max() < 3 and mapping_error(found.camera, LENS) < 1.0


def test_images_are_missing_and_the_stamps_hide_it():
    # the readout was 18 % short, and fy 2.8 sigmas off
    scenes = []
    for scene in scenes_of(3, readout_s=0.02, **DENSE):
        later = np.where(np.arange(len(scene.tracks.frames)) > 11, 100_000_000, 0)
        hidden = replace(scene.tracks, stamps_ns=scene.tracks.stamps_ns - later)
        scenes.append(replace(scene, tracks=hidden))
    found = solved(scenes)
    assert abs(found.readout_s - 0.02) < 2.5 * found.readout_sigma_s < 0.06 * 0.02
    assert np.abs(z_of(found)).max() < 3
    assert len(found.times.frames) == 3 and found.times.missing_s == pytest.approx(0.3, abs=0.03)


def test_stamps_of_arrival():
    rng, scenes = np.random.default_rng(0), []
    for scene in scenes_of(3, readout_s=0.02, **DENSE):
        late_ns = rng.normal(0, 10e6, len(scene.tracks.frames)).astype(np.int64)
        scenes.append(replace(scene, tracks=replace(
            scene.tracks, stamps_ns=scene.tracks.stamps_ns + late_ns)))
    found = solved(scenes)
    assert abs(found.readout_s - 0.02) < 2.5 * found.readout_sigma_s < 0.06 * 0.02
    assert np.abs(z_of(found)).max() < 3
    assert not found.times.frames and found.times.inaccurate_s == pytest.approx(0.01, rel=0.3)


def test_bumps_between_the_keyframes_do_not_make_a_readout_shorter():
    # how fast the camera pitches and rolls, no difference of poses says
    found = solved(scenes_of(3, readout_s=0.02, shaking_deg_s=4.0, aliased=True, **DENSE))
    assert found.readout_s == pytest.approx(0.02, rel=0.03)
    assert abs(found.readout_s - 0.02) < 2.5 * found.readout_sigma_s


def test_a_rough_road_does_not_change_the_focal_length():
    # two bends whose camera pitches and rolls by 16 degrees a second, five times a smooth road's:
    # with a prior for that fx was 4 % off, at 4.6 sigmas
    found = solved([synthetic_turn(
        LENS, yaw_deg, world=world, readout_s=0.02, shaking_deg_s=16.0, aliased=True,
        **{**DENSE, 'noise_px': 0.25, 'tracks': 200}).scene(START, world)
        for world, yaw_deg in enumerate((20.0, -25.0))])
    assert abs(found.camera.fx / LENS.fx - 1) < 0.005
    assert np.abs(z_of(found)[:2]).max() < 2


@pytest.mark.thorough
def test_the_shutter_of_a_fisheye_is_measured():
    lens = Fisheye(SIZE, 300.0, 300.6, 404.0, 221.0, 0.02, -0.008, 0.003, -0.0005)
    found = solved(scenes_of(3, lens, start=Fisheye.centred(SIZE, 1.02 * lens.fx, 0.0),
                             readout_s=0.02, **DENSE))
    # seeds 0, 1 and 2: -2.0, -0.2 and -1.1 sigmas
    assert abs(found.readout_s - 0.02) < 2.5 * found.readout_sigma_s < 0.04 * 0.02
    assert mapping_error(found.camera, lens) < 1.0


def test_a_global_shutter_stays_one():
    found = solved(scenes_of(3))
    assert not found.rolling and abs(found.readout_s) < 3 * found.readout_sigma_s < 0.003
    assert np.abs(z_of(found)).max() < 3


def test_tracks_of_a_rolling_shutter_become_those_of_a_global_one():
    readout_s = 0.03
    turn = synthetic_turn(LENS, 80.0, noise_px=0.0, readout_s=readout_s, keyframes=28,
                          keyframe_s=0.15)
    scene = replace(turn.scene(LENS), structure=turn.structure)
    used = scene.structure.used
    assert np.abs(residuals_px(scene, LENS)[used]).max() > 5
    imaging, turning = imaging_with(LENS, [scene]), scene.trajectory.velocity[0]
    # what is not steered is the shake of each image
    shake = replace(imaging.blocks[Shake.name], value={
        scene.turn: readout_s * (turning - turning @ imaging.steering(scene))})
    back = imaging.having(Readout(np.array([readout_s])), shake).as_lens_sees(scene)
    assert np.abs(residuals_px(back, LENS)[used]).max() < 0.5
    assert np.sqrt(np.mean(residuals_px(back, LENS)[used]**2)) < 0.07
    np.testing.assert_array_equal(back.tracks.seen, scene.tracks.seen)


def test_the_motion_is_that_of_a_cubic_spline():
    turn = synthetic_turn(LENS, 70.0, keyframes=9)
    turning, moving = replace(turn.scene(LENS), structure=turn.structure).trajectory.velocity
    seconds = turn.tracks.stamps_ns / 1e9
    rotations, centres = turn.structure.path()
    np.testing.assert_allclose(
        moving, -np.einsum('kij,kj->ki', rotations, CubicSpline(seconds, centres)(
            seconds, 1)), atol=1e-9)
    # and nearly that of the car
    path = path_of(70.0, seconds, 0)
    little = np.full((9, 1), 1e-4)
    moved = path.local(np.eye(3)[:1], little) - path.local(np.eye(3)[:1], -little)
    local = np.einsum('kij,j->ki', rotations, np.eye(3)[0]) + turn.structure.translations
    expected = np.cross(turning, local) + moving
    assert np.abs(moved[:, 0] / 2e-4 - expected)[1:-1].max() < 0.1 * np.abs(expected).max()


def test_rows_do_not_shift_without_movement():
    [scene] = scenes_of(1, start=LENS)
    imaging = imaging_with(LENS, [scene]).having(Readout(np.array([0.02])))
    shift = imaging.row_shift(scene)
    assert np.isfinite(shift).all() and np.abs(shift).max() > 1
    # the middle row is on time
    late = (scene.tracks.xy[:, :, 1] + 0.5) / LENS.image_size[1] - 0.5
    middle = np.abs(late) < 0.01
    assert np.abs(shift[middle]).max() < 0.05 * np.abs(shift).max()
    still = replace(scene, tracks=replace(
        scene.tracks, stamps_ns=np.zeros_like(scene.tracks.stamps_ns)))
    assert not imaging.row_shift(still).any()
    alone = replace(scene, structure=replace(
        scene.structure, registered=np.arange(len(scene.tracks.frames)) == 3))
    assert not imaging.row_shift(alone).any()


def test_turns_without_stamps_know_nothing_of_the_shutter():
    scenes = [replace(scene, tracks=replace(
        scene.tracks, stamps_ns=np.zeros_like(scene.tracks.stamps_ns)))
        for scene in scenes_of(2, tracks=110, keyframes=12)]
    found = solved(scenes)
    assert not found.rolling and found.readout_sigma_s == pytest.approx(0.02, rel=0.1)
    assert np.abs(z_of(found)).max() < 3.5


def test_a_readout_that_no_shutter_has_is_weak():
    solution = solved(scenes_of(2, tracks=110, keyframes=12))
    assert not any('rows' in str(reason) for reason in judge(solution, CONFIG.verdict).reasons)
    slow = replace(solution, readout_s=-0.08)
    verdict = judge(slow, CONFIG.verdict)
    assert verdict.level != 'accepted' and '80 ms' in verdict.main_text
    # what may be none is not told
    unsure = replace(slow, readout_sigma_s=0.03)
    assert not any('rows' in str(reason) for reason in judge(unsure, CONFIG.verdict).reasons)
