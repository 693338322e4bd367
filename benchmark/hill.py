# SPDX-License-Identifier: Apache-2.0
"""Rendered drives on a slope, and on a crowned road."""
from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.spatial.transform import Rotation

from dashcalib_ros.demo import Drive, DriveSpec
from dashcalib_ros.demo.drive import AnyLens
from dashcalib_ros.demo.parallel import render_parallel
from dashcalib_ros.demo.town import Town
from dashcalib_ros.input import Frame

# m; wider rectangles are the surroundings
FAR_M = 100.0


@dataclass(frozen=True)
class RoadSpec(DriveSpec):
    """A drive on a road that is not level.

    slope_percent: the whole town lies on a hill that falls so much along the first street. The
    frame of the world lies in the road: what is upright leans the other way.
    crown_percent: the road falls so much from its middle to the right. The car in the right lane
    leans so, against the plane of its path and against what is upright; the drawn road is flat.
    """

    slope_percent: float = 0.0
    crown_percent: float = 0.0


class OnRoad(Drive):
    """A drive on such a road."""

    spec: RoadSpec

    def __init__(self, lens: AnyLens, spec: RoadSpec) -> None:
        super().__init__(lens, spec)
        lean = math.atan(spec.crown_percent / 100.0)
        self.ride = replace(self.ride, roll=self.ride.roll + lean)

    @cached_property
    def town(self) -> Town:
        """Return the town, each of its rectangles but the ground leaning about its own foot."""
        town = super().town
        quads = town.quads
        lean = Rotation.from_euler('y', -math.atan(self.spec.slope_percent / 100.0)).as_matrix()
        middle = quads.origin + (quads.right + quads.down) / 2
        foot = np.where([True, True, False], middle, 0.0)
        # the ground, and what is far away all round
        stays = (middle[:, 2] < 0.05) | (np.linalg.norm(quads.right, axis=1) > FAR_M)
        leans = ~stays[:, None]
        return replace(town, quads=replace(
            quads, origin=np.where(leans, foot + (quads.origin - foot) @ lean.T, quads.origin),
            right=np.where(leans, quads.right @ lean.T, quads.right),
            down=np.where(leans, quads.down @ lean.T, quads.down)))

    def frames(self, first: int = 0, last: int | None = None,
               processes: int = 1) -> Iterator[Frame]:
        """Yield frames as a drive does, from processes that know this road."""
        end = len(self) if last is None else min(last, len(self))
        if processes > 1:
            return render_parallel(partial(OnRoad, self.lens, self.spec), first, end, processes)
        return super().frames(first, end)
