# SPDX-License-Identifier: Apache-2.0
"""Pinhole lenses: the paper's two radial terms, Brown's five, OpenCV's quotient of polynomials.

With x, y the point over its depth and s = x^2 + y^2, the pixel is K times
x (1 + k1 s + k2 s^2 + k3 s^3) + 2 p1 x y + p2 (s + 2 x^2), and for y alike: ROS's plumb_bob.
Its rational_polynomial divides the radial factor by 1 + k4 s + k5 s^2 + k6 s^3.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.polynomial import Polynomial

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.camera import PINHOLE, TINY, Camera, ColmapModel

# tangent of 85 degrees: no pinhole camera sees farther out
WIDEST = 11.4
# of the search for a ray, and the last one's length: the error that it leaves is its square
NEWTON_STEPS, SETTLED = 12, 1e-9
# of the focal length; a pixel without a solution this exact has no ray
REACHED = 1e-6
# points nearer to the plane of the pinhole than this cannot be projected
NEAREST = 1e-9


@dataclass(frozen=True)
class Radial(Camera):
    """A pinhole camera with two radial terms of distortion: the paper's six parameters.

    image_size: (width, height) in pixels. fx, fy, cx, cy: pixels; the centre of the first pixel is
    at (0, 0). k1, k2: OpenCV's, ROS's plumb_bob.
    """

    k1: float = 0.0
    k2: float = 0.0

    model: ClassVar[str] = 'radial'
    ros_model: ClassVar[str] = 'plumb_bob'
    family: ClassVar[str] = PINHOLE
    colmap: ClassVar[ColmapModel] = ColmapModel('OPENCV', 8, (0, 1, 2, 3, 4, 5))
    spread: ClassVar[tuple[float, ...]] = (1.0, 1.0)

    def widened(self) -> Camera:
        """Return the camera with p1, p2 and k3, which are 0."""
        return Brown.of(self.image_size, [*self.params, 0.0, 0.0, 0.0])

    def ros_distortion(self) -> list[float]:
        """Return k1, k2, p1, p2, k3, the order of ROS and OpenCV."""
        return [self.k1, self.k2, 0.0, 0.0, 0.0]

    def project(self, points: Floats) -> Floats:
        """Return the pixels (..., 2) of points (..., 3); NaN behind the camera."""
        depth = points[..., 2]
        depth = np.where(depth > NEAREST, depth, np.nan)
        x, y = points[..., 0] / depth, points[..., 1] / depth
        _, _, p1, p2, *_ = self.ros_distortion()
        square = x * x + y * y
        scale = self._stretch(square)
        if p1 or p2:
            product = 2 * x * y
            x, y = (x * scale + p1 * product + p2 * (square + 2 * x * x),
                    y * scale + p1 * (square + 2 * y * y) + p2 * product)
        else:
            x, y = x * scale, y * scale
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)

    def _stretch(self, square: Floats) -> Floats:
        k1, k2, _, _, k3 = self.ros_distortion()
        return 1 + square * (k1 + square * (k2 + square * k3))

    def derivatives(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the derivatives of the pixels of points (m, 3); see Camera."""
        # a tenth of the time of cv2.projectPoints
        inverse = 1 / points[:, 2]
        x, y = points[:, 0] * inverse, points[:, 1] * inverse
        k1, k2, p1, p2, k3 = self.ros_distortion()
        square = x * x + y * y
        scale = self._stretch(square)
        # of the scale by x over x, and by y over y
        slope = 2 * (k1 + square * (2 * k2 + 3 * k3 * square))
        across, sideways, downwards = 2 * x * y, square + 2 * x * x, square + 2 * y * y
        # points are the last axis: NumPy is slow where that is short
        by_params = np.zeros((2, len(self.names()), len(points)))
        by_params[0, 0] = x * scale + p1 * across + p2 * sideways
        by_params[1, 1] = y * scale + p1 * downwards + p2 * across
        by_params[0, 2] = by_params[1, 3] = 1.0
        pixels = np.stack([self.fx * by_params[0, 0] + self.cx,
                           self.fy * by_params[1, 1] + self.cy])
        radial = np.stack([self.fx * x, self.fy * y]) * square
        by_params[:, 4], by_params[:, 5] = radial, radial * square
        if len(self.names()) > 6:
            by_params[0, 6], by_params[0, 7] = self.fx * across, self.fx * sideways
            by_params[1, 6], by_params[1, 7] = self.fy * downwards, self.fy * across
            by_params[:, 8] = radial * (square * square)
        both = across * slope / 2 + 2 * (p1 * x + p2 * y)
        by_point = np.empty((2, 3, len(points)))
        by_point[0, 0] = scale + x * x * slope + 2 * p1 * y + 6 * p2 * x
        by_point[1, 1] = scale + y * y * slope + 6 * p1 * y + 2 * p2 * x
        by_point[0, 1] = by_point[1, 0] = both
        by_point[:, 2] = -(by_point[:, 0] * x + by_point[:, 1] * y)
        by_point *= inverse * np.array([[[self.fx]], [[self.fy]]])
        return by_params.transpose(2, 0, 1), by_point.transpose(2, 0, 1), pixels.T

    def rays(self, pixels: Floats) -> Floats:
        """Return unit viewing rays (..., 3): Newton's method on the radius."""
        distorted = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        target = np.linalg.norm(distorted, axis=-1)
        radius = np.minimum(target, self.fold)
        for _ in range(NEWTON_STEPS):
            square = radius * radius
            value = radius * (1 + square * (self.k1 + square * self.k2)) - target
            slope = 1 + square * (3 * self.k1 + 5 * square * self.k2)
            radius = np.clip(radius - value / np.maximum(slope, 0.1), 0.0, self.fold)
        reached = np.where(np.abs(value) < REACHED, radius, np.nan)
        scale = np.where(target > 1e-12, reached / np.maximum(target, 1e-12), 1.0)
        return _unit(distorted * scale[..., None])

    @cached_property
    def fold(self) -> float:
        """Return the undistorted radius sqrt(x^2 + y^2) at which the model folds over."""
        k1, k2, _, _, k3 = self.ros_distortion()
        # there the slope is 0: a polynomial in 1 / (x^2 + y^2), whose first coefficient is 1
        roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
        real = roots[np.abs(roots.imag) < 1e-9].real
        return float(1 / np.sqrt(max([*real, WIDEST**-2])))


@dataclass(frozen=True)
class Brown(Radial):
    """Brown's model: a Radial that may be decentred (p1, p2), with a third radial term k3.

    image_size: (width, height) in pixels. fx, fy, cx, cy: pixels; the centre of the first pixel is
    at (0, 0). The coefficients, here in the order k1, k2, p1, p2, k3, are OpenCV's.
    """

    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    model: ClassVar[str] = 'brown'
    colmap: ClassVar[ColmapModel] = ColmapModel('FULL_OPENCV', 12, (0, 1, 2, 3, 4, 5, 6, 7, 8))
    spread: ClassVar[tuple[float, ...]] = (1.0, 1.0, 1e-3, 1e-3, 0.05)

    def widened(self) -> Camera:
        """Return this camera: no model has more."""
        return self

    def ros_distortion(self) -> list[float]:
        """Return k1, k2, p1, p2, k3."""
        return [self.k1, self.k2, self.p1, self.p2, self.k3]

    def rays(self, pixels: Floats) -> Floats:
        """Return unit viewing rays (..., 3): Newton's method in x and y."""
        wanted = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        plain = type(self)(self.image_size, 1.0, 1.0, 0.0, 0.0, *self.params[4:])
        xy = np.clip(np.nan_to_num(wanted.reshape(-1, 2)), -self.fold, self.fold)
        moving = np.arange(len(xy))
        for _ in range(NEWTON_STEPS):
            _, slopes, bent = plain.derivatives(
                np.column_stack([xy[moving], np.ones(len(moving))]))
            step = _solved(slopes[:, :, :2], wanted.reshape(-1, 2)[moving] - bent)
            step = np.clip(np.nan_to_num(step), -0.5, 0.5)
            xy[moving] += step
            moving = moving[np.abs(step).max(axis=1, initial=0.0) > SETTLED]
            if not len(moving):
                break
        reached = np.linalg.norm(xy, axis=1) <= 1.02 * self.fold
        missed = np.abs(plain.project(np.column_stack([xy, np.ones(len(xy))]))
                        - wanted.reshape(-1, 2)).max(axis=1)
        xy[~(reached & (missed < REACHED))] = np.nan
        return _unit(xy.reshape(wanted.shape))


@dataclass(frozen=True)
class Rational(Brown):
    """A pinhole camera with OpenCV's eight coefficients. Turns cannot tell these apart.

    image_size: (width, height) in pixels. fx, fy, cx, cy: pixels; the centre of the first pixel is
    at (0, 0). The coefficients are in the order k1, k2, p1, p2, k3, k4, k5, k6.
    """

    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    model: ClassVar[str] = 'rational_polynomial'
    ros_model: ClassVar[str] = 'rational_polynomial'
    given_only: ClassVar[bool] = True
    colmap: ClassVar[ColmapModel] = ColmapModel('FULL_OPENCV', 12, tuple(range(12)))
    spread: ClassVar[tuple[float, ...]] = (1.0, 1.0, 1e-3, 1e-3, 0.1, 1.0, 1.0, 0.1)

    def ros_distortion(self) -> list[float]:
        """Return k1, k2, p1, p2, k3, k4, k5, k6, the order of ROS and OpenCV."""
        return [float(value) for value in self.params[4:]]

    def derivatives(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the derivatives of the pixels of points (m, 3); see Camera."""
        if len(points) == 0:
            return np.zeros((0, 2, len(self.names()))), np.zeros((0, 2, 3)), np.zeros((0, 2))
        # the stubs have wrong types for this function
        project: Any = cv2.projectPoints
        origin = np.zeros(3)
        pixels, jacobian = project(np.ascontiguousarray(points, np.float64), origin, origin,
                                   self.matrix, np.array(self.ros_distortion()))
        jacobian = jacobian.reshape(len(points), 2, -1)
        # OpenCV's columns: rotation, translation (the point's own), fx fy, cx cy, then D
        return (jacobian[:, :, 6:6 + len(self.names())], jacobian[:, :, 3:6],
                pixels.reshape(-1, 2))

    def _stretch(self, square: Floats) -> Floats:
        above, below = self._polynomials
        return np.asarray(above(square) / below(square))

    @cached_property
    def fold(self) -> float:
        """Return the undistorted radius at which the model folds over, or has a pole."""
        above, below = self._polynomials
        square = Polynomial([0.0, 1.0])
        # of radius times above / below: where its slope is 0, by the squared radius
        slope = (above + 2 * square * above.deriv()) * below - 2 * square * above * below.deriv()
        roots = np.concatenate([each.trim(TINY).roots() for each in (slope, below)])
        real = roots[np.abs(roots.imag) < 1e-9].real
        return float(np.sqrt(min([WIDEST**2, *real[real > 0]])))

    @cached_property
    def _polynomials(self) -> tuple[Polynomial, Polynomial]:
        return (Polynomial([1.0, self.k1, self.k2, self.k3]),
                Polynomial([1.0, self.k4, self.k5, self.k6]))


def _unit(xy: Floats) -> Floats:
    rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _solved(m: Floats, b: Floats) -> Floats:
    """Solve the 2 by 2 systems m x = b by Cramer's rule; inf or NaN where m is singular."""
    with np.errstate(all='ignore'):
        determinant = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
        return np.stack([b[:, 0] * m[:, 1, 1] - b[:, 1] * m[:, 0, 1],
                         b[:, 1] * m[:, 0, 0] - b[:, 0] * m[:, 1, 0]], -1) / determinant[:, None]
