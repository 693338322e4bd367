"""A camera in the formats of other programs. Each takes pixels and coefficients its own way.

COLMAP and nerfstudio count pixels from the first one's corner: its centre is at (0.5, 0.5).
OpenSfM counts from the picture's middle, in units of its longer side. The rest counts as ROS and
OpenCV do.
"""
from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import yaml

from dashcalib_ros.camera import Camera, Fisheye
from dashcalib_ros.camera.camera import HALF_PIXEL
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.report.camera_yaml import camera_info_yaml

# a resized picture's columns and rows may round differently by so much
ROUNDING_PX = 1.0


def exported(camera: Camera, kind: str) -> str:
    """Return the text of a camera file of one of EXPORTS.

    Raises ConfigError for a kind that there is not, and for a lens that it cannot describe.
    """
    if kind not in EXPORTS:
        raise ConfigError(f'there is no export to {kind!r}; choose one of {", ".join(EXPORTS)}')
    return EXPORTS[kind](camera)


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the camera of pictures that were resized to (width, height).

    Raises ConfigError where that would stretch them.
    """
    width, height = camera.image_size
    x, y = size[0] / width, size[1] / height
    if abs(size[1] - x * height) > ROUNDING_PX and abs(size[0] - y * width) > ROUNDING_PX:
        raise ConfigError(f'{size[0]}x{size[1]} has another shape than the {width}x{height} of '
                          f'the calibration; was the picture cropped? use --crop')
    return replace(camera, image_size=size, fx=camera.fx * x, fy=camera.fy * y,
                   cx=(camera.cx + HALF_PIXEL) * x - HALF_PIXEL,
                   cy=(camera.cy + HALF_PIXEL) * y - HALF_PIXEL)


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """Return the camera of a part of its pictures. Raises ConfigError where it sticks out."""
    if (min(left, top) < 0 or min(width, height) < 1 or left + width > camera.image_size[0]
            or top + height > camera.image_size[1]):
        whole = 'x'.join(map(str, camera.image_size))
        raise ConfigError(f'{left},{top},{width},{height} is no part of a picture of {whole}; '
                          f'give X,Y,W,H in px, of the corner at the top left and of the part')
    return replace(camera, image_size=(width, height), cx=camera.cx - left, cy=camera.cy - top)


def _opencv(camera: Camera) -> str:
    """Return what cv2.FileStorage writes; a fisheye's D is that of cv2.fisheye."""
    file = cv2.FileStorage('.yaml', cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    width, height = camera.image_size
    file.write('image_width', width)
    file.write('image_height', height)
    file.write('camera_model', 'fisheye' if _is_fisheye(camera) else 'pinhole')
    file.write('camera_matrix', camera.matrix)
    file.write('distortion_coefficients', np.array([camera.ros_distortion()]))
    return str(file.releaseAndGetString())


def _colmap(camera: Camera) -> str:
    """Return COLMAP's cameras.txt."""
    width, height = camera.image_size
    values = ' '.join(repr(float(value)) for value in camera.step2.values(camera.params))
    return ('# Camera list with one line of data per camera:\n'
            '#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n'
            f'1 {camera.step2.name} {width} {height} {values}\n')


def _kalibr(camera: Camera) -> str:
    """Return kalibr's camchain.yaml. Raises ConfigError for k3, which its radtan has not."""
    d = camera.ros_distortion()
    if not _is_fisheye(camera) and d[4]:
        raise ConfigError('kalibr has no k3; calibrate with --model radial, or export to opencv')
    return str(yaml.safe_dump({'cam0': {
        'camera_model': 'pinhole',
        'intrinsics': [camera.fx, camera.fy, camera.cx, camera.cy],
        'distortion_model': 'equidistant' if _is_fisheye(camera) else 'radtan',
        'distortion_coeffs': d[:4],
        'resolution': list(camera.image_size),
        'rostopic': '/image_raw'}}, sort_keys=False, default_flow_style=None))


def _opensfm(camera: Camera) -> str:
    """Return OpenSfM's camera_models.json."""
    width, height = camera.image_size
    longer = max(width, height)
    kind = 'fisheye_opencv' if _is_fisheye(camera) else 'brown'
    return json.dumps({f'v2 dashcam {width} {height} {kind} 0': {
        'projection_type': kind, 'width': width, 'height': height,
        'focal_x': camera.fx / longer, 'focal_y': camera.fy / longer,
        'c_x': (camera.cx + HALF_PIXEL - width / 2) / longer,
        'c_y': (camera.cy + HALF_PIXEL - height / 2) / longer,
        **_coefficients(camera)}}, indent=2) + '\n'


def _nerfstudio(camera: Camera) -> str:
    """Return the camera's part of nerfstudio's transforms.json; the frames are to be added."""
    width, height = camera.image_size
    return json.dumps({
        'camera_model': 'OPENCV_FISHEYE' if _is_fisheye(camera) else 'OPENCV',
        'w': width, 'h': height,
        'fl_x': camera.fx, 'fl_y': camera.fy, 'cx': camera.cx + HALF_PIXEL,
        'cy': camera.cy + HALF_PIXEL,
        **_coefficients(camera), 'frames': []}, indent=2) + '\n'


def _coefficients(camera: Camera) -> dict[str, float]:
    """Return the distortion coefficients by OpenCV's names."""
    names = ('k1', 'k2', 'k3', 'k4') if _is_fisheye(camera) else ('k1', 'k2', 'p1', 'p2', 'k3')
    return dict(zip(names, camera.ros_distortion(), strict=True))


def _is_fisheye(camera: Camera) -> bool:
    return camera.ros_model == Fisheye.ros_model


EXPORTS: dict[str, Callable[[Camera], str]] = {
    'opencv': _opencv, 'colmap': _colmap, 'kalibr': _kalibr, 'opensfm': _opensfm,
    'nerfstudio': _nerfstudio, 'ros': camera_info_yaml}
