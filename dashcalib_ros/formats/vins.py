# SPDX-License-Identifier: Apache-2.0
"""The camera files of VINS-Fusion and VINS-Mono, which are camodocal's."""
from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.other import OtherLens, bent, omni, undone
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    Data,
    camera_with,
    distortion_model,
    is_fisheye,
    named_coefficients,
    read_coefficients,
    read_number,
    read_size,
)
from dashcalib_ros.judge.difference import NamedCamera

MEI, FISHEYE = 'MEI', 'KANNALA_BRANDT'
MODELS = {'PINHOLE': PLUMB_BOB, 'PINHOLE_FULL': RATIONAL, FISHEYE: EQUIDISTANT, MEI: ''}
# of a fisheye, whose k1 is 1; and of Mei's model, whose focal lengths are gamma
FISHEYE_VIEW, FISHEYE_D = ('mu', 'mv', 'u0', 'v0'), ('k2', 'k3', 'k4', 'k5')
MEI_VIEW = ('gamma1', 'gamma2', 'u0', 'v0')


def cameras(data: Any, path: Path) -> Cameras:
    """Return the camera of such a file; see formats/table.py."""
    known = isinstance(data, dict) and {'model_type', 'projection_parameters'} <= data.keys()
    return {'': partial(_read, data, path)} if known else {}


def _read(data: Data, path: Path) -> Camera | OtherLens:
    kind = distortion_model(MODELS, data['model_type'], 'the model_type', path)
    size = read_size(data.get('image_width'), data.get('image_height'), path=path)
    view, lens, mirror = (_part(data, f'{name}_parameters', path)
                          for name in ('projection', 'distortion', 'mirror'))

    def values(part: Data, *keys: str) -> list[float]:
        return [read_number(part, key, path) for key in keys]
    if data['model_type'] == FISHEYE:
        return camera_with(size, values(view, *FISHEYE_VIEW), kind, values(view, *FISHEYE_D), path)
    if data['model_type'] == MEI:
        return OtherLens(MEI, size, values(view, *MEI_VIEW), undone(
            bent(values(lens, 'k1', 'k2'), values(lens, 'p1', 'p2')), omni(*values(mirror, 'xi'))))
    return camera_with(size, values(view, 'fx', 'fy', 'cx', 'cy'), kind,
                       read_coefficients(lens, kind, path), path)


def _part(data: Data, key: str, path: Path) -> Data:
    part = data.get(key, {})
    if not isinstance(part, dict):
        raise InputError('E-CALIBRATION-MISSING',
                         f'{path}: {key} has no values by name; use a complete calibration')
    return part


def write(found: NamedCamera) -> str:
    """Return a camera file. Raises nothing: camodocal has all of our lenses."""
    camera, (width, height) = found.camera, found.image_size
    named = named_coefficients(camera, 8, 'vins')
    view = (camera.fx, camera.fy, camera.cx, camera.cy)
    if is_fisheye(camera):
        model, lens = FISHEYE, {}
        projection = dict(zip((*FISHEYE_D, *FISHEYE_VIEW), (*named.values(), *view), strict=True))
    else:
        full = any(list(named.values())[4:])
        model = 'PINHOLE_FULL' if full else 'PINHOLE'
        lens = dict.fromkeys(('k1', 'k2', 'k3', 'k4', 'k5', 'k6', 'p1', 'p2') if full
                             else ('k1', 'k2', 'p1', 'p2'), 0.0)
        lens |= {key: value for key, value in named.items() if key in lens}
        projection = dict(zip(('fx', 'fy', 'cx', 'cy'), view, strict=True))
    blocks = ''.join(
        f'{name}_parameters:\n' + ''.join(f'   {key}: {float(value)!r}\n'
                                          for key, value in values.items())
        for name, values in (('distortion', lens), ('projection', projection)) if values)
    return (f'%YAML:1.0\n---\nmodel_type: {model}\ncamera_name: camera\n'
            f'image_width: {width}\nimage_height: {height}\n{blocks}')
