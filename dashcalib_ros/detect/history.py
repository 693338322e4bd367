"""The filtered magnitude of the whole drive, for plotting, in bounded memory."""
from __future__ import annotations

import numpy as np

from dashcalib_ros.arrays import Floats


class History:
    """Samples (stamp_s, value); when too many, each pair is replaced by its larger one."""

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
