"""The mapping error between two cameras: by how many pixels their images of a ray differ."""
from __future__ import annotations

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera

GRID = (25, 15)  # columns, rows: enough for a smooth field, and as in the benchmarks


def mapping_error(camera: Camera, reference: Camera) -> float | None:
    """Return the RMS pixel distance between both cameras' images of the same rays.

    The rays are those of a grid over the reference's image; the best common rotation is removed
    first (Hagemann et al.), as it is not observable. None when the reference has no ray for a
    pixel of the grid, or the camera cannot see one of the rays.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    width, height = reference.image_size
    u, v = np.meshgrid(np.linspace(0, width - 1, GRID[0]), np.linspace(0, height - 1, GRID[1]))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    rays = reference.rays(pixels)
    if not np.isfinite(rays).all():
        return None

    def residual(rotation: Floats) -> Floats:
        return (camera.project(Rotation.from_rotvec(rotation).apply(rays)) - pixels).ravel()

    with np.errstate(all='ignore'):
        if not np.isfinite(residual(np.zeros(3))).all():
            return None
        try:
            rest = least_squares(residual, np.zeros(3)).fun
        except ValueError:  # a ray left the camera's view on the way
            return None
    return float(np.sqrt(np.mean(np.sum(rest.reshape(-1, 2)**2, -1))))
