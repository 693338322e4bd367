# SPDX-License-Identifier: Apache-2.0
"""The stamp gate, for recordings and for live streams: order, losses, set-backs, thinning."""
from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from dashcalib_ros.config import Config
from dashcalib_ros.detect import MotionEstimator
from dashcalib_ros.input import Frame
from dashcalib_ros.input.stamps import StampGate

SECOND = 10**9
START = 1_767_614_400 * SECOND


def taken(*stamps):
    watch = StampGate(1e9)
    return watch, [watch.take(stamp, 77 + n) for n, stamp in enumerate(stamps)]


def test_good_stamps_pass_and_gaps_are_counted():
    steps = [0, 1, 2, 3, 4, 5, 6, 9, 10, 11, 12, 15]
    watch, got = taken(*(START + step * SECOND // 10 for step in steps))
    assert got == [START + step * SECOND // 10 for step in steps]
    assert watch.lost == 4


def test_jitter_is_no_loss():
    rng = np.random.default_rng(0)
    watch, _ = taken(*(START + n * SECOND // 30 + int(rng.uniform(-6e6, 6e6)) for n in range(500)))
    assert watch.lost == 0


def test_a_pause_is_no_loss():
    watch, _ = taken(*(START + n * SECOND // 10 for n in range(20)), START + 60 * SECOND)
    assert watch.lost == 0


def test_late_and_repeated_images_are_not_learned_from():
    watch, got = taken(START, START, START - SECOND // 2, START + 1)
    assert got == [START, None, None, START + 1] and watch.repeated == 2


def test_a_clock_that_is_set_back_is_passed_on():
    watch, got = taken(START, START - 100 * SECOND, START - 99 * SECOND)
    assert got == [START, START - 100 * SECOND, START - 99 * SECOND]
    assert (watch.set_back, watch.repeated) == (1, 0)


def test_drivers_without_stamps_are_timed_by_arrival():
    watch, got = taken(0, 0, 0)
    assert got == [77, 78, 79] and watch.zero == 0
    assert watch.take(START, 80) == START


def test_one_zero_among_stamps_is_left_out():
    watch, got = taken(START, 0, START + 1)
    assert got == [START, None, START + 1] and watch.zero == 1


@pytest.mark.parametrize('rate', [5.0, 9.9, 13.0, 15.0, 25.0, 29.97, 60.0])
def test_thinning_takes_what_the_motion_estimator_takes(rate):
    rng = np.random.default_rng(int(rate))
    config = Config()
    gate, estimator = StampGate(config.tracking.rate), MotionEstimator(config.tracking)
    image = np.zeros((48, 64), np.uint8)
    stamps = [START + round(n * SECOND / rate + rng.uniform(-5e6, 5e6)) for n in range(60)]
    stamps += [stamp - 3000 * SECOND for stamp in stamps]  # a bag that loops
    mine = [Frame(n, stamp, image) for n, stamp in enumerate(stamps)
            if gate.take(stamp, 0) is not None]
    theirs = [motion.index for n, stamp in enumerate(stamps)
              if (motion := estimator.push(Frame(n, stamp, image)))]
    again = MotionEstimator(config.tracking)
    assert theirs == [frame.index for frame in mine if again.push(frame)]
    # one a second of the others is looked at
    assert 0 <= len(mine) - len(theirs) <= 2 * 60 / rate + 2


def test_a_recording_goes_on_where_its_clock_is_set_back():
    gate = StampGate()
    stamps = [gate.take(hour * 3600 * SECOND + tenth * SECOND // 10, 0)
              for hour, tenth in ((5, 0), (5, 1), (4, 0), (4, 1), (4, 3))]
    steps = np.diff(np.array(stamps, np.int64)) // (SECOND // 10)
    assert steps.tolist() == [1, 1, 1, 2]
    [warning] = gate.warnings()
    assert warning.code == 'E-STAMP-SET-BACK' and '3600.1 s' in str(warning)


def test_a_recording_without_stamps_keeps_to_the_times_of_reception():
    gate = StampGate()
    assert [gate.take(0, 5), gate.take(START, 6), gate.take(0, 7)] == [5, 6, 7]
    assert [each.code for each in gate.warnings()] == ['E-STAMP-MISSING']


def test_a_live_stream_begins_anew_and_keeps_its_counts():
    gate = StampGate(10.0)
    assert [gate.take(START, 0), gate.take(START, 0), gate.take(0, 0)] == [START, None, None]
    gate.forget()
    assert gate.take(START - 10 * SECOND, 0) == START - 10 * SECOND
    assert (gate.repeated, gate.zero, gate.set_back) == (1, 1, 0)


def beside(gate, stamps, received):
    """Return what a gate makes of stamps, beside the times at which their images came."""
    return [gate.take(int(stamp), int(time)) for stamp, time in zip(stamps, received, strict=True)]


def rounded(times):
    """Return stamps whose seconds are rounded, and their fraction is not."""
    return [round(time / 1e9) * 10**9 + time % 10**9 for time in times]


def late(times):
    """Return stamps whose seconds come 0.35 s late."""
    return [(time - 35 * 10**7) // 10**9 * 10**9 + time % 10**9 for time in times]


def standing(times):
    """Return stamps whose seconds stand still."""
    return [times[0] // 10**9 * 10**9 + time % 10**9 for time in times]


TIMES = [START + n * 10**8 for n in range(300)]
LATE = [time + (n * 37 % 20) * 10**6 for n, time in enumerate(TIMES)]


@pytest.mark.parametrize('rate', [None, 100.0])
@pytest.mark.parametrize('fault', [rounded, late, standing])
def test_stamps_that_fall_back_once_a_second_are_named_and_not_used(rate, fault):
    gate = StampGate(rate)
    found = beside(gate, fault(TIMES), LATE)
    kept = [stamp for stamp in found if stamp is not None]
    assert 'jump back by 0.9 s once per second' in gate.fault
    assert len(kept) > 270 and all(b > a for a, b in pairwise(kept))
    # since it is known, each image has the time at which it came
    assert np.ptp(np.subtract(kept[-200:], LATE[-200:])) == 0
    if rate is None:
        assert [each.code for each in gate.warnings()] == ['E-STAMP-WRONG']


@pytest.mark.parametrize(('factor', 'words'), [
    (1e-3, 'microseconds as nanoseconds'), (1e-6, 'milliseconds as nanoseconds'),
    (1e-9, 'seconds as nanoseconds'), (1e3, 'milliseconds as seconds')])
def test_stamps_of_another_unit_are_named_and_not_used(factor, words):
    gate = StampGate()
    found = beside(gate, [1 + (time - START + 10**12) * factor for time in TIMES], LATE)
    assert words in gate.fault
    assert np.ptp(np.subtract(found[-200:], LATE[-200:])) == 0


@pytest.mark.parametrize('received', [
    [0] * 300, TIMES, LATE, [START] * 300, [time + 10**6 * 17 for time in TIMES[::-1]]])
def test_sound_stamps_are_used_whatever_the_times_of_reception_are(received):
    gate = StampGate()
    assert beside(gate, TIMES, received) == TIMES and not gate.warnings()


def test_two_publishers_whose_clocks_differ_by_a_second_are_no_sawtooth():
    gate = StampGate()
    beside(gate, [time + n % 2 * 10**9 for n, time in enumerate(TIMES)], LATE)
    assert not gate.fault


def test_a_bag_that_loops_is_no_sawtooth():
    gate = StampGate()
    beside(gate, [*TIMES[:20], *TIMES[:20], *TIMES[:20]], LATE[:60])
    assert not gate.fault and gate.set_back == 2
