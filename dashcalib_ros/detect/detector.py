# SPDX-License-Identifier: Apache-2.0
"""Turning magnitudes -> turns, while the car drives (paper, algorithm 1)."""
from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.config import TurnsConfig
from dashcalib_ros.detect.bank import TurnBank
from dashcalib_ros.detect.estimator import Motion
from dashcalib_ros.detect.peaks import Peak, PeakFinder, StreamingMedian
from dashcalib_ros.detect.turn import MIN_PROMINENCE, Turn, is_turn
from dashcalib_ros.input import Frame

# ns; header stamps are rounded: an image exactly half a width away belongs to the turn
ROUNDING = 1_000_000
# least prominences; where the magnitude is higher at an edge of the drive, that may be a turn:
# how straight the car drove beyond is not known. KITTI's raw drive begins in a turn, with 24
CUT_OFF = 3.0
# of its height above that, so far the signal falls beyond the edge: whole turns are better. 0.5
# prefers a start at 12 degrees of yaw to a turn of 46 in one of two real drives that have both
SEEN = 0.25


class History:
    """The filtered magnitude of the whole drive, for plotting, in bounded memory.

    Samples (stamp_s, value); when too many, each pair is replaced by its larger one.
    """

    def __init__(self, capacity: int = 20000) -> None:
        self.capacity = capacity
        self._samples: list[tuple[float, float]] = []
        self._block = 1
        self._open: tuple[float, float] | None = None
        self._filled = 0

    def push(self, stamp_s: float, value: float) -> None:
        """Take the next sample."""
        if self._open is None or value > self._open[1]:
            self._open = stamp_s, value
        self._filled += 1
        if self._filled < self._block:
            return
        self._samples.append(self._open)
        self._open, self._filled = None, 0
        if len(self._samples) >= self.capacity:
            self._block *= 2
            pairs = zip(self._samples[::2], self._samples[1::2], strict=True)
            self._samples = [max(pair, key=lambda sample: sample[1]) for pair in pairs]

    def table(self) -> Floats:
        """Return (n, 2): stamp_s, value."""
        last = [] if self._open is None else [self._open]
        return np.array(self._samples + last, dtype=np.float64).reshape(-1, 2)


@dataclass
class _Candidate:
    """A peak that may be a turn. frames: around it, empty until the last of them has come."""

    peak: Peak
    frames: tuple[Frame, ...] = ()


class TurnDetector:
    """Median filter, peaks by prominence, and the bank of the best turns, as a stream.

    A turn is a peak of enough prominence that has no higher turn within half a width. It is
    reported with its last image; a higher one that follows soon takes its place.
    """

    def __init__(self, config: TurnsConfig) -> None:
        self.config = config
        self.bank = TurnBank(config.capacity)
        self.magnitude = 0.0
        self._history = History()
        self._half_ns = round(config.half_width * 1e9)
        self._reach_ns = self._half_ns + ROUNDING
        self._last_ns: int | None = None
        self._begin()

    def push(self, frame: Frame, motion: Motion) -> list[Turn]:
        """Take the next image and its motion; return the turns that are new."""
        if self._last_ns is not None:
            step = frame.stamp_ns - self._last_ns
            # no turn extends over a gap, or over a long pause of the camera
            if motion.after_gap or step > self._half_ns:
                self._end()
        self._last_ns = frame.stamp_ns
        self._recent.append(frame)
        if motion.center_ns is not None:
            # as in the paper: without an epipole the car moves straight on
            value = 0.0 if math.isnan(motion.magnitude) else motion.magnitude
            for stamp_ns, median in self._median.push(motion.center_ns, value):
                self._filtered(stamp_ns, median)
        self._collect(frame.stamp_ns)
        self._judge(self._is_decided())
        return self.bank.new_turns()

    def finish(self) -> list[Turn]:
        """End the drive; return the turns that are new."""
        self._end()
        return self.bank.new_turns()

    def close(self) -> None:
        """Drop all images; the turns are kept, and no push() may follow."""
        self._begin()
        self.bank.free_images()

    def magnitudes(self) -> Floats:
        """Return (n, 2): stamp in s and filtered magnitude of the drive so far, decimated."""
        return self._history.table()

    def _begin(self) -> None:
        self._median = StreamingMedian(self.config.half_width)
        self._peaks = PeakFinder(MIN_PROMINENCE, 2 * self._half_ns)
        self._filtered_ns: int | None = None
        # the images that a candidate, or a peak still to come, may need
        self._recent: deque[Frame] = deque()
        self._candidates: list[_Candidate] = []

    def _end(self) -> None:
        for stamp_ns, median in self._median.finish():
            self._filtered(stamp_ns, median)
        if self._filtered_ns is not None:
            self._find(self._filtered_ns, self._beyond(self.magnitude))
        self._peaks.finish()
        self._collect(None)
        self._judge(True)
        self._begin()

    def _filtered(self, stamp_ns: int, value: float) -> None:
        if self._filtered_ns is None:
            self._find(stamp_ns, self._beyond(value))
        self._filtered_ns, self.magnitude = stamp_ns, value
        self._history.push(stamp_ns / 1e9, value)
        self._find(stamp_ns, value)

    def _beyond(self, value: float) -> float:
        """Return what the signal counts as beyond an edge of the stretch; value: at the edge."""
        return value - SEEN * max(value - CUT_OFF * MIN_PROMINENCE, 0.0)

    def _find(self, stamp_ns: int, value: float) -> None:
        """Take the next sample; the peak that it ends is a candidate unless a higher one is near.

        That one is not a turn itself where a still higher one follows near it. But then this peak
        lies between both, and is not a turn either.
        """
        peak = self._peaks.push(stamp_ns, value)
        if peak is None:
            return
        self._drop_impossible()
        last = self._candidates[-1].peak if self._candidates else None
        if last is None or not self._near(last, peak) or peak.height > last.height:
            self._candidates.append(_Candidate(peak))

    def _near(self, first: Peak, second: Peak) -> bool:
        return second.stamp_ns - first.stamp_ns <= self._reach_ns

    def _drop_impossible(self) -> None:
        self._candidates = [each for each in self._candidates
                            if each.peak.limit >= MIN_PROMINENCE]

    def _collect(self, now_ns: int | None) -> None:
        """Give the candidates their images, and free the images that no turn needs.

        now_ns: stamp of the last image; None: the stretch ends with it.
        """
        self._drop_impossible()
        for each in self._candidates:
            center_ns = each.peak.stamp_ns
            if not each.frames and (now_ns is None
                                    or now_ns >= center_ns + self._half_ns - ROUNDING):
                each.frames = tuple(frame for frame in self._recent
                                    if abs(frame.stamp_ns - center_ns) <= self._reach_ns)
        needed_ns = next((each.peak.stamp_ns for each in self._candidates if not each.frames),
                         self._peaks.earliest_ns)
        while self._recent and self._recent[0].stamp_ns < needed_ns - self._reach_ns:
            self._recent.popleft()

    def _is_decided(self) -> bool:
        """Return whether no peak can come that hides a candidate."""
        return (bool(self._candidates)
                and self._peaks.earliest_ns - self._candidates[-1].peak.stamp_ns > self._reach_ns
                and all(is_turn(each.peak.prominence) for each in self._candidates))

    def _judge(self, final: bool) -> None:
        """Put the candidates that are turns into the bank.

        Of candidates near each other the last one is the highest. final: there will be no other
        turns near them.
        """
        turns: list[_Candidate] = []
        for each in reversed(self._candidates):
            ready = each.frames and is_turn(each.peak.prominence)
            if ready and not (turns and self._near(each.peak, turns[-1].peak)):
                turns.append(each)
        self.bank.set_newest([(each.peak, each.frames) for each in reversed(turns)], final)
        if final:
            self._candidates = []
