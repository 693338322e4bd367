"""A camera as a file describes it, whichever of the three formats that file has."""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from dashcalib_ros.errors import InputError
from dashcalib_ros.intrinsics import Calibration, Intrinsics
from dashcalib_ros.report.result import parse_json, parse_result
from dashcalib_ros.report.source_text import read_text

PARAMETERS = tuple(field.name for field in fields(Intrinsics))


@dataclass(frozen=True)
class Camera:
    """A plumb_bob camera with what is known about it.

    image_size: (width, height) in pixels. p1, p2, k3: zero in our own calibrations.
    verdict: accepted or weak; None where the file says nothing (a truth, another tool's file).
    name: where it came from, for people to read.
    """

    name: str
    image_size: tuple[int, int]
    intrinsics: Intrinsics
    sigma: Intrinsics | None = None
    verdict: str | None = None
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


def camera_of(calibration: Calibration, name: str = 'estimate') -> Camera:
    """Return the camera of a calibration. Raises InputError when it was refused."""
    if calibration.intrinsics is None:
        raise InputError(_no_intrinsics(name, calibration.verdict.level,
                                        calibration.verdict.reasons))
    return Camera(name, calibration.image_size, calibration.intrinsics, calibration.sigma,
                  calibration.verdict.level)


def load_camera(path: str | Path) -> Camera:
    """Read a result.json (or the folder it is in), a camera_info YAML or a truth JSON.

    Raises InputError for anything else, and when a size or a parameter is missing.
    """
    path = Path(path)
    if path.is_dir():
        path = path / 'result.json'
    text = read_text(path)
    if not text.lstrip().startswith('{'):
        from dashcalib_ros.report.camera_yaml import parse_calibration_yaml
        return parse_calibration_yaml(text, path)
    data = parse_json(text, path)
    if 'fx' in data:
        return _truth_camera(data, path)
    return _result_camera(parse_result(text, path), path)


def read_size(width: Any, height: Any, path: str | Path) -> tuple[int, int]:
    """Check an image size that was read from a file. Raises InputError."""
    for key, value in (('width', width), ('height', height)):
        if value is None:
            raise InputError(f'{path} does not say the image {key}; add it, in pixels')
        if type(value) is not int or value <= 0:
            raise InputError(f'{path}: the image {key} must be a positive integer, not {value!r}')
    return width, height


def read_number(data: Mapping[str, Any], key: str, path: str | Path,
                default: float | None = None) -> float:
    """Return data[key] as a finite float. Raises InputError."""
    if key not in data and default is not None:
        return default
    value = data.get(key)
    try:
        # text too: yaml-cpp writes 1e-05, which YAML 1.1 (and so PyYAML) takes for a word
        number = math.nan if value is None or isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        what = f'no {key}' if value is None else f'{key} = {value!r}'
        raise InputError(f'{path} has {what}; give a complete calibration with finite numbers')
    return number


def read_intrinsics(data: Any, path: str | Path) -> Intrinsics:
    """Check six parameters that were read from a file. Raises InputError."""
    if not isinstance(data, Mapping):
        raise InputError(f'{path} has no intrinsics; give a complete calibration')
    intrinsics = Intrinsics(**{key: read_number(data, key, path) for key in PARAMETERS})
    if intrinsics.fx <= 0 or intrinsics.fy <= 0:
        raise InputError(f'{path} is uncalibrated: its focal length is not positive')
    return intrinsics


def read_sigma(data: Any) -> Intrinsics | None:
    """Return the six sigmas where all are known, else None: a missing sigma is no error."""
    if not isinstance(data, Mapping):
        return None
    try:
        return Intrinsics(**{key: read_number(data, key, '') for key in PARAMETERS})
    except InputError:
        return None


def _truth_camera(data: Mapping[str, Any], path: Path) -> Camera:
    size = read_size(data.get('width'), data.get('height'), path)
    return Camera(str(path), size, read_intrinsics(data, path), read_sigma(data.get('sigma')),
                  None, *(read_number(data, key, path, 0.0) for key in ('p1', 'p2', 'k3')))


def _result_camera(data: Mapping[str, Any], path: Path) -> Camera:
    if not data['intrinsics']:
        raise InputError(_no_intrinsics(str(path), data['verdict'], data.get('reasons')))
    size = data['image_size']
    if not isinstance(size, list) or len(size) != 2:
        raise InputError(f'{path}: image_size must be [width, height], not {size!r}')
    return Camera(str(path), read_size(size[0], size[1], path),
                  read_intrinsics(data['intrinsics'], path), read_sigma(data.get('sigma')),
                  str(data['verdict']))


def _no_intrinsics(name: str, verdict: Any, reasons: Any) -> str:
    known = '; '.join(map(str, reasons)) if isinstance(reasons, (list, tuple)) else ''
    return (f'{name} has no intrinsics to compare, its verdict is {verdict}'
            + (f': {known}' if known else '') + '; calibrate a drive with more turns')
