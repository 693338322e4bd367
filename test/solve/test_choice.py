"""Which model the turns prove, and how far the camera may be off over the picture."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, scenes_of, solved
from synthetic import LENS, SIZE, synthetic_turn

from dashcalib_ros.camera import Brown, Fisheye, Radial
from dashcalib_ros.camera.mapping import as_model, mapping_error
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.reconstruct.scene import Profile, Start
from dashcalib_ros.solve.knowledge import Knowledge, is_clear, scatter_between_turns
from dashcalib_ros.solve.normal import turn_cost
from dashcalib_ros.solve.quadratic import Quadratic
from dashcalib_ros.solve.solution import Candidate

pytestmark = pytest.mark.usefixtures('no_profile')

WIDE = Fisheye(SIZE, 300.0, 300.6, 404.0, 221.0, 0.02, -0.008, 0.003, -0.0005)
DECENTRED = Brown(SIZE, *LENS.params, 0.003, -0.003, 0.0)


def wide_scenes(count: int, tracks: int = 220):
    start = Fisheye.centred(SIZE, 1.02 * WIDE.fx, 0.0)
    return [synthetic_turn(WIDE, yaw, world=world, tracks=tracks, keyframes=16).scene(start, world)
            for world, yaw in enumerate((80.0, -70.0, 85.0, -90.0)[:count])]


@pytest.mark.parametrize('count', [3, 5])
def test_a_decentred_lens_is_found(count):
    found = solved(scenes_of(count, extra=(0.003, -0.003, 0.0)))
    assert type(found.camera) is Brown
    assert mapping_error(found.camera, DECENTRED) < 1.0
    assert mapping_error(found.camera, DECENTRED) < 2.5 * found.picture.rms
    error = np.abs(found.camera.params - DECENTRED.params) / found.sigma
    assert (error[2:4] < 3).all()
    models = [each.model for each in found.tried]
    # a fisheye that still shows a shutter is no candidate
    assert models[0] == 'radial' and models[-1] == 'brown'
    assert found.tried[-1].loses_by == 0 and found.tried[0].loses_by > 30


@pytest.fixture(scope='module')
def brown():
    """A radial lens that was asked to be a decentred one."""
    scenes = scenes_of(3, start=Brown.centred(SIZE, 1.03 * LENS.fx, -0.25))
    return solved(scenes, CONFIG.replace({'model': 'brown'}))


def test_a_model_that_is_asked_for_is_kept(brown):
    scenes = scenes_of(2, extra=(0.003, -0.003, 0.0))
    assert type(solved(scenes, CONFIG.replace({'model': 'radial'})).camera) is Radial
    assert type(brown.camera) is Brown and mapping_error(brown.camera, LENS) < 1.0


def test_a_model_that_was_asked_for_is_weak_where_the_turns_choose_one_far_from_it():
    taken = as_model(LENS, Fisheye)
    scenes = [synthetic_turn(LENS, yaw, world=world, tracks=140, keyframes=12).scene(taken, world)
              for world, yaw in enumerate((80, -70))]
    found = solved(scenes, CONFIG.replace({'model': 'fisheye'}))
    assert type(found.camera) is Fisheye
    tried = {each.model: each for each in found.tried}
    assert [name for name, each in tried.items() if each.chosen] == ['radial']

    def objections(apart_px):
        own = replace(tried['fisheye'], apart_px=apart_px)
        solution = replace(found, tried=tuple({**tried, 'fisheye': own}.values()))
        return [reason for reason in judge(solution, CONFIG.verdict).reasons
                if 'a lens of the model' in reason]

    assert not objections(1.9 * found.picture.rms)
    far = objections(2.1 * found.picture.rms)
    assert len(far) == 1 and 'ask for a lens of the model radial, not fisheye' in far[0]
    assert 'far away' in objections(None)[0]


def test_a_model_that_has_the_chosen_one_in_it_is_as_right(brown):
    far = tuple(replace(each, chosen=each.model == 'radial', apart_px=99.0)
                for each in brown.tried)
    assert far and not any('a lens of the model' in reason for reason in judge(
        replace(brown, tried=far), CONFIG.verdict).reasons)


def test_one_turn_chooses_no_larger_model():
    found = solved(scenes_of(1, extra=(0.003, -0.003, 0.0)))
    assert type(found.camera) is Radial and not found.tried


def test_a_fisheye_is_recovered_beyond_90_degrees():
    scenes = wide_scenes(4)
    assert np.arccos(np.nanmin(WIDE.rays(scenes[0].tracks.xy)[..., 2])) > np.radians(80)
    found = solved(scenes)
    assert type(found.camera) is Fisheye
    assert mapping_error(found.camera, WIDE) < max(2.5 * found.picture.rms, 0.3)
    # points beside the camera are used, too
    used = found.scenes[0].structure
    local = used.points @ used.rotations.transpose(0, 2, 1) + used.translations[:, None]
    assert used.used[local[:, :, 2] < 0.2 * np.linalg.norm(local, axis=2)].any()


def test_turns_that_may_be_of_two_kinds_are_tried_with_both():
    scenes = wide_scenes(3)
    narrow = as_model(WIDE, Radial)
    unsure = Profile(np.array([0.2, 0.3, 0.4]), np.array([2.0, 1.5, 1.8]), 100)
    scenes = [replace(scene, rivals=(Start(unsure, narrow),)) for scene in scenes]
    # one turn was taken for that of a pinhole
    first = synthetic_turn(WIDE, 80.0, world=0, tracks=220, keyframes=16).scene(narrow, 0)
    scenes[0] = replace(first, rivals=(Start(scenes[0].profile, scenes[0].camera),))
    found = solved(scenes)
    assert type(found.camera) is Fisheye
    radial = next(each for each in found.tried if each.model == 'radial')
    assert radial.loses_by > 30


@pytest.mark.parametrize(('ratio', 'sigmas', 'doubted'), [
    (1.4, 11.0, True), (1.4, None, True), (1.6, 11.0, False), (1.4, 9.0, False)])
def test_a_fisheye_is_doubted_where_a_pinhole_far_from_it_is_nearly_as_good(
        brown, ratio, sigmas, doubted):
    pinhole = Candidate('radial', 500.0, sigmas and sigmas * brown.picture.rms, False, ratio)
    fisheye = replace(brown, camera=WIDE, bounds=np.array([WIDE.params - 1, WIDE.params + 1]),
                      tried=(pinhole, Candidate('fisheye', 0.0, 0.0, True)))
    reasons = judge(fisheye, CONFIG.verdict).reasons
    assert any('do not tell whether' in reason for reason in reasons) == doubted


@pytest.mark.parametrize(('loses_by', 'doubted'), [(20.0, True), (400.0, False)])
def test_a_decentred_pinhole_is_doubted_where_a_fisheye_is_nearly_as_good(
        brown, loses_by, doubted):
    fisheye = Candidate('fisheye', loses_by, 11.0 * brown.picture.rms, False, 1.2)
    tried = (fisheye, Candidate('brown', 0.0, 0.0, True))
    reasons = judge(replace(brown, tried=tried), CONFIG.verdict).reasons
    assert any('do not tell whether' in reason for reason in reasons) == doubted


def test_a_pinhole_that_all_turns_were_taken_for_a_fisheye_is_one():
    taken = as_model(LENS, Fisheye)
    sure = Profile(np.array([0.5, 0.65, 0.8]), np.array([1.2, 1.0, 1.3]), 100)
    scenes = [replace(synthetic_turn(LENS, yaw, world=world, tracks=200).scene(taken, world),
                      rivals=(Start(sure, LENS),)) for world, yaw in enumerate((80, -70, 85))]
    found = solved(scenes)
    assert type(found.camera) is Radial and mapping_error(found.camera, LENS) < 1.0


def test_the_wider_model_gains_only_where_the_lens_needs_it():
    def gains(extra):
        found = solved(scenes_of(4, extra=extra), CONFIG.replace({'model': 'radial'}))
        turns = tuple(turn_cost(scene, found.camera, 1.0) for scene in found.scenes)
        prior = Quadratic.prior(1e-9 * np.eye(6))
        return Knowledge(found.camera, turns, prior, np.zeros(6)).gains_of_wider_model
    assert gains((0.0, 0.0, 0.0)).sum() < 10
    assert is_clear(gains((0.002, -0.002, 0.0)))


def test_what_one_turn_alone_says_is_not_clear():
    assert is_clear(np.array([20.0, 15.0, 18.0]))
    assert not is_clear(np.array([90.0, -3.0, -2.0]))
    assert not is_clear(np.array([90.0, 2.0, -1.0, -2.0]))
    assert not is_clear(np.array([5.0, 4.0, 6.0]))


def test_turns_that_agree_scatter_as_their_noise():
    rng = np.random.default_rng(0)
    count, size = 200, 6
    roots = rng.normal(size=(count, size, size))
    hessians = roots @ roots.transpose(0, 2, 1)
    inverse = np.linalg.inv(hessians.sum(axis=0))
    whole = np.linalg.cholesky(inverse)
    scores = np.array([rng.multivariate_normal(np.zeros(size), h - h @ inverse @ h)
                       for h in hessians])
    for times in (1, 3):
        turns = [Quadratic(hessian, times * score, np.zeros((size, size)))
                 for hessian, score in zip(hessians, scores, strict=True)]
        assert scatter_between_turns(turns, inverse, whole) == pytest.approx(times**2, rel=0.15)


@pytest.mark.parametrize('seed', range(4))
def test_a_radial_lens_stays_one_and_its_sigma_over_the_picture_is_neither_blind_nor_timid(seed):
    found = solved(scenes_of(4, seed=seed))
    assert type(found.camera) is Radial and not found.tried
    off = mapping_error(found.camera, LENS)
    assert 0.15 * found.picture.rms < off < 2 * found.picture.rms
    assert found.picture.rms <= found.picture.worst < 2.0
