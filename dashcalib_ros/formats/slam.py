# SPDX-License-Identifier: Apache-2.0
"""The camera files of SLAM programs: ORB-SLAM, VINS, stella_vslam, SVO and DROID-SLAM."""
from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import yaml

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.other import OtherLens, bent, division, field_of_view, omni, undone
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    Data,
    Sizeless,
    camera_with,
    distortion_model,
    is_fisheye,
    named_coefficients,
    numbers_in,
    pinhole_only,
    read_coefficients,
    read_number,
    read_numbers,
    read_size,
)
from dashcalib_ros.judge.difference import NamedCamera

VIEW = ('fx', 'fy', 'cx', 'cy')
# of each program: its lenses, and ROS's distortion model for them; '' where ROS has none
ORBSLAM_PINHOLE, ORBSLAM_FISHEYE = 'PinHole', 'KannalaBrandt8'
ORBSLAM = {ORBSLAM_PINHOLE: PLUMB_BOB, 'Rectified': PLUMB_BOB, ORBSLAM_FISHEYE: EQUIDISTANT}
ORBSLAM_NAMES = ('Camera1', 'Camera2', 'Camera')
MEI, VINS_FISHEYE = 'MEI', 'KANNALA_BRANDT'
VINS = {'PINHOLE': PLUMB_BOB, 'PINHOLE_FULL': RATIONAL, VINS_FISHEYE: EQUIDISTANT, MEI: ''}
# of a fisheye, whose k1 is 1; and of Mei's model, whose focal lengths are gamma
FISHEYE_VIEW, FISHEYE_D = ('mu', 'mv', 'u0', 'v0'), ('k2', 'k3', 'k4', 'k5')
MEI_VIEW = ('gamma1', 'gamma2', 'u0', 'v0')
DIVISION = 'radial_division'
STELLA = {'perspective': PLUMB_BOB, 'fisheye': EQUIDISTANT, DIVISION: ''}
SVO = {'none': PLUMB_BOB, 'radial-tangential': PLUMB_BOB, 'equidistant': EQUIDISTANT,
       'fisheye': ''}
ATAN = 'ATAN'
VIKIT = {'Pinhole': PLUMB_BOB, 'PinholeRadialTangential': PLUMB_BOB,
         'PinholeEquidistant': EQUIDISTANT, ATAN: ''}
# how many coefficients DROID-SLAM passes to cv2.undistort
DROID_COUNTS = (0, 4, 5, 8)


def _view(data: Data, path: Path, names: tuple[str, ...] = VIEW, before: str = '') -> list[float]:
    return [read_number(data, f'{before}{name}', path) for name in names]


def orbslam(data: Any, path: Path) -> Cameras:
    """Return the cameras of ORB-SLAM3's settings, or ORB-SLAM2's, which have no size.

    A file for cv2.FileStorage, whose names have dots in them: Camera1.fx. See formats/table.py.
    """
    return {name: partial(_orbslam, data, name, path) for name in ORBSLAM_NAMES
            if isinstance(data, dict) and f'{name}.fx' in data}


def _orbslam(data: Data, name: str, path: Path) -> Camera | Sizeless:
    kind = distortion_model(ORBSLAM, data.get('Camera.type', ORBSLAM_PINHOLE), 'the Camera.type',
                            path)
    view = _view(data, path, before=f'{name}.')
    own = {str(key).removeprefix(f'{name}.'): value for key, value in data.items()}
    d = read_coefficients(own, kind, path)
    if 'Camera.width' not in data:
        return Sizeless(lambda size: camera_with(size, view, kind, d, path))
    return camera_with((data['Camera.width'], data.get('Camera.height')), view, kind, d, path)


def write_orbslam(found: NamedCamera) -> str:
    """Return the camera's part of ORB-SLAM3's settings. Raises ConfigError."""
    camera, (width, height) = found.camera, found.image_size
    values = {'fx': camera.fx, 'fy': camera.fy, 'cx': camera.cx, 'cy': camera.cy,
              **named_coefficients(camera, 5, 'orbslam')}
    lines = '\n'.join(f'Camera1.{key}: {float(value)!r}' for key, value in values.items())
    return (f'%YAML:1.0\n---\nFile.version: "1.0"\n'
            f'Camera.type: "{ORBSLAM_FISHEYE if is_fisheye(camera) else ORBSLAM_PINHOLE}"\n'
            f'{lines}\nCamera.width: {width}\nCamera.height: {height}\n')


def vins(data: Any, path: Path) -> Cameras:
    """Return the camera of VINS-Fusion or VINS-Mono: camodocal's file; see formats/table.py."""
    known = isinstance(data, dict) and {'model_type', 'projection_parameters'} <= data.keys()
    return {'': partial(_vins, data, path)} if known else {}


def _vins(data: Data, path: Path) -> Camera | OtherLens:
    kind = distortion_model(VINS, data['model_type'], 'the model_type', path)
    size = read_size(data.get('image_width'), data.get('image_height'), path=path)
    view, lens, mirror = (_part(data, f'{name}_parameters', path)
                          for name in ('projection', 'distortion', 'mirror'))
    if data['model_type'] == VINS_FISHEYE:
        return camera_with(size, _view(view, path, FISHEYE_VIEW), kind,
                           _view(view, path, FISHEYE_D), path)
    if data['model_type'] == MEI:
        return OtherLens(MEI, size, _view(view, path, MEI_VIEW), undone(
            bent(_view(lens, path, ('k1', 'k2')), _view(lens, path, ('p1', 'p2'))),
            omni(read_number(mirror, 'xi', path))))
    return camera_with(size, _view(view, path), kind, read_coefficients(lens, kind, path), path)


def _part(data: Data, key: str, path: Path) -> Data:
    part = data.get(key, {})
    if not isinstance(part, dict):
        raise InputError('E-CALIBRATION-MISSING',
                         f'{path}: {key} has no values by name; use a complete calibration')
    return part


def write_vins(found: NamedCamera) -> str:
    """Return a camera file. Raises nothing: camodocal has all of our lenses."""
    camera, (width, height) = found.camera, found.image_size
    named = named_coefficients(camera, 8, 'vins')
    view = (camera.fx, camera.fy, camera.cx, camera.cy)
    if is_fisheye(camera):
        model, lens = VINS_FISHEYE, {}
        projection = dict(zip((*FISHEYE_D, *FISHEYE_VIEW), (*named.values(), *view), strict=True))
    else:
        full = any(list(named.values())[4:])
        model = 'PINHOLE_FULL' if full else 'PINHOLE'
        lens = dict.fromkeys(('k1', 'k2', 'k3', 'k4', 'k5', 'k6', 'p1', 'p2') if full
                             else ('k1', 'k2', 'p1', 'p2'), 0.0)
        lens |= {key: value for key, value in named.items() if key in lens}
        projection = dict(zip(VIEW, view, strict=True))
    blocks = ''.join(
        f'{name}_parameters:\n' + ''.join(f'   {key}: {float(value)!r}\n'
                                          for key, value in values.items())
        for name, values in (('distortion', lens), ('projection', projection)) if values)
    return (f'%YAML:1.0\n---\nmodel_type: {model}\ncamera_name: camera\n'
            f'image_width: {width}\nimage_height: {height}\n{blocks}')


def stella(data: Any, path: Path) -> Cameras:
    """Return the camera of stella_vslam, or of OpenVSLAM, its ancestor; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    part = data.get('Camera')
    if not isinstance(part, dict):  # OpenVSLAM: Camera.fx
        part = {str(key).removeprefix('Camera.'): value for key, value in data.items()
                if str(key).startswith('Camera.')}
    return {'': partial(_stella, part, path)} if {'model', 'cols', 'rows'} <= part.keys() else {}


def _stella(data: Data, path: Path) -> Camera | OtherLens:
    kind = distortion_model(STELLA, data['model'], 'the Camera model', path)
    size = read_size(data['cols'], data['rows'], path=path)
    view = _view(data, path)
    if data['model'] == DIVISION:
        return OtherLens(DIVISION, size, view, division(read_number(data, 'distortion', path)))
    return camera_with(size, view, kind, read_coefficients(data, kind, path), path)


def write_stella(found: NamedCamera) -> str:
    """Return the camera's part of a configuration. Raises ConfigError."""
    camera, (width, height) = found.camera, found.image_size
    return str(yaml.safe_dump({'Camera': {
        'name': 'dashcam', 'setup': 'monocular',
        'model': 'fisheye' if is_fisheye(camera) else 'perspective',
        'fx': camera.fx, 'fy': camera.fy, 'cx': camera.cx, 'cy': camera.cy,
        **named_coefficients(camera, 5, 'stella'),
        'fps': 30.0, 'cols': width, 'rows': height, 'color_order': 'RGB'}}, sort_keys=False))


def svo(data: Any, path: Path) -> Cameras:
    """Return the cameras of SVO Pro, or of vikit, which SVO has its cameras from.

    See formats/table.py.
    """
    if not isinstance(data, dict):
        return {}
    if isinstance(data.get('cameras'), list):
        found = [each['camera'] for each in data['cameras']
                 if isinstance(each, dict) and isinstance(each.get('camera'), dict)]
        return {str(each.get('label', number)): partial(_svo, each, path)
                for number, each in enumerate(found) if 'intrinsics' in each}
    if 'cam_model' in data:
        return {'': partial(_vikit, data, path)}
    return {str(name): partial(_vikit, each, path) for name, each in data.items()
            if isinstance(each, dict) and 'cam_model' in each}


def _svo(data: Data, path: Path) -> Camera | OtherLens:
    lens = data.get('distortion')
    if data.get('type') != 'pinhole' or not isinstance(lens, dict):
        raise InputError('E-LENS-MODEL',
                         f'{path} has a camera that is not a pinhole with distortion; calibrate '
                         f'it as a pinhole')
    name = lens.get('type')
    kind = distortion_model(SVO, name.strip() if isinstance(name, str) else name,
                            'the distortion', path)
    size = read_size(data.get('image_width'), data.get('image_height'), path=path)
    view = read_numbers(data['intrinsics'], 'intrinsics', path, 4)
    d = [] if name == 'none' else read_numbers(lens.get('parameters'), 'parameters', path)
    return camera_with(size, view, kind, d, path) if kind else OtherLens(
        'FOV', size, view, field_of_view(_only(d, path)))


def _vikit(data: Data, path: Path) -> Camera | OtherLens:
    kind = distortion_model(VIKIT, data['cam_model'], 'the cam_model', path)
    size = read_size(data.get('cam_width'), data.get('cam_height'), path=path)
    view = _view(data, path, before='cam_')
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


def write_svo(found: NamedCamera) -> str:
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


def droid(text: str, path: Path) -> Cameras:
    """Return DROID-SLAM's camera: one line of fx fy cx cy, then OpenCV's coefficients, if any.

    See formats/table.py.
    """
    values = numbers_in(text.replace(',', ' ')) if len(text.split('\n', 2)) < 3 else None
    if values is None or len(values) - 4 not in DROID_COUNTS or 0 in values[:4]:
        return {}
    kind = PLUMB_BOB if len(values) <= 9 else RATIONAL
    return {'': lambda: Sizeless(
        lambda size: camera_with(size, values[:4], kind, values[4:], path))}


def write_droid(found: NamedCamera) -> str:
    """Return the line. Raises ConfigError for a fisheye."""
    camera = pinhole_only(found.camera, 'droid')
    values = (*camera.params[:4], *camera.ros_distortion())
    return ' '.join(repr(float(value)) for value in values) + '\n'
