# SPDX-License-Identifier: Apache-2.0
"""Kalibr's camchain.yaml."""
from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from dashcalib_ros.camera import NO_DISTORTION, Camera
from dashcalib_ros.errors import InputError, shortened
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    Cameras,
    Data,
    camera_with,
    distortion_model,
    is_fisheye,
    named_coefficients,
    read_numbers,
    read_pair,
)
from dashcalib_ros.judge.difference import NamedCamera

KEY = 'distortion_coeffs'
MODELS = {'radtan': PLUMB_BOB, 'equidistant': EQUIDISTANT, 'equi': EQUIDISTANT,
          **dict.fromkeys(NO_DISTORTION, PLUMB_BOB)}


def cameras(data: Any, path: Path) -> Cameras:
    """Return the cameras of a camchain, or of a part with one camera; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    if KEY in data:
        return {'': partial(_read, data, path)}
    return {str(name): partial(_read, each, path) for name, each in data.items()
            if isinstance(each, dict) and KEY in each}


def results(text: str, path: Path) -> Cameras:
    """Refuse the text of results that Kalibr writes beside a camchain; see formats/table.py."""
    if re.search(r'^\s*projection: \[.*\+-', text, re.MULTILINE):
        raise InputError('E-KALIBR-RESULTS',
                         f'{path} has the results of Kalibr in words, without the size of the '
                         f'pictures; use the camchain YAML that Kalibr wrote beside it')
    return {}


def _read(data: Data, path: Path) -> Camera:
    if data.get('camera_model', 'pinhole') != 'pinhole':
        raise InputError('E-LENS-MODEL',
                         f'{path} has the camera model {shortened(repr(data["camera_model"]))}; '
                         f'calibrate with --models pinhole-radtan, or pinhole-equi')
    kind = distortion_model(MODELS, data.get('distortion_model'), 'the distortion model', path)
    return camera_with(read_pair(data, 'resolution', path),
                       read_numbers(data.get('intrinsics'), 'intrinsics', path, 4), kind,
                       read_numbers(data[KEY], KEY, path), path)


def write(found: NamedCamera) -> str:
    """Return a camchain.yaml with one camera. Raises ConfigError."""
    camera = found.camera
    return str(yaml.safe_dump({'cam0': {
        'camera_model': 'pinhole',
        'intrinsics': [camera.fx, camera.fy, camera.cx, camera.cy],
        'distortion_model': 'equidistant' if is_fisheye(camera) else 'radtan',
        'distortion_coeffs': list(named_coefficients(camera, 4, 'kalibr').values()),
        'resolution': list(camera.image_size),
        'rostopic': '/image_raw'}}, sort_keys=False, default_flow_style=None))
