# SPDX-License-Identifier: Apache-2.0
"""The values of a camera file, checked; and the camera that they describe.

A file's lens must be one of the models in camera/ exactly: what they lack (skew, thin prisms,
other projections) is an InputError, and is never omitted.
"""
from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import (
    FISHEYE,
    MODELS,
    NO_DISTORTION,
    Brown,
    Camera,
    Fisheye,
    Rational,
    camera_from_ros,
)
from dashcalib_ros.camera.other import OtherLens
from dashcalib_ros.errors import ConfigError, InputError, shortened
from dashcalib_ros.formats.plausible import check_focal, check_lens
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.limits import SIDE, check_pixels

Data = Mapping[str, Any]
Size = tuple[int, int]


@dataclass(frozen=True)
class Sizeless:
    """A camera of a file that does not say the size of its pictures.

    of: returns it for pictures of (width, height). remedy: where nobody knows their size.
    """

    of: Callable[[Size], Camera | NamedCamera | OtherLens]
    remedy: str = 'write their size with --size WxH'


Read = Camera | NamedCamera | OtherLens | Sizeless
# the cameras of a file by their names, each as the function that reads it; one that returns a
# Camera has nothing else to say
Cameras = Mapping[str, Callable[[], Read]]

# ROS's distortion models; RATIONAL has all pinholes in it
ROS_MODELS = PLUMB_BOB, RATIONAL, EQUIDISTANT = (
    'plumb_bob', 'rational_polynomial', 'equidistant')
# the coefficients by name, in the order of D
COEFFICIENTS = {RATIONAL: Rational.names()[4:], PLUMB_BOB: Brown.names()[4:],
                EQUIDISTANT: Fisheye.names()[4:]}
# how many coefficients of a pinhole programs write; less where those after k2 are 0
COUNTS = (4, 5, 8, 12, 14)
# ends of the keys by which files say what their lens model is, and how keys of coefficients look;
# both in small letters without signs
SAYS = ('model', 'intrinsictype', 'polymorphicname', 'projectiontype', 'distortiontype',
        'lenstype', 'cameratype')
# lenses that no model here has, where "camera_model" may be a product's name, too
OTHERS = re.compile(r'\b(omni|mei|unified|e?ucm|ds|double.?sphere|kb[48]|fov|division|poly|ocam|'
                    r'scaramuzza|cahvore?|spherical|equirect\w*|cylindrical|f.?theta)\b')
COEFFICIENT = re.compile('dist(?!ance)|coef|radial|tangential|poly(?!morph)|xi$|[kp][0-9]$')


def camera_with(size: Sequence[Any], view: Sequence[float], kind: str, d: Sequence[float],
                path: object) -> Camera:
    """Return the simplest camera with these values, checked.

    view: fx, fy, cx, cy. kind: ROS's distortion model, of D. path: for messages.
    """
    fx, fy, cx, cy = view
    check_focal(fx, fy, path)
    width, height = read_size(*size, path=path)
    try:
        camera = camera_from_ros((width, height), kind, [fx, 0, cx, 0, fy, cy, 0, 0, 1], d)
    except InputError as error:
        raise InputError(error.code, f'{path}: {error}') from error
    if not is_fisheye(camera):
        _check_count(d, path)
    check_lens(camera, path)
    return camera


def pinhole(view: Sequence[float], path: object) -> Sizeless:
    """Return the camera of fx, fy, cx, cy, of pictures without distortion and without a size."""
    return Sizeless(lambda size: camera_with(size, view, PLUMB_BOB, (), path))


def _check_count(d: Sequence[float], path: object) -> None:
    if len(d) in COUNTS or not any(d[2:]):
        return
    if len(d) == 3:
        raise InputError('E-LENS-AMBIGUOUS',
                         f'{path} has 3 distortion coefficients, k1, k2, k3 or k1, k2, p1; write '
                         f'all five: k1, k2, p1, p2, k3')
    raise InputError('E-LENS-COEFFICIENTS',
                     f'{path} has {len(d)} distortion coefficients; write 5 of them (k1, k2, p1, '
                     f'p2, k3) or 8 (and k4, k5, k6)')


def distortion_model(models: Mapping[str, str], name: Any, what: str, path: object) -> str:
    """Return ROS's distortion model for another program's.

    models: the program's that are known here. what: how the file calls it. Raises InputError.
    """
    kind = models.get(name) if isinstance(name, str) else None
    if kind is None:
        raise _not_supported(path, what, name, models)
    return kind


def _not_supported(path: object, what: str, name: Any, models: Iterable[str]) -> InputError:
    return InputError('E-LENS-MODEL',
                      f'{path} has {what} {shortened(repr(name))}, which is not supported; '
                      f'calibrate or convert it as one of {", ".join(models)}')


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


@dataclass(frozen=True)
class Placed:
    """A camera of a rig, and where it sits: x' = rotation x + translation_m.

    rotation: (3, 3) from the optical axes of the rig's base to its own; translation_m: (3,), None
    where no metres are known. camera: None where its lens was refused. mount: of the base.
    about: a line for people.
    """

    name: str
    camera: Camera | None
    rotation: Floats
    translation_m: Floats | None
    mount: Mount | None = None
    about: str = ''

    @property
    def pose(self) -> Floats:
        """Return (4, 4) from the base's axes to its own; no translation where none is known."""
        found = np.eye(4)
        found[:3, :3] = self.rotation
        found[:3, 3] = 0.0 if self.translation_m is None else self.translation_m
        return found


def with_lenses(rig: Sequence[Placed], program: str) -> list[tuple[Placed, Camera]]:
    """Return the cameras of a rig whose lens is known. Raises ConfigError where that is none."""
    found = [(each, each.camera) for each in rig if each.camera is not None]
    if not found:
        raise ConfigError('E-RIG-NO-LENS', f'{program} needs a lens, and each one of this rig is '
                                           f'refused: drive more turns')
    return found


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


def pinhole_only(camera: Camera, program: str) -> Camera:
    """Return the camera. Raises ConfigError for a fisheye, for a program that has not ours."""
    if is_fisheye(camera):
        raise ConfigError('E-EXPORT-LENS',
                          f'{program} has no fisheye such as ours; export to maps, and use the '
                          f'rectified pictures')
    return camera


def is_fisheye(camera: Camera) -> bool:
    """Return whether the camera's distortion is one of the angle."""
    return camera.family == FISHEYE


def focal_and_centre(k: Sequence[float]) -> list[float]:
    """Return fx, fy, cx, cy of K (9,); ros_faults() names what else it says."""
    return [k[0], k[4], k[2], k[5]]


def read_matrix(data: Data, key: Any, path: object) -> list[float]:
    """Return K (9,) of what data has at a key: fx, fy, cx, cy, or a matrix of 3x3, 3x4 or 4x4.

    Raises InputError.
    """
    value = data[key]
    if (isinstance(value, Mapping) and not isinstance(value.get('data'), list)) or (
            isinstance(value, list) and any(isinstance(each, Mapping) for each in value)):
        model = said_model(value, 'type') or said_model(data)
        if model is not None and model.lower() not in (*MODELS, *ROS_MODELS, *NO_DISTORTION):
            raise _not_supported(path, 'the lens model', model, ROS_MODELS)
        raise InputError('E-CALIBRATION-NO-MATRIX',
                         f'{path}: {key} is not a matrix, and has no fx, fy, cx, cy; write those')
    k = read_numbers(value, str(key), path, 4, 12, 16, 9)
    if len(k) == 4:
        return [k[0], 0, k[2], 0, k[1], k[3], 0, 0, 1]
    if len(k) == 16 and k[12:] != [0, 0, 0, 1]:
        raise _no_matrix(key, '0 0 0 1', path)
    if len(k) > 9:
        k = [*k[:3], *k[4:7], *k[8:11]]
    if k[2] == k[3] == k[5] == 0 and k[8] == 1 and min(k[6:8]) > 0:
        raise InputError('E-CALIBRATION-TRANSPOSED',
                         f'{path}: {key} is transposed; write it as [fx, 0, cx, 0, fy, cy, 0, 0, '
                         f'1]. MATLAB writes it so, and its centre is from 1: subtract 1 from cx '
                         f'and cy')
    if any(k[6:8]) or not k[8]:
        raise _no_matrix(key, '0 0 1', path)
    return k


def _no_matrix(key: Any, row: str, path: object) -> InputError:
    return InputError('E-CALIBRATION-NO-MATRIX',
                      f'{path}: {key} is not a matrix, as its last row is not {row} (Waymo has '
                      f'fx, fy, cx, cy, k1, k2, p1, p2, k3 there); write its values by name, as '
                      f'in {{"fx": 700, "fy": 700, "cx": 640, "cy": 360, "k1": 0, "k2": 0, '
                      f'"width": 1280, "height": 720}}')


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


def xml_root(text: str, path: object) -> ElementTree.Element:
    """Return the root of an XML text without declarations, which could be made to grow."""
    try:
        if '<!DOCTYPE' in text or '<!ENTITY' in text:
            raise ElementTree.ParseError('declarations')
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, RecursionError, ValueError) as error:
        raise InputError('E-CALIBRATION-XML',
                         f'{path} is no XML that can be read; write it again') from error


def numbers_in(text: str) -> list[float] | None:
    """Return the numbers of a text, None where it has other words."""
    try:
        return [int(word) if word.lstrip('+-').isdecimal() else float(word)
                for word in text.split()]
    except ValueError:
        return None


def read_sigma(data: Any, camera: Camera) -> dict[str, float] | None:
    """Return the sigmas where all are known, else None: a missing sigma is not an error."""
    if not isinstance(data, Mapping):
        return None
    try:
        return {name: read_number(data, name, '') for name in camera.names()}
    except InputError:
        return None


def plain_key(key: object) -> str:
    """Return a key in small letters, without signs."""
    return re.sub('[^a-z0-9]', '', str(key).lower())


def said_model(data: Any, *more: str) -> str | None:
    """Return what a file, or a part of it, calls its lens model; None where it does not say.

    more: keys that mean it there, beside SAYS.
    """
    said = (value for key, value in _entries(data)
            if isinstance(value, str) and value and plain_key(key).endswith((*SAYS, *more)))
    return next(said, None)


def check_lens_kind(lens: str, path: object) -> None:
    """Raise InputError where the name of a camera is that of a lens that no model here has."""
    if OTHERS.search(lens):
        raise _not_supported(path, 'the lens model', lens, ROS_MODELS)


def no_distortion(data: Data, what: str, remedy: str, path: object) -> InputError:
    """Return the error for a file without known coefficients: they may have other names.

    what: is missing. remedy: for a lens without distortion.
    """
    alike = [str(key) for key, value in _entries(data)
             if COEFFICIENT.match(plain_key(key)) and _has_number(value)]
    if alike:
        return InputError('E-LENS-COEFFICIENTS',
                          f'{path} has distortion in a form that is not known here: '
                          f'{shortened(", ".join(dict.fromkeys(alike)))}; write it as '
                          f'distortion_coefficients: [k1, k2, p1, p2, k3]')
    return InputError('E-NO-DISTORTION', f'{path} has {what}; for pictures without distortion, '
                                         f'write 0{remedy}')


def _entries(data: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(data, Mapping):
        yield from data.items()
    for each in (data.values() if isinstance(data, Mapping) else
                 data if isinstance(data, list) else ()):
        yield from _entries(each)


def _has_number(value: Any) -> bool:
    if isinstance(value, Mapping):
        value = list(value.values())
    return (any(map(_has_number, value)) if isinstance(value, list)
            else isinstance(value, (int, float)) and not isinstance(value, bool))


def unknown_model(name: Any, path: object) -> InputError:
    """Return the error for a camera model that there is not."""
    return InputError('E-CAMERA-MODEL',
                      f'{path} has the camera model {shortened(repr(name))}; use one of '
                      f'{", ".join(MODELS)}')
