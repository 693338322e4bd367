# SPDX-License-Identifier: Apache-2.0
"""A gyro's scale by the headings of GPS, on drives on paper."""
from __future__ import annotations

import numpy as np
import pytest
from towns import town

from dashcalib_ros.input.motion import Samples
from dashcalib_ros.judge.gyro_scale import scale_by_gps


@pytest.mark.parametrize(('scale', 'given'), [
    (1.0, {}), (1.03, {}), (0.97, {'noise_m': 0.02, 'rate_hz': 10.0}),
    (1.02, {'noise_m': 3.0, 'turns': 20}), (1.0, {'jumps': 0.05}),
    (1.0, {'late_s': 0.4}), (1.0, {'late_s': 0.2, 'lever_m': 2.5})])
def test_the_scale_is_found_and_its_sigma_holds(scale, given):
    off = []
    for seed in range(10):
        found, sigma = scale_by_gps(*town(seed, scale=scale, **given))
        assert sigma < 0.02
        off.append((found - scale) / sigma)
    assert np.sqrt(np.mean(np.square(off))) < 1.7 and np.abs(off).max() < 4


def test_where_little_tells_nothing_is_said():
    rate, position = town(0)
    few = town(0, turns=3)
    assert scale_by_gps(*few) is None
    # of another drive, or in other units
    assert scale_by_gps(rate, town(1)[1]) is None
    assert scale_by_gps(Samples(rate.stamps_s, np.degrees(rate.values)), position) is None
    # gaps of the gyro hide all turns
    still = np.linalg.norm(rate.values, axis=1) < 0.2
    assert scale_by_gps(Samples(rate.stamps_s[still][::40], rate.values[still][::40]),
                        position) is None


def test_a_gyro_that_stands_or_is_one_sample_says_nothing():
    _, position = town(0)
    still = Samples(np.arange(100) / 10, np.zeros((100, 3)))
    assert scale_by_gps(still, position) is None
    assert scale_by_gps(Samples(np.zeros(1), np.zeros((1, 3))), position) is None
    assert scale_by_gps(town(0)[0], Samples(np.zeros(1), np.zeros((1, 3)))) is None
