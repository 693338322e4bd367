# SPDX-License-Identifier: Apache-2.0
"""OpenSfM's camera_models.json and reconstruction.json.

It counts from the picture's middle, in units of its longer side.
"""
from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.camera import HALF_PIXEL
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

MODELS = {'perspective': PLUMB_BOB, 'simple_radial': PLUMB_BOB, 'radial': PLUMB_BOB,
          'brown': PLUMB_BOB, 'fisheye': EQUIDISTANT, 'fisheye_opencv': EQUIDISTANT}


def cameras(data: Any, path: Path) -> Cameras:
    """Return the cameras of either file; see formats/table.py."""
    if isinstance(data, list) and data and isinstance(data[0], dict):
        data = data[0].get('cameras')  # reconstruction.json
    return {str(name): partial(_read, each, path)
            for name, each in (data.items() if isinstance(data, dict) else ())
            if isinstance(each, dict) and 'projection_type' in each}


def _read(data: Data, path: Path) -> Camera:
    kind = distortion_model(MODELS, data['projection_type'], 'the projection_type', path)
    size = read_size(data.get('width'), data.get('height'), path=path)
    longer = max(size)
    # one focal length, or two
    fx, fy = (longer * read_number(data, key if key in data else 'focal', path)
              for key in ('focal_x', 'focal_y'))
    cx, cy = (longer * read_number(data, key, path, 0.0) + side / 2 - HALF_PIXEL
              for key, side in zip(('c_x', 'c_y'), size, strict=True))
    return camera_with(size, [fx, fy, cx, cy], kind, read_coefficients(data, kind, path), path)


def write(found: NamedCamera) -> str:
    """Return a camera_models.json. Raises ConfigError."""
    camera, (width, height) = found.camera, found.image_size
    longer = max(width, height)
    kind = 'fisheye_opencv' if is_fisheye(camera) else 'brown'
    return json.dumps({f'v2 dashcam {width} {height} {kind} 0': {
        'projection_type': kind, 'width': width, 'height': height,
        'focal_x': camera.fx / longer, 'focal_y': camera.fy / longer,
        'c_x': (camera.cx + HALF_PIXEL - width / 2) / longer,
        'c_y': (camera.cy + HALF_PIXEL - height / 2) / longer,
        **named_coefficients(camera, 5, 'opensfm')}}, indent=2) + '\n'
