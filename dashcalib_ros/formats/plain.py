# SPDX-License-Identifier: Apache-2.0
"""Focal lengths and centre by name (fx, fy, cx, cy), with coefficients by name or as a list.

They stand by themselves, or are an object in the file: one of several cameras, or of what other
files have a matrix for.
"""
from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import FISHEYE, MODELS, NO_DISTORTION, Radial
from dashcalib_ros.camera.other import OtherLens
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats import opencv
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    Data,
    camera_with,
    check_lens_kind,
    no_distortion,
    read_coefficients,
    read_number,
    read_sigma,
    unknown_model,
)
from dashcalib_ros.judge.difference import NamedCamera

# how files name fx, fy, cx and cy, in small letters without signs
VIEW = (('fx', 'fu'), ('fy', 'fv'), ('cx', 'u0', 'cu', 'ppx'), ('cy', 'v0', 'cv', 'ppy'))
MODEL = ('model', 'distortionmodel', 'intrinsictype', 'lensmodel', 'projectiontype')


def cameras(data: Any, path: Path) -> Cameras:
    """Return the cameras of such a file; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    if _has_view(data):
        return {'': partial(_read, data, path)}
    matrix = opencv.Entries(data, path).first(*opencv.MATRIX)
    if matrix is not None and not _has_view(matrix):
        return {}
    return {str(name): partial(_read, {**data, **each}, path) for name, each in data.items()
            if _has_view(each)}


def _has_view(data: Any) -> bool:
    return isinstance(data, dict) and opencv.Entries(data, Path()).key(*VIEW[0]) is not None


def _read(data: Data, path: Path) -> NamedCamera | OtherLens:
    entries = opencv.Entries(data, path)
    view = [read_number(data, entries.key(*names) or names[0], path) for names in VIEW]
    if isinstance(entries.first(*opencv.DISTORTION), (list, dict)):
        return opencv.read({**data, 'camera_matrix': view}, path)
    name = entries.first(*MODEL)
    if name is None:
        lens = str(entries.first('cameramodel', 'cameratype', 'type')).lower()
        check_lens_kind(lens, path)
        name = FISHEYE if 'fisheye' in lens else None
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
    known = Radial.names()[4:]
    missing = [] if ideal else [each for each in known if each not in data]
    if missing:
        zeros = ', '.join(f'"{each}": 0' for each in missing)
        raise no_distortion({key: value for key, value in data.items() if key not in known},
                            f'no {" and no ".join(missing)}', f': {zeros}', path)
    camera = camera_with(opencv.size_in(entries.first), view, kind,
                         read_coefficients(data, kind, path), path)
    return NamedCamera(str(path), camera, read_sigma(data.get('sigma'), camera))
