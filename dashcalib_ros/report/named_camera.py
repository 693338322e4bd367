"""A camera with its name, sigma and verdict; the checks of values read from files."""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import Camera
from dashcalib_ros.errors import InputError, shortened
from dashcalib_ros.judgement import Calibration
from dashcalib_ros.limits import SIDE


@dataclass(frozen=True)
class NamedCamera:
    """A camera with its name, sigma and verdict.

    name: where it is from, for messages. sigma: by the parameters' names; None unless all are
    known. verdict: accepted or weak; None where the file has none (a truth, another tool's file).
    """

    name: str
    camera: Camera
    sigma: Mapping[str, float] | None = None
    verdict: str | None = None

    @property
    def image_size(self) -> tuple[int, int]:
        """Return (width, height) in pixels."""
        return self.camera.image_size


def calibrated_camera(calibration: Calibration, name: str = 'estimate') -> NamedCamera:
    """Return the camera of a calibration. Raises InputError when it was refused."""
    if calibration.camera is None:
        raise InputError(no_intrinsics(name, calibration.verdict.level,
                                        calibration.verdict.reasons))
    return NamedCamera(name, calibration.camera, calibration.sigma, calibration.verdict.level)


def read_size(width: Any, height: Any, path: str | Path) -> tuple[int, int]:
    """Check an image size that was read from a file. Raises InputError."""
    for key, value in (('width', width), ('height', height)):
        if value is None:
            raise InputError(f'{path} does not say the image {key}; add it, in pixels')
        if type(value) is not int or value <= 0:
            raise InputError(f'{path}: the image {key} must be a positive integer, not '
                             f'{shortened(repr(value))}')
        if value > SIDE:
            raise InputError(f'{path}: the image {key} must be {SIDE} at the most; is it in px?')
    return width, height


def read_number(data: Mapping[str, Any], key: str, path: str | Path,
                default: float | None = None) -> float:
    """Return data[key] as a finite float. Raises InputError."""
    if key not in data and default is not None:
        return default
    value = data.get(key)
    try:
        # text, too: yaml-cpp writes 1e-05, which YAML 1.1 (and so PyYAML) reads as text
        number = math.nan if value is None or isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        what = f'no {key}' if value is None else f'{key} = {shortened(repr(value))}'
        raise InputError(f'{path} has {what}; give a complete calibration with finite numbers')
    return number


def check_focal(camera: Camera, path: str | Path) -> Camera:
    """Return a camera that was read from a file. Raises InputError where it is uncalibrated."""
    if camera.fx <= 0 or camera.fy <= 0:
        raise InputError(f'{path} is uncalibrated: its focal length is not positive')
    return camera


def read_sigma(data: Any, camera: Camera) -> dict[str, float] | None:
    """Return the sigmas where all are known, else None: a missing sigma is no error."""
    if not isinstance(data, Mapping):
        return None
    try:
        return {name: read_number(data, name, '') for name in camera.names()}
    except InputError:
        return None


def no_intrinsics(name: str, verdict: Any, reasons: Any) -> str:
    """Return the message for a refused calibration, which has no intrinsics."""
    known = '; '.join(map(str, reasons)) if isinstance(reasons, (list, tuple)) else ''
    return (f'{name} has no intrinsics to compare, its verdict is {verdict}'
            + (f': {known}' if known else '') + '; calibrate a drive with more turns')
