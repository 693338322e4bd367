# SPDX-License-Identifier: Apache-2.0
"""MATLAB's cameraParameters and cameraIntrinsics as JSON: jsonencode(toStruct(parameters)).

It counts pixels from (1, 1), and its older IntrinsicMatrix is the transpose of K.
"""
from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.other import OtherLens, polynomial
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    PLUMB_BOB,
    Cameras,
    Data,
    camera_with,
    focal_and_centre,
    named_coefficients,
    pinhole_only,
    read_numbers,
    read_pair,
    read_size,
)
from dashcalib_ros.judge.difference import NamedCamera

# of a fisheye: a0, a2, a3, a4
MAPPING = 'MappingCoefficients'


def cameras(data: Any, path: Path) -> Cameras:
    """Return the camera of a struct; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    data = data['Intrinsics'] if isinstance(data.get('Intrinsics'), dict) else data
    known = 'ImageSize' in data and {'RadialDistortion', MAPPING} & data.keys()
    return {'': partial(_read, data, path)} if known else {}


def _read(data: Data, path: Path) -> Camera | OtherLens:
    size = read_pair(data, 'ImageSize', path)[::-1]
    if MAPPING in data:
        return _fisheye(data, size, path)
    if 'K' in data:
        k = read_numbers(data['K'], 'K', path, 9)
    elif 'IntrinsicMatrix' in data:
        k = read_numbers(data['IntrinsicMatrix'], 'IntrinsicMatrix', path, 9)
        k = [*k[0::3], *k[1::3], *k[2::3]]
    else:
        (fx, fy), (cx, cy) = (read_numbers(data.get(key), key, path, 2)
                              for key in ('FocalLength', 'PrincipalPoint'))
        k = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    if k[1] or k[3] or k[6:] != [0, 0, 1]:
        raise InputError('E-CAMERA-SKEW',
                         f'{path} has a matrix with skew, or one that is not transposed as MATLAB '
                         f'writes it; calibrate without skew')
    fx, fy, cx, cy = focal_and_centre(k)
    radial = read_numbers(data.get('RadialDistortion'), 'RadialDistortion', path, 2, 3)
    tangential = read_numbers(data.get('TangentialDistortion', [0, 0]), 'TangentialDistortion',
                              path, 2)
    return camera_with(size, [fx, fy, cx - 1, cy - 1], PLUMB_BOB,
                       [*radial[:2], *tangential, *radial[2:], *[0.0] * (3 - len(radial))], path)


def _fisheye(data: Data, size: list[Any], path: Path) -> OtherLens:
    a0, *more = read_numbers(data[MAPPING], MAPPING, path, 4)
    cx, cy = read_numbers(data.get('DistortionCenter'), 'DistortionCenter', path, 2)
    stretch = read_numbers(data.get('StretchMatrix', [1, 0, 0, 1]), 'StretchMatrix', path, 4)
    if stretch != [1, 0, 0, 1]:
        raise InputError('E-CAMERA-SKEW', f'{path} has a StretchMatrix that is not the identity; '
                                          f'calibrate without EstimateAlignment')
    return OtherLens('Scaramuzza', read_size(*size, path=path), [1, 1, cx - 1, cy - 1],
                     polynomial([a0, 0, *more]))


def write(found: NamedCamera) -> str:
    """Return a struct that cameraIntrinsics() and cameraParameters() take. Raises ConfigError."""
    camera, (width, height) = pinhole_only(found.camera, 'matlab'), found.image_size
    k1, k2, p1, p2, k3 = named_coefficients(camera, 5, 'matlab').values()
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx + 1, camera.cy + 1
    return json.dumps({
        'ImageSize': [height, width], 'FocalLength': [fx, fy], 'PrincipalPoint': [cx, cy],
        'Skew': 0, 'RadialDistortion': [k1, k2, k3], 'TangentialDistortion': [p1, p2],
        'IntrinsicMatrix': [[fx, 0, 0], [0, fy, 0], [cx, cy, 1]],
        'K': [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]}, indent=2) + '\n'
