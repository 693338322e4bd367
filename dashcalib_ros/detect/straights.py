# SPDX-License-Identifier: Apache-2.0
"""Pairs of images of a car that drives straight on: they show where the camera points."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats, Floats32
from dashcalib_ros.robust import EvenlySpaced

# points kept of a pair, and pairs of a drive: an hour takes no more than 2 MB
POINTS, PAIRS = 150, 600
# s from one pair to the next, at first: a pair spans twice as much
PERIOD_S = 0.3
# of the image width: half of what the epipole moves between a pair's images. 2 degrees of yaw
# move that of a lens of 90 degrees by twice as much
STRAIGHT = 0.01
# points; fewer do not determine a direction
LEAST_POINTS = 40


@dataclass(frozen=True)
class Straights:
    """Matched points of n pairs of images, each some tenths of a second apart.

    before, after: (n, POINTS, 2) px, NaN where a pair has fewer points. stamps_s: (n,) of the
    second image; apart_s: (n,) between both.
    """

    before: Floats32
    after: Floats32
    stamps_s: Floats
    apart_s: Floats

    def __len__(self) -> int:
        return len(self.stamps_s)


class StraightCollector:
    """Keeps pairs that are spread evenly over the drive; more only make them denser."""

    def __init__(self) -> None:
        # ns between both images, and their points
        self._found: EvenlySpaced[tuple[int, Floats32]] = EvenlySpaced(PERIOD_S, PAIRS)

    def wants(self, stamp_ns: int) -> bool:
        """Return whether enough time has passed since the last pair."""
        return self._found.wants(stamp_ns)

    def push(self, first_ns: int, stamp_ns: int, before: Floats32, after: Floats32) -> None:
        """Take a pair: before, after: (n, 2) px of the same points in both images."""
        if len(before) < LEAST_POINTS:
            return
        some = np.linspace(0, len(before) - 1, min(len(before), POINTS)).astype(int)
        pair = np.full((2, POINTS, 2), np.nan, np.float32)
        pair[:, :len(some)] = before[some], after[some]
        self._found.append(stamp_ns, (stamp_ns - first_ns, pair))

    def __len__(self) -> int:
        return len(self._found.items)

    def straights(self, newest: int = PAIRS) -> Straights:
        """Return the pairs so far, or the newest of them."""
        found = self._found.items[-newest:]
        pairs = np.array([pair for _, (_, pair) in found], np.float32).reshape(-1, 2, POINTS, 2)
        stamps, apart = np.array([(stamp_ns, apart_ns) for stamp_ns, (apart_ns, _) in found],
                                 float).reshape(-1, 2).T / 1e9
        return Straights(pairs[:, 0], pairs[:, 1], stamps, apart)
