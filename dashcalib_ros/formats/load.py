# SPDX-License-Identifier: Apache-2.0
"""Reads a camera from a calibration of any common kind: load_camera().

Where a file has several cameras, the caller names one.
"""
from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.errors import InputError, shortened
from dashcalib_ros.formats import colmap, ros
from dashcalib_ros.formats.ours import calibrated_camera
from dashcalib_ros.formats.plausible import doubts
from dashcalib_ros.formats.table import FORMATS
from dashcalib_ros.formats.values import Cameras, Data, numbers_in, said_model
from dashcalib_ros.input.inputs import fits_bag
from dashcalib_ros.input.source import os_error
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.limits import (
    ARRAY_BYTES,
    ARRAYS,
    JSON_BYTES,
    check_file,
    check_npz,
    parse_json,
    parse_yaml,
    path_of,
    read_text,
)

# the first of these that a folder has is read
IN_FOLDER = ('result.json', 'calibration.yaml', 'cameras.bin', 'cameras.txt',
             'sparse/0/cameras.bin', 'sparse/0/cameras.txt', 'camera_models.json',
             'transforms.json')
KNOWN = ('a result.json (or its folder), a camera_info YAML, a file of OpenCV, Kalibr, COLMAP, '
         'nerfstudio, OpenSfM, mrcal or Gyroflow, a JSON of fx, fy, cx, cy, k1, k2, width and '
         'height, or a bag with camera_info')
# names that promise a format: there it is worth a correction
NAMED = ('.json', '.yaml', '.yml')
Given = CalibrationData | NamedCamera | Camera | str | os.PathLike[str]


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
    found = _loaded(path, name)
    return replace(found, warnings=doubts(found.camera, found.name))


def _loaded(path: str | os.PathLike[str], name: str | None) -> NamedCamera:
    text = str(path_of(path))
    before, _, after = text.rpartition(':')
    # lexists() takes any text, also one that is too long for a name
    if name is None and before and os.path.lexists(before) and not os.path.lexists(text):
        text, name = before, after
    place = Path(text)
    try:
        if fits_bag(place):
            return ros.camera_of_bag(place, name)
        if place.is_dir():
            inside = [place / each for each in IN_FOLDER if (place / each).exists()]
            if not inside:
                raise InputError('E-CALIBRATION-FOLDER',
                                 f'{place} is a folder without a calibration; use {KNOWN}')
            place = inside[0]
        if place.suffix == '.npz':
            return _chosen(_cameras_in(_arrays(place), place), name, place)
        if place.suffix == '.bin':
            return _chosen(colmap.binary_cameras(place), name, place)
        return parse_camera(read_text(place, JSON_BYTES), place, name)
    except OSError as error:
        raise os_error(place, error) from error


def parse_camera(text: str, path: str | Path, name: str | None = None) -> NamedCamera:
    """Read a camera from a calibration's text; path is for messages only. See load_camera()."""
    place = Path(path)
    for form in FORMATS.values():
        if form.in_text and (found := form.in_text(text, place)):
            return _chosen(found, name, path)
    return _chosen(_cameras_in(_decoded(text, place), place), name, path)


def _cameras_in(data: Any, path: Path) -> Cameras:
    """Return the cameras that a file's data has. Raises InputError where no format has any."""
    for form in FORMATS.values():
        if form.in_data and (found := form.in_data(data, path)):
            return found
    raise _unknown(path, said_model(data))


def _unknown(path: Path, model: str | None = None) -> InputError:
    said = '' if model is None else f' (it says: {shortened(model, 40)})'
    return InputError('E-CALIBRATION-FORMAT',
                      f'{path} is not a known camera calibration{said}; use {KNOWN}')


def _chosen(cameras: Cameras, name: str | None, path: str | Path) -> NamedCamera:
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


def _decoded(text: str, path: Path) -> Any:
    """Return what a text of XML, JSON or YAML has. Raises InputError."""
    start = text.lstrip()[:1]
    if start == '<':
        return _xml(text, path)
    try:
        return (parse_json(text, str(path)) if start in ('{', '[')
                else parse_yaml(_first_document(text), str(path)))
    except InputError as error:
        if error.__cause__ is None:
            raise  # a limit; the rest is what the parser cannot read
        if start != '{' and path.suffix.lower() not in NAMED:
            raise _unknown(path) from error
        raise InputError(error.code, f'{error}; use {KNOWN}') from error


def _first_document(text: str) -> str:
    """Return a YAML text's first document: `ros2 topic echo` ends each message with ---."""
    # OpenCV writes a head and a tag of its own
    plain = re.sub(r'\A%YAML[^\n]*', '', text).replace('!!opencv-matrix', '')
    documents = re.split(r'^(?:---|\.\.\.)[ \t]*\r?$', plain, flags=re.MULTILINE)
    # comments may stand before the first
    return next((each for each in documents if re.sub(r'#[^\n]*', '', each).strip()), '')


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
    numbers = numbers_in(text)
    if numbers is None:
        return text.strip().strip('"')
    return numbers[0] if len(numbers) == 1 and node.tag != 'data' else numbers


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


def given_camera(given: Given) -> NamedCamera:
    """Return the camera of a calibration: a result, a file as for load_camera(), or a camera.

    Raises InputError for a refused result, a file that cannot be read, and any other object.
    """
    if isinstance(given, NamedCamera):
        return given
    if isinstance(given, CalibrationData):
        return calibrated_camera(given)
    if isinstance(given, Camera):
        return NamedCamera(f'the {given.model} camera', given)
    if isinstance(given, (str, os.PathLike)):
        return load_camera(given)
    raise InputError('E-CALIBRATION-TYPE', f'a calibration cannot be {shortened(repr(given))}: '
                                           f'pass a Calibration, a camera, or the path of a file')
