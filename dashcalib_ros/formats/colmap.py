# SPDX-License-Identifier: Apache-2.0
"""COLMAP's cameras.txt and cameras.bin. It counts pixels from the first one's corner."""
from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.camera import HALF_PIXEL
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    camera_with,
    distortion_model,
    read_numbers,
)
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.limits import JSON_BYTES, read_file

# by their number: name, focal lengths, our distortion model, coefficients; None where no model
# here is the same
MODELS = (('SIMPLE_PINHOLE', 1, PLUMB_BOB, 0), ('PINHOLE', 2, PLUMB_BOB, 0),
          ('SIMPLE_RADIAL', 1, PLUMB_BOB, 1), ('RADIAL', 1, PLUMB_BOB, 2),
          ('OPENCV', 2, PLUMB_BOB, 4), ('OPENCV_FISHEYE', 2, EQUIDISTANT, 4),
          ('FULL_OPENCV', 2, RATIONAL, 8), ('FOV', 2, None, 1),
          ('SIMPLE_RADIAL_FISHEYE', 1, EQUIDISTANT, 1), ('RADIAL_FISHEYE', 1, EQUIDISTANT, 2),
          ('THIN_PRISM_FISHEYE', 2, None, 8))
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
    found: dict[str, Callable[[], Camera]] = {}
    try:
        for _ in range(struct.unpack_from('<Q', data)[0]):
            number, model, *size = struct.unpack_from('<iiQQ', data, at)
            name, focals, _, count = MODELS[model]
            params = struct.unpack_from(f'<{focals + 2 + count}d', data, at + 24)
            found[str(number)] = partial(_read, (name, *size, *params), path)
            at += 24 + 8 * len(params)
    except (struct.error, IndexError) as error:
        raise InputError('E-COLMAP-BINARY',
                         f'{path} is no cameras.bin that can be read; convert it (colmap '
                         f'model_converter --output_type TXT)') from error
    return found


def _read(values: Sequence[Any], path: Path) -> Camera:
    """Return the camera of a line without its number: model, width, height, parameters."""
    if len(values) < 3:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path} has a line without model, width and height; write it again')
    model, *size = values[:3]
    kind = distortion_model({name: kind for name, _, kind, _ in MODELS if kind}, model,
                            'the model', path)
    focals, count = next((each[1], each[3]) for each in MODELS if each[0] == model)
    params = read_numbers(list(values[3:]), model, path)
    if len(params) != focals + 2 + count:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path}: a {model} has {focals + 2 + count} parameters, not '
                         f'{len(params)}; write it again')
    cx, cy = (value - HALF_PIXEL for value in params[focals:focals + 2])
    return camera_with([int(side) if str(side).isdecimal() else side for side in size],
                       [params[0], params[focals - 1], cx, cy], kind, params[focals + 2:], path)


def write(found: NamedCamera) -> str:
    """Return a cameras.txt."""
    camera, (width, height) = found.camera, found.image_size
    values = ' '.join(repr(float(value)) for value in camera.colmap.values(camera.params))
    return f'{HEAD}1 {camera.colmap.name} {width} {height} {values}\n'
