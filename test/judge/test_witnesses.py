# SPDX-License-Identifier: Apache-2.0
"""A gyro and GPS as witnesses of a solution whose truth is known."""
from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from solving import CONFIG, YAWS, solved, with_camera
from synthetic import LENS, synthetic_turn
from towns import town

from dashcalib_ros.config import VerdictConfig
from dashcalib_ros.input.motion import Samples, SensorStream
from dashcalib_ros.input.poses import Poses
from dashcalib_ros.judge import witnesses
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.judge.witnesses import PACE, clock_of_poses, compare_sensors, fit_to, steps_of
from dashcalib_ros.solve.start import scene_with

TURNS = 4
START_S, APART_S, LATE_S = 1_700_000_000.0, 20.0, 0.04
MOUNT = Rotation.from_euler('xyz', (20.0, -130.0, 75.0), degrees=True)
CALIBRATED = CONFIG.replace({'motion.gyro_scale_sigma': 0.001})


@pytest.fixture(scope='module')
def drive():
    """Return a solution, and the true angles: times (n,), rates (n, 3) about the camera's axes."""
    scenes, times, rates = [], [], []
    for world, yaw in enumerate(YAWS[:TURNS]):
        turn = synthetic_turn(yaw_deg=yaw, tracks=250, keyframes=18, world=world)
        when = APART_S * (world + 1) + turn.tracks.stamps_ns / 1e9
        fine = np.arange(when[0], when[-1], 0.01)
        steps = Rotation.from_matrix(turn.structure.rotations[:-1]
                                     @ turn.structure.rotations[1:].transpose(0, 2, 1))
        place = np.clip(np.searchsorted(when, fine, side='right') - 1, 0, len(when) - 2)
        rates.append(steps.as_rotvec()[place] / np.diff(when)[place, None])
        times.append(fine)
        scene = turn.scene(LENS.with_focal(1.03 * LENS.fx), world)
        stamps = np.round((START_S + when) * 1e9).astype(np.int64)
        scenes.append(dataclasses.replace(
            scene, tracks=dataclasses.replace(scene.tracks, stamps_ns=stamps)))
    everywhere = np.arange(0.0, APART_S * (TURNS + 1), 0.01)
    known = np.concatenate(times)
    still = everywhere[np.abs(everywhere[:, None] - known[::5]).min(axis=1) > 0.06]
    order = np.argsort(when := np.r_[known, still], kind='stable')
    values = np.concatenate([*rates, np.zeros((len(still), 3))])[order]
    return solved(scenes), when[order], values


@pytest.fixture(scope='module')
def alone(drive):
    """Return what gives the solution of one turn of the drive, as pictures alone give it."""
    return functools.cache(lambda turn: solved([drive[0].scenes[turn]]))


def gyro(drive, scale=1.0, density_deg=0.02, bias_deg=0.2, late_s=LATE_S, unit=1.0, seed=0):
    _, when, rates = drive
    noise = np.random.default_rng(seed).standard_normal(rates.shape)
    seen = unit * scale * MOUNT.apply(rates) + np.radians(
        bias_deg * np.array([1.0, -1.0, 0.5]) + density_deg * 10 * noise)
    return SensorStream(rate=Samples(when + late_s, seen))


def asked(drive, stream, config=CALIBRATED, solution=None):
    found = compare_sensors(solution or drive[0], stream, START_S, config)
    return found.witnesses.gyro, found.unused


def wrong_camera(solution, focal):
    camera = solution.camera.with_focal(focal * solution.camera.fx)
    scenes = tuple(scene_with(camera, scene, CONFIG) for scene in solution.scenes)
    return dataclasses.replace(with_camera(solution, camera), scenes=scenes)


def test_offset_mounting_bias_and_scale_are_found(drive):
    said, lines = asked(drive, gyro(drive))
    assert lines == ()
    assert abs(said.time_offset_s - LATE_S) < 0.003
    assert abs(said.time_offset_s - LATE_S) < 4 * said.time_sigma_s
    assert abs(said.scale - 1) < 4 * said.scale_sigma < 0.02
    np.testing.assert_allclose(np.degrees(said.bias_rad_s), [0.2, -0.2, 0.1], atol=0.05)
    off = Rotation.from_matrix(said.camera_from_sensor) * MOUNT
    assert np.degrees(off.magnitude()) < 4 * said.alignment_sigma_deg < 3.0
    assert said.agrees and abs(said.fx_percent) < 3 * said.fx_sigma_percent < 2.0


def test_a_focal_length_that_is_off_is_contradicted_in_its_direction(drive):
    for focal in (0.97, 1.03):
        said, _ = asked(drive, gyro(drive), solution=wrong_camera(drive[0], focal))
        assert not said.agrees
        assert said.fx_percent == pytest.approx(100 * (1 / focal - 1), abs=1.0)
        assert abs(said.fx_percent) > 4 * said.fx_sigma_percent


def test_a_gyro_of_unknown_scale_never_contradicts_falsely(drive):
    for scale in (0.97, 1.03):
        said, _ = asked(drive, gyro(drive, scale), CONFIG)
        assert said.agrees and said.fx_sigma_percent > 2.5
        assert said.scale == pytest.approx(scale, abs=4 * said.scale_sigma)
        # and where a false calibration is claimed, it does
        assert not asked(drive, gyro(drive, scale))[0].agrees


def test_a_contradiction_makes_the_result_weak_with_both_named(drive):
    solution, config = drive[0], VerdictConfig()
    before = judge(solution, config)
    found = compare_sensors(solution, gyro(drive, 1.05), START_S, CALIBRATED).witnesses
    verdict = judge(solution, config, witnesses=found)
    assert verdict.level == 'weak'
    assert set(verdict.codes) - set(before.codes) == {'E-SENSOR-CONTRADICTS'}
    [reason] = [each for each in verdict.reasons if each.code == 'E-SENSOR-CONTRADICTS']
    assert 'the gyro' in str(reason)
    assert judge(solution, config, witnesses=compare_sensors(
        solution, gyro(drive), START_S, CALIBRATED).witnesses) == before


@pytest.mark.thorough
def test_sigmas_hold(drive):
    pulls, solution = [], drive[0]
    turns = [steps_of(scene, solution, 0.3, START_S) for scene in solution.scenes]
    # the solution's own error is the same for all
    exact = fit_to(turns, gyro(drive, density_deg=0.0).rate)
    apart = exact.by_camera @ solution.covariance @ exact.by_camera
    assert abs(exact.gyro.inverse_scale - 1) < 2.5 * np.sqrt(apart)
    for seed in range(30):
        said = fit_to(turns, gyro(drive, density_deg=0.1, seed=seed).rate)
        pulls.append([(said.gyro.offset_s - LATE_S) / np.sqrt(said.covariance[7, 7]),
                      (said.gyro.inverse_scale - exact.gyro.inverse_scale)
                      / np.sqrt(said.covariance[6, 6]),
                      said.gyro.pace / np.sqrt(said.covariance[8, 8])])
    assert (np.abs(pulls) < 2).mean(axis=0).min() >= 0.9


@pytest.mark.parametrize('faster', [-0.003, 0.002])
def test_the_pace_of_the_clocks_is_measured_by_several_turns(drive, faster):
    solution, rate = drive[0], gyro(drive).rate
    turns = [steps_of(scene, solution, 0.3, START_S) for scene in solution.scenes]
    ran, plain = (fit_to(turns, Samples(rate.stamps_s * (1 + each), rate.values))
                  for each in (faster, 0.0))
    assert abs(ran.gyro.pace - faster) < 4 * np.sqrt(ran.covariance[8, 8]) < 0.001
    # the pictures' clock or the gyro's is off: no angle is known better than that
    for fit in (ran, plain):
        assert abs(fit.scale - 1) < 4 * np.sqrt(fit.covariance[6, 6])
    assert np.sqrt(ran.covariance[6, 6]) > abs(faster) > np.sqrt(plain.covariance[6, 6])


def test_one_turn_has_the_prior_of_the_pace(drive, alone):
    rate = gyro(drive).rate
    for turn in range(TURNS):
        solution = alone(turn)
        steps = steps_of(solution.scenes[0], solution, 0.3, START_S)
        assert np.sqrt(fit_to([steps], rate).covariance[8, 8]) < PACE


def test_an_image_that_is_missing_within_a_turn_is_noticed(drive):
    for scene in drive[0].scenes:
        tracks = scene.tracks
        # the images are given at a rate, and one of them is missing in the middle
        late = np.arange(len(tracks.stamps_ns)) >= len(tracks.stamps_ns) // 2
        scene = dataclasses.replace(scene, tracks=dataclasses.replace(
            tracks, stamps_ns=tracks.stamps_ns - 100_000_000 * late))
        solution = dataclasses.replace(drive[0], scenes=(scene,))
        said, [line] = asked(drive, gyro(drive, density_deg=0.1), solution=solution)
        assert said is None and line.code == 'E-GYRO-CLOCK'


def jumped(drive, later_s):
    rate = gyro(drive).rate
    return SensorStream(rate=Samples(
        rate.stamps_s + later_s * ((rate.stamps_s > 50.0) & (rate.stamps_s < 70.0)), rate.values))


@pytest.mark.parametrize(('stream', 'code', 'value'), [
    (lambda drive: gyro(drive, unit=180 / np.pi), 'E-GYRO-UNIT', 'not degrees per second'),
    (lambda drive: gyro(drive, unit=9.0), 'E-GYRO-UNIT', 'check its unit'),
    (lambda drive: gyro(drive).shifted(3.0), 'E-GYRO-OTHER-MOTION', ''),
    (lambda drive: gyro(drive).shifted(1e4), 'E-GYRO-NO-SAMPLES', ''),
    (lambda drive: jumped(drive, 0.15), 'E-GYRO-CLOCK', 'turns are'),
    (lambda drive: SensorStream(rate=Samples(
        1.011 * gyro(drive).rate.stamps_s - 0.55, gyro(drive).rate.values)), 'E-GYRO-CLOCK',
     '+1.1 % of time')])
def test_streams_that_do_not_fit_are_told_and_not_used(drive, stream, code, value):
    said, [found] = asked(drive, stream(drive))
    assert said is None and found.code == code
    assert value in str(found) and len(str(found).splitlines()) == 1


def test_a_gyro_that_has_samples_between_turns_only_is_not_used(drive):
    rate = gyro(drive).rate
    kept = rate.stamps_s % APART_S > 15.0
    said, [line] = asked(drive, SensorStream(rate=Samples(rate.stamps_s[kept], rate.values[kept])))
    assert said is None and line.code == 'E-GYRO-TURNS-LITTLE'


def test_sensors_that_cannot_be_compared_cost_themselves_only(drive, monkeypatch):
    def fails(*arguments):
        raise np.linalg.LinAlgError('Singular matrix')
    monkeypatch.setattr(witnesses, 'steps_of', fails)
    found = compare_sensors(drive[0], gyro(drive), START_S, CONFIG)
    assert found.solution is drive[0] and found.witnesses.gyro is None
    assert [each.code for each in found.unused] == ['E-SENSORS-NOT-COMPARED']


def test_gaps_leave_out_what_they_hide(drive):
    rate = gyro(drive).rate
    kept = (rate.stamps_s < 41.0) | (rate.stamps_s > 59.0)
    said, lines = asked(drive, SensorStream(rate=Samples(rate.stamps_s[kept], rate.values[kept])))
    whole, _ = asked(drive, gyro(drive))
    assert lines == () and said.agrees and said.scale_sigma > whole.scale_sigma


def fixes(drive, noise_m, rate_hz=10.0, seed=0):
    """Return a track: each turn is driven at its own place, as jumps between them."""
    when, places = [], []
    for world, scene in enumerate(drive[0].scenes):
        turn = synthetic_turn(yaw_deg=YAWS[world], tracks=250, keyframes=18, world=world)
        own = scene.tracks.stamps_ns / 1e9 - START_S
        centres = -np.einsum('kji,kj->ki', turn.structure.rotations, turn.structure.translations)
        fine = np.arange(own[0], own[-1], 1 / rate_hz)
        east, north = (np.interp(fine, own, centres[:, axis]) for axis in (0, 2))
        when.append(fine)
        places.append(np.stack([east + 300.0 * world, north, 0 * fine], axis=1))
    values = np.concatenate(places)
    values += noise_m * np.random.default_rng(seed).standard_normal(values.shape)
    return SensorStream(position=Samples(np.concatenate(when), values))


def gps(drive, stream, solution=None):
    found = compare_sensors(solution or drive[0], stream, START_S, CONFIG)
    return found.witnesses.gps, found.unused



def test_sensors_of_a_drive_without_a_solution_are_named(drive):
    both = dataclasses.replace(gyro(drive), position=fixes(drive, 0.02).position)
    lines = compare_sensors(None, both, START_S, CONFIG).unused
    assert [line.code for line in lines] == ['E-SENSOR-NO-TURNS'] * 2
    assert 'gyro' in str(lines[0]) and 'GPS' in str(lines[1])


def test_gps_that_is_an_hour_off_is_named_with_the_hour(drive):
    _, [line] = gps(drive, fixes(drive, 0.02).shifted(3600.0))
    assert line.code == 'E-GPS-NO-SAMPLES' and ' 1 h ' in str(line)


def test_gps_headings_say_nothing_where_the_straights_are_short(drive, monkeypatch):
    # six metres before and after each turn
    said, [line] = gps(drive, fixes(drive, 0.02))
    assert said is None and line.code == 'E-GPS-NO-STRAIGHTS'
    monkeypatch.setattr(witnesses, 'STRAIGHT_M', 4.0)
    said, lines = gps(drive, fixes(drive, 0.02))
    assert said.agrees and lines == ()
    # headings that nobody knows, and turns to the other side
    mirrored = fixes(drive, 0.02).position
    for stream, code in ((fixes(drive, 1.0), 'E-GPS-HEADINGS'), (SensorStream(position=Samples(
            mirrored.stamps_s, mirrored.values * (1, -1, 1))), 'E-GPS-OTHER-MOTION')):
        said, [line] = gps(drive, stream)
        assert said is None and line.code == code


@pytest.mark.parametrize(('later_s', 'words'), [
    (3600.0, ' 1 h earlier'), (-12600.0, ' 3.5 h later'), (1e6, 'clock')])
def test_gps_of_another_time_is_named_with_its_zone(drive, later_s, words):
    said, [line] = gps(drive, fixes(drive, 0.02).shifted(later_s))
    assert said is None and line.code == 'E-GPS-NO-SAMPLES' and words in str(line)


@pytest.mark.thorough
def test_a_gyro_finds_its_place_where_the_images_have_whole_seconds(drive):
    for late_s in (-1.4, 0.0, 1.3):
        stream = dataclasses.replace(gyro(drive, late_s=late_s), doubt_s=1.5)
        said, lines = asked(drive, stream)
        assert lines == () and said.agrees and abs(said.time_offset_s - late_s) < 0.003
    # so its GPS is not compared without a gyro
    said, [line] = gps(drive, dataclasses.replace(fixes(drive, 0.02), doubt_s=1.5))
    assert said is None and line.code == 'E-GPS-CLOCK'


def test_a_speed_of_another_time_is_named(drive):
    speed = SensorStream(speed=Samples(np.arange(1e4, 1e4 + 50), np.full((50, 1), 9.0)))
    assert [each.code for each in asked(drive, speed)[1]] == ['E-SPEED-NO-SAMPLES']


def test_noisy_gps_does_no_harm(drive):
    for seed in range(5):
        said, lines = gps(drive, fixes(drive, 3.0, 1.0, seed))
        assert [each.code for each in lines] == (['E-GPS-NO-STRAIGHTS'] if said is None else [])
        assert said is None or said.agrees


def test_a_calibrated_gyro_is_information_for_one_turn(drive, alone):
    pulls = []
    for turn in range(len(drive[0].scenes)):
        solution = alone(turn)
        found = compare_sensors(solution, gyro(drive, density_deg=0.005), START_S, CALIBRATED)
        informed = found.solution
        assert informed.by_pictures is solution
        assert informed.sigma[0] < 0.71 * solution.sigma[0]
        assert informed.picture.rms < solution.picture.rms
        assert np.linalg.eigvalsh(informed.covariance).min() > 0
        # its poses are of its camera: the error stays what it was
        assert informed.reprojection_error_px < 1.2 * solution.reprojection_error_px
        pulls.append((informed.camera.fx - LENS.fx) / informed.sigma[0])
        before, after = (judge(each, VerdictConfig()).codes for each in (solution, informed))
        assert 'E-FEW-TURNS' in before
        assert not {'E-FEW-TURNS', 'E-TWO-FOCAL-LENGTHS'} & set(after)
    assert np.abs(pulls).max() < 3


def test_what_is_no_information_changes_nothing(drive, alone):
    solution = alone(0)
    # its scale is unknown; it is wrong and says so not; it is to be a witness only
    as_witness = CALIBRATED.replace({'motion.use': 'witness'})
    for scale, config in ((1.0, CONFIG), (0.97, CONFIG), (1.2, CALIBRATED), (1.0, as_witness)):
        found = compare_sensors(solution, gyro(drive, scale), START_S, config)
        assert found.solution is solution and found.witnesses.gyro is not None


def test_one_turn_is_not_moved_by_a_gyro_that_is_called_calibrated_and_is_not(drive, alone):
    for scale in (0.975, 1.025):
        solution = alone(0)
        found = compare_sensors(solution, gyro(drive, scale), START_S, CALIBRATED)
        named = 'E-GYRO-UNCONFIRMED' in [each.code for each in found.unused]
        assert found.solution is solution and (named or not found.witnesses.gyro.agrees)


def test_a_gyro_hardly_moves_what_many_turns_know(drive):
    solution = drive[0]
    found = compare_sensors(solution, gyro(drive), START_S, CALIBRATED).solution
    assert abs(found.camera.fx - solution.camera.fx) < solution.sigma[0]
    assert found.sigma[0] <= solution.sigma[0]


def with_town(drive, scale, seed=3, **given):
    """Return what a gyro sees of the turns, and after them of a town, where GPS is received."""
    turns = gyro(drive, scale, density_deg=0.005)
    rate, position = town(seed, scale=scale, turns=30, mounting=MOUNT, noise_m=0.05, rate_hz=5.0,
                          **given)
    later = turns.rate.stamps_s[-1] + 60.0
    bias = turns.rate.values.mean(axis=0)
    return SensorStream(rate=Samples(
        np.r_[turns.rate.stamps_s, rate.stamps_s + later],
        np.concatenate([turns.rate.values, rate.values + bias])),
        position=Samples(position.stamps_s + later, position.values))


@pytest.mark.parametrize('scale', [1.0, 1.02])
def test_gps_calibrates_a_gyro_of_unknown_scale(drive, alone, scale):
    solution = alone(0)
    found = compare_sensors(solution, with_town(drive, scale), START_S, CONFIG)
    said = found.witnesses.gyro
    assert found.unused == () and said.agrees
    own, sigma = said.scale_by_gps
    assert abs(own - scale) < 3 * sigma < 0.01
    # the scale is known now: so its angles are information
    assert found.solution.by_pictures is solution
    assert found.solution.sigma[0] < 0.8 * solution.sigma[0]
    assert abs(found.solution.camera.fx - LENS.fx) < 3 * found.solution.sigma[0]


def test_a_scale_that_gps_contradicts_is_named_and_not_used(drive, alone):
    solution = alone(0)
    found = compare_sensors(solution, with_town(drive, 1.03), START_S, CALIBRATED)
    assert 'E-GYRO-SCALE' in [each.code for each in found.unused]
    assert found.witnesses.gyro.agrees
    assert abs(found.solution.camera.fx - LENS.fx) < 3 * found.solution.sigma[0]


def test_the_clock_of_poses_is_found_by_their_rotations(drive):
    solution, when, rates = drive
    even = np.arange(when[0], when[-1], 0.02)
    steps = Rotation.from_rotvec(0.02 * Samples(when, rates).at(even + 0.01))
    turned = [np.eye(3)]
    for step in steps.as_matrix()[:-1]:
        turned.append(turned[-1] @ step)
    poses = Poses(np.array(turned) @ MOUNT.as_matrix(), np.zeros((len(even), 3)),
                  START_S + even + LATE_S)
    found = clock_of_poses(solution, poses, CONFIG)
    assert abs(found.time_offset_s - LATE_S) < 2 * found.time_sigma_s < 0.01
    assert clock_of_poses(solution, dataclasses.replace(poses, stamps_s=None), CONFIG) is None
    # one that is thousands of years later takes no memory
    later = Poses(np.r_[poses.rotations, poses.rotations[-1:]], np.zeros((len(even) + 1, 3)),
                  np.r_[poses.stamps_s, 1e11])
    again = clock_of_poses(solution, later, CONFIG)
    assert again.time_offset_s == pytest.approx(found.time_offset_s, abs=1e-4)
