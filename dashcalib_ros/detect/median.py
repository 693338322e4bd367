"""The paper's median filter of the turning magnitude, as a stream; its window is a time."""
from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque

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
