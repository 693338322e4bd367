# SPDX-License-Identifier: Apache-2.0
"""Calibrates a dashcam online, from the turns that the car takes."""
from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dashcalib_ros.camera import Brown, Camera, Fisheye, Radial, Rational
    from dashcalib_ros.config import Config
    from dashcalib_ros.errors import (
        ConfigError,
        DashcalibError,
        InputError,
        NotAcceptedError,
        Notice,
        OutputError,
        WorkerError,
    )
    from dashcalib_ros.formats import load_camera
    from dashcalib_ros.formats.export import export
    from dashcalib_ros.formats.rig import load_rig
    from dashcalib_ros.input import Frame
    from dashcalib_ros.input.inputs import open_frames
    from dashcalib_ros.input.motion import SensorStream
    from dashcalib_ros.judge import Check
    from dashcalib_ros.pipeline import Calibrator
    from dashcalib_ros.report import AcceptedCalibration, Calibration, NamedCamera, Verdict
    from dashcalib_ros.report.compare import Comparison, compare
    from dashcalib_ros.rig.placed import RigCalibration
    from dashcalib_ros.rig_session import calibrate_rig
    from dashcalib_ros.selection import Status
    from dashcalib_ros.session import calibrate, check

    __version__: str

__all__ = ['AcceptedCalibration', 'Brown', 'Calibration', 'Calibrator', 'Camera', 'Check',
           'Comparison', 'Config', 'ConfigError', 'DashcalibError', 'Fisheye', 'Frame',
           'InputError', 'NamedCamera', 'NotAcceptedError', 'Notice', 'OutputError', 'Radial',
           'Rational', 'RigCalibration', 'SensorStream', 'Status', 'Verdict', 'WorkerError',
           '__version__', 'calibrate', 'calibrate_rig', 'check', 'compare', 'export',
           'load_camera', 'load_rig', 'open_frames']

_HOMES = {'Calibrator': 'pipeline', 'Check': 'judge', 'Comparison': 'report.compare',
          'Config': 'config', 'Frame': 'input', 'calibrate': 'session', 'check': 'session',
          'calibrate_rig': 'rig_session', 'RigCalibration': 'rig.placed',
          'load_rig': 'formats.rig', 'SensorStream': 'input.motion', 'Status': 'selection',
          'export': 'formats', 'load_camera': 'formats', 'open_frames': 'input.inputs',
          **dict.fromkeys(('AcceptedCalibration', 'Calibration', 'NamedCamera', 'Verdict',
                           'compare'), 'report'),
          **dict.fromkeys(('Brown', 'Camera', 'Fisheye', 'Radial', 'Rational'), 'camera'),
          **dict.fromkeys(('ConfigError', 'DashcalibError', 'InputError', 'NotAcceptedError',
                           'Notice', 'OutputError', 'WorkerError'), 'errors')}


def __dir__() -> list[str]:
    return sorted(__all__)


def __getattr__(name: str) -> Any:
    # loaded at the first use: `dashcalib --help` must not wait for OpenCV
    if name in _HOMES:
        return getattr(import_module(f'dashcalib_ros.{_HOMES[name]}'), name)
    if name == '__version__':
        from importlib.metadata import PackageNotFoundError, version
        try:
            return version('dashcalib_ros')
        except PackageNotFoundError:
            return '0+sources'  # not installed
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
