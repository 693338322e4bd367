# SPDX-License-Identifier: Apache-2.0
"""mrcal's .cameramodel, a Python literal."""
from __future__ import annotations

import ast
import re
from functools import partial
from pathlib import Path

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    camera_with,
    distortion_model,
    is_fisheye,
    read_numbers,
    read_pair,
)
from dashcalib_ros.judge.difference import NamedCamera

MODELS = {'LENSMODEL_PINHOLE': PLUMB_BOB, 'LENSMODEL_OPENCV4': PLUMB_BOB,
          'LENSMODEL_OPENCV5': PLUMB_BOB, 'LENSMODEL_OPENCV8': RATIONAL,
          'LENSMODEL_OPENCV12': RATIONAL}


def cameras(text: str, path: Path) -> Cameras:
    """Return the camera of a .cameramodel; see formats/table.py."""
    known = re.search(r'''["']lensmodel["']\s*:''', text)
    return {'': partial(_read, text, path)} if known else {}


def _read(text: str, path: Path) -> Camera:
    try:
        data = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise InputError('E-CAMERAMODEL',
                         f'{path} is no .cameramodel that can be read; write it again') from error
    kind = distortion_model(MODELS, data.get('lensmodel'), 'the lensmodel', path)
    values = read_numbers(data.get('intrinsics'), 'intrinsics', path)
    if len(values) < 4:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path}: intrinsics must have 4 numbers or more')
    return camera_with(read_pair(data, 'imagersize', path), values[:4], kind, values[4:], path)


def write(found: NamedCamera) -> str:
    """Return a .cameramodel: the splined one for a fisheye, which it has not, and a field.

    Raises OutputError where no spline is exact enough.
    """
    camera = found.camera
    if found.field is None and not is_fisheye(camera):
        d = camera.ros_distortion()
        name, lens = f'LENSMODEL_OPENCV{len(d)}', np.array([*camera.params[:4], *d])
    else:
        # it takes half a second to load
        from dashcalib_ros.formats.mrcal_spline import splined_lens
        name, lens = splined_lens(camera, found.field)
    values = ', '.join(repr(float(value)) for value in lens)
    width, height = camera.image_size
    return (f"{{\n    'lensmodel':  '{name}',\n"
            f"    'intrinsics': [ {values} ],\n"
            f"    'extrinsics': [ 0, 0, 0, 0, 0, 0 ],\n"
            f"    'imagersize': [ {width}, {height} ],\n}}\n")
