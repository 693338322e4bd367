"""A camera with its name, sigma and verdict; the checks of values read from files."""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as default
from pathlib import Path
from typing import Any

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import TERMS, Field
from dashcalib_ros.errors import InputError, shortened
from dashcalib_ros.judge import Calibration
from dashcalib_ros.judge.calibration import ANGLES, Mount
from dashcalib_ros.limits import SIDE
from dashcalib_ros.solve.knowledge import PictureSigma


@dataclass(frozen=True)
class NamedCamera:
    """A camera with its name, sigma and verdict.

    name: where it is from, for messages. sigma: by the parameters' names; None unless all are
    known. verdict: accepted or weak; None where the file has none (a truth, another tool's file).
    covariance: (n, n) of the parameters, as the picture shows them, and sigma_px: over the
    picture; None where the file does not say.
    field: what its lens model leaves over, where a result.json has one that is used. mount: how it
    sits on the car, where the file says.
    faults: in words, of what else stands beside the camera (ROS's K, R and P).
    """

    name: str
    camera: Camera
    sigma: Mapping[str, float] | None = None
    verdict: str | None = None
    covariance: Floats | None = default(default=None, compare=False)
    sigma_px: PictureSigma | None = None
    field: Field | None = default(default=None, compare=False)
    mount: Mount | None = default(default=None, compare=False)
    faults: tuple[str, ...] = ()

    def without_faults(self) -> NamedCamera:
        """Return it; raises InputError where something beside the camera is wrong."""
        if self.faults:
            raise InputError(f'{self.name}: {"; ".join(self.faults)}; no model here has that')
        return self

    @property
    def image_size(self) -> tuple[int, int]:
        """Return (width, height) in pixels."""
        return self.camera.image_size


def calibrated_camera(calibration: Calibration, name: str = 'estimate') -> NamedCamera:
    """Return the camera of a calibration. Raises InputError when it was refused."""
    if calibration.camera is None:
        raise InputError(no_intrinsics(name, calibration.verdict.level,
                                        calibration.verdict.reasons))
    return NamedCamera(name, calibration.camera, calibration.sigma, calibration.verdict.level,
                       read_covariance(calibration.details, calibration.camera,
                                       calibration.sigma),
                       calibration.sigma_px, mount=calibration.mount)


def read_size(width: Any, height: Any, *, path: str | Path) -> tuple[int, int]:
    """Check an image size that was read from a file. Raises InputError."""
    for key, value in (('width', width), ('height', height)):
        if value is None:
            raise InputError(f'{path} does not say the image {key}; add image_{key}, in pixels')
        if type(value) is float and value.is_integer():
            value = int(value)
        if type(value) is not int or value <= 0:
            raise InputError(f'{path}: the image {key} must be a positive integer, not '
                             f'{shortened(repr(value))}')
        if value > SIDE:
            raise InputError(f'{path}: the image {key} must be {SIDE} at the most; is it in px?')
    return int(width), int(height)


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


def check_focal(fx: float, fy: float, path: str | Path) -> None:
    """Raise InputError for the focal lengths of a camera that is not calibrated."""
    if not (fx > 0 and fy > 0):
        raise InputError(f'{path} is uncalibrated: its focal length is not positive')


def read_sigma(data: Any, camera: Camera) -> dict[str, float] | None:
    """Return the sigmas where all are known, else None: a missing sigma is no error."""
    if not isinstance(data, Mapping):
        return None
    try:
        return {name: read_number(data, name, '') for name in camera.names()}
    except InputError:
        return None


def read_covariance(details: Any, camera: Camera, sigma: Mapping[str, float] | None
                    ) -> Floats | None:
    """Return the covariance in result.json's details, None where there is none that can be one.

    That of the picture may be of the wider model's parameters: the camera's own come first. Files
    of 0.2.0 have the correlations only, which say nearly the same.
    """
    data, count = details if isinstance(details, Mapping) else {}, len(camera.params)
    try:
        covariance = np.array(data.get('picture_covariance'), np.float64)
        if covariance.ndim == 2:
            covariance = covariance[:count, :count]
        if 'picture_covariance' not in data and sigma is not None:
            each = [sigma[name] for name in camera.names()]
            covariance = np.array(data.get('correlation'), np.float64) * np.outer(each, each)
        if covariance.shape == (count, count) and np.isfinite(covariance).all():
            np.linalg.cholesky(covariance)
            return covariance
    except (TypeError, ValueError, np.linalg.LinAlgError):
        pass
    return None


def read_field(data: Any, image_size: tuple[int, int]) -> Field | None:
    """Return result.json's field, None where there is none that is used."""
    if not isinstance(data, Mapping) or data.get('used') is not True:
        return None
    try:
        coefficients = np.array(data['coefficients'], np.float64)
    except (KeyError, TypeError, ValueError):
        coefficients = np.zeros(0)
    if coefficients.shape != (2, len(TERMS)) or not np.isfinite(coefficients).all():
        raise InputError('its field has no coefficients that can be read; calibrate again')
    return Field(image_size, coefficients)


def read_mount(data: Any) -> Mount | None:
    """Return a file's mounting; a missing one, or one that cannot be read, is no error."""
    try:
        travel, sigma = ([float(value) for value in data['travel_px']],
                         {name: None if data['sigma'][name] is None
                          else read_number(data['sigma'], name, '')
                          for name in (*ANGLES, 'height_m')})
        roll, height = (None if data[name] is None else read_number(data, name, '')
                        for name in ('roll_right_deg', 'height_m'))
        return Mount('accepted' if data['verdict'] == 'accepted' else 'weak',
                     tuple(map(str, data['reasons'])), read_number(data, 'yaw_left_deg', ''),
                     read_number(data, 'pitch_up_deg', ''), roll, height, sigma,
                     (travel[0], travel[1]), read_number(data, 'travel_sigma_px', ''),
                     read_number(data, 'straight_m', ''),
                     None if data.get('moved_s') is None else read_number(data, 'moved_s', ''))
    except (KeyError, IndexError, TypeError, ValueError, InputError):
        return None


def read_sigma_px(data: Any) -> PictureSigma | None:
    """Return result.json's sigma over the picture; a missing one is no error."""
    try:
        return PictureSigma(*(read_number(data, key, '') for key in ('rms', 'worst')))
    except (AttributeError, TypeError, InputError):
        return None


def no_intrinsics(name: str, verdict: Any, reasons: Any) -> str:
    """Return the message for a refused calibration, which has no intrinsics."""
    known = '; '.join(map(str, reasons)) if isinstance(reasons, (list, tuple)) else ''
    return (f'{name} has no intrinsics to compare, its verdict is {verdict}'
            + (f': {known}' if known else '') + '; calibrate a drive with more turns')
