"""A camera as ROS has it: the fields of CameraInfo, and of a calibration file."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dashcalib_ros.camera.camera import Camera
from dashcalib_ros.camera.rectified import SAME, rectified_matrix


@dataclass(frozen=True)
class RosCamera:
    """CameraInfo's fields, and those of a calibration file: matrices are row-major."""

    image_size: tuple[int, int]
    distortion_model: str
    d: list[float]
    k: list[float]
    r: list[float]
    p: list[float]


def ros_camera(camera: Camera, rectified: str = SAME) -> RosCamera:
    """Return the camera as ROS has it: R is the identity.

    rectified: what P, the camera of the rectified picture, is to show; see rectified.py.
    """
    p = np.column_stack([rectified_matrix(camera, rectified), np.zeros(3)])
    return RosCamera(
        camera.image_size, camera.ros_model, [float(value) for value in camera.ros_distortion()],
        camera.matrix.ravel().tolist(), np.eye(3).ravel().tolist(), p.ravel().tolist())
