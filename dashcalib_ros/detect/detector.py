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
from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.input import Frame

# least prominences; an edge of the drive may be a turn where the magnitude is higher, as nothing
# tells how straight the car drove beyond. KITTI's raw drive begins in a turn, with 24
CUT_OFF = 3.0


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


@dataclass(frozen=True)
class _Sample:
    """One filtered magnitude: its position in the signal, and the frame it belongs to."""

    position: int
    index: int
    stamp_ns: int


class TurnDetector:
    """Median filter, peaks by prominence, and the bank of the best turns, as a stream.

    A peak is a turn as soon as the signal has fallen far enough after it. The turn enters the bank
    when the stream is half a width past its centre.
    """

    def __init__(self, config: TurnsConfig) -> None:
        self.config = config
        self.bank = TurnBank(config)
        self.magnitude = 0.0
        self._history = History()
        self._last_ns: int | None = None
        self._begin()

    def push(self, frame: Frame, motion: Motion) -> list[Turn]:
        """Take the next image and its motion; return the turns newly complete, or changed."""
        changed: list[Turn] = []
        if self._last_ns is not None:
            step = frame.stamp_ns - self._last_ns
            # no turn extends over a gap, or over a long pause of the camera
            if motion.after_gap or step > self.config.half_width * 1e9:
                changed += self.finish()
        self._last_ns = frame.stamp_ns
        self.bank.collect(frame, self._needed_ns(frame))
        if motion.center is not None and motion.center_ns is not None:
            # as in the paper: without an epipole the car moves straight on
            value = 0.0 if math.isnan(motion.magnitude) else motion.magnitude
            self._centers.append((motion.center, motion.center_ns))
            for stamp_ns, median in self._median.push(motion.center_ns, value):
                self._filtered(stamp_ns, median)
        return changed + self.bank.settle(frame.stamp_ns)

    def magnitudes(self) -> Floats:
        """Return (n, 2): stamp in s and filtered magnitude of the drive so far, decimated."""
        return self._history.table()

    def _begin(self) -> None:
        """Begin a stretch without gaps."""
        self._median = StreamingMedian(self.config.half_width)
        # a turn that the stretch cuts off counts as far as it goes
        self._peaks = PeakFinder(self.config.min_prominence,
                                 CUT_OFF * self.config.min_prominence)
        # _centers: frames whose magnitude waits for the median; _samples: those that may be peaks
        self._centers: deque[tuple[int, int]] = deque()
        self._samples: deque[_Sample] = deque()
        self._open: dict[int, int] = {}
        self._position = 0

    def finish(self) -> list[Turn]:
        """End the drive, or what comes before a gap; return the turns that are new or changed."""
        for stamp_ns, median in self._median.finish():
            self._filtered(stamp_ns, median)
        self._found(self._peaks.end())
        for peak in self._peaks.finish():
            self.bank.rate(self._open[peak.position], peak.prominence)
        changed = self.bank.settle(None)
        self._begin()
        return changed

    def _needed_ns(self, frame: Frame) -> int:
        """Return the earliest stamp at which a peak can still appear."""
        if self._samples:
            return self._samples[0].stamp_ns
        return self._centers[0][1] if self._centers else frame.stamp_ns - self._median.reach_ns

    def _filtered(self, stamp_ns: int, value: float) -> None:
        """Take the next sample of the filtered signal."""
        index, _ = self._centers.popleft()
        self._samples.append(_Sample(self._position, index, stamp_ns))
        self._position += 1
        self.magnitude = value
        self._history.push(stamp_ns / 1e9, value)
        self._found(self._peaks.push(value))
        alive = self._peaks.alive()
        self._open = {position: index for position, index in self._open.items()
                      if position in alive}
        self.bank.unpin(set(self._open.values()))
        while self._samples and self._samples[0].position < self._peaks.needed_from:
            self._samples.popleft()

    def _found(self, reports: list[Peak]) -> None:
        """Take the peaks that the last sample opened or changed."""
        new = self._peaks.newcomer
        if new is not None:
            sample = self._samples[new.position - self._samples[0].position]
            self._open[new.position] = sample.index
            self.bank.pin(sample.index, sample.stamp_ns, new.height, new.prominence)
        for peak in reports:
            self.bank.rate(self._open[peak.position], peak.prominence)
