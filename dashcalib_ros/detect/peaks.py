# SPDX-License-Identifier: Apache-2.0
"""The turning magnitude as a signal, in streams: its median, its peaks, their prominence."""
from __future__ import annotations

import math
import sys
from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass

# Hz; the paper's k counts images of 10 fps
PAPER_RATE = 10.0


class StreamingMedian:
    """Median over the samples within half a window of each sample (paper, 3.1).

    The paper's window has 2 * floor(k / 2) - 1 images, k = half_width * 10 fps: 29 for 3 s. As a
    time that is half_width / 2 - 0.05 s to either side: the same window at a steady 10 Hz, and the
    right one at any other rate. At the ends of the stream the window is shorter.
    """

    def __init__(self, half_width: float) -> None:
        """half_width: of a turn, in seconds."""
        self.reach_ns = round((half_width / 2 - 0.5 / PAPER_RATE) * 1e9)
        self._window: deque[tuple[int, float]] = deque()
        self._sorted: list[float] = []
        self._waiting: deque[int] = deque()

    def push(self, stamp_ns: int, value: float) -> list[tuple[int, float]]:
        """Take the next sample; return the (stamp_ns, median) that are now final, in order.

        Stamps must not decrease.
        """
        ready = []
        while self._waiting and self._waiting[0] + self.reach_ns < stamp_ns:
            ready.append(self._next())
        self._window.append((stamp_ns, value))
        insort(self._sorted, value)
        self._waiting.append(stamp_ns)
        return ready

    def finish(self) -> list[tuple[int, float]]:
        """Return the remaining medians, and begin anew."""
        ready = [self._next() for _ in range(len(self._waiting))]
        self._window.clear()
        self._sorted.clear()
        return ready

    def _next(self) -> tuple[int, float]:
        stamp_ns = self._waiting.popleft()
        while self._window[0][0] < stamp_ns - self.reach_ns:
            _, value = self._window.popleft()
            del self._sorted[bisect_left(self._sorted, value)]
        middle = len(self._sorted) // 2
        if len(self._sorted) % 2:
            return stamp_ns, self._sorted[middle]
        return stamp_ns, 0.5 * (self._sorted[middle - 1] + self._sorted[middle])


@dataclass
class Peak:
    """A local maximum of the signal.

    stamp_ns: the middle of a flat top. left: the lowest sample before the peak, back to the next
    higher one, or to the beginning. right: the lowest sample after it, up to the next higher one,
    or so far. open: there is no higher sample after it so far.
    """

    stamp_ns: int
    height: float
    left: float
    right: float
    open: bool = True

    @property
    def prominence(self) -> float:
        """Return the topographic prominence in the signal so far; it can only grow."""
        return self.height - max(self.left, self.right)

    @property
    def limit(self) -> float:
        """Return the largest prominence that the peak can still reach."""
        return self.height - self.left if self.open else self.prominence


class PeakFinder:
    """Finds the peaks of a stream, as scipy.signal.find_peaks(signal, prominence=min_prominence).

    The open peaks are a stack of heights that do not increase: memory and time per sample depend
    on its depth, not on the length of the signal.
    """

    def __init__(self, min_prominence: float, longest_ns: int) -> None:
        """longest_ns: of a flat top; of a longer one only the end counts."""
        self._min_prominence = min_prominence
        self._longest_ns = longest_ns
        self._open: list[Peak] = []
        self._value = self._lowest = math.inf
        self._rises = False
        # the last samples of equal height; before the first one a peak may be at any time
        self._top: deque[int] = deque([-sys.maxsize])

    @property
    def earliest_ns(self) -> int:
        """Return the earliest time at which a new peak can still be found."""
        return self._top[(len(self._top) - 1) // 2 if self._rises else -1]

    def push(self, stamp_ns: int, value: float) -> Peak | None:
        """Take the next sample (not NaN); return the peak that ends with the one before it.

        Peaks that cannot reach the least prominence are omitted.
        """
        found = None
        if value > self._value:
            while self._open and self._open[-1].height < value:
                self._open.pop().open = False
        elif value < self._value and self._rises:
            found = self._peak()
        if value != self._value:
            self._rises = value > self._value
            self._top.clear()
        self._top.append(stamp_ns)
        while stamp_ns - self._top[0] > self._longest_ns:
            self._top.popleft()
        # the deeper in the stack, the lower the signal was since: stop where nothing changes
        for peak in reversed(self._open):
            if peak.right <= value:
                break
            peak.right = value
        self._value, self._lowest = value, min(self._lowest, value)
        return found

    def finish(self) -> None:
        """End the signal: no peak is open any more."""
        for peak in self._open:
            peak.open = False
        self._open.clear()

    def _peak(self) -> Peak | None:
        """Return the peak at the last sample; those of equal height do not end each other."""
        higher = (peak.right for peak in reversed(self._open) if peak.height > self._value)
        peak = Peak(self.earliest_ns, self._value, next(higher, self._lowest), self._value)
        if peak.limit < self._min_prominence:
            return None
        self._open.append(peak)
        return peak
