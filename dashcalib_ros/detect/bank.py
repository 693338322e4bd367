"""The bank: the most prominent turns with their images, bounded however long the drive is."""
from __future__ import annotations

from dataclasses import dataclass, replace

from dashcalib_ros.detect.peaks import Peak
from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.input import Frame


@dataclass
class _Held:
    """A turn, and the peak that knows its prominence. reported: new_turns() has returned it."""

    turn: Turn
    peak: Peak
    reported: bool = False


class TurnBank:
    """Keeps the `capacity` most prominent turns, and those that may still grow into them."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._held: list[_Held] = []

    def add(self, peak: Peak, frames: tuple[Frame, ...]) -> None:
        """Take a turn: its peak and the images around it, but those of an earlier turn."""
        center = next(frame.index for frame in frames if frame.stamp_ns == peak.stamp_ns)
        taken = max((held.turn.last for held in self._held if held.turn.last < center),
                    default=-1)
        frames = tuple(frame for frame in frames if frame.index > taken)
        turn = Turn(center, frames[0].index, frames[-1].index, peak.stamp_ns / 1e9,
                    peak.prominence, frames)
        self._held.append(_Held(turn, peak))
        ranked = self._ranked()
        least = ranked[:self._capacity][-1].peak.prominence
        self._held = ranked[:self._capacity] + [
            held for held in ranked[self._capacity:] if held.peak.limit > least]

    def turns(self) -> tuple[Turn, ...]:
        """Return the turns, the most prominent first."""
        return tuple(replace(held.turn, prominence=held.peak.prominence)
                     for held in self._ranked()[:self._capacity])

    def new_turns(self) -> list[Turn]:
        """Return those of the turns that were not returned before."""
        new = [held for held in self._ranked()[:self._capacity] if not held.reported]
        for held in new:
            held.reported = True
        return [replace(held.turn, prominence=held.peak.prominence) for held in new]

    def exchange(self, center: int, frames: tuple[Frame, ...]) -> None:
        """Take the same images, stored in another way, for those of a turn; none: drop them."""
        for held in self._held:
            if held.turn.center == center:
                held.turn = replace(held.turn, frames=frames, released_images=held.turn.images)

    def _ranked(self) -> list[_Held]:
        return sorted(self._held, key=lambda held: (-held.peak.prominence, held.turn.center))
