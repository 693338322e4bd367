"""How to use a calibration: lines to copy, and what the camera sees."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from shlex import quote

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import FISHEYE, Camera


@dataclass(frozen=True)
class Snippet:
    """Text to copy. name: what it is for; id: of its element in the page."""

    id: str
    name: str
    text: str


def snippets(camera: Camera, calibration_file: Path) -> tuple[Snippet, ...]:
    """Return how ROS drivers, OpenCV and COLMAP take the camera; the file is calibration.yaml."""
    return (Snippet('use-ros', 'ROS 2 camera driver: the parameter',
                    f'camera_info_url: {calibration_file.as_uri()}'),
            Snippet('use-opencv', 'OpenCV in Python', _opencv(camera)),
            Snippet('use-colmap', 'COLMAP', _colmap(camera)))


def _opencv(camera: Camera) -> str:
    fx, fy, cx, cy = (f'{value:.4f}' for value in camera.params[:4])
    distortion = ', '.join(f'{value:.8g}' for value in camera.ros_distortion())
    fisheye = camera.family == FISHEYE
    call = ('cv2.fisheye.undistortImage(image, K, D, Knew=K)' if fisheye
            else 'cv2.undistort(image, K, D)')
    return ('import cv2\nimport numpy as np\n'
            f'K = np.array([[{fx}, 0, {cx}], [0, {fy}, {cy}], [0, 0, 1]])\n'
            f'D = np.array([{distortion}])\n'
            f'straight = {call}')


def _colmap(camera: Camera) -> str:
    values = ','.join(f'{value:.10g}' for value in camera.colmap.values(camera.params))
    return ('colmap feature_extractor --database_path database.db --image_path images '
            '--ImageReader.single_camera 1 '
            f'--ImageReader.camera_model {camera.colmap.name} '
            f'--ImageReader.camera_params {quote(values)}')


@dataclass(frozen=True)
class FieldOfView:
    """Degrees between the picture's edges and between its corners; NaN where not known."""

    horizontal: float
    vertical: float
    diagonal: float


def field_of_view(camera: Camera) -> FieldOfView:
    """Return how wide the camera sees, through the middle of its picture."""
    width, height = camera.image_size
    left, right, top, bottom = -0.5, width - 0.5, -0.5, height - 0.5
    x, y = (width - 1) / 2, (height - 1) / 2
    ends = np.array([[(left, y), (right, y)], [(x, top), (x, bottom)],
                     [(left, top), (right, bottom)], [(left, bottom), (right, top)]])
    with np.errstate(all='ignore'):
        angles = _off_axis(camera.rays(ends)).sum(axis=1)
    return FieldOfView(float(angles[0]), float(angles[1]), float(angles[2:].max()))


def _off_axis(rays: Floats) -> Floats:
    """Return how far rays (..., 3) are off the optical axis, degrees: two sides may exceed 180."""
    return np.asarray(np.degrees(np.arccos(np.clip(rays[..., 2], -1.0, 1.0))))
