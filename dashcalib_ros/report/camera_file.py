"""Reads a camera from a file of any of the three formats."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import MODELS, Camera, Radial
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

# of distortion, in any model's truth
TERMS = ('k1', 'k2', 'k3', 'k4', 'k5', 'k6', 'p1', 'p2')


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
    model = _truth_model(data, path)
    # the terms after k2 may be left out: they are 0
    filled = {**dict.fromkeys(model.names()[len(Radial.names()):], 0.0), **data}
    camera = _read_camera(model, size, filled, path)
    return NamedCamera(str(path), camera, read_sigma(data.get('sigma'), camera))


def _truth_model(data: Mapping[str, Any], path: Path) -> type[Camera]:
    """Return the simplest model of the kind that is named which has all terms that are not 0."""
    name = data.get('model', Radial.model)
    kinds = [model.ros_model for model in MODELS.values() if name in (model.model,
                                                                      model.ros_model)]
    if not kinds:
        raise InputError(_no_model(name, path))
    terms = [each for each in TERMS if read_number(data, each, path, 0.0)]
    found = [model for model in MODELS.values()
             if model.ros_model in kinds and set(terms) <= set(model.names())]
    if not found:
        raise InputError(f'{path} has {", ".join(terms)}, and no {kinds[0]} model here has all of '
                         f'these')
    return found[0]


def _no_model(name: Any, path: Path) -> str:
    return (f'{path} has the camera model {shortened(repr(name))}; there are '
            f'{", ".join(MODELS)}')


def _result_camera(data: Mapping[str, Any], path: Path) -> NamedCamera:
    if not data['intrinsics']:
        raise InputError(no_intrinsics(str(path), data['verdict'], data.get('reasons')))
    size = data['image_size']
    if not isinstance(size, list) or len(size) != 2:
        raise InputError(f'{path}: image_size must be [width, height], not {size!r}')
    name = str(data.get('camera_model', Radial.model))
    if name not in MODELS:
        raise InputError(_no_model(name, path))
    camera = _read_camera(MODELS[name], read_size(size[0], size[1], path), data['intrinsics'],
                          path)
    return NamedCamera(str(path), camera, read_sigma(data.get('sigma'), camera),
                       str(data['verdict']))
