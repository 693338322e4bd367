"""Reads a camera from a calibration of any common kind: load_camera().

A file's lens must be one of the models in camera/ exactly: what they lack (skew, thin prisms,
other projections) is an InputError, and is never omitted. Where a file has several cameras, its
reader returns them all by name, and the caller names one.
"""
from __future__ import annotations

import ast
import math
import os
import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
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
    Radial,
    Rational,
    camera_from_ros,
    ros_faults,
)
from dashcalib_ros.camera.camera import HALF_PIXEL
from dashcalib_ros.camera.field import TERMS as FIELD_TERMS
from dashcalib_ros.camera.field import Field
from dashcalib_ros.camera.mapping import rayless_share
from dashcalib_ros.errors import InputError, shortened
from dashcalib_ros.input.bag_write import first_camera_info
from dashcalib_ros.input.inputs import fits_bag
from dashcalib_ros.input.source import by, os_error
from dashcalib_ros.judge import Calibration
from dashcalib_ros.judge.calibration import ANGLES, Mount
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.limits import (
    ARRAY_BYTES,
    ARRAYS,
    JSON_BYTES,
    LENS_NUMBER,
    SIDE,
    check_file,
    check_npz,
    check_pixels,
    parse_json,
    parse_yaml,
    read_file,
    read_text,
)
from dashcalib_ros.solve.spread import PictureSigma

Data = Mapping[str, Any]
# reads one camera of a file; where the file has nothing but the camera, it returns just that
Reader = Callable[[], Camera | NamedCamera]

# the first of these that a folder has is read
IN_FOLDER = ('result.json', 'calibration.yaml', 'cameras.bin', 'cameras.txt',
             'sparse/0/cameras.bin', 'sparse/0/cameras.txt', 'camera_models.json',
             'transforms.json')
KNOWN = ('a result.json (or its folder), a camera_info YAML, a file of OpenCV, Kalibr, COLMAP, '
         'nerfstudio, OpenSfM, mrcal or Gyroflow, a JSON of fx, fy, cx, cy, k1, k2, width and '
         'height, or a bag with camera_info')
# ROS's distortion models; RATIONAL has all pinholes in it
PLUMB_BOB, RATIONAL, EQUIDISTANT = 'plumb_bob', 'rational_polynomial', 'equidistant'
# the coefficients by name, in the order of D
TERMS = {RATIONAL: Rational.names()[4:], PLUMB_BOB: Brown.names()[4:],
         EQUIDISTANT: Fisheye.names()[4:]}
# COLMAP's models, by their number: name, focal lengths, our distortion model, coefficients; None
# where no model here is the same
COLMAP = (('SIMPLE_PINHOLE', 1, PLUMB_BOB, 0), ('PINHOLE', 2, PLUMB_BOB, 0),
          ('SIMPLE_RADIAL', 1, PLUMB_BOB, 1), ('RADIAL', 1, PLUMB_BOB, 2),
          ('OPENCV', 2, PLUMB_BOB, 4), ('OPENCV_FISHEYE', 2, EQUIDISTANT, 4),
          ('FULL_OPENCV', 2, RATIONAL, 8), ('FOV', 2, None, 1),
          ('SIMPLE_RADIAL_FISHEYE', 1, EQUIDISTANT, 1), ('RADIAL_FISHEYE', 1, EQUIDISTANT, 2),
          ('THIN_PRISM_FISHEYE', 2, None, 8))
KALIBR = {'radtan': PLUMB_BOB, 'equidistant': EQUIDISTANT, 'equi': EQUIDISTANT,
          **dict.fromkeys(NO_DISTORTION, PLUMB_BOB)}
OPENSFM = {'perspective': PLUMB_BOB, 'simple_radial': PLUMB_BOB, 'radial': PLUMB_BOB,
           'brown': PLUMB_BOB, 'fisheye': EQUIDISTANT, 'fisheye_opencv': EQUIDISTANT}
NERFSTUDIO = {name: kind for name, _, kind, _ in COLMAP[:6]}
GYROFLOW = {'opencv_fisheye': EQUIDISTANT, 'opencv_standard': RATIONAL}
# what else a lens profile may do with a picture
GYROFLOW_MORE = ('digital_lens', 'crop', 'input_horizontal_stretch', 'input_vertical_stretch',
                 'interpolations')
# the sign of the readout time of rows; by columns it is not known here
READOUT = {'TopToBottom': 1, 'BottomToTop': -1}
MRCAL = {'LENSMODEL_PINHOLE': PLUMB_BOB, 'LENSMODEL_OPENCV4': PLUMB_BOB,
         'LENSMODEL_OPENCV5': PLUMB_BOB, 'LENSMODEL_OPENCV8': RATIONAL,
         'LENSMODEL_OPENCV12': RATIONAL}
# how files name OpenCV's values, in small letters without anything between them; in a shape the
# height comes first
MATRIX = ('cameramatrix', 'camerainternalmatrix', 'intrinsicmatrix', 'intrinsicsmatrix',
          'intrinsics', 'intrinsic', 'cameraintrinsics', 'cameramat', 'cammatrix', 'cameramtx',
          'kmatrix', 'matrixk', 'k', 'mtx')
DISTORTION = tuple(f'{start}{end}' for start in ('distortion', 'dist') for end in (
    'coefficients', 'coefficient', 'coeffs', 'coeff', 'coefs', 'coef', 'parameters', 'params',
    'vector', '')) + ('coefficients', 'coeffs', 'd')
SIZES = tuple(f'{start}{end}' for start in ('image', 'img', 'camera', 'frame', 'picture', '')
              for end in ('size', 'resolution', 'dimensions'))
SHAPES = tuple(f'{start}shape' for start in ('image', 'img', 'frame', ''))
WIDTHS, HEIGHTS = (tuple(f'{start}{end}' for end in ends for start in (
    'image', 'img', 'frame', 'camera', 'resolution', '')) for ends in (
    ('width', 'w', 'cols', 'x'), ('height', 'h', 'rows', 'y')))
# the section of an INI file that is no camera
INI_IMAGE = 'image'
# of the picture, by which its middle is off: less than the first for width and height exchanged,
# and more than the second as they are
EXCHANGED, AS_GIVEN = 0.06, 0.1


def load_camera(path: str | os.PathLike[str], name: str | None = None) -> NamedCamera:
    """Read a camera from a calibration; returns it with its name, and sigma and verdict if known.

    path: a result.json (or its folder) or calibration.yaml of this package; a camera_info YAML; a
    YAML, XML, JSON or .npz with OpenCV's camera matrix and distortion coefficients; Kalibr's
    camchain; COLMAP's cameras.txt or cameras.bin, or the folder of a model; the JSON of nerfstudio
    or OpenSfM; mrcal's .cameramodel; Gyroflow's lens profile; a JSON of fx, fy, cx, cy, k1, k2
    ..., width and height, which may say its "model"; a bag that has camera_info.
    name: which camera, of a file that has several: as the file names it (cam1, 2), for a bag its
    image topic or its camera_info topic. FILE:NAME as the path means the same.

    Returns a NamedCamera: its `camera` is a Radial, Brown, Rational or Fisheye, in px of the full
    pictures, with the centre of the first pixel at (0, 0). Raises InputError, in one line that
    names the cure, for a file that cannot be read, a lens that none of these describes, and a file
    with several cameras of which none is named.
    """
    return load_with_faults(path, name).without_faults()


def load_with_faults(path: str | os.PathLike[str], name: str | None = None) -> NamedCamera:
    """Read a camera as load_camera() does; what is wrong beside it (R, P) is in its faults."""
    return _seeing(_loaded(path, name))


def _loaded(path: str | os.PathLike[str], name: str | None) -> NamedCamera:
    text = os.fspath(path)
    before, _, after = text.rpartition(':')
    # lexists() takes any text, also one that is too long for a name
    if name is None and before and os.path.lexists(before) and not os.path.lexists(text):
        text, name = before, after
    place = Path(text)
    try:
        if fits_bag(place):
            topic, message = first_camera_info(place, name)
            return camera_of_message(message, f'{place}:{topic}')
        if place.is_dir():
            inside = [place / each for each in IN_FOLDER if (place / each).exists()]
            if not inside:
                raise InputError('E-CALIBRATION-FOLDER',
                                 f'{place} is a folder without a calibration; use {KNOWN}')
            place = inside[0]
        if place.suffix == '.npz':
            return _chosen(_cameras_of(_arrays(place), place), name, place)
        if place.suffix == '.bin':
            return _chosen(_colmap_binary(place), name, place)
        return parse_camera(read_text(place, JSON_BYTES), place, name)
    except OSError as error:
        raise os_error(place, error) from error


def parse_camera(text: str, path: str | Path, name: str | None = None) -> NamedCamera:
    """Read a camera from a calibration's text; path is for messages only. See load_camera()."""
    return _chosen(_parsed(text, Path(path)), name, path)


def camera_of_message(message: Any, name: str) -> NamedCamera:
    """Return the camera of a CameraInfo of ROS 1 or 2. Raises InputError where there is none."""
    k, d, r, p = ([float(value) for value in getattr(message, key,
                                                     getattr(message, key.upper(), ()))]
                  for key in 'kdrp')
    size, roi = (int(message.width), int(message.height)), message.roi
    _check_whole(size, (message.binning_x, message.binning_y),
                 (roi.x_offset, roi.y_offset, roi.width, roi.height), name)
    if not k or not k[0] > 0:
        raise InputError('E-CALIBRATION-EMPTY',
                         f'{name} is uncalibrated: K[0] is not positive; load a calibration into '
                         f'the driver')
    if not np.isfinite([*k, *d, *r, *p]).all():
        raise InputError('E-CALIBRATION-NUMBER',
                         f'{name} has numbers that are not finite; calibrate the camera again')
    camera = _camera(size, _view(k), str(message.distortion_model), d, name)
    return NamedCamera(name, camera, faults=ros_faults(camera, k, r, p))


def _check_whole(size: tuple[int, int], binning: Sequence[float], roi: Sequence[float],
                 name: str | Path) -> None:
    """Raise InputError for a CameraInfo of a part of the sensor, or of one that is binned.

    roi: x, y, width, height.
    """
    if tuple(roi) not in ((0, 0, 0, 0), (0, 0, *size)) or max(binning) > 1:
        raise InputError('E-CALIBRATION-PART',
                         f'{name} has binning or a region of interest: use the calibration of the '
                         f'images as they are')


def _chosen(cameras: Mapping[str, Reader], name: str | None, path: str | Path) -> NamedCamera:
    if name is None and len(cameras) == 1:
        name = next(iter(cameras))
    if name is not None and name in cameras:
        found = cameras[name]()
        return found if isinstance(found, NamedCamera) else NamedCamera(
            f'{path}:{name}' if len(cameras) > 1 else str(path), found)
    there = shortened(', '.join(cameras)) or 'one camera without a name'
    if name is not None:
        raise InputError('E-CAMERA-NAME',
                         f'{path} has no camera {shortened(name)!r}; use one of {there}')
    raise InputError('E-CAMERA-CHOICE',
                     f'{path} has {len(cameras)} cameras; name one, as in '
                     f'{path}:{next(iter(cameras), "1")}; it has {there}')


def _parsed(text: str, path: Path) -> Mapping[str, Reader]:
    start = text.lstrip()
    if re.search(r'''["']lensmodel["']\s*:''', text):
        return {'': partial(_mrcal, text, path)}
    if start.startswith('<'):
        return _cameras_of(_xml(text, path), path)
    lines = [line.split() for line in text.splitlines() if not line.lstrip().startswith('#')]
    lines = [line for line in lines if line]
    if lines and re.match(r'\d+ [A-Z_]+ ', ' '.join(lines[0])):
        return {line[0]: partial(_colmap, line[1:], path) for line in lines}
    if start[:1] in ('{', '['):
        return _cameras_of(parse_json(text, str(path)), path)
    if re.search(rf'^\s*\[{INI_IMAGE}\]\s*$', text, re.MULTILINE):
        return _cameras_of_ini(text, path)
    try:
        data = parse_yaml(_first_document(text), str(path))
    except InputError as error:
        if error.__cause__ is None:
            raise  # a limit; the rest is what PyYAML cannot read
        raise InputError(error.code, f'{error}; use {KNOWN}') from error
    return _cameras_of(data, path)


def _first_document(text: str) -> str:
    """Return a YAML text's first document: `ros2 topic echo` ends each message with ---."""
    # OpenCV writes a head and a tag of its own
    plain = re.sub(r'\A%YAML[^\n]*', '', text).replace('!!opencv-matrix', '')
    documents = re.split(r'^(?:---|\.\.\.)[ \t]*\r?$', plain, flags=re.MULTILINE)
    # comments may stand before the first
    return next((each for each in documents if re.sub(r'#[^\n]*', '', each).strip()), '')


def _cameras_of_ini(text: str, path: Path) -> Mapping[str, Reader]:
    """Return the readers of the cameras of ROS's INI file: a line of words, then its numbers."""
    sections: dict[str, dict[str, Any]] = {}
    section: dict[str, Any] = {}
    values: list[float] = []
    for line in (re.sub('[#;].*', '', line).strip() for line in text.splitlines()):
        key, sign, value = (part.strip() for part in (line.partition('=') if '=' in line else
                                                      line.partition(':')))
        numbers = _numbers_in(line)
        if line.startswith('[') and line.endswith(']'):
            section = sections.setdefault(line[1:-1].strip(), {})
        elif sign:
            section[key] = _numbers_in(value) or value
        elif numbers is None:
            section[line] = values = []
        else:
            values += numbers
    image = {key: values[0] for key, values in sections.pop(INI_IMAGE, {}).items() if values}
    return {name: partial(_opencv, {**image, **section}, path)
            for name, section in sections.items()}


def _cameras_of(data: Any, path: Path) -> Mapping[str, Reader]:
    """Return the readers of the cameras that a file's content has, by name."""
    if isinstance(data, list) and data and isinstance(data[0], Mapping):
        data = data[0].get('cameras')  # OpenSfM's reconstruction.json
    if isinstance(data, Mapping):
        if 'fx' in data:
            return {'': partial(_plain, data, path)}
        if 'verdict' in data and 'image_size' in data:
            return {'': partial(_result, data, path)}
        if {'fl_x', 'camera_angle_x'} & data.keys():
            return {'': partial(_nerfstudio, data, path)}
        if isinstance(data.get('frames'), list):
            return {str(frame.get('file_path', number)): partial(
                _nerfstudio, {**data, **frame}, path)
                for number, frame in enumerate(data['frames']) if isinstance(frame, Mapping)}
        if isinstance(data.get('calibration_data'), Mapping):
            data = data['calibration_data']  # Gyroflow's project has the profile inside
        if 'calib_dimension' in data:
            return {'': partial(_gyroflow, data, path)}
        if 'distortion_coeffs' in data:
            return {'': partial(_kalibr, data, path)}
        for key, read in (('distortion_coeffs', _kalibr), ('projection_type', _opensfm)):
            found: dict[str, Reader] = {
                str(name): partial(read, each, path) for name, each in data.items()
                if isinstance(each, Mapping) and key in each}
            if found:
                return found
        if any(each in _plain_keys(data) for each in MATRIX):
            return {'': partial(_opencv, data, path)}
    raise InputError('E-CALIBRATION-FORMAT',
                     f'{path} is not a known camera calibration; use {KNOWN}')


def _camera(size: Sequence[Any], view: Sequence[float], kind: str, d: Sequence[float],
            path: str | Path) -> Camera:
    """Return the simplest camera with these values, checked. view: fx, fy, cx, cy."""
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
    _check_lens(camera, path)
    return camera


def _check_lens(camera: Camera, path: str | Path) -> None:
    """Raise InputError for numbers that no lens has: nothing can be computed with them."""
    for name, value in camera.named.items():
        if abs(value) > LENS_NUMBER:
            raise InputError('E-CALIBRATION-LENS',
                             f'{path} has {name} = {value:.4g}, which no lens has; use a '
                             f'calibration in px')


def _seeing(found: NamedCamera) -> NamedCamera:
    """Return it; raises InputError where no pixel of its picture has a ray."""
    if rayless_share(found.camera) == 1:
        raise InputError('E-CALIBRATION-NO-RAY',
                         f'{found.name} is of a lens that sees no ray in its picture of '
                         f'{by(found.image_size)}; calibrate the camera again')
    return found


def _view(k: Sequence[float]) -> list[float]:
    """Return fx, fy, cx, cy of K (9,); ros_faults() names what else it says."""
    return [k[0], k[4], k[2], k[5]]


def _model(models: Mapping[str, str], name: Any, what: str, path: Path) -> str:
    """Return our distortion model for another program's. Raises InputError where it has none."""
    kind = models.get(name) if isinstance(name, str) else None
    if kind is None:
        raise InputError('E-LENS-MODEL',
                         f'{path} has {what} {shortened(repr(name))}, which is not supported; '
                         f'calibrate or convert it as one of {", ".join(models)}')
    return kind


def _coefficients(data: Data, kind: str, path: Path) -> list[float]:
    """Return D of coefficients by name; those that are omitted are 0."""
    known = dict.fromkeys((*TERMS[RATIONAL], 'skew', 'xi'))
    there = [name for name in known if read_number(data, name, path, 0.0)]
    more = [name for name in there if name not in TERMS[kind]]
    if more:
        raise InputError('E-LENS-COEFFICIENTS',
                         f'{path} has {", ".join(there)}, but the {kind} model has no '
                         f'{", ".join(more)}; calibrate without')
    return [read_number(data, name, path, 0.0) for name in TERMS[kind]]


def _numbers(value: Any, what: str, path: str | Path) -> list[float]:
    """Return the numbers of a list, of lists in it, or of a block with data."""
    if isinstance(value, Mapping):
        value = value.get('data')
    if not isinstance(value, list):
        raise InputError('E-CALIBRATION-MISSING',
                         f'{path} has no {what}, a list of numbers; use a complete calibration')
    found: list[float] = []
    for each in value:
        found += (_numbers(each, what, path) if isinstance(each, list)
                  else [read_number({what: each}, what, path)])
    return found


def _values(data: Data, key: str, count: int, path: Path) -> list[float]:
    found = _numbers(data.get(key), key, path)
    if len(found) != count:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path}: {key} must have {count} numbers, and has {len(found)}')
    return found


def _plain_keys(data: Data) -> dict[str, Any]:
    """Return the file's keys by what they are without capitals and signs."""
    return {re.sub('[^a-z0-9]', '', str(key).lower()): key for key in data}


def _opencv(data: Data, path: Path) -> NamedCamera:
    """Read a camera matrix and distortion coefficients: those of ROS, OpenCV, and scripts."""
    keys = _plain_keys(data)

    def first(*names: str) -> Any:
        return next((data[keys[name]] for name in names if name in keys), None)

    def numbers(names: Sequence[str], *counts: int) -> list[float]:
        """Return those of the first name that there is, nothing where there is none."""
        key = next((keys[name] for name in names if name in keys), None)
        if key is None or data[key] is None:
            return []
        found = _numbers(data[key], key, path)
        if counts and len(found) not in counts:
            raise InputError('E-CALIBRATION-COUNT',
                             f'{path}: {key} must have {counts[-1]} numbers, and has {len(found)}')
        return found

    k = numbers(MATRIX, 4, 9)
    k = k if len(k) == 9 else [k[0], 0, k[2], 0, k[1], k[3], 0, 0, 1]
    d, r, p = (numbers(DISTORTION), numbers(('rectificationmatrix', 'rectification'), 0, 9),
               numbers(('projectionmatrix', 'projection'), 0, 12))
    size = _size_in(first)
    kind, lens = first('distortionmodel'), str(first('cameramodel')).lower()
    ideal = 'distortionmodel' in keys and str(kind).lower() in NO_DISTORTION
    if not any(name in keys for name in DISTORTION) and not ideal:
        raise InputError('E-NO-DISTORTION',
                         f'{path} has no distortion_coefficients; for pictures without '
                         f'distortion, write 0 for each: distortion_coefficients: [0, 0, 0, 0, 0]')
    if 'binningx' in keys or 'roi' in keys:
        # the fields of a CameraInfo
        r, p = r or numbers(('r',), 0, 9), p or numbers(('p',), 0, 12)
        part = first('roi')
        part = part if isinstance(part, Mapping) else {}
        _check_whole(read_size(*size, path=path),
                     [read_number(data, keys.get(key, ''), path, 0.0)
                      for key in ('binningx', 'binningy')],
                     [read_number(part, key, path, 0.0)
                      for key in ('x_offset', 'y_offset', 'width', 'height')], path)
    if kind is None:
        fisheye = 'fisheye' in lens or first('fisheyemodel', 'fisheye') in (1, '1', True)
        if len(d) == 4 and any(d) and not fisheye and 'pinhole' not in lens:
            raise InputError('E-LENS-AMBIGUOUS',
                             f'{path} has 4 distortion coefficients, which may be those of a '
                             f'fisheye; add a line distortion_model: {PLUMB_BOB}, or '
                             f'{EQUIDISTANT}')
        kind = EQUIDISTANT if fisheye else PLUMB_BOB if len(d) <= 5 else RATIONAL
    camera = _camera(size, _view(k), str(kind), d, path)
    own = data.get('dashcalib')
    own = own if isinstance(own, Mapping) else {}
    verdict = own.get('verdict')
    return NamedCamera(str(path), camera, read_sigma(own.get('sigma'), camera),
                       None if verdict is None else str(verdict),
                       mount=read_mount(own.get('mount')), faults=ros_faults(camera, k, r, p))


def _size_in(first: Callable[..., Any]) -> Sequence[Any]:
    """Return width and height, as they are written. first: the first of these names' values."""
    for names, order in ((SIZES, 1), (SHAPES, -1)):
        both = first(*names)
        both = both.get('data') if isinstance(both, Mapping) else both
        if isinstance(both, list) and 2 <= len(both) <= 2 + (order < 0):
            return both[:2][::order]
    return first(*WIDTHS), first(*HEIGHTS)


def _kalibr(data: Data, path: Path) -> Camera:
    if data.get('camera_model', 'pinhole') != 'pinhole':
        raise InputError('E-LENS-MODEL',
                         f'{path} has the camera model {shortened(repr(data["camera_model"]))}; '
                         f'calibrate with --models pinhole-radtan, or pinhole-equi')
    kind = _model(KALIBR, data.get('distortion_model'), 'the distortion model', path)
    return _camera(_pair(data, 'resolution', path),
                   _values(data, 'intrinsics', 4, path), kind,
                   _numbers(data['distortion_coeffs'], 'distortion_coeffs', path), path)


def _pair(data: Data, key: str, path: Path) -> list[Any]:
    value = data.get(key)
    if not isinstance(value, list) or len(value) != 2:
        raise InputError('E-CALIBRATION-PAIR',
                         f'{path}: {key} must be [width, height], not {shortened(repr(value))}')
    return value


def _colmap(values: Sequence[Any], path: Path) -> Camera:
    """Read a line of cameras.txt without its number: model, width, height, parameters."""
    if len(values) < 3:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path} has a line without model, width and height; write it again')
    model, *size = values[:3]
    kind = _model({name: kind for name, _, kind, _ in COLMAP if kind}, model, 'the model', path)
    focals, count = next((each[1], each[3]) for each in COLMAP if each[0] == model)
    params = _numbers(list(values[3:]), model, path)
    if len(params) != focals + 2 + count:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path}: a {model} has {focals + 2 + count} parameters, not '
                         f'{len(params)}; write it again')
    cx, cy = (value - HALF_PIXEL for value in params[focals:focals + 2])
    return _camera([int(side) if str(side).isdecimal() else side for side in size],
                   [params[0], params[focals - 1], cx, cy], kind, params[focals + 2:], path)


def _colmap_binary(path: Path) -> Mapping[str, Reader]:
    data, at = read_file(path, JSON_BYTES), 8
    cameras: dict[str, Reader] = {}
    try:
        for _ in range(struct.unpack_from('<Q', data)[0]):
            number, model, *size = struct.unpack_from('<iiQQ', data, at)
            name, focals, _, count = COLMAP[model]
            params = struct.unpack_from(f'<{focals + 2 + count}d', data, at + 24)
            cameras[str(number)] = partial(_colmap, (name, *size, *params), path)
            at += 24 + 8 * len(params)
    except (struct.error, IndexError) as error:
        raise InputError('E-COLMAP-BINARY',
                         f'{path} is no cameras.bin that can be read; convert it (colmap '
                         f'model_converter --output_type TXT)') from error
    return cameras


def _nerfstudio(data: Data, path: Path) -> Camera:
    name = 'OPENCV_FISHEYE' if data.get('is_fisheye') else data.get('camera_model', 'OPENCV')
    kind = _model(NERFSTUDIO, name, 'the camera_model', path)
    width, height = read_size(data.get('w'), data.get('h'), path=path)
    if 'fl_x' in data:
        fx = read_number(data, 'fl_x', path)
    else:
        fx = width / 2 / math.tan(read_number(data, 'camera_angle_x', path) / 2)
    view = [fx, read_number(data, 'fl_y', path, fx),
            read_number(data, 'cx', path, width / 2) - HALF_PIXEL,
            read_number(data, 'cy', path, height / 2) - HALF_PIXEL]
    return _camera((width, height), view, kind, _coefficients(data, kind, path), path)


def _opensfm(data: Data, path: Path) -> Camera:
    kind = _model(OPENSFM, data['projection_type'], 'the projection_type', path)
    size = read_size(data.get('width'), data.get('height'), path=path)
    longer = max(size)
    # one focal length, or two
    fx, fy = (longer * read_number(data, key if key in data else 'focal', path)
              for key in ('focal_x', 'focal_y'))
    cx, cy = (longer * read_number(data, key, path, 0.0) + side / 2 - HALF_PIXEL
              for key, side in zip(('c_x', 'c_y'), size, strict=True))
    return _camera(size, [fx, fy, cx, cy], kind, _coefficients(data, kind, path), path)


def _gyroflow(data: Data, path: Path) -> NamedCamera:
    """Read Gyroflow's lens profile; without coefficients each of its models is a pinhole."""
    more = [key for key in GYROFLOW_MORE if data.get(key) not in (None, 0, 1, '', [], {})]
    if more:
        raise InputError('E-LENS-PROFILE',
                         f'{path} has {more[0]} = {shortened(repr(data[more[0]]))}, which is not '
                         f'supported; use a profile of pictures as the lens shows them')
    # the first profiles had no model's name, and a place for each
    standard = data.get('use_opencv_standard') is True and not data.get('use_opencv_fisheye')
    named = data.get('distortion_model')
    kind = _model(GYROFLOW, named or ('opencv_standard' if standard else 'opencv_fisheye'),
                  'the distortion_model', path)
    key = 'calib_params' if standard and not named else 'fisheye_params'
    lens, size = data.get(key), data['calib_dimension']
    if not isinstance(lens, Mapping) or not isinstance(size, Mapping):
        raise InputError('E-CALIBRATION-MISSING',
                         f'{path} has no {key} with a camera_matrix, or no calib_dimension with w '
                         f'and h; use a complete profile')
    k = _values(lens, 'camera_matrix', 9, path)
    d = _numbers(lens.get('distortion_coeffs'), 'distortion_coeffs', path)
    readout_ms = None if data.get('frame_readout_time') is None else read_number(
        data, 'frame_readout_time', path)
    if readout_ms is not None and data.get('frame_readout_direction'):
        sign = READOUT.get(str(data['frame_readout_direction']))
        readout_ms = None if sign is None else sign * abs(readout_ms)
    camera = _camera((size.get('w'), size.get('h')), _view(k), kind if any(d) else PLUMB_BOB, d,
                     path)
    # 0 is what it has where nobody has measured it
    return NamedCamera(str(path), camera, readout_ms=readout_ms or None,
                       faults=ros_faults(camera, k, [], []))


def _mrcal(text: str, path: Path) -> Camera:
    try:
        data = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise InputError('E-CAMERAMODEL',
                         f'{path} is no .cameramodel that can be read; write it again') from error
    kind = _model(MRCAL, data.get('lensmodel'), 'the lensmodel', path)
    values = _numbers(data.get('intrinsics'), 'intrinsics', path)
    if len(values) < 4:
        raise InputError('E-CALIBRATION-COUNT',
                         f'{path}: intrinsics must have 4 numbers or more')
    return _camera(_pair(data, 'imagersize', path), values[:4], kind, values[4:], path)


def _plain(data: Data, path: Path) -> NamedCamera:
    """Read fx, fy, cx, cy and coefficients by name; those after k2 may be omitted."""
    name = data.get('model', data.get('distortion_model'))
    ideal = isinstance(name, str) and name.lower() in NO_DISTORTION
    name = 'pinhole' if ideal else name
    models = [model for model in MODELS.values()
              if name in (None, model.model, model.ros_model, model.family)]
    if not models:
        raise InputError('E-CAMERA-MODEL', _no_model(name, path))
    if name is None and read_number(data, 'k4', path, 0.0) and not {'k5', 'k6'} & data.keys():
        raise InputError('E-LENS-AMBIGUOUS',
                         f'{path} has k4, which may be that of a fisheye; add "model": "fisheye", '
                         f'or "{RATIONAL}"')
    kind = (EQUIDISTANT if models[0].family == FISHEYE else
            PLUMB_BOB if name == PLUMB_BOB else RATIONAL)
    missing = [] if ideal else [each for each in Radial.names()[4:] if each not in data]
    if missing:
        zeros = ', '.join(f'"{each}": 0' for each in missing)
        raise InputError('E-NO-DISTORTION',
                         f'{path} has no {" and no ".join(missing)}; for pictures without '
                         f'distortion, write 0: {zeros}')
    camera = _camera((data.get('width'), data.get('height')),
                     [read_number(data, key, path) for key in Radial.names()[:4]], kind,
                     _coefficients(data, kind, path), path)
    return NamedCamera(str(path), camera, read_sigma(data.get('sigma'), camera))


def _result(data: Data, path: Path) -> NamedCamera:
    given = data.get('intrinsics')
    if not given:
        raise InputError('E-NO-INTRINSICS',
                         no_intrinsics(str(path), data['verdict'], data.get('reasons')))
    name = data.get('camera_model', Radial.model)
    if not isinstance(name, str) or name not in MODELS:
        raise InputError('E-CAMERA-MODEL', _no_model(name, path))
    if not isinstance(given, Mapping):
        raise InputError('E-CALIBRATION-MISSING',
                         f'{path} has no intrinsics; use a complete calibration')
    size = read_size(*_pair(data, 'image_size', path), path=path)
    camera = MODELS[name].of(
        size, [read_number(given, each, path) for each in MODELS[name].names()])
    check_focal(camera.fx, camera.fy, path)
    _check_lens(camera, path)
    sigma = read_sigma(data.get('sigma'), camera)
    return NamedCamera(str(path), camera, sigma, str(data['verdict']),
                       read_covariance(data.get('details'), camera, sigma),
                       read_sigma_px(data.get('sigma_px')),
                       read_field(data.get('field'), size), read_mount(data.get('mount')),
                       read_readout_ms(data.get('rolling_shutter')))


def _no_model(name: Any, path: Path) -> str:
    return (f'{path} has the camera model {shortened(repr(name))}; use one of '
            f'{", ".join(MODELS)}')


def _xml(text: str, path: Path) -> Any:
    """Return the content of OpenCV's XML. It has no declarations, which could be made to grow."""
    try:
        if '<!DOCTYPE' in text or '<!ENTITY' in text:
            raise ElementTree.ParseError('declarations')
        return _element(ElementTree.fromstring(text))
    except (ElementTree.ParseError, RecursionError, ValueError) as error:
        raise InputError('E-CALIBRATION-XML',
                         f'{path} is no XML that can be read; use {KNOWN}') from error


def _element(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _element(child) for child in node}
    text = node.text or ''
    numbers = _numbers_in(text)
    if numbers is None:
        return text.strip().strip('"')
    return numbers[0] if len(numbers) == 1 and node.tag != 'data' else numbers


def _numbers_in(text: str) -> list[float] | None:
    """Return the numbers of a text, None where it has other words."""
    try:
        return [int(word) if word.lstrip('+-').isdecimal() else float(word)
                for word in text.split()]
    except ValueError:
        return None


def _arrays(path: Path) -> Data:
    """Return the small arrays of an .npz, as lists."""
    try:
        check_file(path)
        with path.open('rb') as file:
            check_npz(file, ARRAYS)
            with np.load(file, allow_pickle=False) as arrays:
                small = [info.filename.removesuffix('.npy') for info in arrays.zip.infolist()
                         if info.file_size <= ARRAY_BYTES]
                return {name: arrays[name].tolist() for name in small}
    except InputError:
        raise
    except Exception as error:  # a damaged file makes numpy raise nearly anything
        raise InputError('E-CALIBRATION-NPZ',
                         f'{path} is no .npz that can be read; write it again') from error


def calibrated_camera(calibration: Calibration, name: str = 'estimate') -> NamedCamera:
    """Return the camera of a calibration. Raises InputError when it was refused."""
    if calibration.camera is None:
        raise InputError('E-NO-INTRINSICS', no_intrinsics(
            name, calibration.verdict.level, calibration.verdict.reasons))
    shutter, field = calibration.rolling_shutter, calibration.field
    return NamedCamera(name, calibration.camera, calibration.sigma, calibration.verdict.level,
                       read_covariance(calibration.details, calibration.camera,
                                       calibration.sigma),
                       calibration.sigma_px,
                       field.field if field is not None and field.used else None,
                       mount=calibration.mount,
                       readout_ms=None if shutter is None else shutter.readout_ms)


Given = Calibration | NamedCamera | Camera | str | os.PathLike[str]


def given_camera(given: Given) -> NamedCamera:
    """Return the camera of a calibration: a result, a file as for load_camera(), or a camera.

    Raises InputError for a refused result, a file that cannot be read, and any other object.
    """
    if isinstance(given, NamedCamera):
        return given
    if isinstance(given, Calibration):
        return calibrated_camera(given)
    if isinstance(given, Camera):
        return NamedCamera(f'the {given.model} camera', given)
    if isinstance(given, (str, os.PathLike)):
        return load_camera(given)
    raise InputError('E-CALIBRATION-TYPE', f'a calibration cannot be {shortened(repr(given))}: '
                                           f'pass a Calibration, a camera, or the path of a file')


def read_size(width: Any, height: Any, *, path: str | Path) -> tuple[int, int]:
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
        raise InputError('E-CALIBRATION-NUMBER',
                         f'{path} has {what}; use a complete calibration with finite numbers')
    return number


def check_focal(fx: float, fy: float, path: str | Path) -> None:
    """Raise InputError for the focal lengths of a camera that is not calibrated."""
    if not (fx > 0 and fy > 0):
        raise InputError('E-CALIBRATION-EMPTY',
                         f'{path} is uncalibrated: its focal length is not positive; calibrate '
                         f'the camera')


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
    if coefficients.shape != (2, len(FIELD_TERMS)) or not np.isfinite(coefficients).all():
        raise InputError('E-CALIBRATION-FIELD',
                         'its field has no coefficients that can be read; calibrate again')
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


def read_readout_ms(data: Any) -> float | None:
    """Return result.json's readout time; a missing one is no error."""
    try:
        return read_number(data, 'readout_ms', '')
    except (AttributeError, TypeError, InputError):
        return None


def no_intrinsics(name: str, verdict: Any, reasons: Any) -> str:
    """Return the message for a refused calibration, which has no intrinsics."""
    known = '; '.join(map(str, reasons)) if isinstance(reasons, (list, tuple)) else ''
    return (f'{name} has no intrinsics to compare, its verdict is {verdict}'
            + (f': {known}' if known else '') + '; calibrate a drive with more turns')
