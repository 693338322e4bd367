# SPDX-License-Identifier: Apache-2.0
"""Rendered fisheye lenses: what no pinhole camera sees, with exact truth.

The lens is equidistant with four terms, as in OpenCV's fisheye module and in ROS: a ray at angle t
from the axis lies t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) focal lengths from the centre. It
shares no code with camera/, so that it cannot share an error with the calibration.

The town's renderer casts rays in front of a plane only, so the picture is made of two halves. Each
has a camera of its own in the same place, turned by 45 degrees to its side, from which all rays of
its pixels are in front. The rays are exact: nothing is resampled, and both halves agree where they
meet.
"""
from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dashcalib_ros.arrays import Floats, Floats32
from dashcalib_ros.demo.atlas import Atlas
from dashcalib_ros.demo.glass import Glass
from dashcalib_ros.demo.lens import Lens
from dashcalib_ros.demo.quads import Quads
from dashcalib_ros.demo.raycast import Raycaster
from dashcalib_ros.errors import ConfigError

# angles from the axis that are searched, rad
ANGLES = np.linspace(0.0, 2.6, 26001)
# columns that both halves render, so that outlines are smooth where they meet
SHARED = 2
SIDE_DEG = 45.0


@dataclass(frozen=True)
class FisheyeLens:
    """Sizes, fx, fy, cx and cy in pixels; the first pixel's centre is at (0, 0).

    glass: moves what the lens sees over the picture; None: nothing. Raises ConfigError if a corner
    lies beyond the angle at which the distortion folds over.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    glass: Glass | None = None

    def __post_init__(self) -> None:
        if not self._corner_radius() < 0.98 * self._bent_angles[-1]:
            raise ConfigError(
                'E-LENS-FOLDS', f'{self} folds over inside the picture: use a longer focal '
                                f'length or weaker distortion')

    @classmethod
    def of(cls, width: int, height: int, hfov_deg: float,
           k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
           offset: tuple[float, float] = (0.0, 0.0), aspect: float = 1.0) -> FisheyeLens:
        """Make a lens whose picture is hfov_deg wide, distortion included.

        offset: of the centre, from the picture's middle, pixels. aspect: fy / fx.
        """
        fx = 0.5 * width / float(bent(np.array(math.radians(0.5 * hfov_deg)), k))
        return cls(width, height, fx, fx * aspect, (width - 1) / 2.0 + offset[0],
                   (height - 1) / 2.0 + offset[1], *k)

    @property
    def model(self) -> str:
        """Return the name of the camera model that describes the lens."""
        return 'fisheye'

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height) of the picture."""
        return self.width, self.height

    @property
    def k(self) -> tuple[float, float, float, float]:
        """Return the distortion coefficients."""
        return self.k1, self.k2, self.k3, self.k4

    @property
    def truth(self) -> dict[str, float]:
        """Return what a calibration should find, by the names of result.json."""
        return {'fx': self.fx, 'fy': self.fy, 'cx': self.cx, 'cy': self.cy,
                'k1': self.k1, 'k2': self.k2, 'k3': self.k3, 'k4': self.k4}

    def project(self, points: Floats) -> Floats:
        """Return pixels (n, 2) of points (n, 3) in the camera's frame; NaN beyond the fold."""
        across = np.hypot(points[:, 0], points[:, 1])
        angle = np.arctan2(across, points[:, 2])
        angle = np.where(angle < ANGLES[len(self._bent_angles) - 1], angle, np.nan)
        scale = bent(angle, self.k) / np.maximum(across, 1e-12)
        pixels = scale[:, None] * points[:, :2] * (self.fx, self.fy) + (self.cx, self.cy)
        return pixels if self.glass is None else self.glass.behind(pixels, self.size)

    def rays(self, pixels: Floats) -> Floats:
        """Return unit rays (n, 3) of pixels (n, 2)."""
        if self.glass is not None:
            pixels = self.glass.before(pixels, self.size)
        xy = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        radius = np.hypot(xy[:, 0], xy[:, 1])
        angle = self._angle(radius)
        side = np.where(radius > 1e-12, np.sin(angle) / np.maximum(radius, 1e-12), 1.0)
        return np.column_stack([side[:, None] * xy, np.cos(angle)])

    def pixel_angle(self, pixels: Floats) -> Floats:
        """Return the root of the solid angle (n,) that the pixels (n, 2) see, rad."""
        xy = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        radius = np.maximum(np.hypot(xy[:, 0], xy[:, 1]), 1e-6)
        angle = self._angle(radius)
        spread = radius / np.sin(angle) * slope(angle, self.k)
        return np.asarray(1.0 / np.sqrt(self.fx * self.fy * spread))

    @property
    def widest_deg(self) -> float:
        """Return the angle from the axis that the farthest corner sees."""
        return math.degrees(self._angle(np.array([self._corner_radius()]))[0])

    def _angle(self, radius: Floats) -> Floats:
        """Return the angles of distorted radii, in focal lengths: a table, then Newton."""
        table = self._bent_angles
        angle = np.interp(radius, table, ANGLES[:len(table)])
        for _ in range(4):
            angle = angle - (bent(angle, self.k) - radius) / slope(angle, self.k)
        return angle

    @cached_property
    def _bent_angles(self) -> Floats:
        """Return the distorted radii of ANGLES, as far as they grow."""
        grows = slope(ANGLES, self.k) > 0.05
        count = len(ANGLES) if grows.all() else int(np.argmin(grows))
        return bent(ANGLES[:count], self.k)

    def _corner_radius(self) -> float:
        x = max(self.cx + 0.5, self.width - 0.5 - self.cx) / self.fx
        y = max(self.cy + 0.5, self.height - 0.5 - self.cy) / self.fy
        return math.hypot(x, y)


def bent(angle: Floats, k: tuple[float, float, float, float]) -> Floats:
    """Return the distorted radii of angles, in focal lengths."""
    s = angle * angle
    return np.asarray(angle * (1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))))


def slope(angle: Floats, k: tuple[float, float, float, float]) -> Floats:
    """Return the derivative of bent()."""
    s = angle * angle
    return np.asarray(1.0 + s * (3.0 * k[0] + s * (5.0 * k[1] + s * (7.0 * k[2]
                                                                      + s * 9.0 * k[3]))))


class Half(Raycaster):
    """Renders some columns of a fisheye picture with a camera that is turned to the side.

    turned: (3, 3), the fisheye camera's directions from this camera's.
    """

    def __init__(self, lens: FisheyeLens, columns: range, side_deg: float, atlas: Atlas) -> None:
        self.fisheye = lens
        self.columns = columns
        cos, sin = math.cos(math.radians(side_deg)), math.sin(math.radians(side_deg))
        self.turned = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        # the pinhole lens counts for its size only; the rest is replaced
        super().__init__(Lens.of(len(columns), lens.height, 60.0), atlas)
        # a column's rays need not be all to the left of the next column's
        self.column_low = np.minimum.accumulate(self.column_low[::-1])[::-1]
        self.column_high = np.maximum.accumulate(self.column_high)
        self.row_low = np.minimum.accumulate(self.row_low[::-1])[::-1]
        self.row_high = np.maximum.accumulate(self.row_high)
        pixel = lens.pixel_angle(self._pixels((0.0, 0.0))).reshape(self.x.shape)
        square = 1.0 + self.x * self.x + self.y * self.y
        self.across = (np.sqrt(square) * pixel).astype(np.float32)
        self.along = (square * pixel).astype(np.float32)

    def render(self, quads: Quads, rotation: Floats, position: Floats) -> Floats32:
        """Return the columns' picture; rotation: world from the fisheye camera, (n, 3, 3)."""
        return super().render(quads, rotation @ self.turned, position)

    def _rays(self, offset: tuple[float, float]) -> tuple[Floats32, Floats32]:
        rays = self.fisheye.rays(self._pixels(offset)) @ self.turned
        if rays[:, 2].min() < 0.1:
            raise ConfigError('E-LENS-TOO-WIDE', 'the lens sees too far to the sides: use one of '
                                                 '180 degrees or less')
        shape = (self.fisheye.height, len(self.columns))
        x, y = ((rays[:, axis] / rays[:, 2]).astype(np.float32).reshape(shape) for axis in (0, 1))
        return x, y

    def _pixels(self, offset: tuple[float, float]) -> Floats:
        u, v = np.meshgrid(np.array(self.columns) + offset[0],
                           np.arange(self.fisheye.height) + offset[1])
        return np.column_stack([u.ravel(), v.ravel()])


class WholeRaycaster:
    """Renders a fisheye picture as two halves."""

    def __init__(self, lens: FisheyeLens, atlas: Atlas) -> None:
        self.middle = round(lens.cx)
        self.left = Half(lens, range(self.middle + SHARED), -SIDE_DEG, atlas)
        self.right = Half(lens, range(self.middle - SHARED, lens.width), SIDE_DEG, atlas)

    def render(self, quads: Quads, rotation: Floats, position: Floats) -> Floats32:
        """Return the picture (height, width), grey 0 to 255; as Raycaster.render()."""
        left, right = (half.render(quads, rotation, position)
                       for half in (self.left, self.right))
        return np.hstack([left[:, :-SHARED], right[:, SHARED:]])
