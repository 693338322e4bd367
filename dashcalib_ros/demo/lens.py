# SPDX-License-Identifier: Apache-2.0
"""The rendered camera: a pinhole with distortion, and what stands in front of it; all exact."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats
from dashcalib_ros.demo.glass import Glass
from dashcalib_ros.errors import ConfigError

# normalised radius within which a lens that never folds is taken as valid (about 81 degrees)
MAX_RADIUS = 6.0


@dataclass(frozen=True)
class Lens:
    """plumb_bob, with k1 and k2 alone as a rule; pixel centres at integers, the first at (0, 0).

    width, height, fx, fy, cx, cy in pixels. x_d = x_u (1 + k1 r^2 + k2 r^4 + k3 r^6), p1 and p2
    as in OpenCV; u = fx x_d + cx. glass: moves what the lens sees over the picture; None: nothing.
    Raises ConfigError if the picture reaches beyond the radius where the distortion folds over.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    glass: Glass | None = None

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 16 or min(self.fx, self.fy) <= 0.0:
            raise ConfigError('E-LENS-RANGE',
                              'a lens needs a picture of 16 x 16 px or more and fx, fy > 0')
        if self.distorted_radius(self.valid_radius) < self._corner_radius() * 1.001:
            raise ConfigError(
                'E-LENS-FOLDS', f'the distortion k1 = {self.k1:g}, k2 = {self.k2:g}, k3 = '
                                f'{self.k3:g} folds over inside the picture: use a longer focal '
                                f'length or weaker distortion')

    @classmethod
    def of(cls, width: int, height: int, hfov_deg: float, k1: float = 0.0, k2: float = 0.0,
           offset: tuple[float, float] = (0.0, 0.0), aspect: float = 1.0) -> Lens:
        """Make a lens from its field of view.

        hfov_deg: horizontal, of the pinhole without distortion. offset: of the principal point
        from the picture's centre, pixels. aspect: fy / fx.
        """
        fx = 0.5 * width / math.tan(math.radians(hfov_deg) / 2.0)
        return cls(width, height, fx, fx * aspect, (width - 1) / 2.0 + offset[0],
                   (height - 1) / 2.0 + offset[1], k1, k2)

    @property
    def truth(self) -> dict[str, float]:
        """Return what a calibration should find, by the names of result.json."""
        found = {'fx': self.fx, 'fy': self.fy, 'cx': self.cx, 'cy': self.cy, 'k1': self.k1,
                 'k2': self.k2}
        more = {'p1': self.p1, 'p2': self.p2, 'k3': self.k3}
        return {**found, **more} if any(more.values()) else found

    @property
    def model(self) -> str:
        """Return the name of the camera model that describes the lens."""
        return 'brown' if 'k3' in self.truth else 'radial'

    @property
    def matrix(self) -> Floats:
        """Return K, (3, 3) float64, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Floats:
        """Return OpenCV's (k1, k2, p1, p2, k3), (5,) float64."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    @property
    def valid_radius(self) -> float:
        """Return the undistorted radius up to which the distortion is monotonic."""
        # derivative 1 + 3 k1 q + 5 k2 q^2 + 7 k3 q^3, q = r^2; its smallest positive root folds
        roots = np.roots([7.0 * self.k3, 5.0 * self.k2, 3.0 * self.k1, 1.0])
        real = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 0.0]
        return min(math.sqrt(min(real)), MAX_RADIUS) if real else MAX_RADIUS

    def distorted_radius(self, radius: float) -> float:
        """Return the distorted of an undistorted normalised radius; p1 and p2 aside."""
        return radius * float(self._stretch(np.asarray(radius * radius)))

    def project(self, points: npt.ArrayLike) -> Floats:
        """Return pixels (n, 2) of points (n, 3) in the camera's frame (z forward, metres).

        Points that no pixel can see (behind, or beyond the fold) become NaN.
        """
        xyz = np.asarray(points, np.float64).reshape(-1, 3)
        with np.errstate(divide='ignore', invalid='ignore'):
            xy = xyz[:, :2] / xyz[:, 2:]
        pixels: Floats = self._distorted(xy) * (self.fx, self.fy) + (self.cx, self.cy)
        pixels[(xyz[:, 2] <= 0.0) | (np.sum(xy * xy, axis=1) > self.valid_radius ** 2)] = np.nan
        return pixels if self.glass is None else self.glass.behind(pixels, self.size)

    def undistort(self, pixels: npt.ArrayLike) -> Floats:
        """Return undistorted normalised coordinates (n, 2) of pixels (n, 2); exact to 1e-10."""
        uv = np.asarray(pixels, np.float64).reshape(-1, 2)
        if self.glass is not None:
            uv = self.glass.before(uv, self.size)
        distorted = (uv - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.p1 == self.p2 == 0.0:
            return self._undistorted_radially(distorted)
        # p1 and p2 are small: what they add hardly depends on where exactly
        found = self._undistorted_radially(distorted)
        for _ in range(50):
            error = self._distorted(found) - distorted
            if float(np.max(np.abs(error), initial=0.0)) < 1e-12:
                break
            distorted_by_radius = found * self._stretch(_square(found)) - error
            found = self._undistorted_radially(distorted_by_radius)
        return found

    def rays(self, pixels: npt.ArrayLike) -> Floats:
        """Return unit viewing rays (n, 3) of pixels (n, 2), glass included."""
        xy = self.undistort(pixels)
        rays = np.column_stack([xy, np.ones(len(xy))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height) of the picture."""
        return self.width, self.height

    def _stretch(self, q: Floats) -> Floats:
        return np.asarray(1.0 + q * (self.k1 + q * (self.k2 + q * self.k3)))

    def _distorted(self, xy: Floats) -> Floats:
        """Return distorted of undistorted normalised coordinates (n, 2)."""
        q = _square(xy)
        both = 2.0 * xy[:, :1] * xy[:, 1:]
        return np.asarray(xy * self._stretch(q) + both * (self.p1, self.p2)
                          + (q + 2.0 * xy * xy) * (self.p2, self.p1))

    def _undistorted_radially(self, distorted: Floats) -> Floats:
        """Return the inverse of the radial terms: a table's guess, then Newton's method.

        They are monotonic up to the valid radius, and the guess close: it cannot jump.
        """
        radius_d = np.hypot(distorted[:, 0], distorted[:, 1])
        table = np.linspace(0.0, self.valid_radius, 20001)
        radius = np.interp(radius_d, table * self._stretch(table * table), table)
        for _ in range(20):
            q = radius * radius
            error = radius * self._stretch(q) - radius_d
            if float(np.max(np.abs(error), initial=0.0)) < 1e-13:
                break
            slope = 1.0 + q * (3.0 * self.k1 + q * (5.0 * self.k2 + 7.0 * q * self.k3))
            radius -= error / np.maximum(slope, 1e-9)
        scale = np.where(radius_d > 1e-12, radius / np.maximum(radius_d, 1e-12), 1.0)
        return distorted * scale[:, None]

    def _corner_radius(self) -> float:
        """Return the largest distorted normalised radius in the picture (pixels' outer edges)."""
        x = max(self.cx + 0.5, self.width - 0.5 - self.cx) / self.fx
        y = max(self.cy + 0.5, self.height - 0.5 - self.cy) / self.fy
        return math.hypot(x, y)


def _square(xy: Floats) -> Floats:
    return np.asarray(np.sum(xy * xy, axis=1, keepdims=True))
