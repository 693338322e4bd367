"""Camera calibration that happens by itself while a car drives."""
from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dashcalib_ros.calibrator import Calibrator
    from dashcalib_ros.config import Config
    from dashcalib_ros.frames import open_frames

__all__ = ['Calibrator', 'Config', 'open_frames']

_HOMES = {'Calibrator': 'calibrator', 'Config': 'config', 'open_frames': 'frames'}


def __getattr__(name: str) -> Any:
    # loaded when first asked for: `dashcalib --help` must not wait for OpenCV
    if name in _HOMES:
        return getattr(import_module(f'dashcalib_ros.{_HOMES[name]}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
