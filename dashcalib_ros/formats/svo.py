# SPDX-License-Identifier: Apache-2.0
"""SVO Pro's camera files, and those of vikit, which SVO has its cameras from."""
from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import yaml

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.other import OtherLens, field_of_view
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    Cameras,
    Data,
    camera_with,
    distortion_model,
    is_fisheye,
    named_coefficients,
    read_number,
    read_numbers,
    read_size,
)
from dashcalib_ros.judge.difference import NamedCamera

FOV, ATAN = 'fisheye', 'ATAN'
MODELS = {'none': PLUMB_BOB, 'radial-tangential': PLUMB_BOB, 'equidistant': EQUIDISTANT, FOV: ''}
VIKIT = {'Pinhole': PLUMB_BOB, 'PinholeRadialTangential': PLUMB_BOB,
         'PinholeEquidistant': EQUIDISTANT, ATAN: ''}


def cameras(data: Any, path: Path) -> Cameras:
    """Return the cameras of either kind of file; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    if isinstance(data.get('cameras'), list):
        found = [each['camera'] for each in data['cameras']
                 if isinstance(each, dict) and isinstance(each.get('camera'), dict)]
        return {str(each.get('label', number)): partial(_read, each, path)
                for number, each in enumerate(found) if 'intrinsics' in each}
    if 'cam_model' in data:
        return {'': partial(_read_vikit, data, path)}
    return {str(name): partial(_read_vikit, each, path) for name, each in data.items()
            if isinstance(each, dict) and 'cam_model' in each}


def _read(data: Data, path: Path) -> Camera | OtherLens:
    lens = data.get('distortion')
    if data.get('type') != 'pinhole' or not isinstance(lens, dict):
        raise InputError('E-LENS-MODEL',
                         f'{path} has a camera that is no pinhole with a distortion; calibrate it '
                         f'as a pinhole')
    name = lens.get('type')
    kind = distortion_model(MODELS, name.strip() if isinstance(name, str) else name,
                            'the distortion', path)
    size = read_size(data.get('image_width'), data.get('image_height'), path=path)
    view = read_numbers(data['intrinsics'], 'intrinsics', path, 4)
    d = [] if name == 'none' else read_numbers(lens.get('parameters'), 'parameters', path)
    return camera_with(size, view, kind, d, path) if kind else OtherLens(
        'FOV', size, view, field_of_view(_only(d, path)))


def _read_vikit(data: Data, path: Path) -> Camera | OtherLens:
    kind = distortion_model(VIKIT, data['cam_model'], 'the cam_model', path)
    size = read_size(data.get('cam_width'), data.get('cam_height'), path=path)
    view = [read_number(data, f'cam_{key}', path) for key in ('fx', 'fy', 'cx', 'cy')]
    d = [read_number(data, f'cam_d{number}', path, 0.0) for number in range(4)]
    if kind:
        return camera_with(size, view, kind, d, path)
    # PTAM's: shares of the picture, whose corner is at (0, 0)
    view = [value * side for value, side in zip(view, (*size, *size), strict=True)]
    return OtherLens(ATAN, size, [*view[:2], view[2] - 0.5, view[3] - 0.5],
                     field_of_view(_only(d[:1], path)))


def _only(d: list[float], path: Path) -> float:
    if len(d) != 1 or not d[0]:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path}: the FOV distortion must have 1 number, not 0, and has '
                         f'{len(d)}; correct it')
    return d[0]


def write(found: NamedCamera) -> str:
    """Return SVO Pro's file with one camera, whose T_B_C is to be set. Raises ConfigError."""
    camera, (width, height) = found.camera, found.image_size
    d = list(named_coefficients(camera, 4, 'svo').values())
    return str(yaml.safe_dump({
        'label': 'dashcam', 'cameras': [{
            'camera': {
                'label': 'cam0', 'line-delay-nanoseconds': 0, 'image_height': height,
                'image_width': width, 'type': 'pinhole',
                'intrinsics': _column([camera.fx, camera.fy, camera.cx, camera.cy]),
                'distortion': {
                    'type': 'equidistant' if is_fisheye(camera) else 'radial-tangential',
                    'parameters': _column(d)}},
            'T_B_C': {'cols': 4, 'rows': 4, 'data': [
                float(row == column) for row in range(4) for column in range(4)]}}]},
        sort_keys=False))


def _column(values: list[float]) -> dict[str, Any]:
    return {'cols': 1, 'rows': len(values), 'data': values}
