# SPDX-License-Identifier: Apache-2.0
"""How the camera sits on the car: made pairs of images, made turns, and what makes it weak."""
from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_calibration import MOUNT, make_calibration
from made_lines import made_lines
from scipy.spatial.transform import Rotation
from solving import LENS, scenes_of, solved, with_camera, with_covariance
from straight_pairs import HEIGHT_M, SPACING_S, SPEED, mounted, pairs_of
from synthetic import KEYFRAME_S

from dashcalib_ros import judge
from dashcalib_ros.config import Config
from dashcalib_ros.detect.straights import PAIRS, POINTS, StraightCollector, Straights
from dashcalib_ros.errors import Notice
from dashcalib_ros.formats import load_calibration
from dashcalib_ros.formats.ours import codes_of
from dashcalib_ros.input.scale import FULL_SIZE
from dashcalib_ros.judge import conclude
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.judge.mount import Speed, mount_of
from dashcalib_ros.report import write_results


@pytest.fixture(scope='module')
def solution():
    return solved(scenes_of(3))


def at(speed):
    return Speed(lambda stamps_s: np.full(len(stamps_s), speed), 0.0)


@pytest.mark.parametrize('angles', [(0.0, 0.0, 0.0), (3.5, -2.0, 1.0), (-2.5, 3.0, -3.0)])
def test_straights_tell_where_it_points(solution, angles):
    known = replace(with_camera(solution, LENS), scenes=())
    found = mount_of(pairs_of(mounted(*angles)), None, known, 'accepted', None)
    axis = np.degrees(np.arccos(np.clip(found.rotation[:, 2] @ mounted(*angles)[:, 2], -1, 1)))
    # without a turn or lines roll is unknown, and counts as none
    assert found.roll_right_deg is None and found.sigma['roll_right_deg'] is None
    assert axis < 0.15 + np.sin(np.radians(abs(angles[2]))) * np.hypot(*angles[:2])
    ahead = LENS.project(mounted(*angles).T[:, :1].T)[0]
    assert np.hypot(*(ahead - found.travel_px)) < 3 * found.travel_sigma_px


@pytest.mark.parametrize('angles', [(0.0, 0.0, 0.0), (3.5, -2.0, 0.0)])
def test_a_camera_that_looks_back_is_half_a_turn_about_the_vertical(solution, angles):
    known = replace(with_camera(solution, LENS), scenes=())
    pairs = pairs_of(mounted(*angles))
    ahead = mount_of(pairs, None, known, 'accepted', None)
    played_backwards = replace(pairs, before=pairs.after, after=pairs.before)
    back = mount_of(played_backwards, None, known, 'accepted', None)
    assert not ahead.rear and back.rear
    np.testing.assert_allclose(back.rotation, np.diag([-1, -1, 1]) @ ahead.rotation, atol=2e-3)
    assert back.verdict == ahead.verdict
    np.testing.assert_allclose(back.travel_px, ahead.travel_px, atol=1)


def test_mountings_are_apart_by_the_short_way_across_180_degrees():
    rear = replace(MOUNT, yaw_left_deg=-178.0)
    found = rear.apart(replace(MOUNT, yaw_left_deg=179.9))
    # MOUNT does not know its roll
    assert set(found) == {'yaw_left_deg', 'pitch_up_deg'}
    assert found['yaw_left_deg'] == pytest.approx((2.1, 0.1 * 2**0.5))


def test_a_car_that_drives_both_ways_does_not_say_where_it_looks(solution):
    known = replace(with_camera(solution, LENS), scenes=())
    pairs = pairs_of(mounted(1.0, 0.0, 0.0))
    turned = (np.arange(len(pairs)) % 5 < 2)[:, None, None]
    both = replace(pairs, before=np.where(turned, pairs.after, pairs.before),
                   after=np.where(turned, pairs.before, pairs.after))
    found = mount_of(both, None, known, 'accepted', None)
    assert found.verdict == 'weak' and codes_of(found.reasons)[-1] == 'E-MOUNT-DIRECTION'
    assert mount_of(pairs, None, known, 'accepted', None).reasons == ()


def test_points_that_stay_do_not_spoil_it(solution):
    known = replace(with_camera(solution, LENS), scenes=())
    found = mount_of(pairs_of(mounted(2.0, 1.0, 0.0), still=0.2), None, known, 'accepted',
                     None)
    assert abs(found.yaw_left_deg - 2.0) < 0.15 and abs(found.pitch_up_deg - 1.0) < 0.15


def on_road(scene, points=60, kerb_m=0.0, height_m=HEIGHT_M, unit=0.37):
    """Return a made turn, in other units, that sees points of the road, some beside its path."""
    rotations, centres = scene.structure.path()
    rng = np.random.default_rng(len(centres))
    at, beside = rng.integers(len(centres), size=points), rng.uniform(-4, 4, points)
    road = centres[at] + beside[:, None] * rotations[at, 0]
    road[:, 1] = height_m - kerb_m * (np.abs(beside) > 1.5)
    structure = replace(scene.structure, points=unit * road, used=np.ones((len(centres), points),
                                                                          bool),
                        translations=unit * scene.structure.translations)
    return replace(scene, structure=structure)


def speed_in(scene):
    """Return the speed of a made turn, which is the same everywhere, m/s."""
    _, centres = scene.structure.path()
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).max()) / KEYFRAME_S


def test_upright_lines_on_a_slope_do_not_outvote_the_turns(solution):
    none, lines = StraightCollector().straights(), made_lines(LENS)
    # a street up a hill: what is upright there leans by 3.4 degrees against the car
    angle = np.radians(3.4)
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = np.array([LENS.cx, LENS.cy])
    leaning = replace(lines, points=((lines.points - centre) @ turned.T + centre).astype('f4'))
    level, slope = (mount_of(none, seen, solution, 'accepted', None) for seen in (lines, leaning))
    assert abs(slope.roll_right_deg - level.roll_right_deg) < 0.4
    # alone against a single turn they may be right
    alone = replace(solution, scenes=solution.scenes[:1])
    found = mount_of(none, leaning, alone, 'accepted', None)
    assert found.sigma['roll_right_deg'] > 1.0


@pytest.fixture(scope='module')
def height_in(solution):
    """Return the function that returns the mount by scenes and a speed."""
    none = StraightCollector().straights()
    return lambda scenes, speed: mount_of(none, None, replace(solution, scenes=scenes),
                                          'accepted', speed)


def test_height_needs_a_speed_and_the_road(height_in):
    scene = scenes_of(1)[0]
    speed, seen = speed_in(scene), [on_road(scene)]
    without = height_in(seen, None)
    assert without.height_m is None and without.sigma['height_m'] is None
    found = height_in(seen, at(speed))
    assert found.height_m == pytest.approx(HEIGHT_M, rel=0.01)
    assert 0.01 * HEIGHT_M < found.sigma['height_m'] < 0.02 * HEIGHT_M
    # an error of speed is one of height
    fast = height_in(seen, at(speed * 4.0 / 3.6))
    assert fast.height_m / found.height_m == pytest.approx(4.0 / 3.6)
    assert height_in([on_road(scene, points=12)], at(speed)).height_m is None
    assert height_in(seen, at(0.0)).height_m is None
    vague = height_in(seen, replace(at(speed), sigma=0.03))
    assert vague.sigma['height_m']**2 == pytest.approx(
        found.sigma['height_m']**2 + (0.03 * found.height_m)**2)


def test_kerbs_beside_the_path_are_no_road(height_in):
    scene = scenes_of(1)[0]
    found = height_in([on_road(scene, points=300, kerb_m=0.3)], at(speed_in(scene)))
    assert found.height_m == pytest.approx(HEIGHT_M, rel=0.01)


def test_the_speed_in_a_bend_does_not_count(height_in):
    scene = scenes_of(1)[0]
    speed, stamps_s = speed_in(scene), scene.tracks.stamps_ns / 1e9

    def of_another_place(asked_s):
        middle = np.abs(asked_s - stamps_s.mean()) < 0.2 * np.ptp(stamps_s)
        return np.where(middle, 0.8 * speed, speed)

    found = height_in([on_road(scene)], Speed(of_another_place, 0.0))
    assert found.height_m == pytest.approx(HEIGHT_M, rel=0.01)


def test_a_speed_that_begins_within_the_turn_gives_no_wrong_height(height_in):
    scene = scenes_of(1)[0]
    speed, stamps_s = speed_in(scene), scene.tracks.stamps_ns / 1e9
    found = height_in([on_road(scene)], Speed(
        lambda asked_s: np.where(asked_s > stamps_s[2], speed, 0.0), 0.0))
    assert found.height_m == pytest.approx(HEIGHT_M, rel=0.01)


def test_heights_that_differ_make_sigma_larger(height_in):
    scene = scenes_of(1)[0]
    alike, apart = (height_in([on_road(scene), on_road(scene, height_m=other)],
                              at(speed_in(scene))) for other in (HEIGHT_M, 1.06 * HEIGHT_M))
    assert apart.height_m == pytest.approx(1.03 * HEIGHT_M, rel=0.01)
    assert apart.sigma['height_m'] > 2 * alike.sigma['height_m']


def test_pairs_of_a_braking_car_are_left_out(solution):
    known = replace(with_camera(solution, LENS), scenes=())
    steady, braking = (pairs_of(mounted(0.5, pitch, 0.0), count=30) for pitch in (1.0, -0.5))
    drive = joined(steady, braking)
    begins = drive.stamps_s[len(steady)] - SPACING_S

    def slower(stamps_s):
        return SPEED - 2.0 * np.maximum(stamps_s - begins, 0.0) % SPEED

    found = mount_of(drive, None, known, 'accepted', Speed(slower, 0.0))
    assert abs(found.pitch_up_deg - 1.0) < 0.15 and found.moved_s is None


def test_turns_alone_tell_all_angles(solution):
    none = StraightCollector().straights()
    found = mount_of(none, None, solution, 'accepted', None)
    for key in ('yaw_left_deg', 'pitch_up_deg', 'roll_right_deg'):
        assert abs(getattr(found, key)) < 2 * found.sigma[key] + 0.1, key
    # a crowned road of 2 % leans the car by 1.15 degrees in all turns alike
    assert 2 * found.sigma['roll_right_deg'] > 1.15
    assert found.straight_m == 0.0


def test_nothing_seen_is_no_mount(solution):
    assert mount_of(StraightCollector().straights(), None, replace(solution, scenes=()),
                    'accepted', None) is None


def test_it_is_never_better_than_the_lens(solution):
    pairs = pairs_of(mounted(1.0, 0.0, 0.0))
    known = replace(with_camera(solution, LENS), scenes=())
    assert mount_of(pairs, None, known, 'accepted', None).verdict == 'accepted'
    weak = mount_of(pairs, None, known, 'weak', None)
    assert weak.verdict == 'weak' and codes_of(weak.reasons) == ['E-MOUNT-LENS']
    assert mount_of(pairs, None, known, 'refused', None).verdict == 'weak'
    # 5 px of cy are half a degree of pitch, but not of the pixel of travel
    vague = np.array(solution.covariance)
    vague[3, 3] = 5.0**2
    found = mount_of(pairs, None, with_covariance(known, vague), 'accepted', None)
    assert found.verdict == 'weak' and codes_of(found.reasons) == ['E-MOUNT-SIGMA']
    assert 'drive more turns' in str(found.reasons[0])
    assert found.sigma['pitch_up_deg'] > np.degrees(5.0 / LENS.fy)
    assert found.travel_sigma_px == weak.travel_sigma_px


@pytest.fixture(scope='module')
def drives():
    none = StraightCollector().straights()
    return [none, *(pairs_of(mounted(*angles), count=count, noise_px=noise, seed=count)
                    for angles, count, noise in (((1.0, -2.0, 0.0), 20, 0.05),
                                                 ((0.0, 0.0, 0.0), 12, 0.3),
                                                 ((4.0, 4.0, 2.0), 8, 2.0)))]


@pytest.mark.thorough
@settings(max_examples=40, deadline=None)
@given(which=st.integers(0, 3), level=st.sampled_from(['weak', 'refused']),
       scale=st.floats(1e-8, 10.0), px=st.floats(0.5, 4.0), speed=st.floats(0.0, 40.0),
       turns=st.integers(0, 3))
def test_a_lens_that_is_not_accepted_never_has_an_accepted_mount(
        solution, drives, which, level, scale, px, speed, turns):
    known = replace(with_covariance(solution, scale * np.eye(len(solution.covariance))),
                    scenes=solution.scenes[:turns], px=px)
    found = mount_of(drives[which], None, known, level, at(speed) if speed else None)
    if found is None:
        assert which == 0 and turns == 0
        return
    assert found.verdict == 'weak' and codes_of(found.reasons)[0] == 'E-MOUNT-LENS'
    assert level in str(found.reasons[0])
    # with the same evidence, only sigma decides for an accepted lens
    better = mount_of(drives[which], None, known, 'accepted', None)
    known_well = max(better.sigma['yaw_left_deg'], better.sigma['pitch_up_deg']) <= 0.2
    assert (better.verdict == 'accepted') == known_well


def test_few_straights_say_to_drive_on(solution):
    known = replace(with_covariance(with_camera(solution, LENS), 1e-4 * np.eye(6)), scenes=())
    found = mount_of(pairs_of(mounted(0, 0, 0), count=10, noise_px=4.0), None, known, 'accepted',
                     None)
    assert found.verdict == 'weak' and codes_of(found.reasons) == ['E-MOUNT-SIGMA']
    assert 'drive straight on' in str(found.reasons[0])


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-30, 30)] * 3))
def test_the_quaternion_is_the_rotation(angles):
    mount = Mount('accepted', (), *angles, None, {}, (1.0, 2.0), 0.5, 100.0)
    assert np.allclose(Rotation.from_quat(mount.quaternion).as_matrix(), mounted(*angles))
    # the optical axis of a camera that looks to the left goes to the car's left
    left = np.sin(np.radians(angles[0])) * np.cos(np.radians(angles[1]))
    assert mount.rotation[1, 2] == pytest.approx(left)


def test_a_file_keeps_it(tmp_path):
    mount = Mount('weak', (Notice('E-MOUNT-SIGMA', 'thin'),), 1.0, -0.5, None, None, {
        'yaw_left_deg': 0.1, 'pitch_up_deg': 0.2, 'roll_right_deg': None, 'height_m': None},
        (600.5, 170.25), 0.7, 273.0)
    write_results(make_calibration(mount=mount), tmp_path)
    for name in ('result.json', 'calibration.yaml'):
        found = load_calibration(tmp_path / name).mount
        assert found == mount and codes_of(found.reasons) == ['E-MOUNT-SIGMA']
    path = tmp_path / 'result.json'
    data = json.loads(path.read_text())
    assert data['mount'].pop('reason_codes') == ['E-MOUNT-SIGMA']
    path.write_text(json.dumps(data))
    older = load_calibration(path).mount
    assert older == replace(mount, reasons=older.reasons)
    assert [*map(str, older.reasons)] == [*map(str, mount.reasons)]
    assert codes_of(older.reasons) == ['']


def test_the_pairs_of_a_long_drive_are_few_and_spread():
    collector, points = StraightCollector(), np.zeros((200, 2), np.float32)
    for n in range(20000):
        if collector.wants(n * 100_000_000):
            collector.push((n - 6) * 100_000_000, n * 100_000_000, points, points)
    found = collector.straights()
    assert PAIRS / 4 < len(found) <= PAIRS and found.before.shape == (len(found), POINTS, 2)
    steps = np.diff(found.stamps_s)
    assert steps.max() <= 2.1 * steps.min() and found.stamps_s[-1] > 1900


def evidence_of(pairs):
    return conclude.Evidence(
        LENS.image_size, 100, (), {}, np.zeros((0, 2)), None, FULL_SIZE, {}, pictures=None,
        straights=pairs)


def test_a_failure_does_not_cost_the_lens(solution, monkeypatch):
    def fails(*arguments):
        raise np.linalg.LinAlgError('Singular matrix')

    monkeypatch.setattr(conclude, 'mount_of', fails)
    evidence = evidence_of(pairs_of(mounted(0, 0, 0), count=2))
    found = conclude.conclude(solution, evidence, Config())
    assert found.mount is None and found.camera is not None


def test_a_camera_that_was_moved(solution):
    known = replace(with_camera(solution, LENS), scenes=())
    here, nearby, moved = (mount_of(pairs_of(mounted(yaw, 0.0, 0.0), seed=seed), None, known,
                                    'accepted', None)
                           for seed, yaw in enumerate((0.0, 0.3, 1.0)))
    degrees, sigma = moved.apart(here)['yaw_left_deg']
    assert abs(degrees - 1.0) < 2 * sigma < 0.5
    assert moved.moved_from(here) and here.moved_from(moved)
    # 0.3 degrees are what a load in the boot makes
    assert not nearby.moved_from(here)
    vague = replace(moved, sigma=dict.fromkeys(moved.sigma, 0.5))
    assert not vague.moved_from(here)
    # an angle that one does not know is not compared
    assert set(moved.apart(here)) == {'yaw_left_deg', 'pitch_up_deg'}


def joined(before, after):
    """Return the pairs of two drives, one behind the other."""
    later = before.stamps_s[-1] + 1.0
    return Straights(*(np.concatenate([getattr(before, name), getattr(after, name) + more])
                       for name, more in (('before', 0), ('after', 0), ('stamps_s', later),
                                          ('apart_s', 0))))


@pytest.mark.parametrize('moved', [(1.5, 1.0, 0.0), (0.5, 0.0, 0.0), (-0.5, 2.0, 0.0)])
def test_a_camera_that_is_moved_during_the_drive_begins_anew(solution, moved):
    known = replace(with_camera(solution, LENS), scenes=())
    first, then = pairs_of(mounted(0.5, 1.0, 0.0), count=60), pairs_of(mounted(*moved), count=25,
                                                                       seed=1)
    found = mount_of(joined(first, then), None, known, 'accepted', None)
    assert found.moved_s == pytest.approx(first.stamps_s[-1], abs=3.0)
    assert abs(found.yaw_left_deg - moved[0]) < 0.3 and abs(found.pitch_up_deg - moved[1]) < 0.3
    # with the camera in use alone, and fewer points
    stamp_s, turned = judge.moved(joined(first, then), LENS)
    assert abs(stamp_s - found.moved_s) <= 2.0
    np.testing.assert_allclose(turned, [moved[0] - 0.5, moved[1] - 1.0], atol=0.3)
    assert judge.moved(first, LENS) is None
    assert mount_of(first, None, known, 'accepted', None).moved_s is None


def test_a_camera_that_is_moved_during_the_drive_is_told(solution):
    first, then = (pairs_of(mounted(yaw, 1.0, 0.0), count=40, seed=seed)
                   for seed, yaw in enumerate((0.5, 1.5)))
    for pairs, codes in ((first, []), (joined(first, then), ['E-CAMERA-MOVED'])):
        calibration = conclude.conclude(solution, evidence_of(pairs), Config())
        assert [each.code for each in calibration.warnings] == codes


def test_a_camera_that_stays_is_not_said_to_be_moved(solution):
    known = replace(with_camera(solution, LENS), scenes=())
    for seed in range(10):
        # other roads: 0.3 degrees
        first, then = (pairs_of(mounted(0.5 + more, 1.0, 0.0), seed=2 * seed + n)
                       for n, more in enumerate((0.0, 0.3)))
        found = mount_of(joined(first, then), None, known, 'accepted', None)
        assert found.moved_s is None
