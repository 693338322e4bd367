"""Reads a camera from a file of any of the three formats."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import MODELS, Brown, Camera, Fisheye, Radial
from dashcalib_ros.errors import InputError, shortened
from dashcalib_ros.limits import JSON_BYTES, read_text
from dashcalib_ros.report.camera_yaml import parse_calibration_yaml
from dashcalib_ros.report.named_camera import (
    NamedCamera,
    check_focal,
    no_intrinsics,
    read_number,
    read_sigma,
    read_size,
)
from dashcalib_ros.report.result import parse_json, parse_result


def load_camera(path: str | Path) -> NamedCamera:
    """Read a result.json (or the folder it is in), a camera_info YAML or a truth JSON.

    Raises InputError for anything else, and when a size or a parameter is missing.
    """
    path = Path(path)
    if path.is_dir():
        path = path / 'result.json'
    text = read_text(path, JSON_BYTES)
    if not text.lstrip().startswith('{'):
        return parse_calibration_yaml(text, path)
    data = parse_json(text, path)
    if 'fx' in data:
        return _truth_camera(data, path)
    return _result_camera(parse_result(text, path), path)


def _read_camera(model: type[Camera], size: tuple[int, int], data: Any, path: Path) -> Camera:
    if not isinstance(data, Mapping):
        raise InputError(f'{path} has no intrinsics; give a complete calibration')
    params = [read_number(data, name, path) for name in model.names()]
    return check_focal(model.of(size, params), path)


def _truth_camera(data: Mapping[str, Any], path: Path) -> NamedCamera:
    size = read_size(data.get('width'), data.get('height'), path)
    name = data.get('model', Radial.model)
    if name in (Fisheye.model, Fisheye.ros_model):
        model: type[Camera] = Fisheye
    elif name in (Radial.model, Brown.model, Radial.ros_model):
        extra = Brown.names()[len(Radial.names()):]
        model = Brown if any(read_number(data, each, path, 0.0) for each in extra) else Radial
    else:
        raise InputError(f'{path} has the camera model {shortened(repr(name))}; there are '
                         f'{", ".join(MODELS)}')
    # the terms after k2 may be left out: they are 0
    further = dict.fromkeys(model.names()[len(Radial.names()):], 0.0)
    camera = _read_camera(model, size, {**further, **data}, path)
    odd = [each for each in ('p1', 'p2', 'k3', 'k4', 'k5', 'k6')
           if each not in camera.names() and read_number(data, each, path, 0.0)]
    if odd:
        raise InputError(f'{path} has {odd[0]}, which the {camera.model} model has not')
    return NamedCamera(str(path), camera, read_sigma(data.get('sigma'), camera))


def _result_camera(data: Mapping[str, Any], path: Path) -> NamedCamera:
    if not data['intrinsics']:
        raise InputError(no_intrinsics(str(path), data['verdict'], data.get('reasons')))
    size = data['image_size']
    if not isinstance(size, list) or len(size) != 2:
        raise InputError(f'{path}: image_size must be [width, height], not {size!r}')
    name = str(data.get('camera_model', Radial.model))
    if name not in MODELS:
        raise InputError(f'{path} has the camera model {shortened(repr(name))}; there are '
                         f'{", ".join(MODELS)}')
    camera = _read_camera(MODELS[name], read_size(size[0], size[1], path), data['intrinsics'],
                          path)
    return NamedCamera(str(path), camera, read_sigma(data.get('sigma'), camera),
                       str(data['verdict']))
