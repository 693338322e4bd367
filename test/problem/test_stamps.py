# SPDX-License-Identifier: Apache-2.0
"""The path of a car says where stamps hide a loss of images, and how inaccurate they are."""
from __future__ import annotations

import numpy as np
import pytest

from dashcalib_ros.camera.rotation import rotation_matrices
from dashcalib_ros.problem.stamps import inaccurate_s, missing_s
from dashcalib_ros.problem.trajectory import Trajectory

STAMPS_S = np.cumsum([0.0, *[0.1, 0.2, 0.1, 0.2, 0.2] * 4])


def turn(seconds: np.ndarray, stamps_s: np.ndarray, speed: float = 6.0, braking: float = 0.0
         ) -> Trajectory:
    """Return the path of a car at these times, m/s and m/s^2, in a bend of 10 m."""
    way = speed * seconds - braking * seconds**2 / 2
    rotations = rotation_matrices(np.outer(-way / 10.0, [0.0, 1.0, 0.0]))
    centres = 10.0 * np.column_stack([1 - np.cos(way / 10), 0 * way, np.sin(way / 10)])
    return Trajectory.through(
        rotations, -np.einsum('nij,nj->ni', rotations, centres),
        np.ones(len(seconds), bool), (1e9 * stamps_s).astype(np.int64))


@pytest.mark.parametrize('braking', [0.0, 1.4, -3.0])
@pytest.mark.parametrize('lost_s', [0.1, 0.2, 0.5])
def test_time_that_stamps_hide_is_found(lost_s, braking):
    seconds = STAMPS_S + lost_s * (np.arange(len(STAMPS_S)) > 9)
    found = missing_s(turn(seconds, STAMPS_S, braking=braking))
    assert np.flatnonzero(found).tolist() == [9]
    assert found[9] == pytest.approx(lost_s, abs=0.03)


@pytest.mark.parametrize('braking', [0.0, 1.4, -3.0])
def test_nothing_is_missing_where_stamps_are_right_or_inaccurate(braking):
    rng = np.random.default_rng(0)
    for jitter_s in (0.0, 0.003, 0.01, 0.02):
        stamps_s = STAMPS_S + rng.normal(0.0, jitter_s, len(STAMPS_S))
        assert not missing_s(turn(STAMPS_S, stamps_s, braking=braking)).any()


def test_stamps_that_tell_of_the_loss_hide_nothing():
    seconds = STAMPS_S + 0.5 * (np.arange(len(STAMPS_S)) > 9)
    assert not missing_s(turn(seconds, seconds)).any()


@pytest.mark.parametrize('count', [0, 1, 2, 5, 6])
def test_paths_of_few_keyframes(count):
    path = turn(STAMPS_S[:count], STAMPS_S[:count])
    assert missing_s(path).shape == (max(count - 1, 0),)
    assert inaccurate_s(path)[0].shape == (count,) and inaccurate_s(path)[1] == 0.0


def test_a_parked_car():
    path = turn(STAMPS_S, STAMPS_S, speed=0.0)
    assert not missing_s(path).any() and inaccurate_s(path)[1] == 0.0


@pytest.mark.parametrize('braking', [0.0, 1.4, -3.0])
@pytest.mark.parametrize('jitter_s', [0.005, 0.01, 0.02])
def test_inaccurate_stamps_are_set_right(jitter_s, braking):
    rng = np.random.default_rng(1)
    stamps_s = STAMPS_S + rng.normal(0.0, jitter_s, len(STAMPS_S))
    late, spread = inaccurate_s(turn(STAMPS_S, stamps_s, braking=braking))
    assert spread == pytest.approx(jitter_s, rel=0.5)
    wrong, left = (np.diff(each) / np.diff(STAMPS_S) - 1 for each in (stamps_s, stamps_s - late))
    assert np.std(left) < 0.5 * np.std(wrong)


@pytest.mark.parametrize('braking', [0.0, 1.4, -3.0])
def test_exact_stamps_are_not_called_inaccurate(braking):
    late, spread = inaccurate_s(turn(STAMPS_S, STAMPS_S, braking=braking))
    assert spread < 0.001 and np.abs(late).max() < 0.002
