# SPDX-License-Identifier: Apache-2.0
"""The town: streets along the path, houses, parked cars, trees, signs, ground and sky."""
from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, GreyImage
from dashcalib_ros.demo import paint
from dashcalib_ros.demo.atlas import Atlas, Texture, pack
from dashcalib_ros.demo.ground import Street, paint_ground
from dashcalib_ros.demo.path import Course
from dashcalib_ros.demo.quads import QuadList, Quads

Grid = GreyImage

# the car keeps right: the street's axis is this far to its left
LANE_M = 1.75
ROAD_HALF_M = 4.0
PAVEMENT_HALF_M = 7.2
# streets go on beyond the crossings at which the path leaves them
BEYOND_M = 62.0
MARGIN_M = 45.0
CELL_M = 0.25
SUN = np.array([0.55, 0.35, 0.76])


@dataclass(frozen=True)
class Box:
    """An upright box that casts a shadow. corners: (4, 2) m; height m."""

    corners: Floats
    height: float


@dataclass(frozen=True)
class Town:
    """The static world, and the pictures for it and for cars that move.

    cars: texture numbers, (kinds, 8), in paint.car_textures' order.
    """

    quads: Quads
    atlas: Atlas
    cars: tuple[tuple[int, ...], ...]


def car_quads(quads: QuadList, center: npt.ArrayLike, heading: float,
              textures: tuple[int, ...]) -> None:
    """Add a car (4.3 x 1.75 x 1.45 m): a body and a cabin."""
    front, side, back, top = textures[:4]
    quads.box(center, heading, (4.3, 1.75), 0.22, 0.84, (front, side, back, side, top))
    middle = np.asarray(center) - 0.25 * np.array([math.cos(heading), math.sin(heading)])
    front, side, back, top = textures[4:]
    quads.box(middle, heading, (2.2, 1.5), 0.84, 1.45, (front, side, back, side, top))


def build_town(course: Course, seed: int) -> Town:
    """Build the town around the path."""
    return _Builder(course, np.random.default_rng([seed, 3])).build()


class _Builder:
    """Builds a town, kind by kind, on a map of what is taken."""

    def __init__(self, course: Course, rng: np.random.Generator) -> None:
        self.course = course
        self.rng = rng
        self.streets = _streets(course)
        ends = np.array([street.at(along, 0.0) for street in self.streets
                         for along in (0.0, street.length)])
        self.low = ends.min(axis=0) - MARGIN_M
        self.high = ends.max(axis=0) + MARGIN_M
        size = np.ceil((self.high - self.low) / CELL_M).astype(int)
        self.taken: Grid = np.zeros((size[1], size[0]), np.uint8)
        self.textures: list[Texture] = []
        self.quads = QuadList()
        self.shadows: list[Box] = []
        self.leaves: list[int] = []
        total = sum(street.length for street in self.streets)
        self.grain = paint.noise(rng, (2048, 2048), (24.0, 5.0, 1.0), (4.0, 4.0, 4.0))
        self.density = 40.0 * min(1.0, math.sqrt(1500.0 / total))

    def build(self) -> Town:
        """Place everything; the order is the order of rights of way."""
        xy = np.stack([self.course.x, self.course.y], axis=1)[::20]
        self._block(xy, PAVEMENT_HALF_M)
        for street in self.streets:
            self._block(np.array([street.at(0.0, 0.0), street.at(street.length, 0.0)]),
                        PAVEMENT_HALF_M)
        for street in self.streets:
            for side in (-1.0, 1.0):
                self._houses(street, side, (7.5, 10.5), (6.0, 17.0), 1.0)
        for street in self.streets:
            for side in (-1.0, 1.0):
                self._houses(street, side, (19.0, 30.0), (12.0, 30.0), 0.4)
        cars = tuple(tuple(self._add(image) for image in paint.car_textures(self.rng))
                     for _ in range(7))
        self.leaves = [self._add(paint.leaves(self.rng, light))
                       for light in (1.25, 0.95, 0.7) for _ in range(8)]
        # the kerbs: cars and posts stand on what is free of the path and the crossings
        self.taken[:] = 0
        self._block(xy, 1.8)
        self._block(xy + LANE_M * 2.0 * _normals(xy), 1.6)
        self._block_crossings()
        for street in self.streets:
            for side in (-1.0, 1.0):
                self._kerb(street, side, cars)
        self._surroundings()
        ground, origin, right, down = paint_ground(
            self.rng, self.course, self.streets, [box.corners for box in self.shadows],
            [box.height for box in self.shadows], SUN)
        self.quads.add(origin, right, down, self._add(ground))
        return Town(self.quads.quads(), pack(self.textures), cars)

    def _add(self, texture: Texture) -> int:
        self.textures.append(texture)
        return len(self.textures) - 1

    # -- the map ----------------------------------------------------------------------------

    def _cells(self, points: Floats) -> npt.NDArray[np.int32]:
        return np.asarray(np.round((points - self.low) / CELL_M * 16.0), np.int32)

    def _block(self, line: Floats, half_width: float) -> None:
        cv2.polylines(self.taken, [self._cells(line)], False, 1,
                      max(1, round(2.0 * half_width / CELL_M)), cv2.LINE_8, 4)

    def _block_crossings(self) -> None:
        for i, one in enumerate(self.streets):
            for other in self.streets[i + 1:]:
                point = _crossing(one, other)
                if point is not None:
                    cv2.circle(self.taken, tuple(int(c) for c in self._cells(point)),
                               round(10.0 / CELL_M * 16.0), 1, -1, cv2.LINE_8, 4)

    def _claim(self, corners: Floats) -> bool:
        """Take the ground under a convex footprint (4, 2) m if it is free."""
        cells = self._cells(corners)
        low = np.maximum(cells.min(axis=0) // 16 - 1, 0)
        high = cells.max(axis=0) // 16 + 2
        part = self.taken[low[1]:high[1], low[0]:high[0]]
        if part.shape[0] < high[1] - low[1] or part.shape[1] < high[0] - low[0]:
            return False
        footprint = np.zeros_like(part)
        cv2.fillConvexPoly(footprint, (cells - low * 16).astype(np.int32), 1, cv2.LINE_8, 4)
        if np.any(part & footprint):
            return False
        part |= footprint
        return True

    # -- what stands on it -------------------------------------------------------------------

    def _houses(self, street: Street, side: float, setback: tuple[float, float],
                height: tuple[float, float], quality: float) -> None:
        """Line a street with houses. setback, height: ranges in m."""
        rng = self.rng
        along = float(rng.uniform(0.0, 4.0))
        front = float(rng.uniform(*setback))
        while along < street.length - 6.0:
            wide, deep = float(rng.uniform(7.0, 15.0)), float(rng.uniform(7.0, 10.0))
            if rng.random() < 0.5:
                front = float(rng.uniform(*setback))
            center = street.at(along + 0.5 * wide, side * (front + 0.5 * deep))
            corners = _corners(center, street.heading, (wide - 0.3, deep - 0.3))
            if not self._claim(corners):
                along += 2.0
                continue
            self._house(center, street.heading, side, (wide, deep), float(rng.uniform(*height)),
                        quality)
            along += wide + (float(rng.uniform(1.5, 6.0)) if rng.random() < 0.35 else 0.05)

    def _house(self, center: Floats, heading: float, side: float, size: tuple[float, float],
               top: float, quality: float) -> None:
        rng = self.rng
        wide, deep = size
        faces: list[int | None] = []
        for face in range(4):
            angle = heading + face * 0.5 * math.pi
            sun = max(0.0, float(SUN[0] * math.cos(angle) + SUN[1] * math.sin(angle)))
            light = 0.62 + 0.5 * sun
            # faces 1 and 3 look to the left and to the right of the street
            street_side = face == (3 if side > 0.0 else 1)
            sharp = self.density * quality * (1.0 if street_side else 0.6)
            span = wide if face % 2 == 1 else deep
            faces.append(self._add(paint.facade(rng, (span, top), sharp, light,
                                                street_side and rng.random() < 0.55,
                                                self.grain)))
        self.quads.box(center, heading, (wide, deep), 0.0, top, (*faces, None))
        self.shadows.append(Box(_corners(center, heading, (wide, deep)), top))

    def _kerb(self, street: Street, side: float, cars: tuple[tuple[int, ...], ...]) -> None:
        """Park cars, and put up trees, posts and signs."""
        rng = self.rng
        along = float(rng.uniform(1.0, 6.0))
        while along < street.length - 3.0:
            kind = rng.random()
            if kind < 0.42:
                heading = street.heading + (0.0 if side < 0.0 else math.pi)
                heading += float(rng.normal(0.0, 0.02))
                center = street.at(along, side * (ROAD_HALF_M + 0.75))
                corners = _corners(center, heading, (4.5, 1.8))
                if self._claim(corners):
                    car_quads(self.quads, center, heading,
                              cars[int(rng.integers(0, len(cars)))])
                    self.shadows.append(Box(corners, 0.25))
                along += float(rng.uniform(5.0, 8.0))
                continue
            center = street.at(along, side * float(rng.uniform(5.9, 6.6)))
            if self._claim(_corners(center, 0.0, (0.4, 0.4))):
                if kind < 0.68:
                    self._tree(center)
                else:
                    self._post(center, street.heading, side)
            along += float(rng.uniform(2.5, 6.0))

    def _tree(self, center: Floats) -> None:
        rng = self.rng
        trunk = self._add(paint.bark(rng))
        turn = float(rng.uniform(0.0, 1.5))
        bottom, radius = float(rng.uniform(2.2, 2.8)), float(rng.uniform(0.7, 1.1))
        self.quads.box(center, turn, (0.28, 0.28), 0.0, bottom + 0.5, (trunk,) * 4 + (None,))
        for layer, share in enumerate((0.8, 1.0, 0.85, 0.5)):
            for _ in range(2):
                size = 1.25 * radius * share
                shift = rng.normal(0.0, 0.3 * radius * share, 2)
                low = bottom + layer * 0.55 * radius
                sides = tuple(int(leaf) for leaf in rng.choice(self.leaves, 4))
                self.quads.box(center + shift, float(rng.uniform(0.0, 1.5)), (size, size), low,
                               low + radius, (*sides, self.leaves[0]))
        self.shadows.append(Box(_corners(center, turn, (2.0 * radius, 2.0 * radius)),
                                bottom + radius))

    def _post(self, center: Floats, heading: float, side: float) -> None:
        rng = self.rng
        metal = self._add(paint.bark(rng))
        top = float(rng.uniform(2.6, 6.5))
        self.quads.box(center, heading, (0.14, 0.14), 0.0, top, (metal,) * 4 + (None,))
        self.shadows.append(Box(_corners(center, heading, (0.14, 0.14)), top))
        if rng.random() < 0.75:
            wide, high = float(rng.uniform(0.5, 1.3)), float(rng.uniform(0.5, 0.9))
            front = self._add(paint.sign(rng, round(wide * 90.0), round(high * 90.0)))
            back = self._add(paint.sign(rng, round(wide * 90.0), round(high * 90.0)))
            low = min(top - high, 2.2)
            self.quads.box(center, heading, (0.2, wide), low, low + high,
                           (front, metal, back, metal, None))

    def _surroundings(self) -> None:
        """Put far land, a skyline and clouds around it all."""
        rng = self.rng
        middle = 0.5 * (self.low + self.high)
        reach = 0.5 * float(np.max(self.high - self.low)) + 120.0
        far = 12000.0
        self.quads.add([middle[0] - 1200.0, middle[1] + 1200.0, -0.06], [2400.0, 0.0, 0.0],
                       [0.0, -2400.0, 0.0], self._add(paint.meadow(rng, 2048)))
        # seen from below: its front is its lower side
        self.quads.add([middle[0] - far, middle[1] - far, 1400.0], [2.0 * far, 0.0, 0.0],
                       [0.0, 2.0 * far, 0.0], self._add(paint.clouds(rng, 2048)))
        count = 28
        for i in range(count):
            angle = 2.0 * math.pi * i / count
            wide = 2.0 * reach * math.tan(math.pi / count)
            top = float(rng.uniform(12.0, 40.0)) * reach / 300.0
            out = np.array([math.cos(angle), math.sin(angle)])
            across = np.array([out[1], -out[0]])
            corner = middle + reach * out - 0.5 * wide * across
            self.quads.add([*corner, top], [*(wide * across), 0.0], [0.0, 0.0, -top],
                           self._add(paint.skyline(rng, 600, 200)))


def _streets(course: Course) -> list[Street]:
    """Return the axes of the streets that the path's straights run along."""
    streets = []
    for straight in course.straights:
        street = Street(straight.start, straight.heading, straight.length)
        start = street.at(-BEYOND_M, LANE_M)
        streets.append(Street(start, straight.heading, straight.length + 2.0 * BEYOND_M))
    return streets


def _crossing(one: Street, other: Street) -> Floats | None:
    """Return where two streets meet, (2,) m, or None."""
    matrix = np.stack([one.ahead, -other.ahead], axis=1)
    if abs(float(np.linalg.det(matrix))) < 0.2:
        return None
    a, b = np.linalg.solve(matrix, other.start - one.start)
    if 0.0 < a < one.length and 0.0 < b < other.length:
        return one.at(float(a), 0.0)
    return None


def _corners(center: Floats, heading: float, size: tuple[float, float]) -> Floats:
    """Return the corners (4, 2) m of a rectangle; size along and across the heading (rad)."""
    ahead = np.array([math.cos(heading), math.sin(heading)]) * 0.5 * size[0]
    left = np.array([-math.sin(heading), math.cos(heading)]) * 0.5 * size[1]
    return np.array([center + ahead + left, center - ahead + left, center - ahead - left,
                     center + ahead - left])


def _normals(line: Floats) -> Floats:
    """Return the direction to the left of each point (n, 2) of a line."""
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return np.stack([-along[:, 1], along[:, 0]], axis=1)
