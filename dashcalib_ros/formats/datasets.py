# SPDX-License-Identifier: Apache-2.0
"""The cameras of data sets: only read.

nuScenes, Argoverse 1 and 2 and Cityscapes publish pictures without distortion; of Argoverse's
coefficients, which belong to the pictures before that, nothing is taken.
"""
from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial, reduce
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import Camera
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    Cameras,
    Data,
    Read,
    Sizeless,
    camera_with,
    distortion_model,
    focal_and_centre,
    numbers_in,
    pinhole,
    read_matrix,
    read_number,
    read_numbers,
    read_pair,
)
from dashcalib_ros.limits import JSON_BYTES, parse_json, read_text

# of Argoverse 1's and Cityscapes' files, beside the values
ARGOVERSE, CITYSCAPES = 'camera_data_', ('extrinsic', 'intrinsic')
# Cityscapes has pictures of one size
CITYSCAPES_SIZE = (2048, 1024)
# what a column of Waymo's or Argoverse 2's tables is called before its name
PREFIX = re.compile(r'^(?:key\.|\[CameraCalibrationComponent\]\.)')
WAYMO = ('f_u', 'f_v', 'c_u', 'c_v', 'k1', 'k2', 'p1', 'p2', 'k3')
WAYMO_NAMES = ('UNKNOWN', 'FRONT', 'FRONT_LEFT', 'FRONT_RIGHT', 'SIDE_LEFT', 'SIDE_RIGHT')
# of KITTI's lines, a name and numbers each: how many there are
Lines = dict[str, list[float]]
KITTI_COUNTS = {'S': 2, 'K': 9, 'D': 5, 'P': 12}
LENSES = {'Fisheye': EQUIDISTANT, 'Telecam': PLUMB_BOB}


def kitti(text: str, path: Path) -> Cameras:
    """Return the cameras of KITTI's calib_cam_to_cam.txt, or of the calib.txt of its odometry.

    A camera has two kinds of pictures, raw and rectified ones, of different sizes; those that are
    published as synchronised and all of the odometry are rectified, and have the K of P.
    """
    lines: Lines = {}
    for line in text.splitlines():
        if found := re.fullmatch(r'(P\d|(?:[SKDP]_(?:rect_)?)\d\d):(.*)', line.strip()):
            lines[found[1]] = numbers_in(found[2]) or []
    for name, values in lines.items():
        if len(values) != KITTI_COUNTS[name[0]]:
            raise InputError('E-CALIBRATION-COUNT',
                             f'{path}: {name} must have {KITTI_COUNTS[name[0]]} numbers, and has '
                             f'{len(values)}')
    numbers = [name[2:] for name in lines if re.fullmatch(r'K_\d\d', name)]
    raw = {number: partial(_kitti_raw, lines, number, path) for number in numbers
           if {f'D_{number}', f'S_{number}'} <= lines.keys()}
    rectified = {number: partial(_kitti_rectified, lines, number, path) for number in raw
                 if {f'P_rect_{number}', f'S_rect_{number}'} <= lines.keys()}
    return {
        **{name: partial(pinhole, _view_of(values), path) for name, values in lines.items()
           if re.fullmatch(r'P\d', name)},
        **{number: partial(_kitti_either, lines, number, raw[number], rectified[number])
           if number in rectified else raw[number] for number in raw},
        **{f'raw_{number}': read for number, read in raw.items() if number in rectified},
        **{f'rect_{number}': read for number, read in rectified.items()}}


def _kitti_raw(lines: Lines, number: str, path: Path) -> Camera:
    return camera_with(lines[f'S_{number}'], focal_and_centre(lines[f'K_{number}']), PLUMB_BOB,
                       lines[f'D_{number}'], path)


def _kitti_rectified(lines: Lines, number: str, path: Path) -> Camera:
    return camera_with(lines[f'S_rect_{number}'], _view_of(lines[f'P_rect_{number}']), PLUMB_BOB,
                       (), path)


def _view_of(p: list[float]) -> list[float]:
    """Return fx, fy, cx, cy of P (12,); its last column is the distance to the first camera."""
    return [p[0], p[5], p[2], p[6]]


def _kitti_either(lines: Lines, number: str, raw: Callable[[], Camera],
                  rectified: Callable[[], Camera]) -> Read:
    def of(size: tuple[int, int]) -> Camera:
        return (rectified if list(size) == lines[f'S_rect_{number}'] else raw)()
    return Sizeless(of, f'write rect_{number} for rectified pictures, raw_{number} for others')


def nuscenes(data: Any, path: Path) -> Cameras:
    """Return the cameras of calibrated_sensor.json, by token; and by channel.

    sensor.json beside it has the channels; where cars differ, CAM_FRONT/1, CAM_FRONT/2 ...
    """
    records = {str(each.get('token', number)): each
               for number, each in enumerate(data if isinstance(data, list) else [])
               if isinstance(each, dict) and each.get('camera_intrinsic')}
    if not records:
        return {}
    channels: dict[str, dict[str, str]] = {}
    with suppress(InputError, OSError, KeyError, TypeError):
        place = path.parent / 'sensor.json'
        names = {each['token']: each['channel']
                 for each in parse_json(read_text(place, JSON_BYTES), str(place))}
        for token, each in records.items():
            channels.setdefault(names[each['sensor_token']], {}).setdefault(
                str(each['camera_intrinsic']), token)
    named = {str(name) if len(cars) == 1 else f'{name}/{number}': token
             for name, cars in channels.items() for number, token in enumerate(cars.values(), 1)}
    return {name: partial(_nuscenes, records[token], path)
            for name, token in (*named.items(), *((token, token) for token in records))}


def _nuscenes(data: Data, path: Path) -> Sizeless:
    return pinhole(focal_and_centre(read_matrix(data, 'camera_intrinsic', path)), path)


def argoverse(data: Any, path: Path) -> Cameras:
    """Return the cameras of vehicle_calibration_info.json, or of intrinsics.feather's rows."""
    if isinstance(data, dict) and isinstance(data.get(ARGOVERSE), list):
        return {str(each['key']).removeprefix('image_raw_'): partial(_argoverse, each['value'],
                                                                     path)
                for each in data[ARGOVERSE] if isinstance(each, dict)
                and isinstance(each.get('value'), dict) and 'key' in each}
    return {str(row['sensor_name']): partial(_argoverse2, row, path)
            for row in (data if isinstance(data, list) else [])
            if isinstance(row, dict) and {'sensor_name', 'fx_px', 'width_px'} <= row.keys()}


def _argoverse(data: Data, path: Path) -> Sizeless:
    view = [read_number(data, f'focal_{what}_{axis}_px_', path)
            for what in ('length', 'center') for axis in 'xy']
    if read_number(data, 'skew_', path, 0.0):
        raise InputError('E-CAMERA-SKEW', f'{path} has a skew, which no supported model has: '
                                          f'calibrate without it')
    return pinhole(view, path)


def _argoverse2(data: Data, path: Path) -> Camera:
    return camera_with((data['width_px'], data.get('height_px')),
                       [read_number(data, f'{key}_px', path) for key in ('fx', 'fy', 'cx', 'cy')],
                       PLUMB_BOB, (), path)


def waymo(data: Any, path: Path) -> Cameras:
    """Return the cameras of CameraCalibration as JSON, one or a list, or of rows of a table."""
    if isinstance(data, dict):
        inside = data.get('cameraCalibrations', data.get('camera_calibrations', [data]))
    else:
        inside = data
    rows = [{PREFIX.sub('', str(key)): value for key, value in each.items()}
            for each in (inside if isinstance(inside, list) else []) if isinstance(each, dict)]
    found = {}
    for row in rows:
        if 'intrinsic.f_u' in row:
            row['intrinsic'] = [row.get(f'intrinsic.{name}') for name in WAYMO]
        values = row.get('intrinsic')
        # a matrix has 0 at the second place
        if isinstance(values, list) and len(values) == len(WAYMO) and values[1]:
            name = row.get('name', row.get('camera_name', ''))
            known = isinstance(name, int) and name < len(WAYMO_NAMES)
            found[WAYMO_NAMES[name] if known else str(name)] = partial(_waymo, row, path)
    return found


def _waymo(data: Data, path: Path) -> Camera | Sizeless:
    values = read_numbers(data['intrinsic'], 'intrinsic', path, len(WAYMO))
    if data.get('width') is None:
        return Sizeless(lambda size: camera_with(size, values[:4], PLUMB_BOB, values[4:], path))
    return camera_with((data['width'], data.get('height')), values[:4], PLUMB_BOB, values[4:],
                       path)


def cityscapes(data: Any, path: Path) -> Cameras:
    """Return the left camera of a _camera.json."""
    known = (isinstance(data, dict) and data.keys() == set(CITYSCAPES)
             and all(isinstance(data[key], dict) for key in CITYSCAPES)
             and 'baseline' in data['extrinsic'])
    return {'': partial(_cityscapes, data['intrinsic'], path)} if known else {}


def _cityscapes(data: Data, path: Path) -> Camera:
    return camera_with(CITYSCAPES_SIZE, [read_number(data, key, path)
                                         for key in ('fx', 'fy', 'u0', 'v0')], PLUMB_BOB, (), path)


def a2d2(data: Any, path: Path) -> Cameras:
    """Return the cameras of cams_lidars.json: of the pictures as they are, and undistorted."""
    inside = data.get('cameras') if isinstance(data, dict) else None
    known = {str(name): each for name, each in (inside.items() if isinstance(inside, dict) else ())
             if isinstance(each, dict) and 'CamMatrixOriginal' in each}
    return {**{name: partial(_a2d2, each, path) for name, each in known.items()},
            **{f'{name}/undistorted': partial(_a2d2_undistorted, each, path)
               for name, each in known.items()}}


def _a2d2(data: Data, path: Path) -> Camera:
    kind = distortion_model(LENSES, data.get('Lens'), 'the Lens', path)
    return camera_with(read_pair(data, 'Resolution', path),
                       focal_and_centre(read_matrix(data, 'CamMatrixOriginal', path)), kind,
                       read_numbers(data.get('Distortion'), 'Distortion', path), path)


def _a2d2_undistorted(data: Data, path: Path) -> Camera:
    return camera_with(read_pair(data, 'Resolution', path),
                       focal_and_centre(read_matrix(data, 'CamMatrix', path)), PLUMB_BOB, (), path)


def comma(text: str, path: Path) -> Cameras:
    """Return the cameras of openpilot's common/transformations/camera.py: nominal ones.

    Its intrinsics are of the view frame, whose axes are ROS's: x right, y down, z ahead.
    """
    found: dict[str, partial[Camera]] = {}
    for line in re.finditer(r'^(\w+) *= *(?:\w+\()?(CameraConfig\(.*)$', text, re.MULTILINE):
        for number, each in enumerate(re.findall(
                r'CameraConfig\(([\d. /*]+),([\d. /*]+),([\d. /*]+)\)', line[2])):
            name = line[1].strip('_')
            found[name if not number else f'{name}/{number + 1}'] = partial(_comma, each, path)
    return found


def _comma(texts: tuple[str, str, str], path: Path) -> Camera:
    width, height, focal = map(_product, texts)
    return camera_with((width, height), [focal, focal, width / 2, height / 2], PLUMB_BOB, (), path)


def _product(text: str) -> float:
    """Return the value of a number, or of numbers with * and / between them."""
    first, *more = re.findall(r'//|[*/]|\d+(?:\.\d*)?', text)
    pairs = zip(more[::2], more[1::2], strict=True)
    return float(reduce(lambda value, each: (
        value * float(each[1]) if each[0] == '*' else
        value // float(each[1]) if each[0] == '//' else value / float(each[1])),
        pairs, float(first)))


def vipe(data: Any, path: Path) -> Cameras:
    """Return the camera of ViPE's intrinsics/NAME.npz, whose frames must have the same one."""
    known = isinstance(data, dict) and {'data', 'inds'} <= data.keys() and not data.keys() - {
        'data', 'inds'}
    return {'': partial(_vipe, data['data'], path)} if known else {}


def _vipe(rows: Any, path: Path) -> Sizeless:
    names = path.with_name(f'{path.stem}_camera.txt')
    with suppress(FileNotFoundError):
        for line in read_text(names, JSON_BYTES).splitlines() if names.exists() else ():
            distortion_model({'PINHOLE': PLUMB_BOB}, line.rpartition(':')[2].strip(),
                             'the camera', names)
    if not rows or any(row != rows[0] for row in rows):
        raise InputError('E-CALIBRATION-VARIES',
                         f'{path} has another camera for each frame; run ViPE with intrinsics '
                         f'that are the same for all')
    return pinhole(read_numbers(rows[0], 'data', path, 4), path)
