# SPDX-License-Identifier: Apache-2.0
"""Foxglove's CameraCalibration as JSON; it is read as any file with a camera matrix."""
from __future__ import annotations

import json

from dashcalib_ros.camera import ros_camera
from dashcalib_ros.formats.values import is_fisheye
from dashcalib_ros.judge.difference import NamedCamera


def write(found: NamedCamera) -> str:
    """Return a CameraCalibration, where a fisheye is kannala_brandt."""
    ros = ros_camera(found.camera)
    return json.dumps({
        'timestamp': {'sec': 0, 'nsec': 0}, 'frame_id': 'camera',
        'width': ros.width, 'height': ros.height,
        'distortion_model': ('kannala_brandt' if is_fisheye(found.camera)
                             else ros.distortion_model),
        'D': ros.d, 'K': ros.k, 'R': ros.r, 'P': ros.p}, indent=2) + '\n'
