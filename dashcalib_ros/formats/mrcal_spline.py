# SPDX-License-Identifier: Apache-2.0
"""A camera and its field as mrcal's splined stereographic lens, the one of mrcal's that has both.

mrcal sees a ray at q = f (u + s(u)) + c, where u is the ray's stereographic projection, and s a
cubic B-spline with its control points on a square grid around u = 0.
"""
from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import splu

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.errors import OutputError

ORDER = 3
# control points from left to right: the first that is exact enough is taken
COLUMNS = (24, 32, 48, 64, 96, 128, 192)
# px; how far any pixel may be from where the spline sees its ray
EXACT_PX = 1e-3
# of the picture's sides; the spline is fitted to so many pixels, and checked at all
SAMPLES = (480, 320)
# rows whose pixels are looked at together: a field's terms take memory
STRIP = 64
# what the control points' second differences weigh in the fit, beside a pixel: where the picture
# ends, the spline goes on smoothly
SMOOTH = 1e-4


def splined_lens(camera: Camera, field: Field | None) -> tuple[str, Floats]:
    """Return the lens's name with its configuration, and its values: fx, fy, cx, cy, the spline's.

    Every pixel that has a ray has the same to EXACT_PX. Raises OutputError where no spline does.
    """
    width, height = camera.image_size
    few = [np.unique(np.linspace(0, side - 1, count).round())
           for side, count in zip(camera.image_size, SAMPLES, strict=True)]
    places, wanted = _corrections(camera, field, *few)
    strips = [_corrections(camera, field, np.arange(0.0, width),
                           np.arange(top, min(top + STRIP, height), dtype=float))
              for top in range(0, height, STRIP)]
    all_places, all_wanted = map(np.concatenate, zip(*strips, strict=True))
    across, down = np.abs(all_places).max(axis=0)
    fov_deg = int(np.degrees(4 * np.arctan(across / 2))) + 1
    worst = np.inf
    for columns in COLUMNS:
        # one more at each end than there are segments
        per_u = (columns - 3) / (4 * np.tan(np.radians(fov_deg) / 4))
        shape = (int(np.ceil(2 * down * per_u)) + 3, columns)
        control = _fitted(_on_grid(places, per_u, shape), wanted, shape)
        off = all_wanted - _spline(control, _on_grid(all_places, per_u, shape))
        worst = float(np.linalg.norm(off * camera.params[:2], axis=1).max())
        if worst < EXACT_PX:
            name = (f'LENSMODEL_SPLINED_STEREOGRAPHIC_order={ORDER}_Nx={columns}_Ny={shape[0]}'
                    f'_fov_x_deg={fov_deg}')
            return name, np.concatenate([camera.params[:4], control.ravel()])
    raise OutputError('E-EXPORT-SPLINE',
                      f"mrcal's splined lens describes this camera to {worst:.2g} px at the best, "
                      f'not to {EXACT_PX} px; export to rays')


def _corrections(camera: Camera, field: Field | None, columns: Floats, rows: Floats
                 ) -> tuple[Floats, Floats]:
    """Return (n, 2) u of the rays of these pixels, and (n, 2) what the spline must add there."""
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    rays = camera.rays(pixels if field is None else field.ideal(pixels))
    known = np.isfinite(rays).all(axis=1)
    pixels, rays = pixels[known], rays[known]
    u = 2 * rays[:, :2] / (1 + rays[:, 2:])
    return u, (pixels - camera.params[2:4]) / camera.params[:2] - u


def _on_grid(u: Floats, per_u: float, shape: tuple[int, int]) -> Floats:
    """Return (2, n) where u is on the grid of control points: row and column, from 0."""
    return np.asarray(u[:, ::-1].T * per_u + (np.array(shape)[:, None] - 1) / 2)


def _fitted(at: Floats, wanted: Floats, shape: tuple[int, int]) -> Floats:
    """Return the control points (rows, columns, 2) of the spline that is wanted (n, 2) there."""
    # a pixel's weights of the rows' points, of the columns' points, and of their products
    down, across = (BSpline.design_matrix(each, np.arange(-2.0, count + 2), ORDER)
                    for each, count in zip(at, shape, strict=True))
    count = len(wanted)
    weights = down.data.reshape(count, -1, 1) * across.data.reshape(count, 1, -1)
    point = (down.indices.reshape(count, -1, 1) * shape[1]
             + across.indices.reshape(count, 1, -1))
    spline = sparse.csr_matrix(
        (weights.ravel(), point.ravel(), np.arange(count + 1) * weights[0].size),
        (count, shape[0] * shape[1]))
    bends = [SMOOTH * sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(each - 2, each))
             for each in shape]
    smooth = sparse.vstack([sparse.kron(bends[0], sparse.identity(shape[1])),
                            sparse.kron(sparse.identity(shape[0]), bends[1])])
    normal = sparse.csc_matrix(spline.T @ spline + smooth.T @ smooth)
    return np.asarray(splu(normal).solve(spline.T @ wanted)).reshape(*shape, 2)


def _spline(control: Floats, at: Floats) -> Floats:
    """Return (n, 2) the spline's values at places (2, n) of its grid."""
    return np.stack([ndimage.map_coordinates(control[..., axis], at, order=ORDER,
                                             prefilter=False) for axis in (0, 1)], -1)
