# SPDX-License-Identifier: Apache-2.0
"""Scenes -> a camera, sigmas that are honest, and a verdict for every kind of evidence."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from solving import (
    CONFIG,
    START,
    only,
    scenes_of,
    solved,
    with_camera,
    with_covariance,
    with_turns,
    z_of,
)
from synthetic import LENS, SIZE, SyntheticTurn, rotation, synthetic_turn

from dashcalib_ros.camera import Radial
from dashcalib_ros.camera.field import TERMS, Field
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import Turn, TurnId
from dashcalib_ros.formats import calibrated_camera
from dashcalib_ros.input.motion import Samples, SensorStream
from dashcalib_ros.input.scale import FULL_SIZE, Scale
from dashcalib_ros.judge.agreement import (
    STOOD,
    focal_disagreement,
    leverages,
    outdated,
    separate_bends,
    turns_of_another_camera,
)
from dashcalib_ros.judge.conclude import Evidence, conclude, outlook
from dashcalib_ros.judge.verdict import Grounds, judge, profile_contrast, sigma_too_large
from dashcalib_ros.reconstruct.adjust import Solver, adjust
from dashcalib_ros.reconstruct.scene import (
    Profile,
    Scene,
    residuals_px,
    retriangulated,
    truncated_cost,
)
from dashcalib_ros.solve import joint, solve, start
from dashcalib_ros.solve.optimise import Estimate, with_points_settled
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.solve.start import misfits, profile_around, retriangulate, summed

at, stored = TurnId.at, TurnId.stored


@pytest.fixture(scope='module')
def good() -> Solution:
    return solved(scenes_of(3, outliers=0.03))


def test_straight_stretches_beside_turns_say_nothing_about_other_focal_lengths(monkeypatch):
    probed = []

    def around(scenes, *others):
        probed.append([scene.turn for scene in scenes])
        return profile_around(scenes, *others)

    monkeypatch.setattr(joint, 'profile_around', around)
    turns = scenes_of(2, tracks=110, keyframes=9)
    straight = synthetic_turn(LENS, 1.0, keyframes=9, tracks=110, world=9).scene(START, 2)
    solution = solved([*turns, straight])
    assert [scene.turn for scene in solution.scenes] == [at(0), at(1), at(2)]
    assert probed == [[at(0), at(1)]]


# the adjustment

def built(scene: Scene, limits_px: Sequence[float] = (2.0, 2.0, 2.0)) -> Scene:
    """Return the scene as finish_scene() leaves it: with a focal length and k1, k2 of its own."""
    reach = (scene.camera.fx / 1.3, scene.camera.fx * 1.3)
    for limit_px in limits_px:
        [scene], camera = adjust([retriangulated(scene, scene.camera, limit_px, 0.3)],
                                 scene.camera, Solver(limit_px / 4), 'one focal length', reach)
        scene = retriangulated(scene, camera, limit_px, 0.3)
    return scene


@pytest.mark.parametrize(('cx', 'cy'), [(0.64, 0.5), (0.5, 0.72)])
def test_a_picture_of_which_a_side_was_cut_off_is_calibrated(no_profile, cx, cy):
    width, height = SIZE
    cut = replace(LENS, cx=cx * width, cy=cy * height)
    scenes = [built(scene, (16.0, 8.0, 2.0)) for scene in scenes_of(
        3, cut, start=Radial.centred(SIZE, 1.03 * LENS.fx, -0.2), tracks=110, keyframes=11)]
    solution = solved(scenes)
    assert np.abs(z_of(solution, cut)).max() < 3
    assert solution.sigma[0] < 0.02 * LENS.fx


def test_equations_that_nothing_solves_give_no_solution(monkeypatch):
    def singular(*_):
        raise np.linalg.LinAlgError('Singular matrix')

    scenes = scenes_of(2, tracks=60, keyframes=7)
    monkeypatch.setattr(joint, '_with_all_tracks', singular)
    assert solve(scenes, CONFIG) is None


def test_turns_that_all_lose_their_points_give_no_solution(monkeypatch, no_profile):
    retriangulated, calls, limit = Estimate.retriangulated, [], 100

    def without_turns(self, least_px=0.0):
        calls.append(least_px)
        found = retriangulated(self, least_px)
        return found if len(calls) < limit else replace(found, stretches=())
    monkeypatch.setattr(Estimate, 'retriangulated', without_turns)
    scenes = scenes_of(2, tracks=60, keyframes=7)
    assert solve(scenes, CONFIG) is not None
    # wherever in the solution that happens
    for limit in range(1, len(calls) + 1):
        calls.clear()
        assert solve(scenes, CONFIG) is None and len(calls) >= limit


def test_three_turns_give_all_six_within_three_sigma(good):
    assert np.abs(z_of(good)).max() < 3
    assert good.sigma[0] / LENS.fx < 0.01
    # and sigma is not just large
    assert np.abs(good.camera.params[:4] - LENS.params[:4]).max() < 5
    assert np.abs(good.camera.params[4:] - LENS.params[4:]).max() < 0.01
    assert 0.25 < good.reprojection_error_px < 0.5
    assert [scene.turn for scene in good.scenes] == [at(0), at(1), at(2)]
    assert good.centred.fx == good.centred.fy and good.centred.cx == (SIZE[0] - 1) / 2
    ratio = LENS.fx / SIZE[0]
    assert good.coarse.best == pytest.approx(ratio, rel=0.1)
    assert np.argmin(good.around.costs) not in (0, len(good.around.costs) - 1)
    assert judge(good, CONFIG.verdict).level == 'accepted', judge(good, CONFIG.verdict)


def test_the_covariance_is_one(good):
    correlation = good.covariance / np.outer(good.sigma, good.sigma)
    np.testing.assert_allclose(correlation, correlation.T, atol=1e-4)
    assert (np.linalg.eigvalsh(correlation) > 0).all()


def test_the_same_again_to_the_last_bit(no_profile):
    first, second = (solved(scenes_of(2, tracks=60, keyframes=8)) for _ in range(2))
    np.testing.assert_array_equal(first.camera.params, second.camera.params)
    np.testing.assert_array_equal(first.covariance, second.covariance)


@pytest.mark.thorough
def test_more_turns_know_more(no_profile):
    few, many = (solved(scenes_of(count, tracks=110, keyframes=12)) for count in (2, 6))
    # three times the turns: 1.7 times, and less Student's t
    ratio = few.sigma[:4] / many.sigma[:4]
    assert (ratio > 1.2).all() and ratio.max() < 8
    assert np.abs(z_of(many)).max() < 3.5


@pytest.mark.thorough
def test_sigma_is_honest(no_profile):
    z = np.array([z_of(solved(scenes_of(3, seed=seed, tracks=90, keyframes=10)))[:6]
                  for seed in range(12)])
    assert (np.abs(z[:, 0]) < 2).mean() >= 0.85
    assert (np.abs(z) < 2).mean() >= 0.9 and (np.abs(z) < 3).all()
    # neither too small nor so large that it says nothing; fy is drawn to fx by the prior
    spread = np.sqrt(np.mean(z**2, axis=0))
    assert (spread > 0.25).all() and (spread < 1.3).all()


def test_pixels_that_are_not_square_are_believed_when_the_evidence_is_strong(no_profile):
    tall = replace(LENS, fy=1.006 * LENS.fx)
    scenes = scenes_of(4, tall, noise_px=0.1, tracks=150, keyframes=12)
    camera = solved(scenes).camera
    assert camera.fy / camera.fx == pytest.approx(1.006, abs=0.0015)
    # and square ones where it is not, and one has more faith
    faith = CONFIG.replace({'intrinsics.aspect_sigma': 1e-5})
    camera = solved(scenes_of(2, tracks=80, keyframes=10), faith).camera
    assert camera.fy / camera.fx == pytest.approx(1.0, abs=3e-4)


def test_a_scene_that_knows_nothing_is_dropped_and_told(no_profile):
    scenes = scenes_of(3, tracks=100)
    lost = replace(scenes[1], tracks=replace(
        scenes[1].tracks,
        xy=np.random.default_rng(1).uniform(20, 430, scenes[1].tracks.xy.shape)))
    hopeless = CONFIG.replace({'scene.error_px': 0.2, 'scene.min_angle_deg': 10.0})
    solution = solve([lost], hopeless)
    assert solution is None or judge(solution, hopeless.verdict).level != 'accepted'
    nothing = replace(scenes[1], tracks=replace(
        scenes[1].tracks, xy=np.full_like(scenes[1].tracks.xy, np.nan)))
    assert solve([nothing], CONFIG) is None
    solution = solve([scenes[0], nothing, scenes[2]], CONFIG)
    assert [scene.turn for scene in solution.scenes] == [at(0), at(2)]
    assert np.isfinite(solution.sigma).all()


def test_a_scene_far_from_the_common_focal_length_is_brought_to_it(no_profile):
    scenes = scenes_of(2, tracks=150)
    wide = replace(scenes[1], camera=Radial.centred(SIZE, 0.7 * LENS.fx, -0.2))
    camera = solved([scenes[0], wide]).camera
    assert camera.fx == pytest.approx(LENS.fx, rel=0.01)


def test_profiles_add_up_by_their_observations():
    ratios = np.geomspace(0.3, 1.2, 9)
    strong = Profile(ratios, 0.2 + np.log(ratios / 0.6)**2, 900)
    weak = Profile(ratios, 0.2 + np.log(ratios / 0.9)**2, 100)
    both = summed([strong, weak])
    expected = 0.9 * np.log(0.6) + 0.1 * np.log(0.9)
    # straight lines between the samples: half a step of the grid
    assert np.log(both.best) == pytest.approx(expected, abs=0.09)
    assert both.observations == 1000
    # profiles that share no range still add up
    apart = summed([Profile(np.array([0.3, 0.4]), np.array([1.0, 2.0]), 10),
                    Profile(np.array([0.5, 0.6]), np.array([2.0, 1.0]), 10)])
    assert 0.3 <= apart.best <= 0.6
    single = Profile(np.array([0.5]), np.array([1.0]), 10)
    assert summed([single]).best == pytest.approx(0.5)


def test_a_turn_that_no_focal_length_explains_does_not_outvote_a_gentle_bend():
    ratios = np.geomspace(0.3, 1.2, 9)
    gentle = Profile(ratios, 0.9 + 0.05 * np.log(ratios / 0.6)**2, 500)
    broken = Profile(ratios, 2.2 + np.log(ratios / 1.1)**2, 500)
    assert summed([gentle, broken]).best == pytest.approx(0.6, rel=0.1)
    assert summed([broken]).best == pytest.approx(1.1, rel=0.1)


def test_points_settle_where_their_observations_ask_for_them(good):
    scene, camera = good.scenes[0], good.camera
    rng = np.random.default_rng(0)
    away = scene.structure.points * (1 + 0.005 * rng.normal(size=scene.structure.points.shape))
    moved = replace(scene, structure=replace(scene.structure, points=away))
    loss_px = 0.5

    def cost(scene: Scene) -> float:
        found = residuals_px(scene, camera)[scene.structure.used]
        return float(np.log1p(np.sum(found**2, axis=1) / loss_px**2).sum())

    settled = with_points_settled(moved, camera, loss_px)
    assert cost(moved) > 1.5 * cost(scene)
    assert cost(settled) < 1.001 * cost(scene)
    np.testing.assert_array_equal(settled.structure.rotations, scene.structure.rotations)


# the verdict

def levels(solution: Solution, config: Config = CONFIG) -> tuple[str, dict[str, str]]:
    """Return the level of the verdict, and its reasons by their codes."""
    verdict = judge(solution, config.verdict)
    return verdict.level, dict(zip(verdict.codes, map(str, verdict.reasons), strict=True))


def changed(solution: Solution, **changes: float) -> Solution:
    return with_camera(solution, replace(solution.camera, **changes))


def test_a_good_solution_is_accepted_without_reasons(good):
    assert levels(good) == ('accepted', {})


def test_one_turn_is_weak(good):
    level, reasons = levels(only(good, [0]))
    assert level == 'weak' and 'only 1 of at least 2 turns' in reasons['E-FEW-TURNS']


def test_one_turn_s_sigma_allows_for_how_much_turns_differ(no_profile):
    """Single turns of real drives differ by 0.6 to 2 % in fx; their noise says 0.3 %."""
    lone = solved(scenes_of(1, tracks=100))
    bold = replace(lone, posterior=lone.posterior.alike)
    assert bold.sigma[0] < 0.01 * LENS.fx
    assert bold.sigma[0] < 0.9 * lone.sigma[0] < 0.014 * LENS.fx
    # what a turn knows apart from fx stays
    assert lone.sigma[2] < 1.1 * bold.sigma[2]
    evidence = Evidence(SIZE, 100, (), {}, np.zeros((0, 2)), None, FULL_SIZE, {})
    found = conclude(lone, evidence, CONFIG)
    assert found.verdict.codes[0] == 'E-FEW-TURNS'
    assert solved(scenes_of(2, tracks=100)).sigma[0] < lone.sigma[0]


def narrowed(scene: Scene, yaw_deg: float) -> Scene:
    rotations = np.array([rotation(1, np.radians(yaw_deg) * n / 13).T for n in range(14)])
    return replace(scene, structure=replace(scene.structure, rotations=rotations))


@pytest.mark.parametrize(('yaw_deg', 'level'), [(2.0, 'weak'), (12.0, 'weak'),
                                                (40.0, 'accepted')])
def test_too_little_yaw(good, yaw_deg, level):
    solution = replace(good, scenes=tuple(narrowed(scene, yaw_deg) for scene in good.scenes))
    assert solution.scenes[0].yaw_deg == pytest.approx(yaw_deg, abs=1e-3)
    found, reasons = levels(solution)
    assert found == level
    assert (f'{3 * yaw_deg:.0f}°' in reasons.get('E-LITTLE-YAW', '')) == (level != 'accepted')


def with_profile(solution: Solution, ratios: Sequence[float], costs: Sequence[float]) -> Solution:
    """Return the solution with other costs at so many times its focal length."""
    return replace(solution, around=replace(
        solution.around, ratios=solution.camera.fx / SIZE[0] * np.array(ratios),
        costs=np.array(costs)))


@pytest.mark.parametrize(('costs', 'contrast', 'level'), [
    ((0.302, 0.300, 0.301), 0.0033, 'refused'),
    ((0.31, 0.300, 0.309), 0.03, 'weak'),
    ((0.40, 0.300, 0.36), 0.2, 'accepted'),
    # longer focal lengths explain even more
    ((0.40, 0.300, 0.25), -0.1667, 'refused'),
    ((0.0, 0.0, 0.0), np.nan, 'refused'),
    ((np.nan, 0.2, 0.4), np.nan, 'refused')])
def test_a_flat_profile(good, costs, contrast, level):
    solution = with_profile(good, (0.8, 1.0, 1.25), costs)
    with np.errstate(invalid='ignore'):
        assert profile_contrast(solution) == pytest.approx(contrast, abs=0.001, nan_ok=True)
        found, reasons = levels(solution)
    assert found == level
    assert ('E-FLAT-PROFILE' in reasons) == (level != 'accepted')


@pytest.mark.parametrize(('yaw_deg', 'fixed', 'costs', 'weak'), [
    (10.0, True, (0.301, 0.300, 0.301), False), (10.0, False, (0.301, 0.300, 0.301), True),
    (90.0, True, (0.31, 0.300, 0.309), True), (10.0, True, (0.299, 0.300, 0.301), True)])
def test_of_gentle_stretches_without_a_stabiliser_sigma_decides(
        good, monkeypatch, yaw_deg, fixed, costs, weak):
    """The profile may only not contradict it, and they may scatter as their sigmas say."""
    monkeypatch.setattr(type(good.scenes[0]), 'yaw_deg', yaw_deg)
    _, reasons = levels(replace(with_profile(good, (0.8, 1.0, 1.25), costs), fixed=fixed))
    assert ('E-FLAT-PROFILE' in reasons) == weak


def test_another_focal_length_that_explains_more(good):
    level, reasons = levels(with_profile(good, (0.8, 1.0, 1.25, 1.9), (0.5, 0.4, 0.5, 0.2)))
    assert level == 'refused'
    assert f'about {1.9 * good.camera.fx:.0f} px' in reasons['E-TWO-FOCAL-LENGTHS']
    level, reasons = levels(with_profile(good, (0.5, 0.8, 1.0, 1.25), (0.9, 0.5, 0.4, 0.5)))
    assert (level, reasons) == ('accepted', {})


@pytest.mark.parametrize(('relative', 'level'), [
    (0.01, 'accepted'), (0.03, 'weak'), (0.2, 'refused'), (np.inf, 'refused'),
    (np.nan, 'refused')])
def test_sigma_too_large(good, relative, level):
    wide = good.covariance.copy()
    wide[0, 0] = (relative * good.camera.fx)**2
    found = sigma_too_large(Grounds(with_covariance(good, wide), CONFIG.verdict))
    assert (found.level, found.code) == (level, 'E-LARGE-SIGMA')
    assert found.condition.met == (level == 'accepted')
    assert found.limit == f'at most {100 * CONFIG.verdict.max_sigma:.3g} %'


@pytest.mark.parametrize(('rise', 'asked'), [(0.5, [20, 20, 20]), (0.02, [20] * 3 + [80] * 3)])
def test_more_tracks_are_asked_where_another_focal_length_is_close(monkeypatch, rise, asked):
    [scene] = scenes_of(1, tracks=150)
    seen: list[int] = []

    def cost_at(scenes, camera, _):
        seen.append(scenes[0].tracks.xy.shape[1])
        return 1.0 if camera.fx == LENS.fx else 1.0 + rise

    monkeypatch.setattr(start, '_cost_at', cost_at)
    coarse = Profile(np.array([LENS.fx / SIZE[0]]), np.array([1.0]), 1)
    profile_around([scene], LENS, coarse, CONFIG.replace({'intrinsics.profile_tracks': 20}))
    assert seen == asked


def test_points_at_small_angles_do_not_speak_for_a_shorter_focal_length():
    """With it all angles are larger, so that more of them would be above a fixed least angle."""
    config = CONFIG.replace({'scene.min_angle_deg': 10.0})
    scene = retriangulate(synthetic_turn().scene(LENS), LENS, config.scene)
    assert 0.4 < np.mean(scene.structure.used.any(axis=0)) < 0.6
    ratio = LENS.fx / SIZE[0]
    coarse = Profile(ratio * np.array([0.9, 1.0, 1.1]), np.array([2.0, 1.0, 2.0]), 1000)
    shorter, result, _ = profile_around([scene], LENS, coarse, config).costs
    assert shorter > 1.1 * result


@pytest.mark.parametrize('others, level', [(0.5, 'accepted'), (0.01, 'weak')])
def test_where_one_turn_knows_all_the_others_confirm_nothing(good, others, level):
    """A sharp turn and gentle bends: what the bends say moves nothing, so nothing scatters."""
    solution = with_turns(good, [
        replace(turn, hessian=turn.hessian * (others if n else 1.0),
                by_track=turn.by_track * (others if n else 1.0))
        for n, turn in enumerate(good.posterior.turns)])
    shares = leverages(solution)
    assert sum(shares.values()) == pytest.approx(1.0)
    found, reasons = levels(solution)
    assert found == level and ('E-ONE-TURN-DOMINATES' in reasons) == (level == 'weak')
    if level == 'weak':
        assert shares[at(0)] > 0.9 and 'the turn at frame 0' in reasons['E-ONE-TURN-DOMINATES']


def test_turns_that_disagree_are_weak(good):
    step = np.zeros(len(good.posterior.prior.score))
    step[:2] = 0.08 * LENS.fx
    solution = with_turns(good, [
        replace(turn, score=turn.score + side * turn.hessian @ step)
        for turn, side in zip(good.posterior.turns, (1, -1, 0), strict=True)])
    assert focal_disagreement(good) < 0.01 < 0.03 < focal_disagreement(solution)
    level, reasons = levels(solution)
    assert level == 'weak' and 'E-TURNS-DISAGREE' in reasons
    assert focal_disagreement(only(good, [0])) == 0.0
    # the same values, each known to 20 % only
    unsure = with_turns(solution, [
        replace(turn, score=turn.score / 1e6, hessian=turn.hessian / 1e6,
                by_track=turn.by_track / 1e6) for turn in solution.posterior.turns])
    assert focal_disagreement(unsure) > 0.03 and focal_disagreement(unsure, True) == 0.0
    assert focal_disagreement(solution, True) > 0.03


@pytest.mark.parametrize('name', ['fx', 'cy', 'k2'])
def test_a_parameter_on_its_bound(good, name):
    index = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2').index(name)
    for side in (0, 1):
        level, reasons = levels(changed(good, **{name: float(good.bounds[side][index])}))
        assert level != 'accepted' and f' {name} ' in reasons['E-PARAMETER-LIMIT']


def test_a_distortion_that_folds_over(good):
    level, reasons = levels(changed(good, k1=-0.5, k2=0.0))
    assert level != 'accepted' and 'E-FOLDS-OVER' in reasons


@pytest.mark.parametrize(('last', 'at_rest'), [(0.4, True), (0.6, False)])
def test_a_search_that_did_not_come_to_rest_is_weak(good, last, at_rest):
    assert good.unsettled < 0.1
    level, reasons = levels(replace(good, unsettled=last))
    assert (level == 'accepted') == at_rest == ('E-NOT-CONVERGED' not in reasons)


def test_refused_tells_the_doubts_too(good):
    solution = replace(changed(good, k1=-0.5, k2=0.0), around=replace(
        good.around, costs=np.ones_like(good.around.costs)))
    level, reasons = levels(solution)
    assert level == 'refused' and {'E-FLAT-PROFILE', 'E-FOLDS-OVER'} <= set(reasons)
    assert '\n' not in ''.join(reasons.values())


def test_turns_through_different_lenses_are_not_accepted():
    other = replace(LENS, fx=1.15 * LENS.fx, fy=1.15 * LENS.fx)
    second = Radial.centred(SIZE, 1.03 * other.fx, -0.25)
    few = {'tracks': 90, 'keyframes': 10}
    scenes = [*scenes_of(2, **few), *scenes_of(4, other, start=second, **few)[2:]]
    verdict = judge(solved(scenes), CONFIG.verdict)
    assert verdict.level != 'accepted', verdict


@pytest.mark.parametrize(('factor', 'least', 'used'), [
    (0.8, 0.3, 4), pytest.param(1.1, 0.3, 4, marks=pytest.mark.thorough), (2.2, 0.6, 3)])
def test_a_turn_of_another_camera_is_not_outvoted_in_silence(no_profile, factor, least, used):
    """The loss ignores it, so it causes no scatter; far enough off, it is dropped even."""
    other, few = replace(LENS, fx=factor * LENS.fx, fy=factor * LENS.fx), {
        'tracks': 110, 'keyframes': 10}
    scenes = [built(scene) for scene in
              [*scenes_of(3, start=LENS, **few), *scenes_of(4, other, start=other, **few)[3:]]]
    solution = solved(scenes, CONFIG.replace({'scene.min_explained': least}))
    assert len(solution.scenes) == used
    assert turns_of_another_camera(solution.misfits) == {at(3)}
    assert max(solution.misfits[at(center)] for center in range(3)) < 1.5
    level, reasons = levels(solution)
    assert level != 'accepted' and 'the turn at frame 3 ' in reasons['E-ANOTHER-CAMERA']


@pytest.mark.parametrize(('turns', 'odd', 'gone'), [
    (set(), set(), set()), ({at(5)}, {at(5)}, set()),
    ({at(0), at(1), at(2)}, set(), set()),
    # the newest turn is as most are
    ({stored(0), at(0), at(1), at(2)}, {stored(0), at(1)}, {stored(0), at(1)}),
    # stored turns are older, whatever their order: one turn of this drive may be traffic
    ({stored(0), stored(1), at(1)}, {stored(1), at(1)}, set()),
    ({stored(0), stored(1), at(1)}, {stored(0), at(1)}, set()),
    ({stored(0), at(1), at(2)}, {at(1), at(2)}, {stored(0)}),
    ({at(0), at(1), at(2)}, {at(2)}, set()),  # is it a new camera, or traffic?
    ({at(0), at(1), at(2), at(30)}, {at(2), at(30)}, {at(0), at(1)})])  # the camera has changed
def test_the_newest_turns_tell_which_camera_is_the_present_one(turns, odd, gone):
    assert outdated(turns, odd) == gone


def test_images_that_went_astray_come_back():
    alone = scenes_of(2, start=LENS)
    translations = alone[0].structure.translations.copy()
    translations[-3:] += 2.0
    astray = [retriangulated(replace(alone[0], structure=replace(
        alone[0].structure, translations=translations)), LENS, 2.0, 0.3), alone[1]]
    before, mended = misfits(alone, astray, LENS, 2.0), start.with_better_poses(
        astray, alone, LENS, CONFIG.scene)
    after = misfits(alone, mended, LENS, 2.0)
    assert before[at(0)] > 5 and max(after.values()) < 1.1
    assert mended[0].explained > 0.98 > 0.9 > astray[0].explained
    # what is well is left as it is
    again = start.with_better_poses(mended, alone, LENS, CONFIG.scene)
    assert [new is old for new, old in zip(again, mended, strict=True)] == [True, True]


def test_misfits_are_ratios_of_costs():
    [first, second] = scenes_of(2, start=LENS)
    off = replace(LENS, fx=1.05 * LENS.fx)
    found = misfits([first, second], [replace(first, camera=off)], off, 2.0)
    assert found[at(0)] > 3 and list(found) == [at(0), at(1)]
    whole = retriangulated(second, LENS, 2.0, min_angle_deg=0.0)
    assert found[at(1)] == pytest.approx(4.0 / truncated_cost(whole, LENS, 2.0))
    assert misfits([first], [first], LENS, 2.0) == {at(0): 1.0}


@pytest.mark.parametrize(('misfits', 'text'), [
    ({at(5): 1.9, at(9): 0.4}, ''), ({at(5): 2.1}, 'the turn at frame 5 fits'),
    ({stored(0): 9.0}, '1 turn of ear'),
    ({stored(0): 9.0, stored(1): np.nan}, '2 turns of earlier drives fit another'),
    ({at(9): 3.0, at(5): 3.0, stored(0): 3.0},
     'the turns at frame 5, 9 and 1 turn of earlier drives fit an')])
def test_who_fits_another_camera_is_named(good, misfits, text):
    level, reasons = levels(replace(good, misfits=misfits))
    assert level == ('weak' if text else 'accepted')
    assert text in reasons.get('E-ANOTHER-CAMERA', '')


def test_a_drive_that_is_nearly_straight_is_not_accepted():
    scenes = [synthetic_turn(LENS, yaw, 10, 100, 0.25, world=n).scene(START, n)
              for n, yaw in enumerate((2.0, -1.5, 1.0))]
    verdict = judge(solved(scenes), CONFIG.verdict)
    assert verdict.level != 'accepted' and 'E-LITTLE-YAW' in verdict.codes


def test_a_turn_without_a_step_aside_is_not_accepted():
    """A camera that only rotates sees no depth: points may be anywhere along their rays."""
    turn = synthetic_turn(LENS, 80.0, 10, 100, 0.25)
    still = turn.structure.translations * 1e-3
    local = (turn.structure.points @ turn.structure.rotations.transpose(0, 2, 1)
             + still[:, None])
    local[local[:, :, 2] < 1.0] = np.nan
    xy = LENS.project(local) + 0.25 * np.random.default_rng(1).standard_normal(
        local[..., :2].shape)
    xy[~turn.tracks.seen] = np.nan
    spin = SyntheticTurn(replace(turn.tracks, xy=xy), replace(turn.structure, translations=still))
    solution = solve([spin.scene(LENS)], CONFIG)
    assert solution is None or judge(solution, CONFIG.verdict).level != 'accepted'


# what the user gets

def evidence_for(solution: Solution | None, scale: Scale = FULL_SIZE, turns: int = 3,
                 frames: int = 500) -> Evidence:
    built = {scene.turn: scene for scene in solution.scenes} if solution else {}
    return Evidence(
        (round(SIZE[0] * scale.px), round(SIZE[1] * scale.px)), frames,
        tuple(Turn(n, n - 5, n + 5, n / 10, 0.05) for n in range(turns)), built,
        np.zeros((0, 2)), None, scale, {'detect': 1.0, 'calibrate': 2.0, 'total': 3.0})


def test_a_refused_solution_gives_no_numbers(good):
    bad = replace(good, around=replace(good.around, costs=np.ones_like(good.around.costs)))
    calibration = conclude(bad, evidence_for(bad), CONFIG)
    assert calibration.verdict.level == 'refused'
    assert calibration.intrinsics is None and calibration.sigma is None
    assert calibration.reprojection_error_px is None


@pytest.mark.parametrize(('share', 'used'), [(0.9, False), (1.1, True)])
def test_a_field_is_used_from_its_sigma_on(good, share, used):
    def with_field(size):
        field = Field(SIZE, np.full((2, len(TERMS)), size))
        return replace(good, written=replace(good.written, field=field))

    unit = with_field(1.0)
    rms_px = np.sqrt(np.mean(unit.field.over(unit.camera)**2))
    bent = with_field(share * unit.rays_sigma_px / rms_px)
    found = conclude(bent, evidence_for(bent), CONFIG)
    assert found.field.rms_px == pytest.approx(share * found.field.sigma_px)
    assert found.field.used == used and ('smooth field' in repr(found)) == used
    assert (calibrated_camera(found).field is not None) == used
    # its sigma is 1 px
    assert [each.code for each in found.warnings] == ['E-FIELD-LARGE'] * used


def test_what_the_turns_contradict_or_leave_open_is_told(good, monkeypatch):
    def told(config=CONFIG):
        return [(each.code, each) for each in conclude(good, evidence_for(good), config).warnings]
    [(code, line)] = told(CONFIG.replace({'known.fx': '600±5'}))
    assert code == 'E-KNOWN-CONTRADICTED' and 'known.fx' in str(line) and '600' in str(line)
    for share, codes in ((0.04, []), (0.3, ['E-PIXELS-SQUARE'])):
        monkeypatch.setattr(type(good.posterior), 'rival_share', share)
        assert [code for code, _ in told()] == codes


def test_a_model_that_was_asked_for_and_does_not_do_is_told_of(good):
    asked = CONFIG.replace({'model': 'radial'})
    assert not conclude(good, evidence_for(good), asked).warnings
    refused = replace(good, around=replace(good.around, costs=np.ones_like(good.around.costs)))
    [warning] = conclude(refused, evidence_for(refused), asked).warnings
    assert warning.code == 'E-MODEL-CHOSEN' and 'radial' in str(warning) and 'auto' in str(warning)


@pytest.mark.parametrize(('turns', 'frames', 'code', 'number'), [
    (0, 0, 'E-FEW-IMAGES', '0 images'), (0, 1, 'E-FEW-IMAGES', '1 image'),
    (0, 500, 'E-NO-TURN', ''), (3, 500, 'E-NO-SCENE', '3 turns')])
def test_no_solution_is_refused_with_the_reason(turns, frames, code, number):
    calibration = conclude(None, evidence_for(None, FULL_SIZE, turns, frames), CONFIG)
    assert calibration.verdict.level == 'refused' and calibration.verdict.codes == (code,)
    assert number in str(calibration.verdict.reasons[0])
    assert calibration.intrinsics is None and calibration.sigma is None
    assert len(calibration.turns) == turns and not any(t.used for t in calibration.turns)


def test_turns_that_determine_no_camera_are_not_called_dark(good):
    seen = replace(evidence_for(good), frames=500)
    assert conclude(None, seen, CONFIG).verdict.codes == ('E-UNDETERMINED',)
    # all of them are left out
    for why, code in (('dark', 'E-NO-SCENE'), (STOOD, 'E-CAR-STOOD')):
        dark = replace(seen, left_out=dict.fromkeys(seen.built, why))
        assert conclude(None, dark, CONFIG).verdict.codes == (code,)


def test_the_end_of_a_sharp_bend_does_not_confirm_its_beginning(good):
    first = good.scenes[0]
    begin_ns, end_ns = first.tracks.stamps_ns[[0, -1]]

    def scene(begin_s, right_deg):
        tracks = SimpleNamespace(stamps_ns=np.array([begin_s, begin_s + 4]) * 10**9)
        return SimpleNamespace(turn=TurnId.at(round(10 * begin_s)), tracks=tracks,
                               right_deg=right_deg, yaw_deg=abs(right_deg))

    for others, bends in (([(4.1, 10.0)], 1), ([(4.1, 10.0), (8.2, 80.0)], 1),
                          ([(4.1, -10.0)], 2), ([(9.0, 80.0)], 2), ([(4.1, 10.0), (20, 5.0)], 2)):
        scenes = [scene(0.0, 88.0), *(scene(*each) for each in others)]
        assert separate_bends(scenes) == separate_bends(scenes[::-1]) == bends
    assert separate_bends([scene(0.0, 20.0), scene(4.1, 20.0)]) == 2

    after = replace(first, turn=TurnId.at(999), tracks=replace(
        first.tracks, stamps_ns=first.tracks.stamps_ns + (end_ns - begin_ns) + 10**8))
    found = outlook([first, after], evidence_for(good), CONFIG.verdict).verdict
    assert found.codes[0] == 'E-FEW-TURNS' and 'of one bend' in str(found.reasons[0])


def test_the_outlook_counts_turns_and_angles_as_the_verdict_does(good):
    seen, limits = evidence_for(good), CONFIG.verdict

    def codes(scenes, **changes):
        found = outlook(scenes, replace(seen, **changes), limits).verdict
        return found.level, found.codes
    assert codes(good.scenes) == ('accepted', ())
    assert codes(good.scenes[:1]) == ('weak', ('E-FEW-TURNS',))
    gyro = SensorStream(rate=Samples(np.zeros(2), np.zeros((2, 3))))
    assert codes(good.scenes[:1], motion=gyro) == ('accepted', ())
    limits = replace(limits, min_yaw_deg=500.0)
    assert codes(good.scenes) == ('weak', ('E-LITTLE-YAW',))
    assert codes([]) == ('refused', ('E-UNDETERMINED',))
    assert codes([], built={}) == ('refused', ('E-NO-SCENE',))


def test_turns_are_summed_up_in_the_order_of_the_drive(good):
    calibration = conclude(good, evidence_for(good, turns=5), CONFIG)
    assert [turn.center for turn in calibration.turns] == [0, 1, 2, 3, 4]
    assert [turn.used for turn in calibration.turns] == [True, True, True, False, False]
    used = calibration.turns[0]
    assert used.images == used.registered == 14
    assert used.yaw_deg == pytest.approx(80, abs=3) and 0.2 < used.reprojection_error_px < 0.6
    assert calibration.turns[4].yaw_deg is None


@pytest.mark.parametrize('scale', [
    Scale(), Scale(shrink=2), Scale(shrink=4), Scale(enlarge=2), Scale(enlarge=3)], ids=str)
def test_the_camera_sees_in_the_input_what_it_sees_in_resized_images(good, scale):
    calibration = conclude(good, evidence_for(good, scale), CONFIG)
    camera, px = calibration.camera, scale.px
    assert camera.image_size == calibration.image_size
    points = np.array([[0.3, -0.2, 1.0], [-2.0, 1.1, 4.0], [0.0, 0.0, 2.0]])
    resized = good.camera.project(points)
    # frames/scale.py: pixel x of a resized image is (x + 0.5) px - 0.5 of the input
    np.testing.assert_allclose(camera.project(points), (resized + 0.5) * px - 0.5, atol=1e-9)
    np.testing.assert_allclose(
        [calibration.sigma[name] for name in ('fx', 'cy', 'k1')],
        good.sigma[[0, 3, 4]] * [px, px, 1])
    assert calibration.reprojection_error_px == pytest.approx(
        good.reprojection_error_px * px)
    assert calibration.turns[0].reprojection_error_px == pytest.approx(
        px * conclude(good, evidence_for(good), CONFIG).turns[0].reprojection_error_px)


def test_residuals_are_projected_minus_seen(good):
    scene = good.scenes[0]
    k, t = np.argwhere(scene.structure.used)[7]
    local = (scene.structure.rotations[k] @ scene.structure.points[t]
             + scene.structure.translations[k])
    np.testing.assert_allclose(residuals_px(scene, good.camera)[k, t],
                               good.camera.project(local) - scene.tracks.xy[k, t])
