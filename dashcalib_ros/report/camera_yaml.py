"""calibration.yaml: the file that camera_info_manager, usb_cam, v4l2_camera and others load.

Keys, order and layout are those that camera_calibration_parsers writes. Its parser looks keys up
by name, so it ignores our one extra block, dashcalib, which has sigma and provenance. Texts in
it are quoted: OpenCV's FileStorage, which reads the file, too, takes 4.2.1 for a broken number.
"""
from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dashcalib_ros.camera import Camera, Radial, camera_from_ros, ros_camera
from dashcalib_ros.camera.rectified import SAME
from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.judgement import Calibration
from dashcalib_ros.limits import YAML_BYTES, parse_yaml, read_text
from dashcalib_ros.report.named_camera import (
    NamedCamera,
    check_focal,
    read_number,
    read_sigma,
    read_size,
)
from dashcalib_ros.report.result import plain_values

CAMERA_NAME = 'dashcam'


def calibration_yaml(calibration: Calibration, camera_name: str = CAMERA_NAME,
                     created: str | None = None) -> str:
    """Return the YAML text of an accepted or weak calibration, at full precision.

    created: the time, as ISO 8601 text; without it, the same calibration gives the same text.
    Raises ConfigError for a camera name that the drivers would refuse, ValueError without
    intrinsics.
    """
    check_camera_name(camera_name)
    if calibration.camera is None or not np.isfinite(calibration.camera.params).all():
        raise ValueError('a calibration without finite intrinsics has no calibration.yaml')
    document = _document(calibration.camera, camera_name, calibration.config.rectified)
    return _text({**document, 'dashcalib': _quoted(_provenance(calibration, created))})


def camera_info_yaml(camera: Camera) -> str:
    """Return the YAML text of a camera alone, without a calibration's sigma and provenance."""
    return _text(_document(camera, CAMERA_NAME, SAME))


def _document(camera: Camera, camera_name: str, rectified: str) -> dict[str, Any]:
    c = ros_camera(camera, rectified)
    width, height = camera.image_size
    return {
        'image_width': int(width),
        'image_height': int(height),
        'camera_name': camera_name,
        'camera_matrix': _matrix(3, 3, c.k),
        'distortion_model': c.distortion_model,
        'distortion_coefficients': _matrix(1, len(c.d), c.d),
        'rectification_matrix': _matrix(3, 3, c.r),
        'projection_matrix': _matrix(3, 4, c.p),
    }


def _text(document: Mapping[str, Any]) -> str:
    return str(yaml.dump(dict(document), Dumper=_Dumper, sort_keys=False, default_flow_style=None,
                         width=2**20, allow_unicode=True))


def load_calibration_yaml(path: str | Path) -> NamedCamera:
    """Read a camera_info YAML, ours or another tool's. Raises InputError."""
    return parse_calibration_yaml(read_text(Path(path), YAML_BYTES), path)


def parse_calibration_yaml(text: str, path: str | Path) -> NamedCamera:
    """Parse a camera_info YAML's text; path is for messages only."""
    try:
        data = parse_yaml(text, str(path))
    except InputError as error:
        raise InputError(f'{error}; give a calibration.yaml') from error
    if not isinstance(data, Mapping) or 'camera_matrix' not in data:
        raise InputError(f'{path} is no camera calibration; '
                         'give a result.json, a camera_info YAML or a truth JSON')
    k = _read_matrix(data, 'camera_matrix', 9, path)
    size = read_size(data.get('image_width'), data.get('image_height'), path)
    try:
        camera = camera_from_ros(size, str(data.get('distortion_model', Radial.ros_model)), k,
                                 _read_distortion(data, path))
    except InputError as error:
        raise InputError(f'{path}: {error}') from error
    own = data.get('dashcalib')
    own = own if isinstance(own, Mapping) else {}
    verdict = own.get('verdict')
    return NamedCamera(str(path), check_focal(camera, path), read_sigma(own.get('sigma'), camera),
                       None if verdict is None else str(verdict))


def check_camera_name(name: str) -> None:
    """Raise ConfigError for a name that camera_info_manager or image_pipeline would not take."""
    if not re.fullmatch(r'[A-Za-z0-9_]+', name):
        raise ConfigError(f'the camera name {name!r} must be letters, digits and underscores: '
                          'camera_info_manager takes no others')
    if name == 'narrow_stereo':
        raise ConfigError('the camera name narrow_stereo belongs to image_pipeline\'s stereo '
                          'files; choose another')


class _Text(str):
    """A text that is written with quotes."""


class _Dumper(yaml.SafeDumper):
    """Writes plain values, and texts with quotes."""


_Dumper.add_representer(_Text, lambda dumper, text: dumper.represent_scalar(
    'tag:yaml.org,2002:str', str(text), style='"'))


def _quoted(value: Any) -> Any:
    """Return a value with every text in it, other than keys, as one that is written in quotes."""
    if isinstance(value, str):
        return _Text(value)
    if isinstance(value, Mapping):
        return {key: _quoted(each) for key, each in value.items()}
    return [_quoted(each) for each in value] if isinstance(value, (list, tuple)) else value


def _matrix(rows: int, cols: int, data: Sequence[float]) -> dict[str, Any]:
    # dt: OpenCV reads the matrix by it, as doubles; the other readers look up what they know
    return {'rows': rows, 'cols': cols, 'dt': 'd', 'data': [float(value) for value in data]}


def _provenance(calibration: Calibration, created: str | None) -> dict[str, Any]:
    block: dict[str, Any] = plain_values({
        'verdict': calibration.verdict.level,
        'reasons': calibration.verdict.reasons,
        'camera_model': None if calibration.camera is None else calibration.camera.model,
        'sigma': calibration.sigma,
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
    block = data.get('distortion_coefficients')
    values = block.get('data') if isinstance(block, Mapping) else None
    if not isinstance(values, list):
        raise InputError(f'{path} has no distortion_coefficients; give a complete calibration')
    return _read_matrix(data, 'distortion_coefficients', len(values), path)
