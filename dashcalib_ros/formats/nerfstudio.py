# SPDX-License-Identifier: Apache-2.0
"""nerfstudio's transforms.json. It counts pixels from the first one's corner."""
from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.camera import HALF_PIXEL
from dashcalib_ros.camera.rotation import OPTICAL
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.formats import colmap
from dashcalib_ros.formats.values import (
    Cameras,
    Data,
    Placed,
    camera_with,
    distortion_model,
    is_fisheye,
    named_coefficients,
    read_coefficients,
    read_number,
    read_size,
    with_lenses,
)
from dashcalib_ros.judge.difference import NamedCamera

# COLMAP's first ones, by their names
MODELS = {name: kind for name, _, kind, _ in colmap.MODELS[:6] if kind}


def cameras(data: Any, path: Path) -> Cameras:
    """Return the camera of all frames, or that of each; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    if {'fl_x', 'camera_angle_x'} & data.keys():
        return {'': partial(_read, data, path)}
    frames = data.get('frames')
    return {str(frame.get('file_path', number)): partial(_read, {**data, **frame}, path)
            for number, frame in enumerate(frames if isinstance(frames, list) else [])
            if isinstance(frame, dict)}


def _read(data: Data, path: Path) -> Camera:
    name = 'OPENCV_FISHEYE' if data.get('is_fisheye') else data.get('camera_model', 'OPENCV')
    kind = distortion_model(MODELS, name, 'the camera_model', path)
    width, height = read_size(data.get('w'), data.get('h'), path=path)
    if 'fl_x' in data:
        fx = read_number(data, 'fl_x', path)
    else:
        fx = width / 2 / math.tan(read_number(data, 'camera_angle_x', path) / 2)
    view = [fx, read_number(data, 'fl_y', path, fx),
            read_number(data, 'cx', path, width / 2) - HALF_PIXEL,
            read_number(data, 'cy', path, height / 2) - HALF_PIXEL]
    return camera_with((width, height), view, kind, read_coefficients(data, kind, path), path)


def write(found: NamedCamera) -> str:
    """Return the camera's part of a transforms.json; the frames are to be added.

    Raises ConfigError.
    """
    return json.dumps({**_model(found.camera), **_content(found.camera), 'frames': []},
                      indent=2) + '\n'


def write_rig(rig: Sequence[Placed]) -> str:
    """Return a transforms.json with a frame of each camera of a rig, which are to be repeated.

    Its world is the car as the base sees it: x ahead, y to the left, z upwards. Raises ConfigError
    for fisheyes among other lenses, which it cannot have.
    """
    found = with_lenses(rig, 'nerfstudio')
    model = _model(found[0][1])
    if any(_model(camera) != model for _, camera in found):
        raise ConfigError('E-RIG-MIXED', 'nerfstudio has one kind of lens for all cameras; use '
                                         'rig_config.json')
    turn = np.eye(4)
    turn[:3, :3] = next((each.mount.rotation for each in rig if each.mount), OPTICAL)
    return json.dumps({**model, 'frames': [{
        'file_path': f'{each.name}/', **_content(camera),
        # of a camera that looks along -z, y upwards
        'transform_matrix': (turn @ np.linalg.inv(each.pose) @ np.diag(
            [1.0, -1.0, -1.0, 1.0])).tolist()} for each, camera in found]}, indent=2) + '\n'


def _model(camera: Camera) -> dict[str, str]:
    return {'camera_model': 'OPENCV_FISHEYE' if is_fisheye(camera) else 'OPENCV'}


def _content(camera: Camera) -> dict[str, float]:
    width, height = camera.image_size
    return {'w': width, 'h': height,
            'fl_x': camera.fx, 'fl_y': camera.fy, 'cx': camera.cx + HALF_PIXEL,
            'cy': camera.cy + HALF_PIXEL, **named_coefficients(camera, 5, 'nerfstudio')}
