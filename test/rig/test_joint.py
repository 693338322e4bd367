# SPDX-License-Identifier: Apache-2.0
"""Rigs of made paths: exact truth, noise, lenses that are off, clocks of their own."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_rig import SPEED, Mounted, made_paths

from dashcalib_ros.camera.rotation import OPTICAL, rotation_matrices, rotation_vectors
from dashcalib_ros.config import RigConfig
from dashcalib_ros.rig import joint
from dashcalib_ros.rig.joint import Matched, Solved, solved
from dashcalib_ros.rig.moved import changes
from dashcalib_ros.rig.paths import CameraPaths
from dashcalib_ros.rig.placed import (
    Alone,
    PlacedCamera,
    apart_doubts,
    base_camera,
    base_doubts,
    best_base,
    jump_doubts,
    lens_doubts,
    misnamed,
    placed,
    rig_of_paths,
    why_not_aligned,
)
from dashcalib_ros.rig.start import Metres, aligned, problem_of

CAMERAS = {
    'front': Mounted(step_s=0.25),
    'rear': Mounted((2.0, 177.5, 1.5), (0.3, -0.2, -2.0), 3.35, 0.25, 0.06),
    'left': Mounted((3.0, 75.0, -2.0), (-0.5, 0.1, 1.0), -0.02, 0.25, 0.02)}
METRES = Metres(lambda seconds: np.full(len(seconds), SPEED))


def rig_of(names=('front', 'rear'), metres=METRES, **options) -> tuple[Solved, dict]:
    cameras = {name: CAMERAS[name] for name in names}
    paths, _ = made_paths(cameras, **options)
    found = {name: aligned(paths[name], paths['front']) for name in names[1:]}
    assert all(each is not None and each.found for each in found.values())
    return solved(problem_of(paths, 'front', found, metres)), cameras


def errors(best: Solved, name: str) -> np.ndarray:
    """Return (7,) how far a camera's place is off: rad, m, s."""
    place, truth = best.problem.places[name], CAMERAS[name]
    return np.r_[rotation_vectors((place.rotation @ truth.rotation.T)[None])[0],
                 place.translation_m - truth.translation_m, place.late_s - truth.late_s]


def test_places_are_found_to_within_their_sigmas():
    off = []
    for seed in range(4):
        best, _ = rig_of(yaws=(85.0, -75.0), seed=seed, lens_sigma=0.5)
        off.append(errors(best, 'rear') / best.sigma('rear')[:7])
        assert np.degrees(best.sigma('rear')[:3]).max() < 0.25
        assert abs(errors(best, 'rear')[6]) < 1e-3
    off = np.array(off)
    assert np.mean(np.abs(off) < 2) > 0.85 and np.abs(off).max() < 3.5
    # and they are not much too large
    assert np.sqrt(np.mean(off**2)) > 0.3


def test_known_lenses_make_a_sharp_rig():
    best, _ = rig_of(('front', 'rear', 'left'), yaws=(85.0, -75.0), lens_sigma=0.01)
    for name in ('rear', 'left'):
        assert np.degrees(best.sigma(name)[:3]).max() < 0.04
        assert np.abs(np.degrees(errors(best, name)[:3])).max() < 0.06
        assert np.abs(errors(best, name)[[3, 5]]).max() < 0.03


def test_a_rotation_about_the_vertical_is_known_no_better_than_the_lenses():
    sharp, _ = rig_of(yaws=(85.0, -75.0), lens_sigma=0.01)
    dull, _ = rig_of(yaws=(85.0, -75.0), lens_sigma=1.0)
    # each lens is off by 0.1 degrees
    assert np.degrees(dull.sigma('rear')[1]) > 0.1 > 2 * np.degrees(sharp.sigma('rear')[1])


def test_a_flat_road_shows_no_height_and_no_metres_without_a_speed():
    best, _ = rig_of(yaws=(85.0, -75.0), lens_sigma=0.3)
    assert best.sigma('rear')[4] > 3 * best.sigma('rear')[[3, 5]].max()
    found = placed('rear', 'rear/result.json', best, 0.0, 0.0, RigConfig())
    assert found.visible.rotation == ('accepted',) * 3 and found.verdict == 'accepted'
    assert found.translation_m is not None and abs(found.translation_m[2] + 2.0) < 0.05
    strict = placed('rear', '', best, 0.0, 0.0, RigConfig(rotation_deg=1e-3, clock_s=1e-6))
    assert strict.verdict == 'refused' and strict.visible.clock == 'not visible'
    assert {'E-RIG-ROTATION', 'E-RIG-CLOCK'} == {each.code for each in strict.reasons} - {
        each.code for each in found.reasons}
    best, _ = rig_of(yaws=(85.0, -75.0), metres=None)
    found = placed('rear', 'rear/result.json', best, None, 0.0, RigConfig())
    assert found.translation_m is None and found.verdict == 'accepted'
    assert 'E-RIG-NO-METRES' in [reason.code for reason in found.reasons]


def test_one_stretch_or_a_refused_lens_is_weak():
    best, _ = rig_of(yaws=(85.0,))
    found = placed('rear', '', best, 0.0, 0.0, RigConfig())
    assert found.verdict == 'weak'
    assert 'E-RIG-ONE-STRETCH' in [reason.code for reason in found.reasons]
    best, _ = rig_of(yaws=(85.0, -75.0))
    assert not lens_doubts('rear', 'accepted') and not base_doubts('rear', 'front', ())
    for doubts, code in ((lens_doubts('rear', 'refused'), 'E-RIG-LENS'),
                         (base_doubts('rear', 'front', lens_doubts('front', 'weak')),
                          'E-RIG-BASE')):
        found = placed('rear', '', best, 0.0, 0.0, RigConfig(), doubts)
        assert found.verdict == 'weak' and found.rotation_deg is not None
        assert [reason.code for reason in found.reasons] == [code]


def test_cameras_that_look_elsewhere_than_they_are_called_are_named():
    def looking(**yaws_left):
        return {name: PlacedCamera('', 'accepted', (0.0, float(yaw), 0.0), (0.1, 0.1, 0.1))
                for name, yaw in yaws_left.items()}

    def named(ahead_deg=0.0, **yaws_left):
        car = rotation_matrices(np.radians([[0.0, 0.0, ahead_deg]]))[0] @ OPTICAL
        found = misnamed(looking(**yaws_left), car)
        assert all(each.code == 'E-RIG-SIDE' for each in found)
        return [str(each).split()[0] for each in found]

    assert not named(front=0, left=70, rear=178, side=100)
    # of a stereo pair, and where the base looks back
    assert not named(left=0, right=0.5) and not named(180.0, rear=0, front=180)
    assert named(front=0, left=-80, right=75) == ['left', 'right']
    assert named(180.0, front=0, rear=179) == ['front', 'rear']


@pytest.mark.parametrize('level', ['weak', 'refused'])
def test_a_base_is_no_surer_than_its_lens(level):
    found = base_camera('front/result.json', lens_doubts('front', level))
    assert found.verdict == 'weak' and [each.code for each in found.reasons] == ['E-RIG-LENS']
    assert base_camera('front/result.json').verdict == 'accepted'


@pytest.mark.parametrize('seed', [0, 1])
def test_a_rotation_belongs_to_the_lenses_as_their_own_turns_say(seed):
    cameras = {name: CAMERAS[name] for name in ('front', 'rear')}
    paths, lenses = made_paths(cameras, yaws=(85.0, -75.0), seed=seed)
    best = solved(problem_of(
        paths, 'front', {'rear': aligned(paths['rear'], paths['front'])}, METRES))
    # the two parameters that turn the axes, about y and about x
    front, rear = (rotation_matrices(np.radians([[-0.1 * lens[1], -0.1 * lens[0], 0.0]]))[0]
                   for lens in lenses.values())
    expected = rear @ cameras['rear'].rotation @ front.T
    off = rotation_vectors((best.problem.places['rear'].rotation @ expected.T)[None])[0]
    own = np.sqrt(np.diag(best.covariance)[best.problem.where['rear']][:3])
    assert np.all(np.abs(off) < 3 * own) and np.degrees(own).max() < 0.08
    # the lenses themselves are off by more than that
    assert np.abs(np.degrees(errors(best, 'rear')[:3])).max() > np.degrees(own).max()


def test_lenses_that_paths_contradict_are_named():
    paths, lenses = made_paths({name: CAMERAS[name] for name in ('front', 'rear')},
                               yaws=(85.0, -75.0), lens_sigma=3.0)
    found = {'rear': aligned(paths['rear'], paths['front'])}
    best = solved(problem_of(paths, 'front', found, METRES))
    assert not apart_doubts('rear', best) and not apart_doubts('front', best)
    # a lens that its own turns call much better than it is
    own = paths['rear'].lens_covariance
    paths['rear'] = replace(paths['rear'], lens_covariance=own / 10**2)
    paths['front'] = replace(paths['front'], lens_covariance=own / 10**2)
    assert abs(lenses['rear'][2] - lenses['front'][2]) > 0.5
    best = solved(problem_of(paths, 'front', found, METRES))
    assert 'E-RIG-LENS-APART' in [each.code for name in ('front', 'rear')
                                  for each in apart_doubts(name, best)]


def test_a_scene_that_is_broken_spoils_no_other():
    paths, _ = made_paths({name: CAMERAS[name] for name in ('front', 'rear')}, lens_sigma=0.1)
    found = {'rear': aligned(paths['rear'], paths['front'])}
    sound = solved(problem_of(paths, 'front', found, METRES))
    scenes = list(paths['rear'].scenes)
    half = scenes[2].trajectory.rotations.copy()
    half[len(half) // 2:] = rotation_matrices(np.radians([[2.0, 2.0, 0.0]]))[0] @ half[
        len(half) // 2:]
    scenes[2] = replace(scenes[2], trajectory=replace(scenes[2].trajectory, rotations=half))
    paths['rear'] = replace(paths['rear'], scenes=tuple(scenes))
    best = solved(problem_of(paths, 'front', found, METRES))
    assert len(best.problem.pairs) == len(sound.problem.pairs) - 1
    # the pace of the clock apart, which the last turn tells
    assert np.all(best.sigma('rear')[:7] < 2 * sound.sigma('rear')[:7])


def test_a_camera_that_was_moved_between_two_turns_is_not_accepted():
    paths, _ = made_paths({name: CAMERAS[name] for name in ('front', 'rear')},
                          yaws=(85.0, -75.0), lens_sigma=0.1)
    moved = paths['rear'].scenes[1]
    turned = rotation_matrices(np.radians([[0.0, 0.0, 1.0]]))[0]
    trajectory = replace(moved.trajectory, rotations=turned @ moved.trajectory.rotations,
                         translations=moved.trajectory.translations @ turned.T)
    paths['rear'] = replace(paths['rear'], scenes=(
        paths['rear'].scenes[0], replace(moved, trajectory=trajectory)))
    found = {'rear': aligned(paths['rear'], paths['front'])}
    best = solved(problem_of(paths, 'front', found, METRES))
    result = placed('rear', '', best, 0.0, 0.0, RigConfig())
    assert result.verdict != 'accepted'
    assert 'E-RIG-DISAGREE' in [reason.code for reason in result.reasons]


@pytest.mark.parametrize('turn', [0, 1, 2])
@pytest.mark.parametrize('degrees', [0.3, 0.5, 3.0])
def test_a_camera_that_was_moved_within_a_turn_is_named(turn, degrees):
    paths, _ = made_paths({name: CAMERAS[name] for name in ('front', 'rear')}, lens_sigma=0.3)
    bump = rotation_matrices(np.radians([[0.6, 0.6, 0.53]]) * degrees)[0]
    scenes = list(paths['rear'].scenes)
    for n in range(turn, len(scenes)):
        path = scenes[n].trajectory
        later = slice(len(path.rotations) // 2 if n == turn else 0, None)
        rotations, translations = path.rotations.copy(), path.translations.copy()
        rotations[later] = bump @ rotations[later]
        translations[later] = translations[later] @ bump.T
        scenes[n] = replace(scenes[n], trajectory=replace(
            path, rotations=rotations, translations=translations))
    found = {'rear': aligned(paths['rear'], paths['front'])}
    sound = solved(problem_of(paths, 'front', found, METRES))
    assert not jump_doubts('rear', sound)
    paths['rear'] = replace(paths['rear'], scenes=tuple(scenes))
    best = solved(problem_of(paths, 'front', found, METRES))
    doubts = jump_doubts('rear', best)
    assert not jump_doubts('front', best)
    result = placed('rear', '', best, 0.0, 0.0, RigConfig(), doubts)
    if result.verdict == 'accepted':
        # a first turn that is broken is left out: later ones show where the camera sits now
        after = bump @ CAMERAS['rear'].rotation
        off = rotation_vectors((best.problem.places['rear'].rotation @ after.T)[None])[0]
        assert turn == 0 and best.problem.broken and np.all(
            np.abs(off) < 3 * best.sigma('rear')[:3])
    else:
        assert {'E-RIG-JUMP', 'E-RIG-DISAGREE'} & {reason.code for reason in result.reasons}


def test_a_clip_of_another_drive_does_not_turn_alike():
    front, _ = made_paths({'front': CAMERAS['front']}, yaws=(85.0, -75.0))
    other, _ = made_paths({'rear': CAMERAS['rear']}, yaws=(25.0, 30.0, 28.0), seed=3)
    found = aligned(other['rear'], front['front'])
    assert found is None or not found.found
    assert why_not_aligned('rear', 'front', found, None).code in (
        'E-RIG-OTHER-DRIVE', 'E-RIG-NO-SHARED')
    assert aligned(CameraPaths('rear', (), np.zeros((0, 0))), front['front']) is None
    assert why_not_aligned('rear', 'front', None, 'rear').code == 'E-RIG-NO-SCENES'


@pytest.mark.parametrize('late_s', [-12.0, 0.0, 7.31])
def test_clocks_are_found_wherever_videos_start(late_s):
    cameras = {'front': CAMERAS['front'], 'left': replace(CAMERAS['left'], late_s=late_s)}
    paths, _ = made_paths(cameras, yaws=(85.0, -75.0, 60.0))
    found = aligned(paths['left'], paths['front'])
    assert found is not None and found.found and abs(found.late_s - late_s) < 0.03


@pytest.mark.parametrize(('turns', 'near_s', 'found_it'), [
    (2, 0.0, True), (1, 0.0, False), (1, 9.0, True), (1, None, True)])
def test_one_turn_alone_does_not_say_that_clocks_are_far_apart(turns, near_s, found_it):
    cameras = {'front': CAMERAS['front'], 'left': replace(CAMERAS['left'], late_s=9.0)}
    paths, _ = made_paths(cameras, yaws=(85.0, -75.0))
    left = replace(paths['left'], scenes=paths['left'].scenes[:turns])
    found = aligned(left, paths['front'], near_s)
    assert found is not None and abs(found.late_s - 9.0) < 0.03
    assert found.found == found_it
    assert found_it or why_not_aligned('left', 'front', found, None).code == 'E-RIG-AMBIGUOUS'


def test_a_turn_to_the_other_side_is_another_drive():
    # an upright camera cannot see the car turn to the other side
    front, _ = made_paths({'front': CAMERAS['front']}, yaws=(85.0, -75.0, 60.0))
    left, _ = made_paths({'left': CAMERAS['left']}, yaws=(-85.0, 75.0, -60.0))
    found = aligned(left['left'], front['front'])
    assert found is not None and found.other_side and not found.found
    assert why_not_aligned('left', 'front', found, None).code == 'E-RIG-OTHER-SIDE'


def of_paths(paths, levels=None, base='front'):
    """Return the rig of made paths, as a whole; levels: of lenses that are not accepted."""
    alone = {name: Alone(name, (levels or {}).get(name, 'accepted'), 0.0, len(each.scenes))
             for name, each in paths.items()}
    turned = {name: aligned(paths[name], paths[base]) for name in paths if name != base}
    return rig_of_paths(alone, base, turned, paths, METRES, RigConfig())


def codes_of(camera):
    return [reason.code for reason in camera.reasons]


def test_a_clip_of_another_car_is_named_and_the_others_stand():
    paths, _ = made_paths(CAMERAS, yaws=(85.0, -75.0))
    other, _ = made_paths({'left': CAMERAS['left']}, yaws=(25.0, 60.0, -30.0), seed=3)
    found = of_paths({**paths, **other})
    assert found.cameras['rear'].verdict == 'accepted' == found.cameras['front'].verdict
    assert found.cameras['left'].verdict == 'refused' and found.cameras['left'].rotation is None
    assert set(codes_of(found.cameras['left'])) <= {
        'E-RIG-OTHER-DRIVE', 'E-RIG-NO-SHARED', 'E-RIG-OTHER-SIDE'}
    assert all(str(each).startswith('left') for each in found.cameras['left'].reasons)
    # of the base, which then agrees with nobody
    found = of_paths({'left': other['left'], 'front': paths['front']}, base='left')
    assert found.cameras['front'].rotation is None and not found.accepted


def test_a_camera_that_is_refused_gets_its_rotation_and_the_others_stand():
    paths, _ = made_paths(CAMERAS, yaws=(85.0, -75.0))
    found = of_paths(paths, {'left': 'refused'})
    assert found.cameras['rear'].verdict == 'accepted' == found.cameras['front'].verdict
    left = found.cameras['left']
    assert left.verdict == 'weak' and codes_of(left) == ['E-RIG-LENS']
    off = rotation_vectors((left.rotation @ CAMERAS['left'].rotation.T)[None])[0]
    assert np.all(np.abs(np.degrees(off)) < 3.5 * np.array(left.rotation_sigma_deg))
    # where nothing of it could be reconstructed, it is said about whom
    empty = replace(paths['left'], scenes=())
    found = of_paths({**paths, 'left': empty}, {'left': 'refused'})
    assert found.cameras['rear'].verdict == 'accepted'
    assert codes_of(found.cameras['left']) == ['E-RIG-NO-SCENES']
    found = of_paths({**paths, 'left': empty}, {'left': 'refused'}, base='left')
    assert [str(each.reasons[0]).split(':')[0] for each in found.cameras.values()] == ['left'] * 3
    assert 'E-RIG-NO-SCENES' in codes_of(found.cameras['front'])


@pytest.mark.parametrize(('one', 'other'), [('front', 'left'), ('left', 'rear')])
def test_two_cameras_exchanged_in_the_command_are_named(one, other):
    names = {one: other, other: one}
    paths, _ = made_paths({name: CAMERAS[names.get(name, name)] for name in CAMERAS},
                          yaws=(85.0, -75.0))
    before, _ = made_paths(CAMERAS, yaws=(85.0, -75.0), seed=1)
    found = changes(of_paths(paths), of_paths(before))
    assert found.answer == 'wrong' and set(found.exchanged) == {one, other}


@pytest.mark.parametrize(('base', 'seed'), [('left', 5), ('rear', 0)])
def test_lever_arms_are_found_wherever_scenes_have_their_origin(base, seed):
    paths, _ = made_paths(CAMERAS, yaws=(85.0, -75.0), seed=seed, lens_sigma=0.1)
    found, own = of_paths(paths, base=base), CAMERAS[base]
    for name, camera in found.cameras.items():
        truth = CAMERAS[name]
        true = truth.translation_m - truth.rotation @ own.rotation.T @ own.translation_m
        off = (np.array(camera.translation_m) - true)[[0, 2]]
        assert camera.verdict == 'accepted' and np.abs(off).max() < 0.06


def test_a_rig_that_does_not_settle_is_not_accepted(monkeypatch):
    paths, _ = made_paths({name: CAMERAS[name] for name in ('front', 'rear')}, yaws=(85.0, -75.0))
    monkeypatch.setattr(joint, 'STEPS', 8)
    monkeypatch.setattr(joint, 'SETTLED', 1e-12)
    found = of_paths(paths)
    assert not found.accepted and codes_of(found.cameras['rear'])[0] == 'E-RIG-UNSETTLED'


def test_matches_are_observations_of_cameras_and_lenses():
    cameras = {name: CAMERAS[name] for name in ('front', 'left')}
    paths, _ = made_paths(cameras, yaws=(85.0, -75.0), lens_sigma=0.3)
    found = {'left': aligned(paths['left'], paths['front'])}
    problem = problem_of(paths, 'front', found, METRES)
    true, plain = CAMERAS['left'].rotation, solved(problem)
    noise, nothing = np.radians(0.02), np.zeros((3, 3))
    sharp = Matched('front', 'left', true, noise**2 * np.eye(3),
                    {'front': nothing, 'left': nothing})
    best = solved(replace(problem, matched=(sharp,)))
    assert np.degrees(best.sigma('left')[:3]).max() < 0.03 < np.degrees(
        plain.sigma('left')[:3]).max()
    assert np.abs(np.degrees(errors(best, 'left')[:3])).max() < 0.06
    # what depends on a lens that is not known says little
    dull = replace(sharp, follow={'front': nothing, 'left': np.eye(3)})
    np.testing.assert_allclose(solved(replace(problem, matched=(dull,))).sigma('left')[:3],
                               plain.sigma('left')[:3], rtol=0.2)
    # between two cameras of which none is the base
    paths, _ = made_paths(CAMERAS, yaws=(85.0, -75.0), lens_sigma=0.3)
    turned = {name: aligned(paths[name], paths['front']) for name in ('left', 'rear')}
    across = CAMERAS['rear'].rotation @ true.T
    problem = replace(problem_of(paths, 'front', turned, METRES), matched=(replace(
        sharp, a='left', b='rear', rotation=across, follow={'left': nothing, 'rear': nothing}),))
    places = solved(problem).problem.places
    off = rotation_vectors((places['rear'].rotation @ places['left'].rotation.T @ across.T)[None])
    assert np.abs(np.degrees(off)).max() < 0.06


def test_the_base_is_the_first_camera_whose_lens_is_accepted():
    assert best_base({'front': 'refused', 'left': 'weak', 'rear': 'accepted'}) == 'rear'
    assert best_base({'front': 'accepted', 'left': 'accepted'}) == 'front'
    assert best_base({'front': 'refused', 'left': 'weak', 'rear': 'weak'}) == 'left'
