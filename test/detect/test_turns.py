"""The streaming detector against scipy and numpy, and the bank's bounds."""
from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import find_peaks

from dashcalib_ros.config import TurnsConfig
from dashcalib_ros.detect import TurnDetector
from dashcalib_ros.detect.detector import History
from dashcalib_ros.detect.estimator import Motion
from dashcalib_ros.detect.peaks import SEEN, PeakFinder, StreamingMedian
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
    finder = PeakFinder(min_prominence)
    latest = {}
    for count, value in enumerate(signal, 1):
        for peak in finder.push(value):
            known = latest.get(peak.position)
            assert known is None or not known.settled
            assert known is None or peak.prominence >= known.prominence
            latest[peak.position] = peak
        # nothing is held back: what scipy finds in the signal so far was reported already
        sofar, found = find_peaks(np.array(signal[:count]), prominence=min_prominence)
        for position, prominence in zip(sofar, found['prominences'], strict=True):
            assert latest[position].prominence == prominence
    for peak in finder.finish():
        latest[peak.position] = peak
    positions, found = find_peaks(np.array(signal, float), prominence=min_prominence)
    assert sorted(latest) == list(positions)
    assert [latest[p].prominence for p in positions] == list(found['prominences'])
    assert all(peak.settled and peak.height == signal[p] for p, peak in latest.items())


@settings(max_examples=200, deadline=None)
@given(SIGNALS.filter(len), st.sampled_from([0.1, 0.5, 1.0]), st.sampled_from([0.3, 1.5]))
def test_with_a_rest_a_part_of_the_height_at_the_edges_counts(signal, min_prominence, rest):
    finder, found = PeakFinder(min_prominence, rest), {}
    for value in signal:
        found |= {peak.position: peak.prominence for peak in finder.push(value)}
    for peak in [*finder.end(), *finder.finish()]:
        found[peak.position] = peak.prominence
    first, last = (value - SEEN * (value - rest) if value > rest else value
                   for value in (signal[0], signal[-1]))
    low = [first, *signal, last]
    positions, about = find_peaks(np.array(low, float), prominence=min_prominence)
    assert found == dict(zip((positions - 1).tolist(), about['prominences'], strict=True))


def test_peak_is_confirmed_as_soon_as_it_stands_out():
    finder = PeakFinder(1.0)
    reports = [finder.push(value) for value in (0.0, 3.0, 2.5, 2.0, 1.0, 1.5, 4.0)]
    assert [[(p.position, p.prominence, p.settled) for p in r] for r in reports] == [
        [], [], [], [(1, 1.0, False)], [(1, 2.0, False)], [], [(1, 2.0, True)]]


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

    def feed(self, magnitudes, after_gap=False):
        for value in np.atleast_1d(magnitudes):
            self.ns += round(1e9 / self.rate)
            motion = Motion(self.count, self.ns, float(value), False, 5.0, 300, self.count,
                            self.ns, after_gap)
            frame = Frame(self.count, self.ns, TINY)
            after_gap = False
            new = self.detector.push(frame, motion)
            assert all(turn.frames for turn in new)
            self.emitted += new
            self.count += 1
        return self

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


def test_turns_that_overlap_become_one():
    stream = Stream().feed(quiet(10)).feed(hump(4, 0.03)).feed(hump(4, 0.05)).feed(quiet(10))
    turn, = stream.finish()
    assert 155 <= turn.center <= 165
    assert turn.first <= 95 and turn.last >= 185
    assert [frame.index for frame in turn.frames] == list(range(turn.first, turn.last + 1))
    assert stream.emitted[-1].frames == turn.frames


def test_merged_turn_is_never_longer_than_four_half_widths():
    stream = Stream().feed(quiet(10))
    for height in (0.03, 0.05, 0.04, 0.06, 0.035):
        stream.feed(hump(4, height))
    turns = stream.feed(quiet(10)).finish()
    spans = sorted((turn.first, turn.last) for turn in turns)
    assert len(spans) >= 2
    assert all(last - first <= 120 for first, last in spans)
    assert all(a[1] < b[0] for a, b in pairwise(spans))
    for turn in turns:
        assert turn.first <= turn.center <= turn.last
        assert (turn.frames[0].index, turn.frames[-1].index) == (turn.first, turn.last)


def test_release_drops_the_frames_and_keeps_the_turn():
    stream = Stream().feed(quiet(10)).feed(hump(3, 0.03)).feed(quiet(1.7))
    turn, = stream.detector.bank.turns()
    stream.detector.bank.release(turn.center)
    released, = stream.detector.bank.turns()
    assert released.frames == () and released.images == turn.images == 61
    # what overlaps a released turn is trimmed, whichever is stronger
    stream.feed(hump(4, 0.06)).feed(quiet(10))
    second, first = stream.finish()
    assert (first.center, first.last) == (turn.center, turn.last)
    assert second.first == turn.last + 1 and second.frames[0].index == second.first


def test_a_turn_that_is_fixed_is_as_one_that_is_released_but_has_its_frames():
    """So a drive gives the same turns whether or not their images are handed over."""
    turns = {}
    for choose in ('fix', 'release'):
        stream = Stream().feed(quiet(10)).feed(hump(3, 0.03)).feed(quiet(1.7))
        turn, = stream.detector.bank.turns()
        getattr(stream.detector.bank, choose)(turn.center)
        stream.feed(hump(4, 0.06)).feed(quiet(10))
        turns[choose] = stream.finish()
    outlines = [[(turn.center, turn.first, turn.last, turn.images) for turn in each]
                for each in turns.values()]
    assert outlines[0] == outlines[1] and len(outlines[0]) == 2
    assert all(turn.frames for turn in turns['fix'])


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
    bank = stream.detector.bank
    held = []
    while stream.count < 72000:
        stream.feed(quiet(rng.uniform(0.5, 30)))
        stream.feed(0.002 + hump(rng.uniform(2, 9), rng.uniform(0.0, 0.1)))
        if rng.random() < 0.05:
            stream.feed(np.full(rng.integers(50, 600), 0.2))
            stream.feed(np.linspace(0.2, 0.002, 300) + 0.01 * np.sin(np.arange(300) / 5))
        held.append(bank.frames_held())
    # the bank's ten turns of at most 121 frames, ten candidates of 61, the last seconds
    assert max(held) <= 10 * 121 + 10 * 61 + 91
    assert max(held[len(held) // 2:]) <= 1.3 * max(held[:len(held) // 2])
    assert len(stream.detector.bank.turns()) == 10
    assert len(stream.detector.magnitudes()) <= 20000
    for turn in stream.detector.bank.turns():
        stream.detector.bank.release(turn.center)
    assert bank.frames_held() <= 91 + 10 * 61


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
