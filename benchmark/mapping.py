# SPDX-License-Identifier: Apache-2.0
"""The mapping error: by how many pixels an estimate is off all over the picture, in any model.

Written without the calibration's own camera models, so that it cannot share an error with them.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Floats = npt.NDArray[np.float64]

FISHEYE = ('fisheye', 'equidistant')
# columns and rows of the grid over the picture
GRID = (25, 15)
# from the axis; a camera that is no fisheye sees nothing beyond
WIDEST_DEG = 88.0
UNSEEN_PX = 1e3
# in focal lengths: of a numerical derivative, and the longest step of an iteration
STEP = 1e-6
LEAP = 0.1


def is_fisheye(camera: Mapping[str, Any]) -> bool:
    """Return whether its coefficients are those of the equidistant model."""
    return camera.get('model') in FISHEYE


def model_of(camera: Mapping[str, Any]) -> str:
    """Return the smallest model that describes the camera: 'radial', 'brown' or 'fisheye'."""
    if is_fisheye(camera):
        return 'fisheye'
    return 'brown' if any(camera.get(name) for name in ('p1', 'p2', 'k3')) else 'radial'


def mapping_error(estimate: Mapping[str, Any], truth: Mapping[str, Any],
                  size: tuple[int, int]) -> float:
    """Return the RMS distance, px, between where both project the rays of a grid of the truth's.

    The best rotation of the rays is removed: no calibration can know it. Rays beyond 88 degrees
    are left out where the estimate is no fisheye.
    """
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, GRID[0]), np.linspace(0, size[1] - 1, GRID[1]))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    seen = rays(truth, pixels)
    if not is_fisheye(estimate):
        near = seen[:, 2] > math.cos(math.radians(WIDEST_DEG))
        pixels, seen = pixels[near], seen[near]

    def residual(turn: Floats) -> Floats:
        off = projected(estimate, Rotation.from_rotvec(turn).apply(seen)) - pixels
        return np.nan_to_num(off, nan=UNSEEN_PX).ravel()

    rest = least_squares(residual, np.zeros(3)).fun.reshape(-1, 2)
    return float(np.sqrt(np.mean(np.sum(rest * rest, axis=1))))


def camera_that_sees(seen: Floats, pixels: Floats, near: Mapping[str, Any]) -> dict[str, float]:
    """Return the camera of near's kind that projects rays (n, 3) closest to pixels (n, 2).

    A windscreen does in part what a lens does: what is seen through both has another fx.
    """
    names = ['fx', 'fy', 'cx', 'cy', 'k1', 'k2',
             *(name for name in ('p1', 'p2', 'k3', 'k4') if near.get(name))]
    start = np.array([near.get(name, 0.0) for name in names] + [0.0] * 3)

    def residual(guess: Floats) -> Floats:
        camera = {**near, **dict(zip(names, guess, strict=False))}
        off = projected(camera, Rotation.from_rotvec(guess[-3:]).apply(seen)) - pixels
        return np.nan_to_num(off, nan=UNSEEN_PX).ravel()

    scale = np.maximum(np.abs(start), 0.01)
    return dict(zip(names, map(float, least_squares(residual, start, x_scale=scale).x),
                    strict=False))


def projected(camera: Mapping[str, Any], points: Floats) -> Floats:
    """Return pixels (n, 2) of points (n, 3); NaN behind a camera that is no fisheye."""
    x, y, z = points.T
    if is_fisheye(camera):
        across = np.hypot(x, y)
        scale = _bent(camera, np.arctan2(across, z)) / np.maximum(across, 1e-12)
        x, y = x * scale, y * scale
    else:
        depth = np.where(z > 1e-9, z, np.nan)
        x, y = _distorted(camera, x / depth, y / depth)
    return np.column_stack([camera['fx'] * x + camera['cx'], camera['fy'] * y + camera['cy']])


def rays(camera: Mapping[str, Any], pixels: Floats) -> Floats:
    """Return unit rays (n, 3) of pixels (n, 2)."""
    x_d = (pixels[:, 0] - camera['cx']) / camera['fx']
    y_d = (pixels[:, 1] - camera['cy']) / camera['fy']
    if is_fisheye(camera):
        radius = np.hypot(x_d, y_d)
        angles = np.linspace(0.0, math.pi, 200001)
        # as far as they grow; what lies between is as good as straight
        table = _bent(camera, angles)
        count = int(np.argmax(np.diff(table) <= 0.0)) or len(table) - 1
        angle = np.interp(radius, table[:count + 1], angles[:count + 1])
        scale = np.sin(angle) / np.maximum(radius, 1e-12)
        return np.column_stack([x_d * scale, y_d * scale, np.cos(angle)])
    x, y = x_d, y_d
    # Newton's method: the simple iteration runs away where a lens is near its fold
    for _ in range(50):
        x_now, y_now = _distorted(camera, x, y)
        right, down = (_distorted(camera, x + STEP, y), _distorted(camera, x, y + STEP))
        a, c = (right[0] - x_now) / STEP, (right[1] - y_now) / STEP
        b, d = (down[0] - x_now) / STEP, (down[1] - y_now) / STEP
        off_x, off_y = x_d - x_now, y_d - y_now
        area = np.maximum(a * d - b * c, 0.05)
        x = x + np.clip((d * off_x - b * off_y) / area, -LEAP, LEAP)
        y = y + np.clip((a * off_y - c * off_x) / area, -LEAP, LEAP)
    found = np.column_stack([x, y, np.ones_like(x)])
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _bent(camera: Mapping[str, Any], angle: Floats) -> Floats:
    """Return the equidistant model's distorted radii of angles, in focal lengths."""
    k1, k2, k3, k4 = (camera.get(name, 0.0) for name in ('k1', 'k2', 'k3', 'k4'))
    s = angle * angle
    return np.asarray(angle * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))))


def _distorted(camera: Mapping[str, Any], x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return Brown's distorted coordinates."""
    k1, k2, p1, p2, k3 = (camera.get(name, 0.0) for name in ('k1', 'k2', 'p1', 'p2', 'k3'))
    s = x * x + y * y
    scale = 1.0 + s * (k1 + s * (k2 + s * k3))
    return (x * scale + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
            y * scale + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y)
