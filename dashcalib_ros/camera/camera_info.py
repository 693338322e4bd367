# SPDX-License-Identifier: Apache-2.0
"""A camera as ROS has it: the fields of CameraInfo, and what may be wrong with them."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.camera import Camera
from dashcalib_ros.camera.remap import SAME, rectified_matrix

# of an entry of K, R or P; programs write them with more digits
EXACT = 1e-3
# of the width; the middle of the picture is so near to that of the rectified one, which shows it
# at most so many times smaller or larger: P of twice the size moves the middle by half the width
NEAR, ZOOM = 0.1, (0.1, 2.0)


@dataclass(frozen=True)
class RosCamera:
    """The fields of CameraInfo that a camera has, by their names there; matrices are row-major."""

    height: int
    width: int
    distortion_model: str
    d: list[float]
    k: list[float]
    r: list[float]
    p: list[float]


def ros_camera(camera: Camera, rectified: str = SAME) -> RosCamera:
    """Return the camera as ROS has it: R is the identity.

    rectified: what P, the camera of the rectified picture, is to show; see rectified_matrix().
    """
    p = np.column_stack([rectified_matrix(camera, rectified), np.zeros(3)])
    width, height = camera.image_size
    return RosCamera(
        height, width, camera.ros_model, [float(value) for value in camera.ros_distortion()],
        camera.matrix.ravel().tolist(), np.eye(3).ravel().tolist(), p.ravel().tolist())


def ros_faults(camera: Camera, k: Sequence[float] | None = None, r: Sequence[float] | None = None,
               p: Sequence[float] | None = None) -> tuple[str, ...]:
    """Return in words what is wrong with CameraInfo's K (9,), R (9,) and P (12,) beside a camera.

    The camera has their focal lengths, centre and distortion, of which this says nothing. None, or
    nothing in it: not known, and no fault. So are R and P of zeros where there is no distortion,
    as simulators have them: nothing is to be rectified. R and P of one camera are meant: those of
    a pair are faults.
    """
    distorted = any(camera.ros_distortion())
    faults = []
    if k:
        faults += _odd('K', np.reshape(k, (3, 3)), camera.matrix)
    if r and (distorted or any(r)):
        rotation = np.reshape(r, (3, 3))
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > EXACT or np.linalg.det(rotation) < 0:
            faults.append('R is not a rotation: for a single camera, it must be the identity')
        elif np.abs(rotation - np.eye(3)).max() > EXACT:
            angle = np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
            faults.append(f'R rotates the rectified image by {angle:.1f} degrees: for a single '
                          f'camera, it must be the identity')
    if p and (distorted or any(p)):
        view = np.reshape(p, (3, 4))
        wanted = np.diag([view[0, 0], view[1, 1], 1.0, 0.0])[:3]
        wanted[:2, 2] = view[:2, 2]
        faults += _odd('P', view, wanted) or _of_another_picture(camera, view[:, :3])
    return tuple(faults)


def _odd(name: str, matrix: Floats, wanted: npt.ArrayLike) -> list[str]:
    """Return the entries that are not as they must be."""
    flat, right = matrix.ravel(), np.ravel(wanted)
    odd = np.flatnonzero(~(np.abs(flat - right) <= EXACT))
    texts = (f'{name}[{n}] is {flat[n]:.4g}, not {right[n]:.4g}' for n in odd)
    return [', '.join(texts)] if len(odd) else []


def _of_another_picture(camera: Camera, view: Floats) -> list[str]:
    size = np.array(camera.image_size)
    middle, low, high = (share * (size - 1) for share in (0.5, 0.25, 0.75))
    with np.errstate(all='ignore'):
        rays = camera.rays(np.array([middle, low, high]))
        if not np.isfinite(rays).all():
            return []  # of the distortion, and not of P
        seen = rays @ view.T
        seen = seen[:, :2] / seen[:, 2:]
        away = np.abs(seen[0] - middle).max() / size[0]
        zoom = (seen[2] - seen[1]) / (high - low)
        # NaN is a fault, too
        fits = away <= NEAR and ZOOM[0] <= zoom.min() and zoom.max() <= ZOOM[1]
    return [] if fits else [
        'P does not map the image into the rectified image: it may be for images of another size']
