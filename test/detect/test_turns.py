# SPDX-License-Identifier: Apache-2.0
"""The streaming detector against scipy and numpy offline, and the bank's bounds."""
from __future__ import annotations

import math
import weakref

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import find_peaks

from dashcalib_ros.config import TurnsConfig
from dashcalib_ros.detect import TurnDetector
from dashcalib_ros.detect.detector import CUT_OFF, SEEN, History
from dashcalib_ros.detect.estimator import Motion
from dashcalib_ros.detect.peaks import PeakFinder, StreamingMedian
from dashcalib_ros.detect.turn import MIN_PROMINENCE
from dashcalib_ros.input import Frame

TINY = np.zeros((2, 2), np.uint8)
# few levels make plateaus and ties; the others are plain random signals
SIGNALS = st.one_of(
    st.lists(st.integers(0, 4).map(float), max_size=80),
    st.lists(st.floats(0, 1), max_size=80),
    st.lists(st.integers(-3, 3), max_size=80).map(lambda steps: list(np.cumsum(steps) / 7.0)))


# -- peaks ------------------------------------------------------------------------------------

@settings(max_examples=400, deadline=None)
@given(SIGNALS, st.sampled_from([0.0, 0.1, 0.5, 1.0, 2.0]))
def test_peaks_equal_scipy(signal, min_prominence):
    finder, found = PeakFinder(min_prominence, 1000), []
    for count, value in enumerate(signal, 1):
        earliest = finder.earliest_ns
        peak = finder.push(count - 1, value)
        if peak is not None:
            assert peak.stamp_ns >= earliest
            found.append((peak, peak.prominence))
        # nothing is held back: what scipy finds in the signal so far is known
        sofar, about = find_peaks(np.array(signal[:count]), prominence=min_prominence)
        known = {peak.stamp_ns: peak.prominence for peak, _ in found}
        for position, prominence in zip(sofar, about['prominences'], strict=True):
            assert known[position] == prominence
        # a prominence only grows, up to its limit
        assert all(before <= peak.prominence <= peak.limit for peak, before in found)
        found = [(peak, peak.prominence) for peak, _ in found]
    finder.finish()
    assert all(peak.limit == peak.prominence for peak, _ in found)
    positions, about = find_peaks(np.array(signal, float), prominence=min_prominence)
    assert [(peak.stamp_ns, peak.height, peak.prominence) for peak, _ in found
            if peak.prominence >= min_prominence] == [
        (position, signal[position], prominence)
        for position, prominence in zip(positions, about['prominences'], strict=True)]


def test_of_a_top_that_is_too_flat_the_end_counts():
    finder = PeakFinder(1.0, 10)
    peaks = [finder.push(stamp, value) for stamp, value in enumerate([0.0, *[2.0] * 50, 0.0])]
    assert peaks[:-1] == [None] * 51
    assert peaks[-1].stamp_ns == 45 and len(finder._top) <= 11


def test_the_prominence_of_a_peak_grows_while_the_signal_falls():
    finder, peak, seen = PeakFinder(1.0, 1000), None, []
    for stamp, value in enumerate((0.0, 3.0, 2.5, 2.0, 1.0, 1.5, 4.0, 0.5)):
        peak = finder.push(stamp, value) if peak is None else (finder.push(stamp, value), peak)[1]
        seen.append(peak and (peak.stamp_ns, peak.prominence, peak.limit))
    assert seen == [None, None, (1, 0.5, 3.0), (1, 1.0, 3.0), (1, 2.0, 3.0), (1, 2.0, 3.0),
                    (1, 2.0, 2.0), (1, 2.0, 2.0)]


# -- median -----------------------------------------------------------------------------------

@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 400), st.floats(0, 1)), max_size=80),
       st.sampled_from([0.5, 1.0, 3.0]))
def test_median_equals_numpy(steps, half_width):
    stamps = np.cumsum([step for step, _ in steps], dtype=np.int64) * 1_000_000
    values = np.array([value for _, value in steps])
    median = StreamingMedian(half_width)
    result = [item for stamp, value in zip(stamps, values, strict=True)
              for item in median.push(int(stamp), float(value))]
    result += median.finish()
    assert [stamp for stamp, _ in result] == list(stamps)
    for stamp, value in result:
        window = values[np.abs(stamps - stamp) <= (half_width / 2 - 0.05) * 1e9]
        assert value == np.median(window)


def test_median_window_is_the_papers_at_ten_hertz():
    signal = np.random.default_rng(0).random(200)
    median = StreamingMedian(3.0)
    result = [v for i, x in enumerate(signal) for _, v in median.push(i * 100_000_000, float(x))]
    result += [v for _, v in median.finish()]
    size = 2 * math.floor(30 / 2) - 1
    for i in range(size // 2, 200 - size // 2):
        assert result[i] == np.median(signal[i - size // 2:i + size // 2 + 1])


# -- detector and bank ------------------------------------------------------------------------

class Stream:
    """Feeds a detector with tiny frames and given magnitudes."""

    def __init__(self, rate: float = 10.0, **changes) -> None:
        self.detector = TurnDetector(TurnsConfig(**changes))
        self.rate = rate
        self.count = 0
        self.ns = 0
        self.emitted = []
        self._images = []

    def feed(self, magnitudes, after_gap=False):
        for value in np.atleast_1d(magnitudes):
            self.ns += round(1e9 / self.rate)
            motion = Motion(self.count, self.ns, float(value), False, 5.0, 300, self.count,
                            self.ns, after_gap)
            frame = Frame(self.count, self.ns, TINY.copy())
            self._images.append(weakref.ref(frame.image))
            after_gap = False
            new = self.detector.push(frame, motion)
            assert all(turn.frames for turn in new)
            self.emitted += new
            self.count += 1
        return self

    def frames_alive(self):
        """Return how many images are still in memory."""
        self._images = [image for image in self._images if image() is not None]
        return len(self._images)

    def finish(self):
        self.emitted += self.detector.finish()
        return self.detector.bank.turns()


def hump(seconds: float, height: float, rate: float = 10.0) -> np.ndarray:
    n = round(seconds * rate)
    return height * np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2


def quiet(seconds: float, rate: float = 10.0) -> np.ndarray:
    return np.full(round(seconds * rate), 0.002)


@pytest.mark.parametrize('rate', [5.0, 10.0, 12.5])
def test_turn_has_three_seconds_on_either_side_at_any_rate(rate):
    stream = Stream(rate).feed(np.concatenate([quiet(10, rate), hump(5, 0.05, rate)]))
    assert stream.detector.bank.turns() == ()
    stream.feed(quiet(6, rate))
    turn, = stream.detector.bank.turns()
    # reported once, with the prominence it had then
    assert [new.center for new in stream.emitted] == [turn.center]
    assert stream.emitted[0].frames == turn.frames
    assert abs(turn.center / rate - 12.5) < 0.35
    assert abs(turn.first - (turn.center - 3 * rate)) < 1
    assert abs(turn.last - (turn.center + 3 * rate)) < 1
    assert [frame.index for frame in turn.frames] == list(range(turn.first, turn.last + 1))
    # the median takes a little off the top
    assert 0.035 < turn.prominence < 0.05
    assert turn.stamp_s == pytest.approx((turn.center + 1) / rate)


def test_turn_is_complete_as_soon_as_the_stream_is_half_a_width_past_it():
    stream = Stream().feed(np.concatenate([quiet(10), hump(3, 0.05)]))
    while not stream.emitted:
        stream.feed(0.002)
    assert stream.count - 1 == stream.emitted[0].last == stream.emitted[0].center + 30


def test_no_turns_in_straight_standing_and_unknown():
    rng = np.random.default_rng(1)
    noise = np.abs(rng.normal(0.003, 0.001, 600))
    standing = np.zeros(200)
    unknown = np.full(200, np.nan)
    stream = Stream().feed(np.concatenate([noise, standing, noise, unknown, noise]))
    # from driving to standing and back is no peak, but the stretch between may stand out a bit
    assert all(turn.prominence < 0.004 for turn in stream.finish())
    assert Stream().feed(noise).finish() == ()


def test_order_is_by_prominence_and_capacity_keeps_the_best():
    heights = [0.02, 0.05, 0.03, 0.01, 0.06]
    stream = Stream(capacity=3)
    for height in heights:
        stream.feed(quiet(8)).feed(hump(4, height))
    turns = stream.feed(quiet(8)).finish()
    assert [turn.center // 120 for turn in turns] == [4, 1, 2]
    assert list(turns) == sorted(turns, key=lambda turn: -turn.prominence)


def test_images_around_two_turns_belong_to_the_earlier_one():
    stream = Stream().feed(quiet(10)).feed(hump(4, 0.03)).feed(hump(4, 0.05)).feed(quiet(10))
    best, other = stream.finish()
    assert abs(other.center - 120) <= 5 and abs(best.center - 160) <= 5
    assert other.last == other.center + 30 and best.first == other.last + 1
    for turn in (best, other):
        assert [frame.index for frame in turn.frames] == list(range(turn.first, turn.last + 1))


def test_a_turn_that_a_neighbour_hid_is_not_lost():
    """Peaks at 124, 146, 172 and 194: the third hides those beside it, the first is its own."""
    stream = Stream().feed(quiet(10))
    for height in (0.03, 0.05, 0.04, 0.06, 0.035):
        stream.feed(hump(2.4, height))
    turns = stream.feed(quiet(10)).finish()
    assert [turn.center for turn in turns] == [172, 124]
    assert [turn.center for turn in stream.emitted] == [124, 146, 172, 124]
    assert all(turn.images > 30 for turn in turns)


def test_a_turn_that_was_handed_over_and_hidden_comes_back_with_its_images():
    stream = Stream().feed(quiet(10))
    for value in np.concatenate([*(hump(2.4, height) for height in (0.03, 0.05, 0.04, 0.06)),
                                 quiet(10)]):
        stream.feed(value)
        for turn in stream.detector.bank.turns():
            if turn.center == 124 and len(stream.emitted) == 1:
                stream.detector.bank.exchange(124, ())
    assert [turn.center for turn in stream.emitted] == [124, 146, 172, 124]
    assert stream.detector.bank.turns()[1].frames == stream.emitted[0].frames


def test_the_best_turn_enters_a_full_bank_while_its_prominence_still_grows():
    """The signal falls slowly behind it: when it is found, it stands out less than the others."""
    stream = Stream(capacity=3)
    for _ in range(3):
        stream.feed(quiet(8)).feed(hump(4, 0.04))
    stream.feed(quiet(8)).feed(hump(4, 0.09)[:20])
    stream.feed(np.linspace(0.09, 0.08, 60))
    begun = stream.count
    assert len(stream.emitted) == 3
    stream.feed(np.linspace(0.08, 0.002, 60)).feed(quiet(10))
    turns = stream.finish()
    assert stream.emitted[-1].center == turns[0].center
    assert abs(turns[0].center - (begun - 60)) <= 10 and turns[0].images == 61
    assert len(turns) == 3


def test_release_drops_the_frames_and_keeps_the_turn():
    stream = Stream().feed(quiet(10)).feed(hump(3, 0.03)).feed(quiet(4))
    turn, = stream.detector.bank.turns()
    stream.detector.bank.exchange(turn.center, ())
    released, = stream.detector.bank.turns()
    assert released.frames == () and released.images == turn.images == 61
    stream.feed(quiet(10)).feed(hump(4, 0.06)).feed(quiet(10))
    second, first = stream.finish()
    assert (first.center, first.last, first.frames) == (turn.center, turn.last, ())
    # the same images in another place
    stream.detector.bank.exchange(second.center, second.frames[::-1][::-1])
    assert stream.detector.bank.turns()[0].images == second.images


@pytest.mark.thorough
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([3, 10, 50]))
def test_turns_equal_those_found_offline(seed, capacity):
    """Whole drives at random, in stretches: scipy's prominences, the highest first, none near."""
    rng = np.random.default_rng(seed)
    config = TurnsConfig(capacity=capacity)
    stretches = [random_stretch(rng) for _ in range(rng.integers(1, 4))]
    stream, expected = Stream(capacity=capacity), []
    for stretch in stretches:
        expected += offline(stretch, config, stream.count)
        stream.feed(stretch, after_gap=True)
    turns = stream.finish()
    best = sorted(expected, key=lambda turn: (-turn[0], turn[1]))[:capacity]
    assert [(turn.prominence, turn.center) for turn in turns] == [turn[:2] for turn in best]
    # each turn was reported, and then stayed as it was
    emitted = {turn.center: turn.frames for turn in stream.emitted}
    assert all(turn.frames == emitted[turn.center] for turn in turns)
    if capacity >= len(expected):
        assert [(turn.first, turn.last) for turn in turns] == [turn[2:] for turn in best]


def random_stretch(rng: np.random.Generator) -> np.ndarray:
    """Return magnitudes of up to 100 s with noise and humps that overlap; some are held."""
    values = 0.002 + np.abs(rng.normal(0, 0.0015, rng.integers(1, 1000)))
    for _ in range(rng.integers(0, 30)):
        bump = hump(rng.uniform(1, 6), rng.uniform(0.003, 0.09))
        begin = rng.integers(-20, len(values))
        part = values[max(begin, 0):max(begin + len(bump), 0)]
        part += bump[max(-begin, 0):][:len(part)]
    # measured once in three images, as of a triplet
    return np.repeat(values[::3], 3) if rng.random() < 0.5 else values


def offline(values: np.ndarray, config: TurnsConfig, index: int
            ) -> list[tuple[float, int, int, int]]:
    """Return (prominence, center, first, last) of each turn of a stretch from this index on."""
    reach, half = 14, 30
    signal = np.array([np.median(values[max(i - reach, 0):i + reach + 1])
                       for i in range(len(values))])
    # whatever is beyond the edges
    first, last = (value - SEEN * max(value - CUT_OFF * MIN_PROMINENCE, 0.0)
                   for value in (signal[0], signal[-1]))
    peaks, about = find_peaks([first, *signal, last], prominence=MIN_PROMINENCE)
    prominence = dict(zip((peaks - 1).tolist(), about['prominences'], strict=True))
    kept: list[int] = []
    for peak in sorted(prominence, key=lambda peak: (-signal[peak], peak)):
        if all(abs(peak - other) > half for other in kept):
            kept.append(peak)
    turns, free = [], 0
    for peak in sorted(kept):
        begin, end = max(peak - half, free), min(peak + half, len(values) - 1)
        turns.append((prominence[peak], index + peak, index + begin, index + end))
        free = end + 1
    return turns


def test_gap_and_clock_set_back_end_a_turn():
    for jump in (10_000_000_000, -20_000_000_000):
        stream = Stream().feed(quiet(10)).feed(hump(6, 0.05)[:35])
        stream.ns += jump
        # the motion says that the clock was set back, and the detector sees the pause itself
        stream.feed(hump(6, 0.05)[35:], after_gap=jump < 0).feed(quiet(10))
        for turn in stream.finish():
            stamps = np.diff([frame.stamp_ns for frame in turn.frames])
            assert np.all((stamps > 0) & (stamps < 3_000_000_000))
        whole = Stream().feed(quiet(10)).feed(hump(6, 0.05)).feed(quiet(10)).finish()
        assert len(whole) == 1


def test_no_turn_spans_a_gap_that_the_stamps_do_not_show():
    """As between two files; the motion says where one is."""
    calm = Stream().feed(quiet(10)).feed(hump(4, 0.05)).feed(quiet(2)).feed(quiet(2), True)
    turns = calm.feed(hump(4, 0.04)).feed(quiet(10)).finish()
    assert sorted(turn.center // 160 for turn in turns) == [0, 1]
    assert not any(turn.first < 160 <= turn.last for turn in turns)
    assert all(turn.images >= 50 for turn in turns)
    turning = Stream().feed(quiet(10)).feed(hump(6, 0.05)[:30])
    turns = turning.feed(hump(6, 0.05)[30:], True).feed(quiet(10)).finish()
    assert not any(turn.first < 130 <= turn.last for turn in turns)


def test_end_of_drive_completes_a_turn_with_what_is_there():
    stream = Stream().feed(quiet(10)).feed(hump(4, 0.05)).feed(quiet(0.5))
    assert stream.detector.bank.turns() == ()
    turn, = stream.finish()
    assert turn.last == stream.count - 1 < turn.center + 30


def test_a_turn_that_an_edge_of_the_drive_cuts_counts_as_far_as_it_goes():
    half = hump(6, 0.05)[30:]
    stream = Stream().feed(half).feed(quiet(12)).feed(half[::-1])
    later, first = sorted(stream.finish(), key=lambda turn: -turn.center)
    assert first.first == 0 and first.center <= 5 and first.last >= first.center + 29
    assert later.last == stream.count - 1 and later.center >= stream.count - 6
    assert Stream().feed(quiet(12)).finish() == ()
    # a swerve, as straight streets have them too
    assert Stream().feed(half / 6).feed(quiet(12)).finish() == ()


def test_memory_does_not_grow_with_the_drive():
    """Two hours of turns at random, some close together, some with descending steps."""
    rng = np.random.default_rng(3)
    stream = Stream()
    held = []
    while stream.count < 72000:
        stream.feed(quiet(rng.uniform(0.5, 30)))
        stream.feed(0.002 + hump(rng.uniform(2, 9), rng.uniform(0.0, 0.1)))
        if rng.random() < 0.05:
            stream.feed(np.full(rng.integers(50, 600), 0.2))
            stream.feed(np.linspace(0.2, 0.002, 300) + 0.01 * np.sin(np.arange(300) / 5))
        stream.emitted.clear()
        held.append(stream.frames_alive())
    # the bank's ten turns of 61, a few that may still grow, the last seconds
    assert max(held) <= 10 * 61 + 3 * 61 + 91
    assert max(held[len(held) // 2:]) <= 1.3 * max(held[:len(held) // 2])
    assert len(stream.detector.bank.turns()) == 10
    assert len(stream.detector.magnitudes()) <= 20000
    for turn in stream.detector.bank.turns():
        stream.detector.bank.exchange(turn.center, ())
    del turn
    assert stream.frames_alive() <= 3 * 61 + 91


def test_a_turn_that_goes_on_and_on_holds_few_images():
    """As round a large roundabout, or a magnitude that stays the same to the last digit."""
    for values in (np.full(3000, 0.05), np.linspace(0.05, 0.049, 3000)):
        stream = Stream().feed(quiet(10)).feed(hump(4, 0.05)[:20]).feed(values)
        assert stream.frames_alive() <= 61 + 61 + 91
        turn, = stream.feed(quiet(10)).finish()
        assert turn.images == 61


def test_history_is_decimated_and_keeps_the_peaks():
    history = History(capacity=100)
    signal = np.random.default_rng(0).random(1000)
    signal[637] = 9.0
    for i, value in enumerate(signal):
        history.push(float(i), float(value))
    table = history.table()
    assert 40 < len(table) <= 101
    assert table[np.argmax(table[:, 1])].tolist() == [637.0, 9.0]
    assert np.all(np.diff(table[:, 0]) > 0)
    assert History().table().shape == (0, 2)
