# SPDX-License-Identifier: Apache-2.0
"""Which kind of lens the turns prove, and which model of it is written."""
from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from solving import CONFIG, scenes_of, solved, with_camera
from synthetic import LENS, SIZE, synthetic_turn

from dashcalib_ros.camera import Brown, Fisheye, Radial
from dashcalib_ros.camera.mapping import as_model, mapping_error
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.problem.blocks import imaging_with
from dashcalib_ros.reconstruct.scene import Profile, Scene, Start
from dashcalib_ros.solve import evidence
from dashcalib_ros.solve.evidence import Candidate, is_clear

pytestmark = pytest.mark.usefixtures('no_profile')

WIDE = Fisheye(SIZE, 300.0, 300.6, 404.0, 221.0, 0.02, -0.008, 0.003, -0.0005)
DECENTRED = Brown(SIZE, *LENS.params, 0.003, -0.003, 0.0)


def wide_scenes(count: int, tracks: int = 150) -> list[Scene]:
    start = Fisheye.centred(SIZE, 1.02 * WIDE.fx, 0.0)
    return [synthetic_turn(WIDE, yaw, world=world, tracks=tracks, keyframes=16).scene(start, world)
            for world, yaw in enumerate((80.0, -70.0, 85.0)[:count])]


# the model that is written

@pytest.mark.parametrize('count', [2, 4])
def test_a_decentred_lens_is_written_as_one(count):
    found = solved(scenes_of(count, extra=(0.003, -0.003, 0.0)))
    assert type(found.camera) is Brown
    assert mapping_error(found.camera, DECENTRED) < 2 * found.picture.rms < 3.0
    error = np.abs(found.camera.params - DECENTRED.params) / found.sigma
    assert (error < 3).all()


@pytest.mark.thorough
def test_a_radial_lens_is_written_as_one_and_its_sigma_is_neither_blind_nor_timid():
    found = [solved(scenes_of(4, seed=seed, tracks=110, keyframes=12)) for seed in range(4)]
    assert [type(each.camera) for each in found].count(Radial) >= 3
    ratios = [mapping_error(each.camera, LENS) / each.picture.rms for each in found]
    assert np.sqrt(np.mean(np.square(ratios))) > 0.2 and max(ratios) < 1.5
    assert all(each.picture.rms <= each.picture.worst < 3.0 for each in found)


def test_camera_and_field_have_the_rays_that_were_found():
    found = solved(scenes_of(2, extra=(0.003, -0.003, 0.0)), CONFIG.replace({'model': 'radial'}))
    assert type(found.camera) is Radial and found.field is not None
    pixels = found.written.pixels
    alone = mapping_error(found.camera, DECENTRED)
    rays = found.camera.rays(found.field.ideal(pixels))
    truth = DECENTRED.rays(pixels)
    # up to a rotation, which the solution does not know
    left, _, right = np.linalg.svd(truth.T @ rays)
    apart = LENS.fx * np.linalg.norm(rays @ (left @ right).T - truth, axis=1)
    assert np.sqrt(np.mean(apart**2)) < 0.8 * alone
    # what is written alone has what it leaves over in its sigma
    assert found.picture.rms > found.rays_sigma_px and alone < 2 * found.picture.rms


# the kind of lens

@pytest.fixture(scope='module')
def brown():
    """A radial lens that was asked to be a decentred one."""
    scenes = scenes_of(3, start=Brown.centred(SIZE, 1.03 * LENS.fx, -0.25))
    return solved(scenes, CONFIG.replace({'model': 'brown'}))


def test_a_model_that_is_asked_for_is_kept(brown):
    assert type(brown.camera) is Brown and mapping_error(brown.camera, LENS) < 1.0


def test_a_model_that_was_asked_for_is_weak_where_the_turns_choose_one_far_from_it():
    taken = as_model(LENS, Fisheye)
    scenes = [synthetic_turn(LENS, yaw, world=world, tracks=140, keyframes=12).scene(taken, world)
              for world, yaw in enumerate((80, -70))]
    found = solved(scenes, CONFIG.replace({'model': 'fisheye'}))
    assert type(found.camera) is Fisheye
    tried = {each.model: each for each in found.tried}
    assert [name for name, each in tried.items() if each.chosen] == ['brown']
    verdict = judge(found, CONFIG.verdict)
    far = str(verdict.reasons[verdict.codes.index('E-ANOTHER-MODEL')])
    assert 'brown' in far and 'fisheye' in far
    assert f' {found.px * tried["fisheye"].apart_px:.1f} px' in far and ' 0.0 px' not in far
    own = tuple(each if each.chosen else replace(each, apart_px=None) for each in found.tried)
    assert 'far apart' in judge(replace(found, tried=own), CONFIG.verdict).main_text


def test_a_model_with_fewer_coefficients_is_weak_where_the_picture_needs_them(brown):
    def codes(apart_px: float) -> tuple[str, ...]:
        written = replace(brown.written, apart_px=apart_px)
        return judge(replace(brown, written=written), CONFIG.verdict).codes

    assert 'E-ANOTHER-MODEL' not in codes(1.9 * brown.rays_sigma_px)
    assert 'E-ANOTHER-MODEL' in codes(2.1 * brown.rays_sigma_px)


def test_a_fisheye_is_recovered_beyond_90_degrees():
    scenes = wide_scenes(3)
    assert np.arccos(np.nanmin(WIDE.rays(scenes[0].tracks.xy)[..., 2])) > np.radians(80)
    found = solved(scenes)
    assert type(found.camera) is Fisheye
    assert mapping_error(found.camera, WIDE) < max(2.0 * found.picture.rms, 0.3)
    # points beside the camera are used, too
    used = found.scenes[0].structure
    local = used.points @ used.rotations.transpose(0, 2, 1) + used.translations[:, None]
    assert used.used[local[:, :, 2] < 0.2 * np.linalg.norm(local, axis=2)].any()


@pytest.mark.thorough
def test_turns_that_may_be_of_two_kinds_are_tried_with_both():
    scenes = wide_scenes(2)
    narrow = as_model(WIDE, Radial)
    unsure = Profile(np.array([0.2, 0.3, 0.4]), np.array([2.0, 1.5, 1.8]), 100)
    scenes = [replace(scene, rivals=(Start(unsure, narrow),)) for scene in scenes]
    # one turn was taken for that of a pinhole
    first = synthetic_turn(WIDE, 80.0, world=0, tracks=150, keyframes=16).scene(narrow, 0)
    scenes[0] = replace(first, rivals=(Start(scenes[0].profile, scenes[0].camera),))
    found = solved(scenes)
    assert type(found.camera) is Fisheye
    pinhole = next(each for each in found.tried if each.model != 'fisheye')
    assert pinhole.loses_by > 30


def test_a_pinhole_that_all_turns_were_taken_for_a_fisheye_is_one():
    taken = as_model(LENS, Fisheye)
    sure = Profile(np.array([0.5, 0.65, 0.8]), np.array([1.2, 1.0, 1.3]), 100)
    turns = [synthetic_turn(LENS, yaw, world=world, tracks=120, keyframes=14)
             for world, yaw in enumerate((80, -70, 85))]
    scenes = [replace(turn.scene(taken, world), rivals=(Start(sure, LENS),))
              for world, turn in enumerate(turns)]
    found = solved(scenes)
    assert found.camera.family == 'pinhole' and mapping_error(found.camera, LENS) < 1.0


NARROW = Radial(SIZE, 720.0, 721.0, 407.0, 219.0, -0.25, 0.08)


@pytest.mark.parametrize(('pinhole', 'fisheye', 'costs', 'noise_px', 'chosen'), [
    (LENS, WIDE, (1000.0, 970.0), 1.0, Radial),
    (replace(LENS, k1=-0.6), WIDE, (1000.0, 970.0), 1.0, Fisheye),
    (LENS, WIDE, (1000.0, 500.0), 0.03, Fisheye),
    (LENS, WIDE, (1000.0, 500.0), 0.003, Radial),
    (NARROW, as_model(NARROW, Fisheye), (1000.0, 500.0), 0.03, Radial)], ids=[
        'a little better', 'the pinhole folds over', 'much better', 'by what is no pixel',
        'but alike'])
def test_a_fisheye_must_be_better_by_what_only_a_fisheye_can_be(
        monkeypatch, pinhole, fisheye, costs, noise_px, chosen):
    seen = SimpleNamespace(tracks=SimpleNamespace(seen=np.ones((20, 100), bool)))
    kinds = [SimpleNamespace(camera=camera, inflation=1.0, loss_px=lambda: 1.0, scenes=[seen] * 3,
                             noise=lambda loss_px: SimpleNamespace(variance=noise_px**2),
                             imaging=imaging_with(camera))
             for camera in (pinhole, fisheye)]
    of_kind = dict(zip((Radial, Fisheye), costs, strict=True))
    monkeypatch.setattr(evidence, 'costs_left_out', lambda kind, loss_px: dict.fromkeys(
        map(TurnId.at, range(3)), of_kind[type(kind.camera)]))
    found, tried = evidence.chosen_kind(kinds)
    assert type(found.camera) is chosen
    assert [each.chosen for each in tried] == [kind is found for kind in kinds]


@pytest.mark.thorough
def test_a_narrow_lens_that_all_turns_took_for_a_fisheye_is_a_pinhole():
    # in the field of a fisheye p1 and p2 become an error of the centre
    extra = (0.003, -0.003, 0.02)
    found = solved(scenes_of(3, NARROW, start=as_model(NARROW, Fisheye), extra=extra, tracks=120,
                             keyframes=12))
    assert type(found.camera) is Brown
    assert (np.abs(found.camera.params - [*NARROW.params, *extra])[:4] < 3 * found.sigma[:4]).all()


@pytest.mark.parametrize(('ratio', 'sigmas', 'doubted'), [
    (1.05, 11.0, True), (1.05, None, True), (1.6, 11.0, False), (1.05, 9.0, False)])
def test_a_fisheye_is_doubted_where_a_pinhole_far_from_it_is_nearly_as_good(
        brown, ratio, sigmas, doubted):
    pinhole = Candidate('radial', 500.0, sigmas and sigmas * brown.picture.rms, False, ratio)
    fisheye = replace(with_camera(brown, WIDE), bounds=np.array([WIDE.params - 1,
                                                                 WIDE.params + 1]),
                      tried=(pinhole, Candidate('fisheye', 0.0, 0.0, True)))
    assert ('E-LENS-AMBIGUOUS' in judge(fisheye, CONFIG.verdict).codes) == doubted


@pytest.mark.parametrize(('left', 'other', 'folds', 'doubted'), [
    (0.03, 2.5, True, False), (0.9, 4.3, True, True), (0.03, 2.5, False, True),
    (0.03, 0.5, True, True)])
def test_a_fisheye_is_not_doubted_for_a_pinhole_that_folds_over_even_behind_a_windscreen(
        brown, left, other, folds, doubted):
    pinhole = Candidate('brown', 291.0, 11.0 * brown.picture.rms, False, 1.02, other, folds)
    fisheye = replace(with_camera(brown, WIDE), bounds=np.array([WIDE.params - 1,
                                                                 WIDE.params + 1]),
                      tried=(pinhole, Candidate('fisheye', 0.0, 0.0, True, 1.0, left)))
    assert ('E-LENS-AMBIGUOUS' in judge(fisheye, CONFIG.verdict).codes) == doubted


@pytest.mark.parametrize(('loses_by', 'doubted'), [(20.0, True), (400.0, False)])
def test_a_decentred_pinhole_is_doubted_where_a_fisheye_is_nearly_as_good(
        brown, loses_by, doubted):
    fisheye = Candidate('fisheye', loses_by, 11.0 * brown.picture.rms, False, 1.02)
    tried = (fisheye, Candidate('brown', 0.0, 0.0, True))
    codes = judge(replace(brown, tried=tried), CONFIG.verdict).codes
    assert ('E-LENS-AMBIGUOUS' in codes) == doubted


def test_what_one_turn_alone_says_is_not_clear():
    assert is_clear(np.array([20.0, 15.0, 18.0]))
    assert not is_clear(np.array([90.0, -3.0, -2.0]))
    assert not is_clear(np.array([90.0, 2.0, -1.0, -2.0]))
    assert not is_clear(np.array([5.0, 4.0, 6.0]))
