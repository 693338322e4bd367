# SPDX-License-Identifier: Apache-2.0
"""The stretches of a drive beside its turns that promise most about the camera.

What shows a focal length is rotation that points see while they live, about any axis: a bend, a
roundabout, a crest, bumps, a change of lanes. A drive is cut into tiles as long as a turn; those
in which the picture swings most are kept with their images.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dashcalib_ros.arrays import GreyImage
from dashcalib_ros.detect.turn import MIN_PROMINENCE, Turn
from dashcalib_ros.input import Frame

# s; what a turn leaves of a tile must be as long
LEAST_S = 3.0
# tiles that wait: by then a turn in them is known; of a live drive, where memory counts, one
WAITING, WAITING_LIVE = 2, 1

# how the images of a stretch are kept
Keep = Callable[[Sequence[GreyImage]], Sequence[GreyImage]]


@dataclass
class _Tile:
    """Images, and how far the median point moved before each, (x, y) of the image width."""

    frames: list[Frame] = field(default_factory=list)
    shifts: list[tuple[float, float]] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        return (self.frames[-1].stamp_ns - self.frames[0].stamp_ns) / 1e9 if self.frames else 0.0

    def without(self, turns: Sequence[Turn]) -> _Tile:
        """Return the longest part that no turn has."""
        parts = [_Tile()]
        for frame, shift in zip(self.frames, self.shifts, strict=True):
            if any(turn.first <= frame.index <= turn.last for turn in turns):
                parts.append(_Tile())
            else:
                parts[-1].frames.append(frame)
                parts[-1].shifts.append(shift)
        return max(parts, key=lambda part: part.seconds)

    def stretch(self) -> Turn:
        """Return the tile as a turn of less than the least prominence: the more it promises."""
        path = np.cumsum(self.shifts, axis=0)
        promise = float(np.linalg.norm(path.std(axis=0)))
        middle = self.frames[len(self.frames) // 2]
        return Turn(middle.index, self.frames[0].index, self.frames[-1].index,
                    middle.stamp_ns / 1e9, MIN_PROMINENCE * promise / (1 + promise),
                    tuple(self.frames))


class StretchBank:
    """Keeps the `capacity` stretches that promise most, in bounded memory; none overlaps a turn.

    turns: those that are known now, the latest ones too. keep: how images are kept; None: those
    of one stretch at a time are, as they are, until it is taken: a better one replaces it.
    """

    def __init__(self, capacity: int, tile_s: float, turns: Callable[[], Sequence[Turn]],
                 keep: Keep | None = None) -> None:
        self._wanted = capacity > 0
        self._capacity = capacity
        self._tile_s = tile_s
        self._turns = turns
        self._keep = keep
        self._tile = _Tile()
        self._waiting: deque[_Tile] = deque()
        self._kept: list[Turn] = []

    def push(self, frame: Frame, shift: tuple[float, float], after_gap: bool) -> None:
        """Take the next image, and how far the median point moved before it, of the width."""
        if not self._wanted:
            return
        if after_gap or self._tile.seconds >= self._tile_s:
            self._end_tile(WAITING if self._keep else WAITING_LIVE)
        self._tile.frames.append(frame)
        self._tile.shifts.append(shift if np.isfinite(shift).all() else (0.0, 0.0))

    def want(self, wanted: bool) -> None:
        """Collect stretches from now on, or none, and free all images."""
        if self._wanted and not wanted:
            self.free_images()
        self._wanted = wanted and self._capacity > 0

    def finish(self) -> None:
        """End the drive: all turns are known."""
        self._end_tile(0)

    def stretches(self) -> tuple[Turn, ...]:
        """Return the stretches, those first that promise most."""
        turns = self._turns()
        return tuple(each for each in self._kept
                     if not any(turn.first <= each.last and each.first <= turn.last
                                for turn in turns))

    def exchange(self, center: int, frames: tuple[Frame, ...]) -> None:
        """Take the same images, stored in another way; none: drop them."""
        self._kept = [replace(each, frames=frames, released_images=each.images)
                      if each.center == center else each for each in self._kept]

    def free_images(self) -> None:
        """Drop all images."""
        for each in self._kept:
            self.exchange(each.center, ())
        self._tile, self._waiting = _Tile(), deque()

    def _end_tile(self, waiting: int) -> None:
        self._waiting.append(self._tile)
        self._tile = _Tile()
        while len(self._waiting) > waiting:
            tile = self._waiting.popleft().without(self._turns())
            if tile.seconds >= LEAST_S:
                self._add(tile.stretch())

    def _add(self, new: Turn) -> None:
        before = [each for each in self._kept if self._keep or not each.frames
                  or each.prominence > new.prominence]
        if not self._keep and any(each.frames for each in before):
            return
        self._kept = sorted([*before, new], key=lambda each: -each.prominence)[:self._capacity]
        if self._keep and new in self._kept:
            images = self._keep([frame.image for frame in new.frames])
            self.exchange(new.center, tuple(
                replace(frame, image=image)
                for frame, image in zip(new.frames, images, strict=True)))
