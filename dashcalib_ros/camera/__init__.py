# SPDX-License-Identifier: Apache-2.0
"""The camera models: projection, viewing rays, derivatives, limits; COLMAP's names and ROS's."""
from dashcalib_ros.camera.camera import FISHEYE, PINHOLE, Camera
from dashcalib_ros.camera.camera_info import ros_camera, ros_faults
from dashcalib_ros.camera.fisheye import Fisheye
from dashcalib_ros.camera.models import (
    AUTO,
    MODELS,
    NO_DISTORTION,
    calibrated_models,
    camera_from_ros,
    camera_of,
    larger_models,
    misread,
    model_named,
    searched,
)
from dashcalib_ros.camera.pinhole import Brown, Radial, Rational
from dashcalib_ros.camera.remap import RECTIFIED

__all__ = ['AUTO', 'FISHEYE', 'MODELS', 'NO_DISTORTION', 'PINHOLE', 'RECTIFIED', 'Brown', 'Camera',
           'Fisheye', 'Radial', 'Rational', 'calibrated_models', 'camera_from_ros', 'camera_of',
           'larger_models', 'misread', 'model_named', 'ros_camera', 'ros_faults', 'searched']
