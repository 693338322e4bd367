"""Calibrates a dashcam online, from the turns that the car takes."""
from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dashcalib_ros.calibrator import Calibrator
    from dashcalib_ros.camera import Camera
    from dashcalib_ros.config import Config
    from dashcalib_ros.frames import Frame
    from dashcalib_ros.inputs import open_frames
    from dashcalib_ros.judgement import Calibration
    from dashcalib_ros.recorded import calibrate, check

from dashcalib_ros.limits import PIXELS

# OpenCV reads it when it is loaded; image headers are checked before decoding, too
os.environ.setdefault('OPENCV_IO_MAX_IMAGE_PIXELS', str(PIXELS))

__all__ = ['Calibration', 'Calibrator', 'Camera', 'Config', 'Frame', 'calibrate', 'check',
           'open_frames']

_HOMES = {'Calibration': 'judgement', 'Calibrator': 'calibrator', 'Camera': 'camera',
          'Config': 'config', 'Frame': 'frames', 'calibrate': 'recorded',
          'check': 'recorded', 'open_frames': 'inputs'}


def __getattr__(name: str) -> Any:
    # loaded at the first use: `dashcalib --help` must not wait for OpenCV
    if name in _HOMES:
        return getattr(import_module(f'dashcalib_ros.{_HOMES[name]}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
