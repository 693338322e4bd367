"""The mapping error between two cameras: what a user of one instead of the other would see."""
from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dashcalib_ros.report.camera import Camera

Points = npt.NDArray[np.float64]

GRID = (25, 15)  # columns, rows: enough for a smooth field, and the same as our scoring tool
NEWTON_STEPS = 50
STEPS_OUT = np.linspace(0, 1, 33)


def project(camera: Camera, xy: Points) -> Points:
    """Project normalised coordinates (n, 2) to pixels (n, 2)."""
    c = camera.intrinsics
    pixels: Points = distort(camera, xy) * (c.fx, c.fy) + (c.cx, c.cy)
    return pixels


def distort(camera: Camera, xy: Points) -> Points:
    """Apply plumb_bob's distortion to normalised coordinates (n, 2)."""
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = _radial(camera, r2)
    p1, p2 = camera.p1, camera.p2
    bent: Points = np.stack([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                             y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1)
    return bent


def undistort(camera: Camera, pixels: Points) -> Points:
    """Return the normalised coordinates (n, 2) seen at pixels (n, 2); NaN where there are none.

    A lens model that folds over inside the image has pixels that no ray reaches.
    """
    c = camera.intrinsics
    wanted = (pixels - (c.cx, c.cy)) / (c.fx, c.fy)
    xy = wanted.copy()
    with np.errstate(all='ignore'):
        for _ in range(NEWTON_STEPS):
            xy = xy - _solve(_jacobian(camera, xy), distort(camera, xy) - wanted)
        missed = np.abs(distort(camera, xy) - wanted).max(-1)
        # a root beyond a fold is no viewing ray: from the centre out, the image must go on growing
        growing = np.all([_determinant(_jacobian(camera, part * xy)) > 0 for part in STEPS_OUT], 0)
    found: Points = np.where(((missed < 1e-9) & growing)[:, None], xy, np.nan)
    return found


def mapping_error(camera: Camera, reference: Camera) -> float | None:
    """Return the RMS pixel distance between both cameras' images of the same rays.

    The rays are those of a grid over the reference's image; the best common rotation is taken
    out first (Hagemann et al.), since no one can see it. None when the reference has no ray for
    some pixel of its image, or the camera sends one to infinity.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    width, height = reference.image_size
    u, v = np.meshgrid(np.linspace(0, width - 1, GRID[0]), np.linspace(0, height - 1, GRID[1]))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    xy = undistort(reference, pixels)
    if not np.isfinite(xy).all():
        return None
    rays = np.column_stack([xy, np.ones(len(xy))])

    def residual(rotation: Points) -> Points:
        turned = Rotation.from_rotvec(rotation).apply(rays)
        flat: Points = (project(camera, turned[:, :2] / turned[:, 2:]) - pixels).ravel()
        return flat

    with np.errstate(all='ignore'):
        if not np.isfinite(residual(np.zeros(3))).all():
            return None
        rest = least_squares(residual, np.zeros(3)).fun
    return float(np.sqrt(np.mean(np.sum(rest.reshape(-1, 2)**2, -1))))


def _radial(camera: Camera, r2: Points) -> Points:
    c = camera.intrinsics
    return 1 + r2 * (c.k1 + r2 * (c.k2 + r2 * camera.k3))


def _jacobian(camera: Camera, xy: Points) -> Points:
    """Return d distort / d xy as (n, 2, 2)."""
    x, y = xy[:, 0], xy[:, 1]
    c, p1, p2 = camera.intrinsics, camera.p1, camera.p2
    r2 = x * x + y * y
    radial = _radial(camera, r2)
    slope = 2 * (c.k1 + r2 * (2 * c.k2 + 3 * r2 * camera.k3))  # d radial / dx = slope x
    cross = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return np.stack([
        np.stack([radial + slope * x * x + 2 * p1 * y + 6 * p2 * x, cross], -1),
        np.stack([cross, radial + slope * y * y + 6 * p1 * y + 2 * p2 * x], -1)], -2)


def _determinant(m: Points) -> Points:
    det: Points = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
    return det


def _solve(m: Points, b: Points) -> Points:
    """Solve the 2 by 2 systems m x = b by Cramer's rule; a singular one gives NaN or infinity."""
    return np.stack([b[:, 0] * m[:, 1, 1] - b[:, 1] * m[:, 0, 1],
                     b[:, 1] * m[:, 0, 0] - b[:, 0] * m[:, 1, 0]], -1) / _determinant(m)[:, None]
