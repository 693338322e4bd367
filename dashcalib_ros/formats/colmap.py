# SPDX-License-Identifier: Apache-2.0
"""COLMAP's cameras.txt, cameras.bin and database. It counts pixels from the first one's corner."""
from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.camera import HALF_PIXEL
from dashcalib_ros.camera.other import (
    OtherLens,
    Places,
    angles,
    bent,
    division,
    extended_unified,
    field_of_view,
    undone,
)
from dashcalib_ros.camera.rotation import quaternion
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    Placed,
    Read,
    camera_with,
    distortion_model,
    read_numbers,
    read_size,
    with_lenses,
)
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.limits import JSON_BYTES, check_file, read_file

# by their number: name, focal lengths, our distortion model, coefficients; None where no model
# here is the same
MODELS = (('SIMPLE_PINHOLE', 1, PLUMB_BOB, 0), ('PINHOLE', 2, PLUMB_BOB, 0),
          ('SIMPLE_RADIAL', 1, PLUMB_BOB, 1), ('RADIAL', 1, PLUMB_BOB, 2),
          ('OPENCV', 2, PLUMB_BOB, 4), ('OPENCV_FISHEYE', 2, EQUIDISTANT, 4),
          ('FULL_OPENCV', 2, RATIONAL, 8), ('FOV', 2, None, 1),
          ('SIMPLE_RADIAL_FISHEYE', 1, EQUIDISTANT, 1), ('RADIAL_FISHEYE', 1, EQUIDISTANT, 2),
          ('THIN_PRISM_FISHEYE', 2, None, 8), ('RAD_TAN_THIN_PRISM_FISHEYE', 2, None, 12),
          ('SIMPLE_DIVISION', 1, None, 1), ('DIVISION', 2, None, 1),
          ('SIMPLE_FISHEYE', 1, EQUIDISTANT, 0), ('FISHEYE', 2, EQUIDISTANT, 0),
          ('EUCM', 2, None, 2))
NUMBERED = dict(enumerate(MODELS))
# those that ROS has not; of the thin prisms' k1, k2, p1, p2, k3, k4, sx1, sy1
OTHERS: Mapping[str, Callable[[Sequence[float]], Places]] = {
    'FOV': lambda d: field_of_view(d[0]),
    'THIN_PRISM_FISHEYE': lambda d: undone(bent((*d[:2], *d[4:6]), d[2:4], d[6:]), angles),
    'SIMPLE_DIVISION': lambda d: division(d[0]), 'DIVISION': lambda d: division(d[0]),
    'EUCM': lambda d: extended_unified(*d)}
# of its database: a table that COLMAP completes with the others
TABLE = ('CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, model '
         'INTEGER NOT NULL, width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB, '
         'prior_focal_length INTEGER NOT NULL)')
HEAD = ('# Camera list with one line of data per camera:\n'
        '#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n')


def cameras(text: str, path: Path) -> Cameras:
    """Return the cameras of a cameras.txt; see formats/table.py."""
    lines = [words for line in text.splitlines() if not line.lstrip().startswith('#')
             and (words := line.split())]
    if not lines or not re.match(r'\d+ [A-Z_]+ ', ' '.join(lines[0])):
        return {}
    return {line[0]: partial(_read, line[1:], path) for line in lines}


def binary_cameras(path: Path) -> Cameras:
    """Return the cameras of a cameras.bin. Raises InputError, OSError."""
    data, at = read_file(path, JSON_BYTES), 8
    found: dict[str, Callable[[], Read]] = {}
    try:
        for _ in range(struct.unpack_from('<Q', data)[0]):
            number, model, *size = struct.unpack_from('<iiQQ', data, at)
            name, focals, _, count = NUMBERED[model]
            params = struct.unpack_from(f'<{focals + 2 + count}d', data, at + 24)
            found[str(number)] = partial(_read, (name, *size, *params), path)
            at += 24 + 8 * len(params)
    except (struct.error, KeyError) as error:
        raise InputError('E-COLMAP-BINARY',
                         f'{path} is not a readable cameras.bin; convert it (colmap '
                         f'model_converter --output_type TXT)') from error
    return found


def database_cameras(path: Path) -> Cameras:
    """Return the cameras of a database. Raises InputError, OSError."""
    import apsw

    from dashcalib_ros.input.bag_read import limited
    check_file(path)
    found: dict[str, Callable[[], Read]] = {}
    try:
        with closing(apsw.Connection(f'file:{quote(str(path.absolute()))}?mode=ro&immutable=1',
                                     apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI)) as file:
            limited(file)
            for number, model, *size, params in file.execute(
                    'SELECT camera_id, model, width, height, params FROM cameras LIMIT 10000'):
                values = struct.unpack(f'<{len(params) // 8}d', params)
                found[str(number)] = partial(_read, (NUMBERED[model][0], *size, *values), path)
    except (apsw.Error, struct.error, KeyError, TypeError) as error:
        raise InputError('E-COLMAP-BINARY',
                         f'{path} is not a COLMAP database with readable cameras; export '
                         f'the model (colmap model_converter --output_type TXT)') from error
    return found


def _read(values: Sequence[Any], path: Path) -> Camera | OtherLens:
    if len(values) < 3:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path} has a line without model, width and height; write it again')
    model, *size = values[:3]
    kind = distortion_model({name: kind or '' for name, _, kind, _ in MODELS
                             if kind or name in OTHERS}, model, 'the model', path)
    focals, count = next((each[1], each[3]) for each in MODELS if each[0] == model)
    params = read_numbers(list(values[3:]), model, path)
    if len(params) != focals + 2 + count:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path}: a {model} has {focals + 2 + count} parameters, not '
                         f'{len(params)}; write it again')
    cx, cy = (value - HALF_PIXEL for value in params[focals:focals + 2])
    sides = [int(side) if str(side).isdecimal() else side for side in size]
    view, d = [params[0], params[focals - 1], cx, cy], params[focals + 2:]
    return camera_with(sides, view, kind, d, path) if kind else OtherLens(
        model, read_size(*sides, path=path), view, OTHERS[model](d))


def write(found: NamedCamera) -> str:
    """Return a cameras.txt."""
    camera, (width, height) = found.camera, found.image_size
    values = ' '.join(repr(float(value)) for value in camera.colmap.values(camera.params))
    return f'{HEAD}1 {camera.colmap.name} {width} {height} {values}\n'


def write_rig(rig: Sequence[Placed]) -> str:
    """Return a rig_config.json, for rig_configurator: a folder of images for each camera.

    A camera without metres has no pose in it: COLMAP finds that. Raises ConfigError.
    """
    found = with_lenses(rig, 'colmap')
    first, cameras = np.linalg.inv(found[0][0].pose), []
    for number, (each, camera) in enumerate(found):
        values: dict[str, Any] = {
            'image_prefix': f'{each.name}/', 'camera_model_name': camera.colmap.name,
            'camera_params': [float(value) for value in camera.colmap.values(camera.params)]}
        if not number:
            values['ref_sensor'] = True
        elif each.translation_m is not None and found[0][0].translation_m is not None:
            pose = each.pose @ first
            x, y, z, w = quaternion(pose[:3, :3])
            values |= {'cam_from_rig_rotation': [w, x, y, z],
                       'cam_from_rig_translation': pose[:3, 3].tolist()}
        cameras.append(values)
    return json.dumps([{'cameras': cameras}], indent=2) + '\n'


def write_database(found: NamedCamera) -> bytes:
    """Return a database with the camera as number 1, for --ImageReader.existing_camera_id 1."""
    import apsw
    camera, (width, height) = found.camera, found.image_size
    values = camera.colmap.values(camera.params)
    number = next(number for number, each in enumerate(MODELS) if each[0] == camera.colmap.name)
    database = apsw.Connection(':memory:')
    database.execute(TABLE)
    database.execute('INSERT INTO cameras VALUES (1, ?, ?, ?, ?, 1)',
                     (number, width, height, struct.pack(f'<{len(values)}d', *values)))
    return bytes(database.serialize('main'))
