"""The values of a camera file, checked; and the camera that they describe.

A file's lens must be one of the models in camera/ exactly: what they lack (skew, thin prisms,
other projections) is an InputError, and is never omitted.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dashcalib_ros.camera import (
    FISHEYE,
    MODELS,
    Brown,
    Camera,
    Fisheye,
    Rational,
    camera_from_ros,
)
from dashcalib_ros.errors import ConfigError, InputError, shortened
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.limits import LENS_NUMBER, SIDE, check_pixels

Data = Mapping[str, Any]
# the cameras of a file by their names, each as the function that reads it; one that returns a
# Camera has nothing else to say
Cameras = Mapping[str, Callable[[], Camera | NamedCamera]]

# ROS's distortion models; RATIONAL has all pinholes in it
PLUMB_BOB, RATIONAL, EQUIDISTANT = 'plumb_bob', 'rational_polynomial', 'equidistant'
# the coefficients by name, in the order of D
COEFFICIENTS = {RATIONAL: Rational.names()[4:], PLUMB_BOB: Brown.names()[4:],
                EQUIDISTANT: Fisheye.names()[4:]}
# of the picture, by which its middle is off: less than the first for width and height exchanged,
# and more than the second as they are
EXCHANGED, AS_GIVEN = 0.06, 0.1


def camera_with(size: Sequence[Any], view: Sequence[float], kind: str, d: Sequence[float],
                path: object) -> Camera:
    """Return the simplest camera with these values, checked.

    view: fx, fy, cx, cy. kind: ROS's distortion model, of D. path: for messages.
    """
    fx, fy, cx, cy = view
    check_focal(fx, fy, path)
    width, height = read_size(*size, path=path)
    off, exchanged = (max(abs(cx / across - 0.5), abs(cy / down - 0.5))
                      for across, down in ((width, height), (height, width)))
    if exchanged < EXCHANGED and off > AS_GIVEN:
        raise InputError('E-CALIBRATION-EXCHANGED',
                         f'{path} is for pictures of {width}x{height}, but the centre ({cx:.0f}, '
                         f'{cy:.0f}) is that of {height}x{width}: are width and height '
                         f'exchanged? write the width first')
    try:
        camera = camera_from_ros((width, height), kind, [fx, 0, cx, 0, fy, cy, 0, 0, 1], d)
    except InputError as error:
        raise InputError(error.code, f'{path}: {error}') from error
    check_lens(camera, path)
    return camera


def check_lens(camera: Camera, path: object) -> None:
    """Raise InputError for numbers that no lens has: nothing can be computed with them."""
    check_focal(camera.fx, camera.fy, path)
    for name, value in camera.named.items():
        if abs(value) > LENS_NUMBER:
            raise InputError('E-CALIBRATION-LENS',
                             f'{path} has {name} = {value:.4g}, which no lens has; use a '
                             f'calibration in px')


def check_focal(fx: float, fy: float, path: object) -> None:
    """Raise InputError for the focal lengths of a camera that is not calibrated."""
    if not (fx > 0 and fy > 0):
        raise InputError('E-CALIBRATION-EMPTY',
                         f'{path} is uncalibrated: its focal length is not positive; calibrate '
                         f'the camera')


def distortion_model(models: Mapping[str, str], name: Any, what: str, path: object) -> str:
    """Return ROS's distortion model for another program's.

    models: the program's that are known here. what: how the file calls it. Raises InputError.
    """
    kind = models.get(name) if isinstance(name, str) else None
    if kind is None:
        raise InputError('E-LENS-MODEL',
                         f'{path} has {what} {shortened(repr(name))}, which is not supported; '
                         f'calibrate or convert it as one of {", ".join(models)}')
    return kind


def read_coefficients(data: Data, kind: str, path: object) -> list[float]:
    """Return D of coefficients by name; those that are omitted are 0."""
    known = dict.fromkeys((*COEFFICIENTS[RATIONAL], 'skew', 'xi'))
    there = [name for name in known if read_number(data, name, path, 0.0)]
    more = [name for name in there if name not in COEFFICIENTS[kind]]
    if more:
        raise InputError('E-LENS-COEFFICIENTS',
                         f'{path} has {", ".join(there)}, but the {kind} model has no '
                         f'{", ".join(more)}; calibrate without')
    return [read_number(data, name, path, 0.0) for name in COEFFICIENTS[kind]]


def named_coefficients(camera: Camera, most: int, program: str) -> dict[str, float]:
    """Return the distortion coefficients by OpenCV's names, as many as a program has.

    Raises ConfigError where others of the camera are not 0.
    """
    named = dict(zip(COEFFICIENTS[EQUIDISTANT if is_fisheye(camera) else RATIONAL],
                     camera.ros_distortion(), strict=False))
    more = [name for name in list(named)[most:] if named[name]]
    if more:
        raise ConfigError('E-EXPORT-LENS',
                          f'{program} has no {", ".join(more)}; calibrate with --model radial, or '
                          f'export to opencv')
    return dict(list(named.items())[:most])


def is_fisheye(camera: Camera) -> bool:
    """Return whether the camera's distortion is one of the angle."""
    return camera.family == FISHEYE


def focal_and_centre(k: Sequence[float]) -> list[float]:
    """Return fx, fy, cx, cy of K (9,); ros_faults() names what else it says."""
    return [k[0], k[4], k[2], k[5]]


def read_size(width: Any, height: Any, *, path: object) -> tuple[int, int]:
    """Check an image size that was read from a file. Raises InputError."""
    for key, value in (('width', width), ('height', height)):
        if value is None:
            raise InputError('E-CALIBRATION-NO-SIZE',
                             f'{path} has no image {key}; add image_{key}, in px')
        if type(value) is float and value.is_integer():
            value = int(value)
        if type(value) is not int or value <= 0:
            raise InputError('E-CALIBRATION-NO-SIZE',
                             f'{path}: the image {key} must be a positive integer, not '
                             f'{shortened(repr(value))}')
        if value > SIDE:
            raise InputError('E-CALIBRATION-TOO-LARGE',
                             f'{path}: the image {key} must be at most {SIDE} px; write it in px')
    check_pixels(int(width), int(height), f'{path}: the image')
    return int(width), int(height)


def read_pair(data: Data, key: str, path: object) -> list[Any]:
    """Return data[key], a list of width and height. Raises InputError."""
    value = data.get(key)
    if not isinstance(value, list) or len(value) != 2:
        raise InputError('E-CALIBRATION-PAIR',
                         f'{path}: {key} must be [width, height], not {shortened(repr(value))}')
    return value


def read_number(data: Data, key: str, path: object, default: float | None = None) -> float:
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
        raise InputError('E-CALIBRATION-NUMBER',
                         f'{path} has {what}; use a complete calibration with finite numbers')
    return number


def read_numbers(value: Any, what: str, path: object, *counts: int) -> list[float]:
    """Return the numbers of a list, of lists in it, or of a block with data.

    counts: how many there may be; none: any. Raises InputError.
    """
    if isinstance(value, Mapping):
        value = value.get('data')
    if not isinstance(value, list):
        raise InputError('E-CALIBRATION-MISSING',
                         f'{path} has no {what}, a list of numbers; use a complete calibration')
    found: list[float] = []
    for each in value:
        found += (read_numbers(each, what, path) if isinstance(each, list)
                  else [read_number({what: each}, what, path)])
    if counts and len(found) not in counts:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path}: {what} must have {counts[-1]} numbers, and has {len(found)}')
    return found


def numbers_in(text: str) -> list[float] | None:
    """Return the numbers of a text, None where it has other words."""
    try:
        return [int(word) if word.lstrip('+-').isdecimal() else float(word)
                for word in text.split()]
    except ValueError:
        return None


def read_sigma(data: Any, camera: Camera) -> dict[str, float] | None:
    """Return the sigmas where all are known, else None: a missing sigma is no error."""
    if not isinstance(data, Mapping):
        return None
    try:
        return {name: read_number(data, name, '') for name in camera.names()}
    except InputError:
        return None


def unknown_model(name: Any, path: object) -> InputError:
    """Return the error for a camera model that there is not."""
    return InputError('E-CAMERA-MODEL',
                      f'{path} has the camera model {shortened(repr(name))}; use one of '
                      f'{", ".join(MODELS)}')
