"""A street of the town: its axis."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats


@dataclass(frozen=True)
class Street:
    """A street's axis. start: (2,) m; heading rad; length m."""

    start: Floats
    heading: float
    length: float

    @property
    def ahead(self) -> Floats:
        """Return the direction, (2,)."""
        return np.array([math.cos(self.heading), math.sin(self.heading)])

    @property
    def left(self) -> Floats:
        """Return the direction to its left, (2,)."""
        return np.array([-math.sin(self.heading), math.cos(self.heading)])

    def at(self, along: float, left: float) -> Floats:
        """Return the point (2,) m."""
        return np.asarray(self.start + along * self.ahead + left * self.left)
