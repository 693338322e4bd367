"""The rendered camera: a pinhole with two radial terms, inverted exactly."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats
from dashcalib_ros.errors import ConfigError

# normalised radius within which a lens that never folds is taken as valid (about 81 degrees)
MAX_RADIUS = 6.0


@dataclass(frozen=True)
class Lens:
    """plumb_bob with k1 and k2 only; pixel centres at integers, the first one's at (0, 0).

    width, height, fx, fy, cx, cy in pixels. x_d = x_u (1 + k1 r^2 + k2 r^4), u = fx x_d + cx.
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

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 16 or min(self.fx, self.fy) <= 0.0:
            raise ConfigError('a lens needs a picture of 16 x 16 px or more and fx, fy > 0')
        if self.distorted_radius(self.valid_radius) < self._corner_radius() * 1.001:
            raise ConfigError(
                f'the distortion k1 = {self.k1:g}, k2 = {self.k2:g} folds over inside the '
                'picture: take a longer focal length or weaker distortion')

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
        return {'fx': self.fx, 'fy': self.fy, 'cx': self.cx, 'cy': self.cy, 'k1': self.k1,
                'k2': self.k2}

    @property
    def matrix(self) -> Floats:
        """Return K, (3, 3) float64, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Floats:
        """Return OpenCV's (k1, k2, p1, p2, k3), (5,) float64."""
        return np.array([self.k1, self.k2, 0.0, 0.0, 0.0])

    @property
    def valid_radius(self) -> float:
        """Return the undistorted radius up to which the distortion is monotonic."""
        # derivative 1 + 3 k1 q + 5 k2 q^2 with q = r^2; its smallest positive root folds
        roots = np.roots([5.0 * self.k2, 3.0 * self.k1, 1.0])
        real = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 0.0]
        return min(math.sqrt(min(real)), MAX_RADIUS) if real else MAX_RADIUS

    def distorted_radius(self, radius: float) -> float:
        """Return the distorted of an undistorted normalised radius."""
        q = radius * radius
        return radius * (1.0 + q * (self.k1 + q * self.k2))

    def project(self, points: npt.ArrayLike) -> Floats:
        """Return pixels (n, 2) of points (n, 3) in the camera's frame (z forward, metres).

        Points that no pixel can see (behind, or beyond the fold) become NaN.
        """
        xyz = np.asarray(points, np.float64).reshape(-1, 3)
        with np.errstate(divide='ignore', invalid='ignore'):
            xy = xyz[:, :2] / xyz[:, 2:]
        q = np.sum(xy * xy, axis=1)
        pixels: Floats = xy * (1.0 + q * (self.k1 + q * self.k2))[:, None]
        pixels = pixels * (self.fx, self.fy) + (self.cx, self.cy)
        pixels[(xyz[:, 2] <= 0.0) | (q > self.valid_radius ** 2)] = np.nan
        return pixels

    def undistort(self, pixels: npt.ArrayLike) -> Floats:
        """Return undistorted normalised coordinates (n, 2) of pixels (n, 2); exact to 1e-10."""
        uv = np.asarray(pixels, np.float64).reshape(-1, 2)
        distorted = (uv - (self.cx, self.cy)) / (self.fx, self.fy)
        radius_d = np.hypot(distorted[:, 0], distorted[:, 1])
        radius = self._undistorted_radius(radius_d)
        scale = np.where(radius_d > 1e-12, radius / np.maximum(radius_d, 1e-12), 1.0)
        return distorted * scale[:, None]

    def _undistorted_radius(self, radius_d: Floats) -> Floats:
        """Return the inverse of distorted_radius: a table's guess, then Newton's method.

        The function is monotonic up to the valid radius, and the guess close: it cannot jump.
        """
        table = np.linspace(0.0, self.valid_radius, 20001)
        square = table * table
        radius = np.interp(radius_d, table * (1.0 + square * (self.k1 + square * self.k2)), table)
        for _ in range(20):
            q = radius * radius
            error = radius * (1.0 + q * (self.k1 + q * self.k2)) - radius_d
            if float(np.max(np.abs(error), initial=0.0)) < 1e-13:
                break
            radius -= error / np.maximum(1.0 + q * (3.0 * self.k1 + 5.0 * q * self.k2), 1e-9)
        return np.asarray(radius)

    def _corner_radius(self) -> float:
        """Return the largest distorted normalised radius in the picture (pixels' outer edges)."""
        x = max(self.cx + 0.5, self.width - 0.5 - self.cx) / self.fx
        y = max(self.cy + 0.5, self.height - 0.5 - self.cy) / self.fy
        return math.hypot(x, y)
