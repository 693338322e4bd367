# SPDX-License-Identifier: Apache-2.0
"""ORB-SLAM3's settings, and ORB-SLAM2's, which do not say the size of the pictures.

A file for cv2.FileStorage, whose names have dots in them: Camera1.fx.
"""
from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import Camera
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    Cameras,
    Data,
    Sizeless,
    camera_with,
    distortion_model,
    is_fisheye,
    named_coefficients,
    read_coefficients,
    read_number,
)
from dashcalib_ros.judge.difference import NamedCamera

PINHOLE, FISHEYE = 'PinHole', 'KannalaBrandt8'
MODELS = {PINHOLE: PLUMB_BOB, 'Rectified': PLUMB_BOB, FISHEYE: EQUIDISTANT}
NAMES = ('Camera1', 'Camera2', 'Camera')


def cameras(data: Any, path: Path) -> Cameras:
    """Return the cameras of a file of settings; see formats/table.py."""
    return {name: partial(_read, data, name, path) for name in NAMES
            if isinstance(data, dict) and f'{name}.fx' in data}


def _read(data: Data, name: str, path: Path) -> Camera | Sizeless:
    kind = distortion_model(MODELS, data.get('Camera.type', PINHOLE), 'the Camera.type', path)
    view = [read_number(data, f'{name}.{key}', path) for key in ('fx', 'fy', 'cx', 'cy')]
    own = {str(key).removeprefix(f'{name}.'): value for key, value in data.items()}
    d = read_coefficients(own, kind, path)
    if 'Camera.width' not in data:
        return Sizeless(lambda size: camera_with(size, view, kind, d, path))
    return camera_with((data['Camera.width'], data.get('Camera.height')), view, kind, d, path)


def write(found: NamedCamera) -> str:
    """Return the camera's part of the settings. Raises ConfigError."""
    camera, (width, height) = found.camera, found.image_size
    values = {'fx': camera.fx, 'fy': camera.fy, 'cx': camera.cx, 'cy': camera.cy,
              **named_coefficients(camera, 5, 'orbslam')}
    lines = '\n'.join(f'Camera1.{key}: {float(value)!r}' for key, value in values.items())
    return (f'%YAML:1.0\n---\nFile.version: "1.0"\n'
            f'Camera.type: "{FISHEYE if is_fisheye(camera) else PINHOLE}"\n{lines}\n'
            f'Camera.width: {width}\nCamera.height: {height}\n')
