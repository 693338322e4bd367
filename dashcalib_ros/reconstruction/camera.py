"""The camera model that scenes are built with: pinhole and two radial terms (paper, Eq. 1, 2)."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
# tangent of 85 degrees: no pinhole camera sees farther out
WIDEST = 11.4


@dataclass(frozen=True)
class Camera:
    """fx, fy, cx, cy in pixels (first pixel's centre at 0, 0); k1, k2; image_size (w, h)."""

    image_size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0

    @classmethod
    def centred(cls, image_size: tuple[int, int], focal: float, k1: float = 0.0) -> Camera:
        """Return the camera that the paper's first step starts from: fx = fy, centre fixed."""
        width, height = image_size
        return cls(image_size, focal, focal, (width - 1) / 2, (height - 1) / 2, k1)

    @property
    def params(self) -> Array:
        """Return fx, fy, cx, cy, k1, k2 as (6,)."""
        return np.array([self.fx, self.fy, self.cx, self.cy, self.k1, self.k2])

    def with_params(self, params: npt.ArrayLike) -> Camera:
        """Return the camera with other fx, fy, cx, cy, k1, k2."""
        fx, fy, cx, cy, k1, k2 = (float(value) for value in np.asarray(params))
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, k1=k1, k2=k2)

    def rays(self, xy: Array) -> Array:
        """Return the normalised, undistorted coordinates (..., 2) of pixels (..., 2).

        NaN stays NaN; a pixel that the model cannot reach, because it folds over before, becomes
        NaN. Newton's method on the radius.
        """
        distorted = (xy - [self.cx, self.cy]) / [self.fx, self.fy]
        target = np.linalg.norm(distorted, axis=-1)
        radius = target.copy()
        for _ in range(12):
            square = radius * radius
            value = radius * (1 + square * (self.k1 + square * self.k2)) - target
            slope = 1 + square * (3 * self.k1 + 5 * square * self.k2)
            radius = np.clip(radius - value / np.maximum(slope, 0.1), 0.0, WIDEST)
        reached = np.where(np.abs(value) < 1e-6, radius, np.nan)
        scale = np.where(target > 1e-12, reached / np.maximum(target, 1e-12), 1.0)
        return np.asarray(distorted * scale[..., None])

    def project(self, points: Array) -> Array:
        """Return the pixels (..., 2) of points (..., 3) in the camera's frame, z > 0."""
        xy = points[..., :2] / points[..., 2:]
        square = np.sum(xy * xy, axis=-1, keepdims=True)
        scale = 1 + square * (self.k1 + square * self.k2)
        return np.asarray(xy * scale * [self.fx, self.fy] + [self.cx, self.cy])

    def monotonic(self) -> bool:
        """Return whether the distortion model grows with the radius all over the picture."""
        width, height = self.image_size
        corners = np.array([[x, y] for x in (0.0, width - 1.0) for y in (0.0, height - 1.0)])
        reach = np.linalg.norm((corners - [self.cx, self.cy]) / [self.fx, self.fy], axis=1).max()
        # the undistorted radius of the farthest corner must lie before the fold
        radii = np.linspace(0, 3 * reach, 600)
        square = radii**2
        rising = 1 + square * (3 * self.k1 + 5 * square * self.k2) > 0
        until = radii[: int(np.argmin(rising))] if not rising.all() else radii
        if len(until) == 0:
            return False
        last = until[-1]
        return bool(last * (1 + last**2 * (self.k1 + last**2 * self.k2)) >= reach)
