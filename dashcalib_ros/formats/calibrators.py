# SPDX-License-Identifier: Apache-2.0
"""The camera files of calibration programs: Kalibr, MATLAB, mrcal, and Gyroflow's lens profiles.

Of Kalibr the camchain.yaml, which OpenVINS has for cv2.FileStorage. MATLAB's cameraParameters and
cameraIntrinsics are JSON, of jsonencode(toStruct(parameters)); it counts pixels from (1, 1), and
its older IntrinsicMatrix is the transpose of K. mrcal's .cameramodel is a Python literal. Without
coefficients each model of Gyroflow is a pinhole.
"""
from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dashcalib_ros.camera import NO_DISTORTION, Camera, ros_faults
from dashcalib_ros.camera.other import (
    OtherLens,
    Places,
    bent,
    double_sphere,
    extended_unified,
    field_of_view,
    omni,
    polynomial,
    undone,
)
from dashcalib_ros.errors import ConfigError, InputError, shortened
from dashcalib_ros.formats.ros import Indented
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    Data,
    Placed,
    camera_with,
    distortion_model,
    focal_and_centre,
    is_fisheye,
    named_coefficients,
    pinhole_only,
    read_number,
    read_numbers,
    read_pair,
    read_size,
    with_lenses,
)
from dashcalib_ros.judge.difference import NamedCamera

KALIBR_KEY = 'distortion_coeffs'
PINHOLE, OMNI, DS, EUCM, FOV = 'pinhole', 'omni', 'ds', 'eucm', 'fov'
# what comes before fx, fy, cx, cy
FIRST = {PINHOLE: 0, OMNI: 1, DS: 2, EUCM: 2}
LIFTS: Mapping[str, Callable[..., Places]] = {
    OMNI: omni, DS: double_sphere, EUCM: extended_unified}
KALIBR_MODELS = {'radtan': PLUMB_BOB, 'equidistant': EQUIDISTANT, 'equi': EQUIDISTANT,
                 **dict.fromkeys(NO_DISTORTION, PLUMB_BOB)}
# of a fisheye: a0, a2, a3, a4
MAPPING = 'MappingCoefficients'
MRCAL_MODELS = {'LENSMODEL_PINHOLE': PLUMB_BOB, 'LENSMODEL_OPENCV4': PLUMB_BOB,
                'LENSMODEL_OPENCV5': PLUMB_BOB, 'LENSMODEL_OPENCV8': RATIONAL,
                'LENSMODEL_OPENCV12': RATIONAL}
GYROFLOW_FISHEYE, GYROFLOW_STANDARD = 'opencv_fisheye', 'opencv_standard'
GYROFLOW_MODELS = {GYROFLOW_FISHEYE: EQUIDISTANT, GYROFLOW_STANDARD: RATIONAL}
# what else a lens profile may do with a picture
GYROFLOW_MORE = ('digital_lens', 'crop', 'input_horizontal_stretch', 'input_vertical_stretch',
                 'interpolations')
# the sign of the readout time of rows; by columns it is not known here
GYROFLOW_DIRECTIONS = {'TopToBottom': 1, 'BottomToTop': -1}


def kalibr(data: Any, path: Path) -> Cameras:
    """Return the cameras of a camchain, or of a part with one camera; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    if KALIBR_KEY in data:
        return {'': partial(_kalibr, data, path)}
    return {str(name): partial(_kalibr, each, path) for name, each in data.items()
            if isinstance(each, dict) and KALIBR_KEY in each}


def kalibr_results(text: str, path: Path) -> Cameras:
    """Refuse the text of results that Kalibr writes beside a camchain; see formats/table.py."""
    if re.search(r'^\s*projection: \[.*\+-', text, re.MULTILINE):
        raise InputError('E-KALIBR-RESULTS',
                         f'{path} has the results of Kalibr in words, without the size of the '
                         f'pictures; use the camchain YAML that Kalibr wrote beside it')
    return {}


def _kalibr(data: Data, path: Path) -> Camera | OtherLens:
    model = data.get('camera_model', PINHOLE)
    if model not in FIRST:
        raise InputError('E-LENS-MODEL',
                         f'{path} has the camera model {shortened(repr(model))}; '
                         f'calibrate with --models pinhole-radtan, or pinhole-equi')
    size, d = read_pair(data, 'resolution', path), read_numbers(data[KALIBR_KEY], KALIBR_KEY, path)
    values = read_numbers(data.get('intrinsics'), 'intrinsics', path, 4 + FIRST[model])
    first, view, name = values[:-4], values[-4:], data.get('distortion_model')
    if model == PINHOLE and name == FOV:
        return OtherLens(FOV, read_size(*size, path=path), view, field_of_view(*d[:1] or [0.0]))
    kind = distortion_model(KALIBR_MODELS, name, 'the distortion model', path)
    if model == PINHOLE:
        return camera_with(size, view, kind, d, path)
    if any(d) and kind != PLUMB_BOB:
        raise InputError('E-LENS-MODEL',
                         f'{path} has {model} with {name}, which Kalibr does not calibrate; use '
                         f'its own file')
    return OtherLens(model, read_size(*size, path=path), view,
                     undone(bent(d[:2], (d[2], d[3])), LIFTS[model](*first)) if any(d) else
                     LIFTS[model](*first))


def write_kalibr(found: NamedCamera) -> str:
    """Return a camchain.yaml with one camera. Raises ConfigError."""
    return str(yaml.safe_dump({'cam0': _kalibr_content(found.camera)}, sort_keys=False,
                              default_flow_style=None))


def write_openvins(found: NamedCamera) -> str:
    """Return OpenVINS's kalibr_imucam_chain.yaml, whose T_imu_cam is to be set.

    Raises ConfigError.
    """
    pose = [[float(row == column) for column in range(4)] for row in range(4)]
    content = yaml.dump({'cam0': {'T_imu_cam': pose, **_kalibr_content(found.camera)}},
                        Dumper=Indented, sort_keys=False, default_flow_style=None, width=2**20)
    return f'%YAML:1.0\n---\n{content}'


def write_kalibr_rig(rig: Sequence[Placed]) -> str:
    """Return a camchain.yaml of the cameras of a rig. Raises ConfigError."""
    cameras, last, head = {}, np.eye(4), '# T_cn_cnm1: from the camera before\n'
    for number, (each, camera) in enumerate(with_lenses(rig, 'kalibr')):
        content = _kalibr_content(camera, f'/{each.name}/image_raw')
        if number:
            content['T_cn_cnm1'] = (each.pose @ np.linalg.inv(last)).tolist()
        if each.translation_m is None:
            head += f'# {each.name}: no metres are known, 0 is written\n'
        cameras[f'cam{number}'], last = content, each.pose
    return head + str(yaml.safe_dump(cameras, sort_keys=False, default_flow_style=None))


def _kalibr_content(camera: Camera, topic: str = '/image_raw') -> dict[str, Any]:
    return {
        'camera_model': 'pinhole',
        'intrinsics': [camera.fx, camera.fy, camera.cx, camera.cy],
        'distortion_model': 'equidistant' if is_fisheye(camera) else 'radtan',
        'distortion_coeffs': list(named_coefficients(camera, 4, 'kalibr').values()),
        'resolution': list(camera.image_size),
        'rostopic': topic}


def matlab(data: Any, path: Path) -> Cameras:
    """Return the camera of a struct of MATLAB; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    data = data['Intrinsics'] if isinstance(data.get('Intrinsics'), dict) else data
    known = 'ImageSize' in data and {'RadialDistortion', MAPPING} & data.keys()
    return {'': partial(_matlab, data, path)} if known else {}


def _matlab(data: Data, path: Path) -> Camera | OtherLens:
    size = read_pair(data, 'ImageSize', path)[::-1]
    if MAPPING in data:
        return _matlab_fisheye(data, size, path)
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


def _matlab_fisheye(data: Data, size: list[Any], path: Path) -> OtherLens:
    a0, *more = read_numbers(data[MAPPING], MAPPING, path, 4)
    cx, cy = read_numbers(data.get('DistortionCenter'), 'DistortionCenter', path, 2)
    stretch = read_numbers(data.get('StretchMatrix', [1, 0, 0, 1]), 'StretchMatrix', path, 4)
    if stretch != [1, 0, 0, 1]:
        raise InputError('E-CAMERA-SKEW', f'{path} has a StretchMatrix that is not the identity; '
                                          f'calibrate without EstimateAlignment')
    return OtherLens('Scaramuzza', read_size(*size, path=path), [1, 1, cx - 1, cy - 1],
                     polynomial([a0, 0, *more]))


def write_matlab(found: NamedCamera) -> str:
    """Return a struct that cameraIntrinsics() and cameraParameters() take. Raises ConfigError."""
    camera, (width, height) = pinhole_only(found.camera, 'matlab'), found.image_size
    k1, k2, p1, p2, k3 = named_coefficients(camera, 5, 'matlab').values()
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx + 1, camera.cy + 1
    return json.dumps({
        'ImageSize': [height, width], 'FocalLength': [fx, fy], 'PrincipalPoint': [cx, cy],
        'Skew': 0, 'RadialDistortion': [k1, k2, k3], 'TangentialDistortion': [p1, p2],
        'IntrinsicMatrix': [[fx, 0, 0], [0, fy, 0], [cx, cy, 1]],
        'K': [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]}, indent=2) + '\n'


def mrcal(text: str, path: Path) -> Cameras:
    """Return the camera of a .cameramodel; see formats/table.py."""
    known = re.search(r'''["']lensmodel["']\s*:''', text)
    return {'': partial(_mrcal, text, path)} if known else {}


def _mrcal(text: str, path: Path) -> Camera:
    try:
        data = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise InputError('E-CAMERAMODEL',
                         f'{path} is no .cameramodel that can be read; write it again') from error
    kind = distortion_model(MRCAL_MODELS, data.get('lensmodel'), 'the lensmodel', path)
    values = read_numbers(data.get('intrinsics'), 'intrinsics', path)
    if len(values) < 4:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path}: intrinsics must have 4 numbers or more')
    return camera_with(read_pair(data, 'imagersize', path), values[:4], kind, values[4:], path)


def write_mrcal(found: NamedCamera) -> str:
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


def gyroflow(data: Any, path: Path) -> Cameras:
    """Return the camera of a profile of Gyroflow, or of a project, which has it inside.

    See formats/table.py.
    """
    if not isinstance(data, dict):
        return {}
    inside = data.get('calibration_data')
    data = inside if isinstance(inside, dict) else data
    return {'': partial(_gyroflow, data, path)} if 'calib_dimension' in data else {}


def _gyroflow(data: Data, path: Path) -> NamedCamera:
    more = [key for key in GYROFLOW_MORE if data.get(key) not in (None, 0, 1, '', [], {})]
    if more:
        raise InputError('E-LENS-PROFILE',
                         f'{path} has {more[0]} = {shortened(repr(data[more[0]]))}, which is not '
                         f'supported; use a profile of pictures as the lens shows them')
    # the first profiles had no model's name, and a place for each
    standard = data.get('use_opencv_standard') is True and not data.get('use_opencv_fisheye')
    named = data.get('distortion_model')
    usual = GYROFLOW_STANDARD if standard else GYROFLOW_FISHEYE
    kind = distortion_model(GYROFLOW_MODELS, named or usual, 'the distortion_model', path)
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
        sign = GYROFLOW_DIRECTIONS.get(str(data['frame_readout_direction']))
        readout_ms = None if sign is None else sign * abs(readout_ms)
    camera = camera_with((size.get('w'), size.get('h')), focal_and_centre(k),
                         kind if any(d) else PLUMB_BOB, d, path)
    # 0 is what it has where nobody has measured it
    return NamedCamera(str(path), camera, readout_ms=readout_ms or None,
                       faults=ros_faults(camera, k))


def write_gyroflow(found: NamedCamera) -> str:
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
        'distortion_model': GYROFLOW_FISHEYE if is_fisheye(camera) else GYROFLOW_STANDARD,
        'use_opencv_fisheye': is_fisheye(camera),
        'fisheye_params': {'camera_matrix': camera.matrix.tolist(),
                           'distortion_coeffs': list(d)}}, indent=2) + '\n'
