# SPDX-License-Identifier: Apache-2.0
"""The statistics that all rooms share: few bad values do not spoil them."""
from __future__ import annotations

import numpy as np
import pytest

from dashcalib_ros.robust import (
    EvenlySpaced,
    cauchy_fit,
    jackknife,
    mad_sigma,
    weighted_mean,
    weighted_median,
)

RNG = np.random.default_rng(3)
X = np.linspace(-1, 1, 200)
COLUMNS = np.column_stack([np.ones(200), X])
# of every fifth value; the others have noise of 0.01
SPOILED = np.arange(200) % 5 == 0
LINE = 2 + 3 * X + 0.01 * RNG.standard_normal(200) + np.where(SPOILED, 5 + X, 0.0)


def scale(off):
    return 2 * max(mad_sigma(off), 1e-6)


def test_the_size_of_errors_is_that_of_most():
    assert mad_sigma(RNG.standard_normal(20_000)) == pytest.approx(1.0, rel=0.03)
    assert mad_sigma(np.r_[RNG.standard_normal(1000), np.full(50, 1e9)]) < 1.2


@pytest.mark.parametrize('power', [1, 2])
def test_a_line_is_that_of_most_values(power):
    found = cauchy_fit(COLUMNS, LINE, scale, 20, power=power)
    np.testing.assert_allclose(found.params, [2.0, 3.0], atol=0.02)
    plain = np.linalg.lstsq(COLUMNS, LINE, rcond=None)[0]
    assert abs(plain[0] - 2.0) > 0.5
    np.testing.assert_allclose(found.off, np.abs(LINE - COLUMNS @ found.params))
    assert found.weights[SPOILED].max() < 1e-3 < 0.2 < np.median(found.weights[~SPOILED])
    np.testing.assert_allclose(found.normal, COLUMNS.T * found.weights @ COLUMNS)


def test_without_new_weights_it_is_the_weighted_least_squares():
    weights = RNG.uniform(0.1, 1.0, 200)
    found = cauchy_fit(COLUMNS, LINE, scale, 0, weights)
    root = np.sqrt(weights)
    expected = np.linalg.lstsq(COLUMNS * root[:, None], LINE * root, rcond=None)[0]
    np.testing.assert_allclose(found.params, expected, rtol=1e-9)


def test_two_components_share_a_weight():
    wanted = np.column_stack([LINE, 1 - X])
    design = np.zeros((200, 2, 4))
    design[:, 0, :2] = design[:, 1, 2:] = COLUMNS
    found = cauchy_fit(design, wanted, scale, 20)
    np.testing.assert_allclose(found.params, [2.0, 3.0, 1.0, -1.0], atol=0.02)
    assert found.weights.shape == found.off.shape == (200,)


def test_scales_of_single_values_and_a_start_are_used():
    sigma = np.where(SPOILED, 100.0, 0.01)
    found = cauchy_fit(COLUMNS, LINE, sigma, 30, sigma**-2, np.array([1.9, 3.1]))
    np.testing.assert_allclose(found.params, [2.0, 3.0], atol=0.01)


def test_what_nothing_determines_is_as_small_as_possible():
    found = cauchy_fit(np.column_stack([COLUMNS, np.zeros(200)]), LINE, scale, 20)
    assert abs(found.params[2]) < 1e-9
    drawn = cauchy_fit(COLUMNS, LINE, scale, 20, prior=lambda w: w.sum() * np.array([0, 1e6]))
    assert abs(drawn.params[1]) < 1e-4


def test_the_jackknife_of_a_mean_is_its_standard_error():
    values = RNG.standard_normal((240, 2)) * [1.0, 10.0]
    each = jackknife(lambda kept: values[kept].mean(axis=0), np.arange(240), 240)
    np.testing.assert_allclose(each, values.std(axis=0, ddof=1) / np.sqrt(240))
    # what groups share makes it larger
    shared = values + np.repeat(RNG.standard_normal((12, 1)) * 5, 20, axis=0)
    grouped = jackknife(lambda kept: shared[kept].mean(axis=0), np.repeat(np.arange(12), 20), 12)
    assert grouped[0] > 3 * jackknife(lambda kept: shared[kept].mean(axis=0),
                                      np.arange(240), 240)[0]


def test_a_mean_is_wider_where_its_values_differ_by_more_than_they_say():
    alike = weighted_mean(np.array([1.0, 1.0, 1.0]), np.array([1.0, 1.0, 0.5]))
    assert (alike.value, alike.variance, alike.widened) == (1.0, 0.25, 0.25)
    apart = weighted_mean(np.array([0.0, 10.0]), np.array([1.0, 1.0]))
    assert (apart.value, apart.variance, apart.squares) == (5.0, 0.5, 50.0)
    assert apart.widened == 25.0
    lone = weighted_mean(np.array([7.0]), np.array([4.0]))
    assert (lone.value, lone.widened) == (7.0, 4.0)


def test_a_median_counts_weights():
    values = np.array([3.0, 1.0, 2.0, 100.0])
    assert weighted_median(values, np.ones(4)) == 2.0
    assert weighted_median(values, np.array([1.0, 1.0, 1.0, 9.0])) == 100.0


def test_many_items_stay_evenly_spaced():
    kept = EvenlySpaced(0.1, 40)
    for stamp_ns in range(0, 100_000_000_000, 50_000_000):
        if kept.wants(stamp_ns):
            kept.append(stamp_ns, stamp_ns // 10**6)
    stamps = np.array([stamp for stamp, _ in kept.items])
    assert 20 <= len(stamps) <= 40 and len(set(np.diff(stamps))) == 1
    assert stamps[-1] > 90_000_000_000 and kept.items[3][1] == stamps[3] // 10**6
    # a clock that was set back starts anew
    assert kept.wants(5)
