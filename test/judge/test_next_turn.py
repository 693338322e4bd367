# SPDX-License-Identifier: Apache-2.0
"""What one more turn would bring is what it brings."""
from __future__ import annotations

import dataclasses
import re

import pytest
from solving import CONFIG, only, scenes_of, solved, with_turns

from dashcalib_ros.judge.agreement import next_turn, with_right_angles
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.solve.solution import Solution

NEEDS_MORE = CONFIG.replace({'verdict.min_turns': 9}).verdict


@pytest.fixture(scope='module')
def four():
    return solved(scenes_of(4, tracks=110, keyframes=12))


def first(solution: Solution, count: int) -> Solution:
    """Return the solution as if only the first turns had been there."""
    return only(solution, range(count))


@pytest.mark.parametrize(('count', 'more'), [(1, 2), (2, 1), (3, 1)])
def test_it_is_what_the_next_turns_bring(four, count, more):
    after = first(four, count + more)
    told = with_right_angles(first(four, count), more)
    assert 1 / 2 < told / float(after.sigma[0] / four.camera.fx) < 2


def test_a_single_turn_is_told_what_two_more_bring(four):
    assert re.fullmatch(r'two more right-angle turns: fx known to about [\d.]+ %',
                        next_turn(first(four, 1)))


def test_where_nothing_is_known_nothing_is_told(four):
    turns = tuple(dataclasses.replace(
        turn, hessian=1e-9 * turn.hessian, by_track=1e-9 * turn.by_track)
        for turn in four.posterior.turns)
    assert next_turn(with_turns(four, turns)) == ''


def test_a_verdict_tells_it_with_the_first_cure(four):
    verdict = judge(four, NEEDS_MORE, outlook=True)
    assert verdict.level == 'weak'
    assert str(verdict.reasons[0]).endswith(f' ({next_turn(four)})') and next_turn(four)
    assert str(verdict.reasons[0]).endswith(': ' + verdict.remedies[0])


def test_where_something_contradicts_the_result_more_turns_are_no_cure(four):
    strange = dataclasses.replace(NEEDS_MORE, max_aspect=0.0)
    verdict = judge(four, strange, outlook=True)
    assert verdict.codes == ('E-FEW-TURNS', 'E-PIXEL-ASPECT')
    assert next_turn(four) not in ' '.join(map(str, verdict.reasons))
    assert judge(four, CONFIG.verdict, outlook=True).reasons == ()
