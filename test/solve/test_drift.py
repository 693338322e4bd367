# SPDX-License-Identifier: Apache-2.0
"""A focal length that changes with time: found where it does, and not named where it does not."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, START, scenes_of, solved
from synthetic import LENS, SIZE, synthetic_turn

from dashcalib_ros.input.motion import Samples
from dashcalib_ros.input.scale import FULL_SIZE
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.judge.conclude import Evidence, conclude
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.problem.blocks import Drift, Warmth
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.solution import FocalDrift, Solution, with_measurement

pytestmark = pytest.mark.usefixtures('no_profile')

MIDDLE = (np.array(SIZE) - 1) / 2


def warming(size: float, count: int = 5) -> list[Scene]:
    """Return turns, a minute apart, whose pictures grow by size from the first to the last."""
    return zoomed([1 + size * (n / (count - 1) - 0.5) for n in range(count)])


def zoomed(zooms: Sequence[float], scenes: Sequence[Scene] = ()) -> list[Scene]:
    """Return turns, a minute apart, whose pictures are so many times as large."""
    scenes, found = scenes or scenes_of(len(zooms), tracks=150), []
    for n, (scene, zoom) in enumerate(zip(scenes, zooms, strict=True)):
        tracks = replace(scene.tracks, xy=MIDDLE + (scene.tracks.xy - MIDDLE) * zoom,
                         stamps_ns=scene.tracks.stamps_ns + n * 60 * 10**9)
        found.append(replace(scene, tracks=tracks))
    return found


@pytest.mark.parametrize('size', [0.02, pytest.param(-0.012, marks=pytest.mark.thorough)])
def test_a_lens_that_warms_up_is_measured(size):
    solution = solved(warming(size))
    assert solution.drift is not None
    assert abs(solution.drift.size - size) < 3 * solution.drift.sigma < 0.012
    assert solution.drift.seconds == pytest.approx(240, rel=0.03)
    assert abs(solution.camera.fx - LENS.fx) < 3 * solution.sigma[0]
    assert 'E-FOCAL-LENGTH-DRIFTS' not in judge(solution, CONFIG.verdict).codes


def test_what_is_known_of_a_drift_moves_it():
    solution = solved(warming(0.02))
    along = np.eye(len(solution.posterior.prior.score))[-1]
    found = with_measurement(solution, along, 0.001, 1e-12)
    assert found.drift is not None and solution.drift is not None
    moved = (found.posterior.offset - solution.posterior.offset)[-1]
    assert 0 < moved < 0.0011
    assert found.drift.size == pytest.approx(solution.drift.size + moved)
    assert found.drift.sigma < 1e-5
    last_ns = solution.drift.ways.end_ns
    grown = found.at(last_ns)[0].fx / found.camera.fx
    assert grown == pytest.approx(1 + found.drift.size / 2)


def test_a_steady_lens_has_no_drift():
    assert solved(warming(0.0)).drift is None


def concluded(solution: Solution, warmth: Samples) -> CalibrationData:
    """Return the result of a drive with a temperature."""
    return conclude(solution, Evidence(SIZE, 300, (), {}, np.zeros((0, 2)), None, FULL_SIZE, {},
                                       temperature=warmth), CONFIG)


# of turns, a minute apart, degrees Celsius: it warms up, and cools down again
WARMTH = (20.0, 32.0, 38.0, 30.0, 22.0)


def temperature(degrees: Sequence[float]) -> Samples:
    """Return the temperature of such turns."""
    start_s = scenes_of(1, tracks=150)[0].tracks.stamps_ns[0] / 1e9
    return Samples(start_s + np.array([0.0, 60, 120, 180, 245]), np.array(degrees)[:, None])


def test_a_lens_that_follows_the_temperature_is_measured_by_kelvin():
    size = 0.001
    scenes = zoomed([1 + size * (each - np.mean(WARMTH)) for each in WARMTH])
    solution = solved(scenes, temperature=temperature(WARMTH))
    drift = solution.drift
    assert drift is not None and drift.of_kelvin is not None and drift.linear
    value, sigma = drift.of_kelvin
    assert abs(value - size) < 3 * sigma < 0.6 * abs(size)
    assert drift.largest > 3 * abs(drift.size)
    for turn, each in enumerate(WARMTH):
        camera, off = solution.at(turn * 60 * 10**9 + 10**9)
        assert abs(camera.fx - LENS.fx * (1 + size * (each - np.mean(WARMTH)))) < 3 * off[0]
    found = concluded(solution, temperature(WARMTH))
    assert found.drift is not None and found.drift.fx_percent_per_kelvin == 100 * value
    assert found.drift.sigma_per_kelvin == 100 * sigma and found.drift.to_c is not None
    assert found.temperature_c is not None and 28 < found.temperature_c < 29
    # one that was measured on another day
    later = replace(temperature(WARMTH), stamps_s=temperature(WARMTH).stamps_s + 86400)
    other = concluded(solved(warming(0.0, 2), temperature=later), later)
    assert other.temperature_c is None and other.drift is None
    assert 'E-TEMPERATURE-TIMES' in {each.code for each in other.warnings}


@pytest.mark.thorough
def test_what_grows_with_time_and_not_with_the_temperature_has_no_size_per_kelvin():
    found = solved(warming(0.02), temperature=temperature(WARMTH)).drift
    assert found is not None and found.linear and found.of_kelvin is None
    assert solved(warming(0.0), temperature=temperature(WARMTH)).drift is None


@pytest.mark.thorough
def test_a_temperature_that_stays_is_not_followed():
    found = solved(warming(0.02), temperature=temperature([20.0, 20.5, 21.0, 20.5, 20.0])).drift
    assert found is not None and found.of_kelvin is None


def test_a_temperature_of_other_times_is_none():
    turns_ns = [scene.tracks.stamps_ns for scene in warming(0.0)]
    samples = temperature(WARMTH)
    found = Warmth.over(samples, turns_ns)
    assert found is not None and 20 <= found.coldest_c < 21 and 37 < found.warmest_c <= 38
    assert Warmth.over(replace(samples, stamps_s=samples.stamps_s + 1000), turns_ns) is None
    assert Warmth.over(None, turns_ns) is None


def test_a_gentle_stretch_says_little_about_a_drift():
    gentle = synthetic_turn(LENS, 4.0, keyframes=14, tracks=150, noise_px=0.25, world=9)
    sharp = scenes_of(5, tracks=150)[1:]
    alone = solved(zoomed([1.0] * 4, sharp))
    # a step fits a little better, and its fx is hardly known
    found = solved(zoomed([1.02, 1.0, 1.0, 1.0, 1.0], [gentle.scene(START, 0), *sharp]))
    assert found.drift is None and found.sigma[0] < 1.3 * alone.sigma[0]


def test_two_turns_cannot_tell():
    assert solved(warming(0.02, 2)).drift is None


@pytest.mark.thorough
def test_a_large_drift_has_no_camera_info():
    assert 'E-FOCAL-LENGTH-DRIFTS' in judge(solved(warming(0.05)), CONFIG.verdict).codes


def test_a_step_is_found_at_its_place_with_a_calibration_of_each_side():
    solution = solved(zoomed([1.0, 1.0, 1.02, 1.02, 1.02]))
    drift = solution.drift
    assert drift is not None and drift.step_ns is not None and not drift.linear
    assert 60e9 < drift.step_ns < 120e9
    assert abs(drift.size - 0.02 / 1.01) < 3 * drift.sigma < 0.01
    for part, zoom in zip(solution.parts, (1.0, 1.02), strict=True):
        assert part is not None and abs(part.camera.fx - zoom * LENS.fx) < 3 * part.sigma[0]
    for turn, zoom in ((1, 1.0), (3, 1.02)):
        camera, sigma = solution.at(turn * 60 * 10**9)
        assert abs(camera.fx - zoom * LENS.fx) < 3 * sigma[0] < 0.01 * LENS.fx
    assert 'E-FOCAL-LENGTH-STEPS' in judge(solution, CONFIG.verdict).codes


def test_it_is_not_said_how_it_changes_where_turns_do_not_tell():
    zooms = [1.0, 1.018, 1.03]
    solution = solved(zoomed(zooms))
    assert solution.drift is not None and solution.parts == ()
    assert not solution.drift.linear and solution.drift.step_ns is None
    for turn, zoom in enumerate(zooms):
        camera, sigma = solution.at(turn * 60 * 10**9 + 10**9)
        assert abs(camera.fx - zoom * LENS.fx) < 3 * sigma[0]


def test_a_zoom_in_and_back_changes_as_much_as_in_between():
    ways = Drift(np.array([0.0, 0.3, -0.3]), 0, 100, steps_ns=(30, 60))
    found = FocalDrift.of(ways, np.eye(9))
    assert found.size == pytest.approx(0.0) and found.largest == pytest.approx(0.3)


@pytest.mark.thorough
def test_nothing_steps_between_turns_that_overlap():
    first, second, *others = zoomed([1.0, 1.0, 1.3, 1.15])
    tracks = second.tracks
    within = replace(second, tracks=replace(
        tracks, stamps_ns=(tracks.stamps_ns - tracks.stamps_ns[0]) // 2 + 10**9))
    drift = solved([first, within, *others]).drift
    assert drift is not None and len(drift.ways.steps_ns) == 2
    assert min(drift.ways.steps_ns) > first.tracks.stamps_ns[-1]


@pytest.mark.thorough
def test_a_zoom_has_a_focal_length_at_each_turn():
    zooms = [1.0, 1.05, 1.2, 1.22, 1.3]
    solution = solved(zoomed(zooms))
    assert 'E-FOCAL-LENGTH-DRIFTS' in judge(solution, CONFIG.verdict).codes
    for turn, zoom in enumerate(zooms):
        camera, sigma = solution.at(turn * 60 * 10**9 + 10**9)
        assert abs(camera.fx - zoom * LENS.fx) < 3 * sigma[0] < 0.03 * zoom * LENS.fx
