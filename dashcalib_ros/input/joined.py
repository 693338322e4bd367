"""Several files of one camera as one drive."""
from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.source import FrameSource, Picture, Reading

# a later recording that begins within this goes on with the one before; split bags do
CONTINUES_NS = 1_000_000_000
# ns; the step to the next file after one with a single image
STEP_NS = 100_000_000


class JoinedSource(FrameSource):
    """The images of several sources, one after the other; index and stamps go on.

    No video or folder tells whether it follows the one before without a loss: each begins perhaps
    after a gap (Frame.perhaps_after_gap), and its stamps go on as if there was none. A bag's
    stamps are kept where they are later than those before; they tell where there is a gap.

    A source that cannot be read is left out, with a warning. Raises InputError where two that
    tell their size have different ones.
    """

    def __init__(self, parts: Sequence[FrameSource], warnings: tuple[str, ...] = ()) -> None:
        self._parts = tuple(parts)
        first = self._parts[0]
        sized = [part for part in self._parts if part.size is not None]
        for part in sized:
            if part.size != sized[0].size:
                raise InputError(
                    f'{part.name} is {_by(part)} and {sized[0].name} is {_by(sized[0])}: a '
                    f'calibration holds for one size; calibrate each size on its own')
        counts = [part.count for part in self._parts]
        lengths = [part.length_ns for part in self._parts]
        super().__init__(
            f'{first.name} and {len(self._parts) - 1} more',
            None if None in counts else sum(filter(None, counts)), first.topic,
            (*warnings, *_together([(part.name, part.warnings) for part in self._parts])))
        self.contradictions = tuple(dict.fromkeys(
            line for part in self._parts for line in part.contradictions))
        self.length_ns = None if None in lengths else sum(filter(None, lengths))

    def _pictures(self, reading: Reading, start_ns: int = 0) -> Generator[Picture, None, None]:
        place = _Place(start_ns)
        told = []
        for part in self._parts:
            inner = Reading()
            try:
                with closing(place.pictures(part, inner)) as pictures:
                    yield from pictures
            except (InputError, OSError) as error:
                reading.warnings.append(f'{part.name} is left out from image {inner.images} on: '
                                        f'{error}')
            told.append((part.name, inner.summary()))
            place.index += inner.images
        reading.images = place.index
        reading.warnings += _together(told)


@dataclass(frozen=True)
class _Joint:
    """How a source follows the one before. shift_ns: what is added to its stamps."""

    shift_ns: int
    gap: bool = False
    perhaps_gap: bool = False


class _Place:
    """Where the next source begins in the drive: index of its first image, and its time in ns.

    start_ns: of the excerpt, from the drive's first image on.
    """

    def __init__(self, start_ns: int) -> None:
        self.index = 0
        self._start_ns = start_ns
        self._first_ns: int | None = None
        self._next_ns = self._last_ns = 0
        self._recorded = False

    def pictures(self, part: FrameSource, reading: Reading) -> Generator[Picture, None, None]:
        """Yield a source's pictures with the drive's index and stamps."""
        left = 0 if part.recorded else self._left_ns()
        if part.length_ns is not None and part.length_ns <= left:
            reading.images = part.count or 0
            self._next_ns += part.length_ns
            return
        before: int | None = None
        with closing(part._pictures(reading, left)) as pictures:
            for picture in pictures:
                if before is None:
                    joint = self._joint(part, picture.stamp_ns)
                    before = picture.stamp_ns - STEP_NS
                stamp_ns = picture.stamp_ns + joint.shift_ns
                if self._first_ns is None:
                    self._first_ns = stamp_ns
                self._last_ns = stamp_ns
                self._next_ns = stamp_ns + picture.stamp_ns - before
                before = picture.stamp_ns
                # what a bag has before the start is left out here; it is not decoded yet
                if stamp_ns - self._first_ns >= self._start_ns:
                    yield replace(picture, index=self.index + picture.index, stamp_ns=stamp_ns,
                                  file=part.name, after_gap=joint.gap,
                                  perhaps_after_gap=joint.perhaps_gap)
                    joint = _Joint(joint.shift_ns)
        if before is None:
            self._next_ns += part.length_ns or 0  # all of it was before the excerpt
        self._recorded = part.recorded

    def _left_ns(self) -> int:
        """Return how much of the next source is before the excerpt, if it follows directly."""
        if self._first_ns is None:
            self._first_ns = self._next_ns
        return max(0, self._start_ns - (self._next_ns - self._first_ns))

    def _joint(self, part: FrameSource, stamp_ns: int) -> _Joint:
        """Return how a source follows the one before. stamp_ns: its first one."""
        if not part.recorded:
            return _Joint(self._next_ns, perhaps_gap=self.index > 0)
        if self.index == 0:
            return _Joint(0)
        if not self._recorded:
            return _Joint(self._next_ns - stamp_ns, perhaps_gap=True)
        step = stamp_ns - self._last_ns
        if step > 0:
            return _Joint(0, gap=step > CONTINUES_NS)
        return _Joint(self._next_ns - stamp_ns, gap=True)


def _by(part: FrameSource) -> str:
    width, height = part.size or (0, 0)
    return f'{width}x{height}'


def _together(told: Sequence[tuple[str, Sequence[str]]]) -> tuple[str, ...]:
    """Return the warnings of all sources; what several say in the same words is said once.

    told: names and warnings.
    """
    first: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for name, warnings in told:
        for warning in warnings:
            words = warning.replace(name, '')
            first.setdefault(words, warning if name in warning else f'{name}: {warning}')
            counts[words] += 1
    return tuple(line + (f' (and {counts[words] - 1} more like it)' if counts[words] > 1 else '')
                 for words, line in first.items())
