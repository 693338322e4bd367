# SPDX-License-Identifier: Apache-2.0
"""Stamps of messages -> increasing times of images, for recordings and live streams."""
from __future__ import annotations

import statistics
from collections import deque
from itertools import pairwise

from dashcalib_ros.errors import Notice, counted

SECOND_NS = 1_000_000_000
# a stamp further back means a clock that was set back (a bag that loops), not a late image
SET_BACK_NS = SECOND_NS
# a longer gap is a camera that paused
PAUSE_NS = 5 * SECOND_NS
# of the median period; a longer step means that images are missing
GAP = 1.5
# of the period; an image may come this much early: of a camera of up to 13.3 Hz all are used
EARLY = 0.25


# between two looks at images that are left out: in a few seconds, at any place between those used
LOOK_NS = 1_020_000_000


class Looks:
    """Chooses among the images that thinning leaves out those that are looked at: one a second."""

    def __init__(self) -> None:
        self._last: int | None = None

    def due(self, stamp_ns: int) -> bool:
        """Return whether this image, which is left out, is to be looked at."""
        if self._last is not None and 0 <= stamp_ns - self._last < LOOK_NS:
            return False
        self._last = stamp_ns
        return True


def least_step_ns(rate: float) -> float:
    """Return how far apart images must be to be used when they are thinned to a rate in Hz."""
    return (1 - EARLY) * 1e9 / rate


# images whose stamps are compared with the times at which they came; minimum number of these
COMPARED, LEAST_COMPARED = 50, 8
# how much longer or shorter the time between stamps is, and what a driver then writes as what
WRONG_UNITS = {1e-9: 'seconds as nanoseconds', 1e-6: 'milliseconds as nanoseconds',
               1e-3: 'microseconds as nanoseconds', 1e3: 'milliseconds as seconds',
               1e6: 'microseconds as seconds'}
# of it, by which the ratio may be off
ALIKE = 0.2
# ns that images may come late, where stamps are otherwise whole seconds off; falls, to be believed
LATE_NS, FALLS = 200_000_000, 2


class Comparison:
    """Compares stamps with the times at which the images came: faults that drivers have."""

    def __init__(self) -> None:
        self._pairs: deque[tuple[int, int]] = deque(maxlen=COMPARED)

    def fault(self, stamp_ns: int, received_ns: int) -> str:
        """Take an image; return in words what is wrong with the stamps, '' for nothing."""
        self._pairs.append((stamp_ns, received_ns))
        if len(self._pairs) < LEAST_COMPARED:
            return ''
        stamps, came = zip(*self._pairs, strict=True)
        steps, passed = ([b - a for a, b in pairwise(each)] for each in (stamps, came))
        if min(passed) <= 0:  # there are no times of reception
            return ''
        ratio = (stamps[-1] - stamps[0]) / (came[-1] - came[0])
        for factor, units in WRONG_UNITS.items():
            if min(steps) >= 0 and abs(ratio / factor - 1) < ALIKE:
                how = 'fast' if factor > 1 else 'slow'
                return (f'the time stamps run {max(factor, 1 / factor):.0f} times too {how}: '
                        f'the driver writes {units}')
        # seconds that are rounded up while their fraction is not: 1 s too late, for a part of
        # each; or that stand still
        apart = [stamp - time - stamps[0] + came[0] for stamp, time in self._pairs]
        seconds = [round(each / SECOND_NS) for each in apart]
        falls = sum(b < a for a, b in pairwise(seconds))
        if (falls >= FALLS and abs(falls - (came[-1] - came[0]) / SECOND_NS) <= 1
                and all(abs(each - n * SECOND_NS) < LATE_NS
                        for each, n in zip(apart, seconds, strict=True))):
            return (f'the time stamps jump back by {-min(steps) / SECOND_NS:.1f} s once per '
                    f'second: the driver writes wrong seconds')
        return ''


class StampGate:
    """Gives each image of a stream its time, and leaves out those that cannot be used.

    The time is the header's stamp; for drivers that set no stamps it is the time of reception. An
    image that is not later than the one before is a repetition or came late: it is left out.

    rate: Hz, of a live stream, whose images are thinned to it as in MotionEstimator, but before
    they are decoded, and those that it looks at are not left out; None: a recording, of which all
    are used. After the clock was set back, a recording's later stamps are shifted so that time
    goes on; a live stream's stay as they are: the core then begins its tracking anew and keeps
    its turns. In a live stream an image without a stamp is left out where others have one, also if
    the first stamp comes late; in a recording the first image decides whether stamps or times of
    reception are used.

    unstamped: times of reception are used. repeated: number of images left out as not later than
    the one before; zero: of those left out as without a stamp. set_back: how often the clock was
    set back, furthest_back_ns the largest such step. lost: images missing between stamps.
    fault: of the stamps beside the times of reception, in words; from then on those are used.
    """

    def __init__(self, rate: float | None = None) -> None:
        self._live = rate is not None
        self.unstamped = False
        self.repeated = self.zero = self.lost = self.set_back = 0
        self.furthest_back_ns = 0
        self._received: int | None = None
        self._least_ns = least_step_ns(rate) if rate else 0.0
        self._steps: deque[int] = deque(maxlen=31)
        self._looks = Looks()
        self.forget()

    def forget(self) -> None:
        """Begin anew with the next image; the counts stay."""
        self.unstamped = False
        self.fault = ''
        self._last: int | None = None
        self._used: int | None = None
        self._step = self._shift = 0
        self._steps.clear()
        self._comparison = Comparison()

    def take(self, header_ns: int, received_ns: int) -> int | None:
        """Return the next image's time in ns, or None when it is not to be used."""
        stamp_ns = self._time(header_ns, received_ns)
        if stamp_ns is None:
            return None
        if self._used is not None and 0 <= stamp_ns - self._used < self._least_ns:
            return stamp_ns if self._looks.due(stamp_ns) else None
        self._used = stamp_ns
        return stamp_ns

    def warnings(self) -> list[Notice]:
        """Return warnings about a recording's stamps for the user, one line each."""
        found = self.of_clock()
        if self.repeated and not self.fault:
            found.append(Notice('E-STAMP-NOT-LATER', f'{counted(self.repeated, "image")} skipped: '
                                f'the time stamps are not later than the previous ones'))
        if self.set_back:
            found.append(Notice(
                'E-STAMP-SET-BACK', f'the clock was set back {counted(self.set_back, "time")}, by '
                f'up to {self.furthest_back_ns / 1e9:.1f} s: later time stamps are shifted'))
        return found

    def of_clock(self) -> list[Notice]:
        """Return what is wrong with the stamps now, so that times of reception are used."""
        if self.unstamped:
            return [Notice('E-STAMP-MISSING', 'the image headers have no time stamps: the times '
                           'of reception are used, with which a rolling shutter may be missed; '
                           'fix the driver')]
        if self.fault:
            return [Notice('E-STAMP-WRONG', f'{self.fault}; from there on the times of reception '
                           f'are used: fix the driver')]
        return []

    def _time(self, header_ns: int, received_ns: int) -> int | None:
        if not self._choose_clock(header_ns):
            self.zero += 1
            return None
        if not (self.unstamped or self.fault):
            self._doubt(header_ns, received_ns)
        self._received = received_ns
        now = (received_ns if self.unstamped or self.fault else header_ns) + self._shift
        if self._last is None:
            self._last = now
            return now
        step = now - self._last
        if step < -SET_BACK_NS:
            self.set_back += 1
            self.furthest_back_ns = max(self.furthest_back_ns, -step)
            if self._live:
                self._last = now
                return now
            self._shift += self._step - step
            step = self._step
        if step <= 0:
            self.repeated += 1
            return None
        self._count_lost(step)
        self._step = step
        self._last += step
        return self._last

    def _doubt(self, header_ns: int, received_ns: int) -> None:
        """Look whether the stamps are wrong; then time goes on with that of reception."""
        self.fault = self._comparison.fault(header_ns, received_ns)
        if self.fault and self._last is not None and self._received is not None:
            self._shift = self._last - self._received
            self._steps.clear()

    def _choose_clock(self, header_ns: int) -> bool:
        """Decide between stamps and times of reception; return False to leave the image out."""
        begun = self._last is not None
        if begun and not self._live:
            return True
        if begun and header_ns == 0 and not self.unstamped:
            return False
        if header_ns and self.unstamped:
            self._last = None  # the first stamp: it is of another clock
        self.unstamped = header_ns == 0
        return True

    def _count_lost(self, step: int) -> None:
        if step >= PAUSE_NS:
            return
        if len(self._steps) >= 5:
            period = statistics.median(self._steps)
            if step > GAP * period:
                self.lost += round(step / period) - 1
        self._steps.append(step)
