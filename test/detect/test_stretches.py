# SPDX-License-Identifier: Apache-2.0
"""The stretches beside turns: which are kept, and that they stay apart from turns."""
from __future__ import annotations

import numpy as np
import pytest

from dashcalib_ros.detect.stretches import LEAST_S, StretchBank
from dashcalib_ros.detect.turn import MIN_PROMINENCE, Turn
from dashcalib_ros.input import Frame

RATE = 10
IMAGE = np.zeros((4, 8), np.uint8)


def turn(first: int, last: int) -> Turn:
    return Turn((first + last) // 2, first, last, 0.0, 0.05)


def bank_of(swings: list[float], turns: tuple[Turn, ...] = (), capacity: int = 3,
            gaps: tuple[int, ...] = (), keep=list) -> StretchBank:
    """Return the bank after a drive of tiles of 6 s that swing so far, of the width."""
    bank = StretchBank(capacity, 6.0, lambda: turns, keep)
    for index in range(6 * RATE * len(swings)):
        swing = swings[index // (6 * RATE)]
        bank.push(Frame(index, index * 10**9 // RATE, IMAGE),
                  (0.0, swing * np.cos(2 * np.pi * index / RATE / 3)), index in gaps)
    bank.finish()
    return bank


def test_those_are_kept_that_swing_most():
    found = bank_of([0.01, 0.04, 0.0, 0.03, 0.02]).stretches()
    assert [each.center // (6 * RATE) for each in found] == [1, 3, 4]
    assert 0 < found[2].prominence < found[0].prominence < MIN_PROMINENCE
    assert all(each.images >= LEAST_S * RATE for each in found)


def test_what_a_turn_has_is_left_to_it():
    found = bank_of([0.04] * 3, (turn(80, 140),)).stretches()
    assert found and all(each.last < 80 or each.first > 140 for each in found)
    # too little is left of the second tile before the turn, and of none behind it
    assert sorted(each.first for each in found) == [0, 141]


def test_no_stretch_goes_over_a_gap():
    assert all(not each.first < 30 <= each.last
               for each in bank_of([0.04] * 2, gaps=(30,)).stretches())


def test_images_can_be_freed_and_none_is_kept_without_a_place():
    bank = bank_of([0.01, 0.04])
    first = bank.stretches()[0]
    bank.exchange(first.center, ())
    assert bank.stretches()[0].frames == () and bank.stretches()[0].images == first.images
    bank.free_images()
    assert not any(each.frames for each in bank.stretches())
    assert bank_of([0.04], capacity=0).stretches() == ()


def test_a_live_drive_keeps_the_images_of_one_until_they_are_taken():
    bank = bank_of([0.01, 0.04, 0.0, 0.03, 0.02], keep=None)
    [best] = bank.stretches()
    assert best.frames and best.center // (6 * RATE) == 1
    bank.exchange(best.center, ())
    for index in range(300, 420):
        bank.push(Frame(index, index * 10**9 // RATE, IMAGE), (0.001 * (index % 7), 0.0), False)
    bank.finish()
    assert len(bank.stretches()) > 1 and sum(bool(each.frames) for each in bank.stretches()) == 1
    bank.want(False)
    assert not any(each.frames for each in bank.stretches())


@pytest.mark.parametrize('seconds', [2, 3])
def test_short_drives_have_none(seconds):
    bank = StretchBank(3, 6.0, tuple, list)
    for index in range(seconds * RATE):
        bank.push(Frame(index, index * 10**9 // RATE, IMAGE), (0.01, 0.0), False)
    bank.finish()
    assert bank.stretches() == ()
