# SPDX-License-Identifier: Apache-2.0
"""What the node says while it learns, one line for each event: no ROS needed."""
from __future__ import annotations

from dataclasses import replace

from dashcalib_ros.config import Config
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import Notice
from dashcalib_ros.judge import TurnSummary, Verdict
from dashcalib_ros.report import Calibration
from dashcalib_ros.report.turns import BACK, LEFT, RIGHT
from dashcalib_ros.ros.background import beginning, new_turns, seen
from dashcalib_ros.ros.state import outcome_text
from dashcalib_ros.selection import Status


def status(*turns, ways=()):
    """Return a status with these (turn, yaw); ways: where they go."""
    keys, yaws = tuple(turn for turn, _ in turns), tuple(yaw for _, yaw in turns)
    return Status(10, len(turns), len(turns), sum(yaws), 0.1, False, keys, 0, yaws, ways=ways)


def lines(told, now, wanted=5, checking=False):
    return new_turns(told, now, wanted, checking)


A, B, C = TurnId.at(10), TurnId.at(20), TurnId.at(30)
OLD = TurnId.stored(0)


def test_each_new_turn_is_one_line():
    assert lines(set(), status((A, 90.0))) == ['turn 1 of 5: 90°, 90° in all']
    assert lines({A}, status((B, 89.4), (A, 90.0))) == ['turn 2 of 5: 89°, 179° in all']
    assert lines({A, B}, status((B, 89.4), (A, 90.0))) == []


def test_turns_that_come_together_are_numbered_on():
    assert lines({A}, status((B, 60.0), (A, 90.0), (C, 30.0))) == [
        'turn 2 of 5: 60°, 150° in all', 'turn 3 of 5: 30°, 180° in all']


def test_who_drives_reads_which_turns_there_are_and_how_many_are_missing():
    assert seen(status(), 5) == 'no turn yet; 5 more turns needed'
    some = status((A, 90.0), (B, 60.4), (C, 30.0), ways=(RIGHT, LEFT, RIGHT))
    assert seen(some, 4) == '2 right turns, 1 left turn, 180° in all; 1 more turn needed'
    assert seen(status((A, 90.0), ways=(BACK,)), 1) == '1 S-bend, 90° in all'
    gentle = replace(status(), stretches=(A, B, TurnId.at(9)), bends=1)
    assert seen(gentle, 5, 0.0123) == (
        'no turn yet, 1 bend, 2 straight pieces; fx ± 1.2 % so far; 5 more turns needed')
    assert lines(set(), status((A, 90.0), ways=(LEFT,))) == [
        'turn 1 of 5: 90° to the left, 90° in all']


def test_stored_turns_and_checks_are_told_as_such():
    assert lines(set(), status((OLD, 85.0))) == [
        'turn 1 of 5 (of an earlier drive): 85°, 85° in all']
    assert lines(set(), status((A, 85.0)), checking=True) == [
        'turn 1 of 5 for the next check of the calibration: 85°, 85° in all']
    # more than wanted, as the result was weak
    assert lines({A, B}, status((A, 50.0), (B, 50.0), (C, 80.0)), wanted=2) == [
        'turn 3: 80°, 180° in all']


def test_a_calibration_begins_and_ends_with_a_line():
    assert beginning(status((A, 90.0))) == 'calibrating with 1 turn, 90° of yaw…'
    turn = TurnSummary(10, 0, 20, 1.0, 0.05, 30, 30, True)
    weak = Calibration(Verdict('weak', (Notice('', 'few turns'),)), (320, 240), None, None,
                       (turn,), 10, 0.3, {}, {}, Config())
    assert outcome_text(weak, 'few turns') == (
        'a calibration of 1 turn is weak: few turns; it is calculated again with each better turn')


def test_a_calibration_on_request_may_begin_before_its_turn_is_built():
    found = Status(10, 1, 0, 0.0, 0.1, False)
    assert beginning(found) == 'calibrating, as soon as 1 turn found so far can be used…'
