# SPDX-License-Identifier: Apache-2.0
"""The camera in stella_vslam's configuration, and in that of OpenVSLAM, its ancestor."""
from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import yaml

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.other import OtherLens, division
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    Cameras,
    Data,
    camera_with,
    distortion_model,
    is_fisheye,
    named_coefficients,
    read_coefficients,
    read_number,
    read_size,
)
from dashcalib_ros.judge.difference import NamedCamera

DIVISION = 'radial_division'
MODELS = {'perspective': PLUMB_BOB, 'fisheye': EQUIDISTANT, DIVISION: ''}


def cameras(data: Any, path: Path) -> Cameras:
    """Return the camera of a configuration; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    part = data.get('Camera')
    if not isinstance(part, dict):  # OpenVSLAM: Camera.fx
        part = {str(key).removeprefix('Camera.'): value for key, value in data.items()
                if str(key).startswith('Camera.')}
    return {'': partial(_read, part, path)} if {'model', 'cols', 'rows'} <= part.keys() else {}


def _read(data: Data, path: Path) -> Camera | OtherLens:
    kind = distortion_model(MODELS, data['model'], 'the Camera model', path)
    size = read_size(data['cols'], data['rows'], path=path)
    view = [read_number(data, key, path) for key in ('fx', 'fy', 'cx', 'cy')]
    if data['model'] == DIVISION:
        return OtherLens(DIVISION, size, view, division(read_number(data, 'distortion', path)))
    return camera_with(size, view, kind, read_coefficients(data, kind, path), path)


def write(found: NamedCamera) -> str:
    """Return the camera's part of a configuration. Raises ConfigError."""
    camera, (width, height) = found.camera, found.image_size
    return str(yaml.safe_dump({'Camera': {
        'name': 'dashcam', 'setup': 'monocular',
        'model': 'fisheye' if is_fisheye(camera) else 'perspective',
        'fx': camera.fx, 'fy': camera.fy, 'cx': camera.cx, 'cy': camera.cy,
        **named_coefficients(camera, 5, 'stella'),
        'fps': 30.0, 'cols': width, 'rows': height, 'color_order': 'RGB'}}, sort_keys=False))
