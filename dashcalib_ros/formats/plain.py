"""A plain JSON of fx, fy, cx, cy, coefficients by name, width and height."""
from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import FISHEYE, MODELS, NO_DISTORTION, Radial
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    Data,
    camera_with,
    read_coefficients,
    read_number,
    read_sigma,
    unknown_model,
)
from dashcalib_ros.judge.difference import NamedCamera


def cameras(data: Any, path: Path) -> Cameras:
    """Return the camera of such a file; see formats/table.py."""
    return {'': partial(_read, data, path)} if isinstance(data, dict) and 'fx' in data else {}


def _read(data: Data, path: Path) -> NamedCamera:
    """Return the camera; coefficients after k2 may be omitted."""
    name = data.get('model', data.get('distortion_model'))
    ideal = isinstance(name, str) and name.lower() in NO_DISTORTION
    name = 'pinhole' if ideal else name
    models = [model for model in MODELS.values()
              if name in (None, model.model, model.ros_model, model.family)]
    if not models:
        raise unknown_model(name, path)
    if name is None and read_number(data, 'k4', path, 0.0) and not {'k5', 'k6'} & data.keys():
        raise InputError('E-LENS-AMBIGUOUS',
                         f'{path} has k4, which may be that of a fisheye; add "model": "fisheye", '
                         f'or "{RATIONAL}"')
    kind = (EQUIDISTANT if models[0].family == FISHEYE else
            PLUMB_BOB if name == PLUMB_BOB else RATIONAL)
    missing = [] if ideal else [each for each in Radial.names()[4:] if each not in data]
    if missing:
        zeros = ', '.join(f'"{each}": 0' for each in missing)
        raise InputError('E-NO-DISTORTION',
                         f'{path} has no {" and no ".join(missing)}; for pictures without '
                         f'distortion, write 0: {zeros}')
    camera = camera_with((data.get('width'), data.get('height')),
                         [read_number(data, key, path) for key in Radial.names()[:4]], kind,
                         read_coefficients(data, kind, path), path)
    return NamedCamera(str(path), camera, read_sigma(data.get('sigma'), camera))
