# SPDX-License-Identifier: Apache-2.0
"""Gyroflow's lens profile. Without coefficients each of its models is a pinhole."""
from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import ros_faults
from dashcalib_ros.errors import ConfigError, InputError, shortened
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    Data,
    camera_with,
    distortion_model,
    focal_and_centre,
    is_fisheye,
    read_number,
    read_numbers,
)
from dashcalib_ros.judge.difference import NamedCamera

FISHEYE, STANDARD = 'opencv_fisheye', 'opencv_standard'
MODELS = {FISHEYE: EQUIDISTANT, STANDARD: RATIONAL}
# what else a lens profile may do with a picture
MORE = ('digital_lens', 'crop', 'input_horizontal_stretch', 'input_vertical_stretch',
        'interpolations')
# the sign of the readout time of rows; by columns it is not known here
DIRECTIONS = {'TopToBottom': 1, 'BottomToTop': -1}


def cameras(data: Any, path: Path) -> Cameras:
    """Return the camera of a profile, or of a project, which has it inside.

    See formats/table.py.
    """
    if not isinstance(data, dict):
        return {}
    inside = data.get('calibration_data')
    data = inside if isinstance(inside, dict) else data
    return {'': partial(_read, data, path)} if 'calib_dimension' in data else {}


def _read(data: Data, path: Path) -> NamedCamera:
    more = [key for key in MORE if data.get(key) not in (None, 0, 1, '', [], {})]
    if more:
        raise InputError('E-LENS-PROFILE',
                         f'{path} has {more[0]} = {shortened(repr(data[more[0]]))}, which is not '
                         f'supported; use a profile of pictures as the lens shows them')
    # the first profiles had no model's name, and a place for each
    standard = data.get('use_opencv_standard') is True and not data.get('use_opencv_fisheye')
    named = data.get('distortion_model')
    kind = distortion_model(MODELS, named or (STANDARD if standard else FISHEYE),
                            'the distortion_model', path)
    key = 'calib_params' if standard and not named else 'fisheye_params'
    lens, size = data.get(key), data['calib_dimension']
    if not isinstance(lens, dict) or not isinstance(size, dict):
        raise InputError('E-CALIBRATION-MISSING',
                         f'{path} has no {key} with a camera_matrix, or no calib_dimension with w '
                         f'and h; use a complete profile')
    k = read_numbers(lens.get('camera_matrix'), 'camera_matrix', path, 9)
    d = read_numbers(lens.get('distortion_coeffs'), 'distortion_coeffs', path)
    readout_ms = None if data.get('frame_readout_time') is None else read_number(
        data, 'frame_readout_time', path)
    if readout_ms is not None and data.get('frame_readout_direction'):
        sign = DIRECTIONS.get(str(data['frame_readout_direction']))
        readout_ms = None if sign is None else sign * abs(readout_ms)
    camera = camera_with((size.get('w'), size.get('h')), focal_and_centre(k),
                         kind if any(d) else PLUMB_BOB, d, path)
    # 0 is what it has where nobody has measured it
    return NamedCamera(str(path), camera, readout_ms=readout_ms or None,
                       faults=ros_faults(camera, k))


def write(found: NamedCamera) -> str:
    """Return a lens profile; Gyroflow treats all that it lacks as unknown.

    Raises ConfigError for a fisheye without coefficients.
    """
    camera, readout_ms, (width, height) = found.camera, found.readout_ms, found.image_size
    d = camera.ros_distortion()
    if is_fisheye(camera) and not any(d):
        raise ConfigError('E-EXPORT-FISHEYE-ZERO',
                          'gyroflow reads a fisheye whose coefficients are all 0 as a pinhole; '
                          'calibrate with --model fisheye, or export to opencv')
    size = {'w': width, 'h': height}
    return json.dumps({
        'name': f'dashcam {width}x{height}', 'camera_model': 'dashcam',
        'calibrated_by': 'dashcalib', 'calibrator_version': 'dashcalib',
        'calib_dimension': size, 'orig_dimension': size,
        'frame_readout_time': None if readout_ms is None else abs(readout_ms),
        'frame_readout_direction': None if readout_ms is None else (
            'TopToBottom' if readout_ms >= 0 else 'BottomToTop'),
        'input_horizontal_stretch': 1.0, 'input_vertical_stretch': 1.0,
        # else the principal point is taken to be in the middle
        'asymmetrical': True,
        'distortion_model': FISHEYE if is_fisheye(camera) else STANDARD,
        'use_opencv_fisheye': is_fisheye(camera),
        'fisheye_params': {'camera_matrix': camera.matrix.tolist(),
                           'distortion_coeffs': list(d)}}, indent=2) + '\n'
