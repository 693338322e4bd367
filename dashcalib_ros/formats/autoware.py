# SPDX-License-Identifier: Apache-2.0
"""Autoware's: the camera YAML of CalibrationTools, and VisionPilot's H.yaml.

VisionPilot's H maps a pixel to the road: metres ahead and to the left.
"""
from __future__ import annotations

import cv2
import numpy as np

from dashcalib_ros.errors import ConfigError
from dashcalib_ros.formats import ros
from dashcalib_ros.formats.urdf import mount_of
from dashcalib_ros.formats.values import pinhole_only
from dashcalib_ros.judge.difference import NamedCamera


def write(found: NamedCamera) -> str:
    """Return camera_info YAML as CalibrationTools writes it. Raises ConfigError for a fisheye."""
    pinhole_only(found.camera, 'autoware')
    return ros.write(found)


def write_road(found: NamedCamera) -> str:
    """Return H.yaml of pictures without distortion: pixel to the road below the camera, m.

    Raises ConfigError where the mounting or the height is not known.
    """
    mount = mount_of(found)
    if mount.height_m is None:
        raise ConfigError('E-EXPORT-NO-HEIGHT',
                          f'{found.name} has no height of the camera above the road, without '
                          f'which nothing has a distance; calibrate with --speed, or with GPS')
    # of a point of the road in the camera's axes: ahead, left, and the camera's height below it
    to_camera = mount.rotation.T
    pixel_of = found.camera.matrix @ np.column_stack(
        [to_camera[:, 0], to_camera[:, 1], -mount.height_m * to_camera[:, 2]])
    road = np.linalg.inv(pixel_of)
    file = cv2.FileStorage('.yaml', cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.writeComment(f'of {found.name}, for pictures without distortion (export --to maps); x '
                      f'and y count from the road below the camera')
    file.write('H', road / road[2, 2] if abs(road[2, 2]) > 1e-9 else road)
    return str(file.releaseAndGetString())
