# SPDX-License-Identifier: Apache-2.0
"""Reads a camera from a calibration of any common kind: load_camera().

Where a file has several cameras, the caller names one.
"""
from __future__ import annotations

import os
import re
import shlex
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.other import OtherLens
from dashcalib_ros.camera.other import nearest as nearest_camera
from dashcalib_ros.errors import InputError, Notice, shortened
from dashcalib_ros.formats import colmap, ros
from dashcalib_ros.formats.ours import calibrated_camera
from dashcalib_ros.formats.plausible import check_lens, doubts
from dashcalib_ros.formats.table import FORMATS
from dashcalib_ros.formats.values import (
    Cameras,
    Data,
    Read,
    Size,
    Sizeless,
    numbers_in,
    said_model,
    xml_root,
)
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
KNOWN = ('a result.json (or its folder), a camera_info YAML, a file of OpenCV, Kalibr, COLMAP or '
         'another program or data set of docs/formats.md, a JSON of fx, fy, cx, cy, k1, k2, width '
         'and height, or a bag with camera_info')
# tables of cameras, and rows of one that are read
TABLES, ROWS = ('.feather', '.parquet'), 1000
# names that promise a format: there it is worth a correction
NAMED = ('.json', '.yaml', '.yml')
Given = CalibrationData | NamedCamera | Camera | str | os.PathLike[str]


def load_camera(path: str | os.PathLike[str], *, name: str | None = None,
                image_size: Size | None = None, nearest: bool = False) -> NamedCamera:
    """Read a camera from a calibration; returns it with its name, and sigma and verdict if known.

    path: a result.json (or its folder) or calibration.yaml of this package; a camera_info YAML; a
    YAML, XML, JSON or .npz with OpenCV's camera matrix and distortion coefficients; a file of one
    of the programs and data sets in docs/formats.md; a JSON of fx, fy, cx, cy, k1, k2 ..., width
    and height, which may say its "model"; a bag that has camera_info.
    name: which camera, of a file that has several: as the file names it (cam1, 2) or by its
    number, for a bag its image topic or its camera_info topic. FILE:NAME as the path means the
    same.
    image_size: (width, height) of the pictures, for a file that does not say it.
    nearest: of a lens that none of our models describes, return the nearest one that does; its
    warnings say by how many px it is off.

    Returns a NamedCamera: its `camera` is a Radial, Brown, Rational or Fisheye, in px of the full
    pictures, with the centre of the first pixel at (0, 0). Raises InputError, in one line that
    names the remedy, for a file that cannot be read, a lens that none of these describes, and a
    file with several cameras where none is named.
    """
    return load_with_faults(path, name, lambda: image_size, nearest).without_faults()


def load_with_faults(path: str | os.PathLike[str], name: str | None = None,
                     size: Callable[[], Size | None] = lambda: None, nearest: bool = False
                     ) -> NamedCamera:
    """Read a camera as load_camera() does; what is wrong beside it (R, P) is in its faults.

    size: returns image_size; it is called where the file does not say it.
    """
    return _checked(*_loaded(path, name), size, nearest)


def load_pair(a: str | os.PathLike[str], b: str | os.PathLike[str]
              ) -> tuple[NamedCamera, NamedCamera]:
    """Read two cameras of the same pictures; one file may omit the pictures' size."""
    found = [_loaded(path, None) for path in (a, b)]
    sizes = [read.image_size for _, read in found if not isinstance(read, Sizeless)]
    first, second = (_checked(label, read, lambda: sizes[0] if sizes else None, False)
                     .without_faults() for label, read in found)
    return first, second


def _checked(label: str, found: Read, size: Callable[[], Size | None], nearest: bool
             ) -> NamedCamera:
    if isinstance(found, Sizeless):
        known = size()
        if known is None:
            raise InputError('E-CALIBRATION-NO-SIZE',
                             f'{label} has no size of the pictures; {found.remedy}')
        found = found.of(known)
    notices: tuple[Notice, ...] = ()
    if isinstance(found, OtherLens):
        if not nearest:
            raise InputError('E-LENS-MODEL',
                             f'{label} has the lens model {found.model!r}, which ROS has not; '
                             f'write the nearest one with dashcalib export '
                             f'{shlex.quote(label)} --nearest --to ros')
        found, notices = _nearest(label, found)
    if isinstance(found, Camera):
        found = NamedCamera(label, found)
    return replace(found, warnings=(*notices, *doubts(found.camera, found.name)))


def _nearest(label: str, lens: OtherLens) -> tuple[Camera, tuple[Notice, ...]]:
    found = nearest_camera(lens)
    check_lens(found.camera, label)
    unseen = (f'; the lens has no ray for {100 * found.unseen:.0f} % of the picture'
              if found.unseen else '')
    return found.camera, (Notice(
        'E-LENS-NEAREST',
        f'{label} has the lens model {lens.model!r}: the nearest one of ROS, '
        f'{found.camera.ros_model}, is off by {found.rms_px:.2g} px RMS over the picture and '
        f'{found.worst_px:.2g} px at the worst, at {found.worst_at}{unseen}'),)


def _loaded(path: str | os.PathLike[str], name: str | None) -> tuple[str, Read]:
    text = str(path_of(path))
    before, _, after = text.rpartition(':')
    # lexists() takes any text, also one that is too long for a name
    if name is None and before and os.path.lexists(before) and not os.path.lexists(text):
        text, name = before, after
    place = Path(text)
    try:
        if place.suffix == '.db':
            return _chosen(colmap.database_cameras(place), name, place)
        if fits_bag(place):
            found = ros.camera_of_bag(place, name)
            return found.name, found
        if place.is_dir():
            inside = [place / each for each in IN_FOLDER if (place / each).exists()]
            if not inside:
                raise InputError('E-CALIBRATION-FOLDER',
                                 f'{place} is a folder without a calibration; use {KNOWN}')
            place = inside[0]
        if place.suffix == '.npz':
            return _chosen(_cameras_in(_arrays(place), place), name, place)
        if place.suffix in TABLES:
            return _chosen(_cameras_in(_table(place), place), name, place)
        if place.suffix == '.bin':
            return _chosen(colmap.binary_cameras(place), name, place)
        return _chosen(_text_cameras(read_text(place, JSON_BYTES), place), name, place)
    except OSError as error:
        raise os_error(place, error) from error


def parse_camera(text: str, path: str | Path, name: str | None = None) -> NamedCamera:
    """Read a camera from a calibration's text; path is for messages only. See load_camera()."""
    return _checked(*_chosen(_text_cameras(text, Path(path)), name, path), lambda: None, False)


def _text_cameras(text: str, place: Path) -> Cameras:
    for form in FORMATS.values():
        if form.in_text and (found := form.in_text(text, place)):
            return found
    return _cameras_in(_decoded(text, place), place)


def _cameras_in(data: Any, path: Path) -> Cameras:
    for form in FORMATS.values():
        if form.in_data and (found := form.in_data(data, path)):
            return found
    raise _unknown(path, said_model(data))


def _unknown(path: Path, model: str | None = None) -> InputError:
    said = '' if model is None else f' (it says: {shortened(model, 40)})'
    return InputError('E-CALIBRATION-FORMAT',
                      f'{path} is not a known camera calibration{said}; use {KNOWN}')


def _chosen(cameras: Cameras, name: str | None, path: str | Path) -> tuple[str, Read]:
    if name is None and len(cameras) == 1:
        name = next(iter(cameras))
    if name is not None and name not in cameras and name.isdecimal():
        numbered = [each for each in cameras if re.findall(r'\d+', each)[-1:]
                    and int(re.findall(r'\d+', each)[-1]) == int(name)]
        name = numbered[0] if len(numbered) == 1 else name
    if name is not None and name in cameras:
        return f'{path}:{name}' if len(cameras) > 1 else str(path), cameras[name]()
    there = shortened(', '.join(cameras)) or 'one camera without a name'
    if name is not None:
        raise InputError('E-CAMERA-NAME',
                         f'{path} has no camera {shortened(name)!r}; use one of {there}')
    raise InputError('E-CAMERA-CHOICE',
                     f'{path} has {len(cameras)} cameras; name one, as in '
                     f'{path}:{next(iter(cameras), "1")}; it has {there}')


def _decoded(text: str, path: Path) -> Any:
    start = text.lstrip()[:1]
    if start == '<':
        return _element(xml_root(text, path))
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


def _element(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _element(child) for child in node}
    text = node.text or ''
    numbers = numbers_in(text)
    if numbers is None:
        return text.strip().strip('"')
    return numbers[0] if len(numbers) == 1 and node.tag != 'data' else numbers


def _arrays(path: Path) -> Data:
    try:
        check_file(path)
        with path.open('rb') as file:
            check_npz(file, ARRAYS)
            with np.load(file, allow_pickle=False) as arrays:
                sizes = sorted((info.file_size, info.filename.removesuffix('.npy'))
                               for info in arrays.zip.infolist())
                small = [name for (_, name), total in zip(
                    sizes, accumulate(size for size, _ in sizes), strict=True)
                    if total <= ARRAY_BYTES]
                return {name: arrays[name].tolist() for name in small}
    except InputError:
        raise
    except Exception as error:  # a damaged file makes numpy raise nearly anything
        raise InputError('E-CALIBRATION-NPZ',
                         f'{path} is no .npz that can be read; write it again') from error


def _table(path: Path) -> list[Data]:
    check_file(path, limit=JSON_BYTES)
    try:
        from pyarrow import feather, parquet
    except ImportError as error:
        raise InputError('E-CALIBRATION-ARROW',
                         f"{path} needs pyarrow: pip install '.[fleet]' in the folder of this "
                         f'package') from error
    try:
        table = (feather if path.suffix == TABLES[0] else parquet).read_table(str(path))
        return list(table.slice(0, ROWS).to_pylist())
    except Exception as error:  # a damaged file makes Arrow raise nearly anything
        raise InputError('E-CALIBRATION-TABLE',
                         f'{path} is not a readable table; copy it again') from error


def given_camera(given: Given, size: Callable[[], Size | None] = lambda: None) -> NamedCamera:
    """Return the camera of a calibration: a result, a file as for load_camera(), or a camera.

    size: returns that of the pictures, for a file that does not say it.
    Raises InputError for a refused result, a file that cannot be read, and any other object.
    """
    if isinstance(given, NamedCamera):
        return given
    if isinstance(given, CalibrationData):
        return calibrated_camera(given)
    if isinstance(given, Camera):
        return NamedCamera(f'the {given.model} camera', given)
    if isinstance(given, (str, os.PathLike)):
        return load_with_faults(given, size=size).without_faults()
    raise InputError('E-CALIBRATION-TYPE', f'a calibration cannot be {shortened(repr(given))}: '
                                           f'pass a Calibration, a camera, or the path of a file')
