# SPDX-License-Identifier: Apache-2.0
"""The ground's one big picture: asphalt, pavements, markings, cracks, shadows."""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Floats32, GreyImage
from dashcalib_ros.demo.paint import finish, noise
from dashcalib_ros.demo.path import Course

Texture = GreyImage

FINEST_M = 0.03
MAX_TEXELS = 6500
ROAD_M = 11.0
PAVEMENT_M = 15.5
AROUND_M = 25.0
SHIFT = 4


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


def paint_ground(rng: np.random.Generator, course: Course, streets: Sequence[Street],
                 shapes: Sequence[Floats], heights: Sequence[float], sun: Floats
                 ) -> tuple[Texture, Floats, Floats, Floats]:
    """Return the texture, and its corner, right and down sides (3,) m, at height 0.

    shapes: (4, 2) m, what stands on it, heights in m: they cast shadows away from the sun.
    """
    canvas = _Canvas(rng, course)
    canvas.areas(streets)
    canvas.wear(streets)
    canvas.markings(streets)
    high, wide = canvas.image.shape
    image = canvas.shadows(shapes, heights, sun)
    image *= canvas.image
    blotches = noise(rng, (high // 4, wide // 4), (40.0, 10.0, 2.3), (6.0, 6.0, 5.0))
    image += cv2.resize(blotches, (wide, high), interpolation=cv2.INTER_LINEAR)
    # fine grain may repeat: the blotches under it do not
    grain = noise(rng, (1024, 1024), (3.0, 1.0), (6.0, 7.0))
    for top in range(0, high, 1024):
        for left in range(0, wide, 1024):
            part = image[top:top + 1024, left:left + 1024]
            part += grain[:part.shape[0], :part.shape[1]]
    return finish(image), canvas.origin, canvas.right, canvas.down


class _Canvas:
    """Paints in metres on a grid that lies along the drive."""

    def __init__(self, rng: np.random.Generator, course: Course) -> None:
        self.rng = rng
        points = np.stack([course.x, course.y], axis=1)[::20]
        center, _, angle = cv2.minAreaRect(points.astype(np.float32))
        turn = math.radians(angle)
        self.axes = np.array([[math.cos(turn), math.sin(turn)],
                              [math.sin(turn), -math.cos(turn)]])
        spread = (points - np.array(center)) @ self.axes.T
        # the first texel's corner: texture rows run along axes[0], columns along axes[1]
        low, high = spread.min(axis=0) - AROUND_M, spread.max(axis=0) + AROUND_M
        low[:] = np.minimum(low, -40.0)
        high[:] = np.maximum(high, 40.0)
        self.corner = np.array(center) + low @ self.axes
        self.cell = max(FINEST_M, float(np.max(high - low)) / MAX_TEXELS)
        wide, tall = (int(v) for v in np.ceil((high - low) / self.cell))
        self.image = np.full((tall, wide), 92, np.uint8)
        self.origin = np.array([*self.corner, 0.0])
        self.right = np.array([*(self.axes[0] * wide * self.cell), 0.0])
        self.down = np.array([*(self.axes[1] * tall * self.cell), 0.0])

    def texels(self, points: npt.ArrayLike) -> npt.NDArray[np.int32]:
        """Return texel coordinates of points (n, 2) m, in cv2's fixed point."""
        local = (np.atleast_2d(np.asarray(points, np.float64)) - self.corner) @ self.axes.T
        return np.asarray(np.round((local / self.cell - 0.5) * (1 << SHIFT)), np.int32)

    def line(self, points: npt.ArrayLike, width_m: float, grey: float) -> None:
        """Draw a polyline; points (n, 2) m."""
        cv2.polylines(self.image, [self.texels(points)], False, int(grey),
                      max(1, round(width_m / self.cell)), cv2.LINE_AA, SHIFT)

    def areas(self, streets: Sequence[Street]) -> None:
        """Lay pavements with slabs, kerbs and asphalt."""
        rng = self.rng
        axes = [(street.at(-40.0, 0.0), street.at(street.length + 40.0, 0.0))
                for street in streets]
        for ends in axes:
            self.line(ends, PAVEMENT_M, 138)
        for street in streets:
            for along in np.arange(0.0, street.length, 1.5):
                self.line([street.at(along, -7.7), street.at(along, 7.7)], 0.04, 105)
            for side in (-7.1, -6.3, 6.3, 7.1):
                self.line([street.at(0.0, side), street.at(street.length, side)], 0.04, 108)
        for ends in axes:
            self.line(ends, ROAD_M + 0.5, 172)
        for street, ends in zip(streets, axes, strict=True):
            self.line(ends, ROAD_M, 84)
            for along in np.arange(0.0, street.length, float(rng.uniform(6.0, 11.0))):
                wide = float(rng.uniform(0.5, 4.0))
                side = float(rng.uniform(-4.0, 4.0))
                self.line([street.at(along, side), street.at(along + wide, side)],
                          float(rng.uniform(0.5, 2.0)), float(rng.uniform(62.0, 112.0)))

    def wear(self, streets: Sequence[Street]) -> None:
        """Add cracks, joints, drains and oil."""
        rng = self.rng
        for street in streets:
            for _ in range(int(street.length / 2.5)):
                start = street.at(float(rng.uniform(0.0, street.length)),
                                  float(rng.uniform(-5.0, 5.0)))
                turns = np.cumsum(rng.normal(0.0, 0.5, 12)) + float(rng.uniform(0.0, 6.3))
                steps = np.stack([np.cos(turns), np.sin(turns)], axis=1) * 0.25
                self.line(start + np.cumsum(steps, axis=0), float(rng.uniform(0.03, 0.07)),
                          float(rng.uniform(35.0, 60.0)))
            for _ in range(int(street.length / 6.0)):
                spot = self.texels(street.at(float(rng.uniform(0.0, street.length)),
                                             float(rng.uniform(-4.5, 4.5))))[0]
                radius = round(float(rng.choice([0.12, 0.2, 0.33])) / self.cell * (1 << SHIFT))
                cv2.circle(self.image, (int(spot[0]), int(spot[1])), radius,
                           int(rng.uniform(38.0, 70.0)), -1, cv2.LINE_AA, SHIFT)
            for along in np.arange(5.0, street.length, 17.0):
                self.line([street.at(along, -5.4), street.at(along + 0.3, 5.4)], 0.05, 52)

    def markings(self, streets: Sequence[Street]) -> None:
        """Paint dashes, parking lines and zebra crossings."""
        rng = self.rng
        for street in streets:
            for along in np.arange(0.0, street.length, 6.0):
                self.line([street.at(along, 0.0), street.at(along + 3.0, 0.0)], 0.14,
                          float(rng.uniform(165.0, 215.0)))
            for side in (-3.7, 3.7):
                for along in np.arange(0.0, street.length, 5.5):
                    self.line([street.at(along, side), street.at(along + 4.9, side)], 0.1,
                              float(rng.uniform(150.0, 205.0)))
                    self.line([street.at(along, side), street.at(along, side * 1.45)], 0.1,
                              float(rng.uniform(150.0, 205.0)))
            for along in (44.0, street.length - 44.0):
                for side in np.arange(-4.8, 5.0, 1.0):
                    self.line([street.at(along - 1.3, side), street.at(along + 1.3, side)], 0.5,
                              float(rng.uniform(165.0, 215.0)))

    def shadows(self, shapes: Sequence[Floats], heights: Sequence[float], sun: Floats
                ) -> Floats32:
        """Return the light on the ground, 1 in the sun."""
        shade = np.ones(self.image.shape, np.float32)
        for shape, height in zip(shapes, heights, strict=True):
            thrown = shape - sun[:2] / sun[2] * min(height, 14.0)
            hull = cv2.convexHull(self.texels(np.concatenate([shape, thrown])))
            cv2.fillConvexPoly(shade, hull, 0.62, cv2.LINE_8, SHIFT)
        return np.asarray(cv2.blur(shade, (5, 5)), np.float32)
