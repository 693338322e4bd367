# SPDX-License-Identifier: Apache-2.0
"""The clocks of positions and speeds, from made paths whose scale and heading wander."""
from __future__ import annotations

import numpy as np
import pytest

from dashcalib_ros.input.motion import Samples
from dashcalib_ros.judge.calibration import Witness
from dashcalib_ros.judge.clocks import Path, offset_of

LEVER = -1.1 + 0.4j
WAYS = ((1.4, 3.0), (-1.5, 2.5), (0.3, 6.0), (-1.2, 4.0))


def driven(seed, late_s=0.0, kind='position', noise=0.02, pace=0.0):
    """Return the paths of turns, and what a sensor measured meanwhile."""
    rng, paths, stamps, values, where, way_m = np.random.default_rng(seed), [], [], [], 0j, 0.0
    for n, (turn, slowest) in enumerate(WAYS):
        fine = np.linspace(0, 7, 701)
        speed = slowest + 4 * np.abs(fine / 7 - 0.45)**1.5 * 2
        yaw = turn / (1 + np.exp(-(fine - 3.2) * 2.2))
        places = where + np.cumsum(speed * np.exp(1j * yaw)) * 0.01
        way = way_m + np.cumsum(speed) * 0.01
        where, way_m = places[-1], way[-1]
        shown = slice(50, 651, 10)
        scale = 0.05 * (1 + 0.01 * np.sin(fine * 0.8 + rng.uniform(0, 6)))
        seen = np.cumsum(np.gradient(places) * scale)
        paths.append(Path(20 * n + fine[shown], seen[shown], yaw[shown]))
        when = 20 * n + fine[::10]
        stamps.append(when + late_s + pace * (when - 30))
        if kind == 'position':
            fix = (places + np.exp(1j * yaw) * LEVER)[::10]
            fix = fix + noise * (rng.standard_normal((len(fix), 2)) @ [1, 1j])
            values.append(np.stack([fix.real, fix.imag, 0 * fix.real], axis=1))
        else:
            values.append((speed[::10] + noise * rng.standard_normal(len(when)))[:, None])
    return paths, Samples(np.concatenate(stamps), np.concatenate(values))


@pytest.mark.parametrize('kind', ['position', 'speed'])
@pytest.mark.parametrize('late_s', [-0.2, 0.04])
def test_an_offset_is_found_beside_a_lever_arm(kind, late_s):
    for seed in range(2):
        found = offset_of(*driven(seed, late_s, kind))
        assert abs(found.time_offset_s - late_s) < 2 * found.time_sigma_s < 0.07
        assert found.scale is None and found.agrees


def test_a_straight_at_one_speed_tells_nothing():
    stamps = np.linspace(0, 7, 71)
    path = Path(stamps, stamps + 0j, 0 * stamps)
    assert offset_of([path], Samples(stamps, np.outer(8 * stamps, [1.0, 0.0, 0.0]))) is None
    assert offset_of([], Samples(stamps, np.outer(8 * stamps, [1.0, 0.0, 0.0]))) is None


def test_a_fix_of_another_millennium_takes_no_memory():
    paths, fixes = driven(0, 0.04)
    more = Samples(np.r_[fixes.stamps_s, 1e11], np.r_[fixes.values, fixes.values[-1:]])
    found = offset_of(paths, more)
    assert found.time_offset_s == pytest.approx(offset_of(paths, fixes).time_offset_s, abs=1e-4)


def test_a_gyro_with_the_same_stamps_knows_better_where_it_agrees():
    gyro = Witness(0.041, 0.001, 1.0, 0.002, 0.1, 0.2, True, drift_ppm=20.0, drift_sigma_ppm=40.0)
    paths, fixes = driven(0, 0.04)
    found = offset_of(paths, fixes, gyro)
    assert (found.time_offset_s, found.drift_ppm, found.drift_sigma_ppm) == (0.041, 20.0, 40.0)
    assert found.time_sigma_s < 0.01 and found.scale is None
    # fixes that a logger has written beside a gyro are later than it
    paths, fixes = driven(0, 0.3)
    assert offset_of(paths, fixes, gyro).time_offset_s == pytest.approx(0.3, abs=0.05)
