# SPDX-License-Identifier: Apache-2.0
"""The bank: the most prominent turns with their images, bounded however long the drive is."""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from dashcalib_ros.detect.peaks import Peak
from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.input import Frame


@dataclass
class _Held:
    turn: Turn
    peak: Peak
    reported: bool = False

    def present(self) -> Turn:
        # it grows while the turn is new; afterwards each image asks for the same turn
        if self.turn.prominence != self.peak.prominence:
            self.turn = replace(self.turn, prominence=self.peak.prominence)
        return self.turn

    def exchange(self, frames: tuple[Frame, ...]) -> None:
        """Take the same images, stored in another way; none: drop them."""
        self.turn = replace(self.turn, frames=frames, released_images=self.turn.images)


class TurnBank:
    """Keeps the `capacity` most prominent turns, and those that may still grow into them."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._held: list[_Held] = []
        # the newest turns, in the order of time: one that comes may still hide some of them
        self._newest: list[_Held] = []

    def set_newest(self, newest: Iterable[tuple[Peak, tuple[Frame, ...]]], final: bool) -> None:
        """Replace the newest turns: peaks and the images around them, in the order of time.

        Images of an earlier turn stay with that. final: they are not replaced any more.
        """
        known = {id(held.peak): held for held in self._newest}
        self._newest = []
        for peak, frames in newest:
            self._newest.append(known.get(id(peak)) or self._made(peak, frames))
        if final:
            self._held, self._newest = self._held + self._newest, []
            best = self._ranked()[:self._capacity]
            least = best[-1].peak.prominence if best else 0.0
            self._held = best + [held for held in self._ranked()[self._capacity:]
                                 if held.peak.limit > least]

    def turns(self) -> tuple[Turn, ...]:
        """Return the turns, the most prominent first."""
        return tuple(held.present() for held in self._ranked()[:self._capacity])

    def new_turns(self) -> list[Turn]:
        """Return those of the turns that were not returned before."""
        new = [held for held in self._ranked()[:self._capacity] if not held.reported]
        for held in new:
            held.reported = True
        return [held.present() for held in new]

    def exchange(self, center: int, frames: tuple[Frame, ...]) -> None:
        """Take the same images, stored in another way, for those of a turn; none: drop them."""
        for held in self._held + self._newest:
            if held.turn.center == center:
                held.exchange(frames)

    def free_images(self) -> None:
        """Drop the images of all turns."""
        for held in self._held + self._newest:
            held.exchange(())

    def _made(self, peak: Peak, frames: tuple[Frame, ...]) -> _Held:
        center = next(frame.index for frame in frames if frame.stamp_ns == peak.stamp_ns)
        taken = max((held.turn.last for held in self._held + self._newest
                     if held.turn.last < center), default=-1)
        frames = tuple(frame for frame in frames if frame.index > taken)
        return _Held(Turn(center, frames[0].index, frames[-1].index, peak.stamp_ns / 1e9,
                          peak.prominence, frames), peak)

    def _ranked(self) -> list[_Held]:
        return sorted(self._held + self._newest,
                      key=lambda held: (-held.peak.prominence, held.turn.center))
