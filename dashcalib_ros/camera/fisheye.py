# SPDX-License-Identifier: Apache-2.0
"""Fisheye lenses: the angle off the axis, not its tangent, grows with the radius in the picture.

With theta the angle between a ray and the optical axis, the radius is fx times
theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8): OpenCV's fisheye, ROS's equidistant
(Kannala and Brandt 2006). Rays beyond 90 degrees are seen like all others.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.camera import FISHEYE, TINY, Camera, ColmapModel

# radians (120 degrees): the corners of a picture that is 190 degrees wide see to 110
WIDEST = 2.1
NEWTON_STEPS = 12
# radians; a pixel without a solution this exact has no ray
REACHED = 1e-6
# of a point's distance; nearer to the axis, the limits for a radius of 0 hold to the last digit
ON_AXIS = 1e-7


@dataclass(frozen=True)
class Fisheye(Camera):
    """A fisheye lens: the equidistant model with four coefficients, as cv2.fisheye has it.

    image_size: (width, height) in pixels. fx, fy, cx, cy: pixels; the centre of the first pixel is
    at (0, 0). k1 to k4: of the powers 3, 5, 7, 9 of the angle to the axis.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    model: ClassVar[str] = 'fisheye'
    ros_model: ClassVar[str] = 'equidistant'
    family: ClassVar[str] = FISHEYE
    colmap: ClassVar[ColmapModel] = ColmapModel('OPENCV_FISHEYE', 8, (0, 1, 2, 3, 4, 5, 6, 7))
    spread: ClassVar[tuple[float, ...]] = (0.2, 0.1, 0.05, 0.02)
    # 250 to 82 degrees across, without distortion
    focal_ratios: ClassVar[tuple[float, ...]] = tuple(0.23 * 1.2**n for n in range(7))
    sees_behind: ClassVar[bool] = True

    def ros_distortion(self) -> list[float]:
        """Return k1, k2, k3, k4, the order of ROS and OpenCV."""
        return [self.k1, self.k2, self.k3, self.k4]

    def project(self, points: Floats) -> Floats:
        """Return the pixels (..., 2) of points (..., 3); NaN beyond the radius of the fold."""
        radius = np.hypot(points[..., 0], points[..., 1])
        theta = np.arctan2(radius, points[..., 2])
        distance = np.hypot(radius, points[..., 2])
        visible = (theta < self.fold) & (distance > 0)
        axial = radius <= ON_AXIS * distance
        with np.errstate(divide='ignore', invalid='ignore'):
            scale = np.where(axial, 1 / distance, theta * self._stretch(theta) / radius)
        scale = np.where(visible, scale, np.nan)
        return np.stack([self.fx * scale * points[..., 0] + self.cx,
                         self.fy * scale * points[..., 1] + self.cy], axis=-1)

    def rays(self, pixels: Floats) -> Floats:
        """Return unit viewing rays (..., 3): Newton's method on the angle."""
        distorted = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        target = np.linalg.norm(distorted, axis=-1)
        theta = np.minimum(target, self.fold)
        for _ in range(NEWTON_STEPS):
            value = theta * self._stretch(theta) - target
            slope = np.maximum(self._slope(theta), 0.1)
            theta = np.clip(theta - value / slope, 0.0, self.fold)
        value = theta * self._stretch(theta) - target
        theta = np.where(np.abs(value) < REACHED, theta, np.nan)
        across = distorted / np.maximum(target, 1e-300)[..., None] * np.sin(theta)[..., None]
        return np.concatenate([across, np.cos(theta)[..., None]], axis=-1)

    def derivatives(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the derivatives of the pixels of points (m, 3); see Camera."""
        x, y, z = points.T
        radius, distance = np.hypot(x, y), np.linalg.norm(points, axis=1)
        theta = np.arctan2(radius, z)
        axial = radius <= ON_AXIS * distance
        safe = np.where(axial, 1.0, radius)
        angle = theta * self._stretch(theta)
        scale = np.where(axial, 1 / np.maximum(distance, 1e-300), angle / safe)
        # of the scale by the radius, over the radius; and by z
        inner = np.where(axial, 0.0,
                         (self._slope(theta) * z / distance**2 - scale) / safe**2)
        by_z = np.where(axial, -1 / np.maximum(distance, 1e-300)**2,
                        -self._slope(theta) / distance**2)
        focal = np.array([self.fx, self.fy])
        plain = points[:, :2] * scale[:, None]
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, :, :2] = points[:, :2, None] * points[:, None, :2] * inner[:, None, None]
        by_point[:, [0, 1], [0, 1]] += scale[:, None]
        by_point[:, :, 2] = points[:, :2] * by_z[:, None]
        by_point *= focal[:, None]
        by_params = np.zeros((len(points), 2, len(self.names())))
        by_params[:, [0, 1], [0, 1]] = plain
        by_params[:, 0, 2] = by_params[:, 1, 3] = 1.0
        direction = focal * np.where(axial[:, None], 0.0, points[:, :2] / safe[:, None])
        for n in range(4):
            by_params[:, :, 4 + n] = direction * theta[:, None] ** (2 * n + 3)
        return by_params, by_point, focal * plain + [self.cx, self.cy]

    def depths(self, points: Floats) -> Floats:
        """Return (...) the distances of points (..., 3): pictures shrink alike all around."""
        return np.asarray(np.linalg.norm(points, axis=-1))

    @cached_property
    def fold(self) -> float:
        """Return the angle at which the model folds over, WIDEST at most; radians."""
        slope = np.array([9 * self.k4, 7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0])
        roots = np.roots(np.where(np.abs(slope) < TINY, 0.0, slope))
        squares = roots[np.abs(roots.imag) < 1e-9].real
        return float(min([WIDEST, *np.sqrt(squares[squares > 0])]))

    def _stretch(self, theta: Floats) -> Floats:
        s = theta * theta
        return 1 + s * (self.k1 + s * (self.k2 + s * (self.k3 + s * self.k4)))

    def _slope(self, theta: Floats) -> Floats:
        """Return the derivative of theta times its stretch."""
        s = theta * theta
        return 1 + s * (3 * self.k1 + s * (5 * self.k2 + s * (7 * self.k3 + 9 * s * self.k4)))
