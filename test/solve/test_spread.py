# SPDX-License-Identifier: Apache-2.0
"""What turns know together: how much they differ is learnt from them, and is in sigma."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solving import only, scenes_of, solved
from synthetic import LENS

from dashcalib_ros.camera import Brown
from dashcalib_ros.problem.quadratic import Quadratic
from dashcalib_ros.solve.solution import Solution, with_measurement
from dashcalib_ros.solve.spread import Posterior, softened

WIDE = LENS.widened()
# sigmas of one turn: fx fy cx cy, k1 k2 p1 p2 k3
ONE = np.array([2.0, 2.0, 1.0, 1.0, 0.003, 0.003, 1e-4, 1e-4, 0.003])


def knowing(offsets_px: list[float], earlier: list[bool] | None = None,
            sharp: float = 1.0) -> Posterior:
    """Return turns that each ask for an fx (and fy) that is so far off, with sigmas ONE / sharp.

    Only fx and fy are known together.
    """
    spread = np.diag((ONE / sharp)**2)
    spread[0, 1] = spread[1, 0] = 0.9 * spread[0, 0]
    hessian = np.linalg.inv(spread)
    turns = tuple(Quadratic(hessian, hessian @ np.r_[off, off, np.zeros(7)], hessian)
                  for off in offsets_px)
    return Posterior(WIDE, np.zeros((9, 9)), turns,
                     np.array(earlier or [False] * len(turns)), Quadratic.prior(1e-9 * np.eye(9)))


def test_what_is_known_besides_takes_away_what_all_turns_err_by():
    turns = knowing([0.5, -0.5]).erring_together(0.1)
    along = np.eye(9)[0]
    informed = replace(turns, further=(Quadratic(
        np.outer(along, along), along * 30.0, np.zeros((9, 9))),))
    assert sigma(turns) > 0.09 * LENS.fx
    # fx is 30 ± 1 px more, and fy follows as far as the turns know them together
    assert sigma(informed) == pytest.approx(1.0, rel=0.01)
    assert informed.offset[:2] == pytest.approx([30.0, 27.0], rel=0.02)
    assert informed.covariance[1, 1] < 0.01 * turns.covariance[1, 1]


def sigma(known: Posterior) -> float:
    return float(np.sqrt(known.covariance[0, 0]))


def test_two_turns_that_disagree_have_a_larger_sigma():
    agree, disagree = knowing([0.2, -0.2]), knowing([8.0, -8.0])
    assert sigma(disagree) > 2 * sigma(agree)
    # one sigma of their mean, about
    assert 0.4 * 8.0 < sigma(disagree) < 8.0
    assert disagree.offset[0] == pytest.approx(0.0, abs=1e-6)


def test_five_sharp_turns_that_agree_lose_nothing():
    five = knowing([0.1, -0.1, 0.05, 0.0, -0.05], sharp=10.0)
    assert sigma(five) < 1.5 * sigma(five.alike)
    # two of them cannot show that they agree as well
    assert sigma(five.of([0, 1])) / sigma(five.alike.of([0, 1])) > 1.3 * (
        sigma(five) / sigma(five.alike))


def test_one_turn_allows_for_how_much_turns_differ():
    one = knowing([0.0])
    assert sigma(one.alike) == pytest.approx(ONE[0], rel=1e-3)
    assert 0.004 * LENS.fx < sigma(one) < 0.01 * LENS.fx
    # what it knows apart from fx stays
    assert one.covariance[2, 2] == pytest.approx(ONE[2]**2, rel=1e-3)


@pytest.mark.parametrize('differ', [0.0, 0.003, 0.006])
def test_sigma_holds_where_turns_differ(differ):
    rng, held = np.random.default_rng(3), []
    for _ in range(150):
        own = rng.normal(size=3) * np.hypot(ONE[0] / 2, differ * LENS.fx)
        known = knowing(own.tolist(), sharp=2.0)
        held.append(abs(known.offset[0]) < 2 * sigma(known))
    assert np.mean(held) >= 0.92


def test_a_turn_without_information_adds_no_certainty():
    known = knowing([1.0, -1.0])
    nothing = Quadratic(*(np.zeros((9, 9)), np.zeros(9), np.zeros((9, 9))))
    more = replace(known, turns=(*known.turns, nothing), earlier=np.zeros(3, bool))
    np.testing.assert_allclose(more.covariance, known.covariance, rtol=1e-6)


def test_tracks_that_share_their_errors_count_less():
    known = knowing([0.0, 0.0]).alike
    louder = replace(known, turns=tuple(replace(turn, by_track=9 * turn.by_track)
                                        for turn in known.turns))
    assert sigma(louder) == pytest.approx(3 * sigma(known), rel=1e-3)


def test_what_all_turns_share_does_not_average_out():
    known = knowing([0.0] * 4).alike
    shared = replace(known, alike_in_all=np.diag(np.r_[9.0, np.zeros(8)]))
    assert sigma(shared) == pytest.approx(np.hypot(3.0, sigma(known)))


def test_earlier_drives_count_as_far_as_this_one_confirms_them():
    own, alone = knowing([0.0] * 4), knowing([0.0])
    mixed = knowing([0.0] * 4, [False, True, True, True])
    assert sigma(own) < sigma(mixed) < sigma(alone)
    assert mixed.of_another_drive < 0 == own.of_another_drive
    other = knowing([0.0, 0.0, 30.0, 30.0], [False, False, True, True])
    assert other.of_another_drive > 4.5
    # some of both: the result may be off by that
    doubted = knowing([0.0, 8.0, 8.0, 8.0], [False, True, True, True])
    assert abs(doubted.offset[0]) < 2 * sigma(doubted)


def test_the_prior_s_pull_on_the_centre_is_in_sigma():
    """A picture of which a side was cut off has its centre elsewhere."""
    known = knowing([0.0, 0.0])
    pulled = replace(known, prior=Quadratic(known.prior.hessian, np.r_[
        0.0, 0.0, 2.0, np.zeros(6)], np.zeros((9, 9))))
    drawn = float((pulled.total.covariance @ pulled.prior.score)[2])
    assert drawn > 0.5
    assert pulled.covariance[2, 2] == pytest.approx(known.covariance[2, 2] + drawn**2, rel=0.01)


def test_what_makes_a_cost_soft_is_in_its_covariance():
    cost = knowing([0.0]).turns[0]
    column = np.zeros((9, 1))
    column[0] = 5.0
    _, soft = softened(cost, column)
    free = np.diag([1.0, 0, 0, 0, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(np.linalg.inv(soft.hessian),
                               np.linalg.inv(cost.hessian) + 25.0 * free, rtol=1e-6, atol=1e-12)
    covariance = np.linalg.inv(soft.hessian)
    np.testing.assert_allclose(covariance @ soft.by_track @ covariance, covariance, rtol=1e-6,
                               atol=1e-12)
    # where the turn asks for such a change, there is evidence for it
    far = replace(cost, score=cost.hessian @ (10.0 * column[:, 0] / 5.0))
    assert softened(far, column)[0] > 0 > softened(cost, column)[0]


# one more measurement

@pytest.fixture(scope='module')
def solution() -> Solution:
    return solved(scenes_of(2))


def test_a_measurement_draws_the_camera_as_far_as_it_is_known(solution):
    along = np.zeros(len(solution.posterior.prior.score))
    along[0] = 1.0
    own = float(solution.posterior.covariance[0, 0])
    sharp, blind = (with_measurement(solution, along, 3.0, variance)
                    for variance in (1e-6, 1e9))
    assert sharp.camera.fx == pytest.approx(solution.camera.fx + 3.0, abs=0.3)
    assert sharp.sigma[0] < 0.3 * solution.sigma[0]
    assert blind.camera.fx == pytest.approx(solution.camera.fx, abs=1e-3)
    assert blind.sigma[0] == pytest.approx(solution.sigma[0], rel=0.02)
    equal = with_measurement(solution, along, 3.0, own)
    # half way, if sigma were that of one case; where turns may not differ it is smaller
    assert 0.5 < equal.camera.fx - solution.camera.fx < 2.2
    # fy, which is known together with fx, follows
    assert sharp.camera.fy - solution.camera.fy > 1.5
    assert sharp.scenes is solution.scenes


def test_sigma_of_some_turns_is_larger(solution):
    assert only(solution, [0]).sigma[0] > solution.sigma[0]
    assert isinstance(solution.posterior.lens, Brown)
