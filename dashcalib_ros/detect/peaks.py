"""The turning magnitude as a signal, in streams: its median, its peaks, their prominence."""
from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass

# Hz; the paper's k counts images of 10 fps
PAPER_RATE = 10.0
# of a turn that an edge cuts; so whole turns are better. 0.5 prefers a start at 12 degrees of yaw
# to a turn of 46 in one of two real drives that have both
SEEN = 0.25


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


@dataclass(frozen=True)
class Peak:
    """A local maximum of enough prominence.

    position: of the sample, counted from 0; a plateau's middle, rounded down.
    prominence: how far the signal falls, at least, between the peak and any higher place. Until
    the peak is settled this is a lower bound: later samples can only increase it.
    """

    position: int
    height: float
    prominence: float
    settled: bool


@dataclass
class _Open:
    """A peak without a higher sample after it; left_min is final, right_min may still fall."""

    position: int
    height: float
    left_min: float
    right_min: float
    reported: bool = False

    @property
    def prominence(self) -> float:
        return self.height - max(self.left_min, self.right_min)


class PeakFinder:
    """As scipy.signal.find_peaks(signal, prominence=min_prominence), for a stream.

    rest: a signal that begins or ends higher has a peak there. As nobody saw how far it falls
    beyond, SEEN of its height above rest counts.
    Each peak is reported as soon as its prominence so far reaches the minimum, again whenever it
    has grown, and once more when it is settled; the last reports equal scipy's result.
    Open peaks are a stack of decreasing heights: memory and time per sample depend on its depth,
    not on the length of the signal.
    """

    def __init__(self, min_prominence: float, rest: float = math.inf) -> None:
        self.min_prominence = min_prominence
        self._open: list[_Open] = []
        self._count = 0
        self._rest = rest
        self._last = math.inf
        self._lowest = math.inf
        # where the current rise reached its present height; None while falling
        self._summit: int | None = None
        self._fresh = False

    @property
    def needed_from(self) -> int:
        """Return the earliest sample at which a peak can still appear."""
        return self._count if self._summit is None else (self._summit + self._count - 1) // 2

    @property
    def newcomer(self) -> Peak | None:
        """Return the peak that the last sample opened, with its highest possible prominence."""
        top = self._open[-1] if self._fresh else None
        if top is None or top.height - top.left_min < self.min_prominence:
            return None
        return Peak(top.position, top.height, top.height - top.left_min, False)

    def alive(self) -> set[int]:
        """Return the positions of the peaks that are open and may still count."""
        return {peak.position for peak in self._open
                if peak.height - peak.left_min >= self.min_prominence}

    def push(self, value: float) -> list[Peak]:
        """Take the next sample (not NaN); return the peaks that appeared, grew or are settled."""
        reports: list[Peak] = []
        self._fresh = False
        if not self._count:
            self._last = self._lowest = self._beyond(value)
        if value > self._last:
            self._summit = self._count
            while self._open and self._open[-1].height < value:
                reports += self._settle(self._open.pop())
        elif value < self._last:
            if self._summit is not None:
                self._rise((self._summit + self._count - 1) // 2, self._last)
            self._summit = None
            reports += self._fall(value)
        self._lowest = min(self._lowest, value)
        self._last = value
        self._count += 1
        return reports

    def end(self) -> list[Peak]:
        """Take the last edge; return the peaks that appeared or grew there."""
        return self.push(min(self._last, self._beyond(self._last)))

    def finish(self) -> list[Peak]:
        """End the signal; return the peaks that this settles."""
        reports: list[Peak] = []
        while self._open:
            reports += self._settle(self._open.pop())
        return reports

    def _beyond(self, value: float) -> float:
        """Return what the signal counts as beyond an edge at which it has a value."""
        return value - SEEN * (value - self._rest) if value > self._rest else math.inf

    def _rise(self, position: int, height: float) -> None:
        """Open a peak. Lower ones were settled before; those of equal height are still open."""
        left_min = self._lowest
        for peak in reversed(self._open):
            if peak.height > height:
                left_min = peak.right_min
                break
        self._open.append(_Open(position, height, left_min, height))
        self._fresh = True

    def _fall(self, value: float) -> list[Peak]:
        reports: list[Peak] = []
        # deeper peaks have a lower or equal right_min: stop at the first that does not change
        for peak in reversed(self._open):
            if peak.right_min <= value:
                break
            before = peak.prominence
            peak.right_min = value
            if peak.prominence >= self.min_prominence and not (
                    peak.reported and peak.prominence == before):
                peak.reported = True
                reports.append(Peak(peak.position, peak.height, peak.prominence, False))
        return reports

    def _settle(self, peak: _Open) -> list[Peak]:
        if peak.prominence < self.min_prominence:
            return []
        return [Peak(peak.position, peak.height, peak.prominence, True)]
