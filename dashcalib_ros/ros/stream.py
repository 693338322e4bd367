"""What the headers of an image stream tell: its time, its losses, and whether it is one camera's.

Nothing here looks at a pixel: all of it runs in the image callback.
"""
from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass
from typing import Literal

from dashcalib_ros.motion.estimator import EARLY

SECOND_NS = 1_000_000_000
# a stamp further behind is no late image but a clock that was set back (a bag that loops)
SET_BACK_NS = SECOND_NS
# a longer gap is a camera that paused
PAUSE_NS = 5 * SECOND_NS
# of the median period; a longer step means that images are missing
GAP = 1.5
# images in a row of another size or frame before it counts as a change: strays of a second
# publisher are never in a row
LASTING = 10


class StampWatch:
    """The time of the images: stamps that increase, except where the clock is set back.

    lost: images missing between the stamps. repeated: not later than the one before. zero: without
    a stamp, among others that have one. set_back: how often the clock was.
    """

    def __init__(self) -> None:
        self.lost = self.repeated = self.zero = self.set_back = 0
        self.unstamped = False
        self._last: int | None = None
        self._steps: deque[int] = deque(maxlen=31)

    def take(self, header_ns: int, received_ns: int) -> int | None:
        """Return the image's time in ns, None for one that must not be learned from.

        Drivers that never stamp are timed by their images' arrival. A stamp that is set back is
        returned as it is: the core then begins its tracking anew and keeps the turns it has.
        """
        if header_ns == 0:
            if self._last is not None and not self.unstamped:
                self.zero += 1
                return None
            self.unstamped = True
        elif self.unstamped:
            # stamps after all: another clock
            self.unstamped, self._last = False, None
        now = received_ns if self.unstamped else header_ns
        if self._last is None:
            self._last = now
            return now
        step = now - self._last
        if -SET_BACK_NS <= step <= 0:
            self.repeated += 1
            return None
        self._last = now
        if step < 0:
            self.set_back += 1
        elif step < PAUSE_NS:
            self._count_lost(step)
        return now

    def forget(self) -> None:
        """Begin anew with the next image; the counts stay."""
        self.unstamped, self._last = False, None
        self._steps.clear()

    def _count_lost(self, step: int) -> None:
        if len(self._steps) >= 5:
            period = statistics.median(self._steps)
            if step > GAP * period:
                self.lost += round(step / period) - 1
        self._steps.append(step)


class Thinning:
    """The choice that MotionEstimator makes among the images, made before they are decoded."""

    def __init__(self, rate: float) -> None:
        self._least_ns = (1 - EARLY) * 1e9 / rate
        self._last: int | None = None

    def wants(self, stamp_ns: int) -> bool:
        """Tell whether this image is used, given that all the wanted ones before were."""
        if self._last is not None and 0 <= stamp_ns - self._last < self._least_ns:
            return False
        self._last = stamp_ns
        return True


@dataclass(frozen=True)
class Source:
    """What makes images one camera's: size (width, height) in px, and frame_id."""

    size: tuple[int, int]
    frame_id: str

    def __str__(self) -> str:
        return f'{self.size[0]}x{self.size[1]} in frame {self.frame_id!r}'


class SourceWatch:
    """Tells a camera that changed from images that strayed in. previous: before the change."""

    def __init__(self) -> None:
        self.current: Source | None = None
        self.previous: Source | None = None
        self._other: Source | None = None
        self._run = 0

    def take(self, source: Source) -> Literal['first', 'same', 'stray', 'changed']:
        """Take the next image's source."""
        if source == self.current:
            self._run = 0
            return 'same'
        if self.current is None:
            self.current = source
            return 'first'
        self._run = self._run + 1 if source == self._other else 1
        self._other = source
        if self._run < LASTING:
            return 'stray'
        self.previous, self.current, self._run = self.current, source, 0
        return 'changed'
