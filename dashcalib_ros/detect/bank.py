"""The bank: the best turns with their frames, bounded however long the drive is."""
from __future__ import annotations

import dataclasses
from collections import deque
from dataclasses import dataclass, field

from dashcalib_ros.config import TurnsConfig
from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.input import Frame

# ns; header stamps are rounded: a frame exactly half_width away belongs to the turn
ROUNDING = 1_000_000
# half widths; frames are kept no longer than this for a peak that may still come (on a plateau)
RECENT = 3
# half widths; overlapping turns that are longer together are not joined
LONGEST = 4


@dataclass
class _Candidate:
    """A peak that may become a turn. potential: the highest prominence it can have."""

    center: int
    stamp_ns: int
    height: float
    potential: float
    frames: list[Frame]
    prominence: float | None = None


@dataclass
class _Kept:
    """A turn in the bank, made of one peak or several; first_ns, last_ns: its frames' stamps.

    fixed: its frames do not change any more; turns that overlap it are trimmed or dropped.
    height: of its highest peak. Of two turns that overlap, the higher one wins: a height is final,
    while a prominence may still grow.
    """

    turn: Turn
    height: float
    first_ns: int
    last_ns: int
    fixed: bool = False
    peaks: set[int] = field(default_factory=set)


class TurnBank:
    """Collects the frames around peaks; keeps the `capacity` most prominent turns.

    It holds references to frames, not copies: to those of the last seconds, of the candidates and
    of the turns that are not released.
    """

    def __init__(self, config: TurnsConfig) -> None:
        self.config = config
        self._half_ns = round(config.half_width * 1e9)
        self._recent: deque[Frame] = deque()
        self._candidates: dict[int, _Candidate] = {}
        self._kept: list[_Kept] = []

    def turns(self) -> tuple[Turn, ...]:
        """Return the turns, best first."""
        return tuple(kept.turn for kept in self._kept)

    def frames_held(self) -> int:
        """Return how many different frames are referenced."""
        held = {frame.index for frame in self._recent}
        for candidate in self._candidates.values():
            held.update(frame.index for frame in candidate.frames)
        for kept in self._kept:
            held.update(frame.index for frame in kept.turn.frames)
        return len(held)

    def collect(self, frame: Frame, needed_ns: int) -> None:
        """Take the next frame. needed_ns: the earliest time at which a peak can still be found."""
        reach = self._half_ns + ROUNDING
        self._recent.append(frame)
        oldest = max(min(needed_ns, frame.stamp_ns) - reach, frame.stamp_ns - RECENT * reach)
        while self._recent[0].stamp_ns < oldest:
            self._recent.popleft()
        for candidate in self._candidates.values():
            if frame.stamp_ns <= candidate.stamp_ns + reach:
                candidate.frames.append(frame)

    def pin(self, center: int, stamp_ns: int, height: float, potential: float) -> None:
        """Keep the frames around a peak that may become a turn of at most this prominence."""
        if center in self._candidates:
            return
        reach = self._half_ns + ROUNDING
        frames = [frame for frame in self._recent if abs(frame.stamp_ns - stamp_ns) <= reach]
        if not frames:
            return
        self._candidates[center] = _Candidate(
            center, stamp_ns, height, potential, frames)
        if len(self._candidates) > self.config.capacity:
            del self._candidates[min(self._candidates.values(), key=lambda c: c.potential).center]

    def rate(self, center: int, prominence: float) -> None:
        """Set a peak's prominence: it is a turn, or an existing turn has become more prominent."""
        if center in self._candidates:
            self._candidates[center].prominence = prominence
        for kept in self._kept:
            if center in kept.peaks and prominence > kept.turn.prominence:
                kept.turn = dataclasses.replace(kept.turn, prominence=prominence)
                self._sort()

    def unpin(self, open_centers: set[int]) -> None:
        """Forget the candidates that cannot become turns any more."""
        for center, candidate in list(self._candidates.items()):
            if candidate.prominence is None and center not in open_centers:
                del self._candidates[center]

    def settle(self, now_ns: int | None) -> list[Turn]:
        """Put complete candidates into the bank; return the turns that are new or changed.

        now_ns: stamp of the last frame; None: the stretch of the drive ends here.
        """
        changed: list[Turn] = []
        for center, candidate in list(self._candidates.items()):
            complete = now_ns is None or now_ns >= candidate.stamp_ns + self._half_ns - ROUNDING
            if complete and candidate.prominence is not None:
                del self._candidates[center]
                changed += self._enter(candidate)
        if now_ns is None:
            self._candidates.clear()
            self._recent.clear()
        present = self.turns()
        return [turn for turn in changed if turn in present]

    def fix(self, center: int) -> None:
        """Keep the frames of the turn at this centre as they are from now on."""
        for kept in self._kept:
            if kept.turn.center == center:
                kept.fixed = True

    def release(self, center: int) -> None:
        """Drop the frames of the turn at this centre; the turn stays, and does not change."""
        self.fix(center)
        for kept in self._kept:
            if kept.turn.center == center:
                kept.turn = dataclasses.replace(
                    kept.turn, frames=(), released_images=kept.turn.images)

    def exchange(self, center: int, frames: tuple[Frame, ...]) -> None:
        """Take the same frames, stored in another way, for those of a turn that is fixed."""
        for kept in self._kept:
            if kept.turn.center == center:
                kept.turn = dataclasses.replace(kept.turn, frames=frames)

    def _enter(self, candidate: _Candidate) -> list[Turn]:
        """Put a turn into the bank; turns that overlap are merged, trimmed or dropped."""
        assert candidate.prominence is not None
        frames = tuple(candidate.frames)
        turn = Turn(candidate.center, frames[0].index, frames[-1].index,
                    candidate.stamp_ns / 1e9, candidate.prominence, frames)
        new = _Kept(turn, candidate.height, frames[0].stamp_ns, frames[-1].stamp_ns,
                    peaks={candidate.center})
        changed: list[Turn] = []
        # best first; each step removes an overlap
        for other in list(self._kept):
            if not _overlap(new.turn, other.turn):
                continue
            span = max(new.last_ns, other.last_ns) - min(new.first_ns, other.first_ns)
            if not other.fixed and span <= LONGEST * self._half_ns + ROUNDING:
                self._kept.remove(other)
                new = _merge(new, other)
                continue
            wins = new.height > other.height
            if other.fixed or not wins:
                trimmed = _trim(new, other.turn)
                if trimmed is not None:
                    new = trimmed
                elif wins:
                    self._kept.remove(other)
                else:
                    return changed
            else:
                self._kept.remove(other)
                rest = _trim(other, new.turn)
                if rest is not None:
                    self._kept.append(rest)
                    changed.append(rest.turn)
        self._kept.append(new)
        self._sort()
        del self._kept[self.config.capacity:]
        return [*changed, new.turn]

    def _sort(self) -> None:
        self._kept.sort(key=lambda kept: (-kept.turn.prominence, kept.turn.center))


def _overlap(a: Turn, b: Turn) -> bool:
    return a.first <= b.last and b.first <= a.last


def _merge(a: _Kept, b: _Kept) -> _Kept:
    """Return one turn with the frames of both and the centre of the stronger."""
    strong = a.turn if a.height >= b.height else b.turn
    frames = {frame.index: frame for frame in a.turn.frames + b.turn.frames}
    turn = dataclasses.replace(
        strong, first=min(a.turn.first, b.turn.first), last=max(a.turn.last, b.turn.last),
        prominence=max(a.turn.prominence, b.turn.prominence),
        frames=tuple(frames[index] for index in sorted(frames)))
    return _Kept(turn, max(a.height, b.height), min(a.first_ns, b.first_ns),
                 max(a.last_ns, b.last_ns), peaks=a.peaks | b.peaks)


def _trim(weak: _Kept, strong: Turn) -> _Kept | None:
    """Return the weaker turn without the frames of the stronger; None if these have its centre."""
    if strong.first <= weak.turn.center <= strong.last:
        return None
    before = weak.turn.center < strong.first
    frames = tuple(frame for frame in weak.turn.frames
                   if (frame.index < strong.first if before else frame.index > strong.last))
    if not frames:
        return None
    turn = dataclasses.replace(
        weak.turn, first=frames[0].index, last=frames[-1].index, frames=frames)
    return _Kept(
        turn, weak.height, frames[0].stamp_ns, frames[-1].stamp_ns, peaks=weak.peaks)
