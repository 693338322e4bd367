# SPDX-License-Identifier: Apache-2.0
"""Costs near the solution: added up, with parameters fixed or eliminated, at their optimum."""
from __future__ import annotations

import numpy as np
import pytest

from dashcalib_ros.problem.quadratic import Quadratic


def by_track(cost: Quadratic) -> np.ndarray:
    """Return the covariance of the optimum with each track as one measurement."""
    return cost.covariance @ cost.by_track @ cost.covariance


def a_cost(seed: int, size: int = 5) -> Quadratic:
    rng = np.random.default_rng(seed)
    root, tracks = rng.normal(size=(2, size, 3 * size))
    return Quadratic(root @ root.T, rng.normal(size=size), tracks @ tracks.T)


def test_the_optimum_costs_least():
    cost = a_cost(0)
    least = cost.change(cost.optimum)
    assert least < 0 and cost.change(np.zeros(5)) == 0
    for step in np.random.default_rng(1).normal(size=(20, 5)):
        assert cost.change(cost.optimum + step) > least


def test_another_place_has_the_same_optimum():
    cost, step = a_cost(0), np.arange(5) / 10
    np.testing.assert_allclose(cost.moved(step).optimum, cost.optimum - step)


def test_what_is_eliminated_follows_and_what_is_fixed_does_not():
    cost = a_cost(0)
    rest = cost.eliminated(2)
    np.testing.assert_allclose(rest.optimum, cost.optimum[2:])
    np.testing.assert_allclose(rest.covariance, cost.covariance[2:, 2:])
    np.testing.assert_allclose(by_track(rest), by_track(cost)[2:, 2:])
    # fewer free parameters are known better
    assert (np.diag(cost.of([2, 3, 4]).covariance) < np.diag(rest.covariance)).all()


def test_a_sum_lies_between_its_parts():
    one, other = a_cost(0, 1), a_cost(1, 1)
    both = Quadratic.together([one, other])
    low, high = sorted([one.optimum[0], other.optimum[0]])
    assert low <= both.optimum[0] <= high
    assert both.covariance < min(one.covariance, other.covariance)


def test_a_prior_is_one_more_cost():
    cost = a_cost(0)
    strong = Quadratic.prior(np.diag([1e12, 1e12]), np.full(3, 1e-12))
    drawn = Quadratic.together([cost, strong]).optimum
    np.testing.assert_allclose(drawn[:2], 0, atol=1e-9)
    np.testing.assert_allclose(drawn[2:], cost.of([2, 3, 4]).optimum, rtol=1e-6)


def test_twice_the_noise_is_half_the_information_and_the_same_optimum():
    cost = a_cost(0)
    loud = cost.at_noise(2.0)
    np.testing.assert_allclose(loud.optimum, cost.optimum)
    np.testing.assert_allclose(loud.covariance, 2 * cost.covariance)
    # what tracks scatter does not depend on the noise that one takes them to have
    np.testing.assert_allclose(by_track(loud), by_track(cost))


def test_chance_is_the_number_of_parameters_where_tracks_are_independent():
    cost = a_cost(0)
    assert Quadratic(cost.hessian, cost.score, cost.hessian).chance == pytest.approx(5)
