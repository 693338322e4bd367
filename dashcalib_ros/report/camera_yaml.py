"""calibration.yaml: the file that camera_info_manager, usb_cam, v4l2_camera and others load.

Keys, order and layout are those camera_calibration_parsers writes. Its parser looks keys up by
name, so it passes over our one extra block, dashcalib, which holds sigma and provenance.
"""
from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.intrinsics import Calibration
from dashcalib_ros.report.camera import (
    Camera,
    read_intrinsics,
    read_number,
    read_sigma,
    read_size,
)
from dashcalib_ros.report.result import plain_values
from dashcalib_ros.report.source_text import read_text

CAMERA_NAME = 'dashcam'


def calibration_yaml(calibration: Calibration, camera_name: str = CAMERA_NAME,
                     created: str | None = None) -> str:
    """Return the YAML text of an accepted or weak calibration, at full precision.

    created: when, as ISO 8601 text; left out, the same calibration gives the same text.
    Raises ConfigError for a camera name that the drivers would refuse, ValueError without
    intrinsics.
    """
    check_camera_name(camera_name)
    c = calibration.intrinsics
    if c is None or any(value is None for value in plain_values(c).values()):
        raise ValueError('a calibration without finite intrinsics has no calibration.yaml')
    width, height = calibration.image_size
    document = {
        'image_width': int(width),
        'image_height': int(height),
        'camera_name': camera_name,
        'camera_matrix': _matrix(3, 3, (c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1)),
        'distortion_model': 'plumb_bob',
        'distortion_coefficients': _matrix(1, 5, (c.k1, c.k2, 0, 0, 0)),
        'rectification_matrix': _matrix(3, 3, (1, 0, 0, 0, 1, 0, 0, 0, 1)),
        'projection_matrix': _matrix(3, 4, (c.fx, 0, c.cx, 0, 0, c.fy, c.cy, 0, 0, 0, 1, 0)),
        'dashcalib': _provenance(calibration, created),
    }
    text: str = yaml.safe_dump(document, sort_keys=False, default_flow_style=None,
                               width=2**20, allow_unicode=True)
    return text


def load_calibration_yaml(path: str | Path) -> Camera:
    """Read a camera_info YAML, ours or another tool's. Raises InputError."""
    return parse_calibration_yaml(read_text(path), path)


def parse_calibration_yaml(text: str, path: str | Path) -> Camera:
    """Parse a camera_info YAML's text; path is for messages only."""
    try:
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f'{path} is not valid YAML; give a calibration.yaml') from error
    if not isinstance(data, Mapping) or 'camera_matrix' not in data:
        raise InputError(f'{path} is no camera calibration; '
                         'give a result.json, a camera_info YAML or a truth JSON')
    k = _read_matrix(data, 'camera_matrix', 9, path)
    d = _read_distortion(data, path)
    named = dict(zip(('fx', 'cx', 'fy', 'cy'), (k[0], k[2], k[4], k[5]), strict=True))
    own = data.get('dashcalib')
    own = own if isinstance(own, Mapping) else {}
    verdict = own.get('verdict')
    return Camera(
        str(path), read_size(data.get('image_width'), data.get('image_height'), path),
        read_intrinsics({**named, 'k1': d[0], 'k2': d[1]}, path), read_sigma(own.get('sigma')),
        None if verdict is None else str(verdict), d[2], d[3], d[4])


def check_camera_name(name: str) -> None:
    """Raise ConfigError for a name that camera_info_manager or image_pipeline would not take."""
    if not re.fullmatch(r'[A-Za-z0-9_]+', name):
        raise ConfigError(f'the camera name {name!r} must be letters, digits and underscores: '
                          'camera_info_manager takes no others')
    if name == 'narrow_stereo':
        raise ConfigError('the camera name narrow_stereo belongs to image_pipeline\'s stereo '
                          'files; choose another')


def _matrix(rows: int, cols: int, data: Sequence[float]) -> dict[str, Any]:
    return {'rows': rows, 'cols': cols, 'data': [float(value) for value in data]}


def _provenance(calibration: Calibration, created: str | None) -> dict[str, Any]:
    sigma = None if calibration.sigma is None else dataclasses.asdict(calibration.sigma)
    block: dict[str, Any] = plain_values({
        'verdict': calibration.verdict.level,
        'reasons': calibration.verdict.reasons,
        'sigma': sigma,
        'turns_used': calibration.turns_used,
        'reprojection_error_px': calibration.reprojection_error_px,
        'input': calibration.input_name,
        'seed': calibration.config.seed,
        'versions': calibration.versions,
    })
    return block if created is None else {**block, 'created': created}


def _read_matrix(data: Mapping[str, Any], key: str, count: int, path: str | Path) -> list[float]:
    block = data.get(key)
    values = block.get('data') if isinstance(block, Mapping) else None
    if not isinstance(values, list) or len(values) != count:
        raise InputError(f'{path}: {key} must have data of {count} numbers')
    return [read_number({key: value}, key, path) for value in values]


def _read_distortion(data: Mapping[str, Any], path: str | Path) -> list[float]:
    model = data.get('distortion_model', 'plumb_bob')
    if model not in ('plumb_bob', 'rational_polynomial'):
        raise InputError(f'{path} has distortion_model {model}; only plumb_bob can be compared')
    block = data.get('distortion_coefficients')
    values = block.get('data') if isinstance(block, Mapping) else None
    if not isinstance(values, list):
        raise InputError(f'{path} has no distortion_coefficients; give a complete calibration')
    d = _read_matrix(data, 'distortion_coefficients', len(values), path)
    if any(d[5:]):
        raise InputError(f'{path} has distortion coefficients beyond k3; '
                         'only plumb_bob can be compared')
    return (d + [0.0] * 5)[:5]
