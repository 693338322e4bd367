# SPDX-License-Identifier: Apache-2.0
"""A value for each pixel as an .npz: viewing rays, and the maps of cv2.remap.

Beside them it has the camera's K and D, by which it is read like any file with a camera matrix.
"""
from __future__ import annotations

import io
from typing import Any

import numpy as np
import numpy.typing as npt

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.remap import source_map
from dashcalib_ros.judge.difference import NamedCamera


def write_rays(found: NamedCamera) -> bytes:
    """Return an .npz with rays (h, w, 3): the unit viewing ray of each pixel, NaN for none."""
    camera, (width, height) = found.camera, found.image_size
    pixels = np.stack(np.meshgrid(np.arange(width, dtype=float),
                                  np.arange(height, dtype=float)), -1)
    ideal = pixels if found.field is None else found.field.ideal(pixels)
    return _npz(camera, rays=camera.rays(ideal).astype(np.float32))


def write_maps(found: NamedCamera) -> bytes:
    """Return an .npz with map_x, map_y (h, w) for cv2.remap: to a pinhole with the same K."""
    x, y = np.moveaxis(source_map(found.camera, field=found.field), -1, 0)
    return _npz(found.camera, map_x=x, map_y=y)


def _npz(camera: Camera, **arrays: npt.NDArray[np.float32]) -> bytes:
    file = io.BytesIO()
    both: dict[str, Any] = {
        **arrays, 'K': camera.matrix, 'D': np.array(camera.ros_distortion()),
        'distortion_model': np.array(camera.ros_model), 'image_size': np.array(camera.image_size)}
    np.savez(file, **both)
    return file.getvalue()
