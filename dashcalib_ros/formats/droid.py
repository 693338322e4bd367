# SPDX-License-Identifier: Apache-2.0
"""DROID-SLAM's calibration: one line of fx fy cx cy, then OpenCV's coefficients, if any."""
from __future__ import annotations

from pathlib import Path

from dashcalib_ros.formats.values import (
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    Sizeless,
    camera_with,
    numbers_in,
    pinhole_only,
)
from dashcalib_ros.judge.difference import NamedCamera

# how many coefficients it passes to cv2.undistort
COUNTS = (0, 4, 5, 8)


def cameras(text: str, path: Path) -> Cameras:
    """Return the camera of such a line; see formats/table.py."""
    values = numbers_in(text.replace(',', ' ')) if len(text.split('\n', 2)) < 3 else None
    if values is None or len(values) - 4 not in COUNTS or 0 in values[:4]:
        return {}
    kind = PLUMB_BOB if len(values) <= 9 else RATIONAL
    return {'': lambda: Sizeless(
        lambda size: camera_with(size, values[:4], kind, values[4:], path))}


def write(found: NamedCamera) -> str:
    """Return the line. Raises ConfigError for a fisheye."""
    camera = pinhole_only(found.camera, 'droid')
    values = (*camera.params[:4], *camera.ros_distortion())
    return ' '.join(repr(float(value)) for value in values) + '\n'
