# SPDX-License-Identifier: Apache-2.0
"""OpenCV's camera matrix and distortion coefficients, as ROS and many scripts write them, too.

Read from YAML, XML, JSON and .npz; written as cv2.FileStorage does, and beside a value for each
pixel in an .npz: viewing rays, and the maps of cv2.remap.
"""
from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.camera import NO_DISTORTION, Camera, ros_faults
from dashcalib_ros.camera.other import OtherLens, plane, undone
from dashcalib_ros.camera.other import opencv as distortion
from dashcalib_ros.camera.remap import source_map
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    RATIONAL,
    Cameras,
    Data,
    camera_with,
    check_lens_kind,
    focal_and_centre,
    is_fisheye,
    no_distortion,
    plain_key,
    read_matrix,
    read_numbers,
    read_size,
)
from dashcalib_ros.judge.difference import NamedCamera

# how files name these values, in small letters without anything between them; in a shape the
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
RECTIFICATION = ('rectificationmatrix', 'rectification')
PROJECTION = ('projectionmatrix', 'projection')
# coefficients of a lens with thin prisms, without and with a tilted sensor
PRISMS = (12, 14)


class Entries:
    """The values of a file by any of their names, without regard to capitals and signs."""

    def __init__(self, data: Data, path: Path) -> None:
        self.data, self.path = data, path
        self._keys = {plain_key(key): key for key in data}

    def __contains__(self, name: str) -> bool:
        return name in self._keys

    def key(self, *names: str) -> Any:
        """Return how the file writes the first of the names that it has, None if none."""
        return next((self._keys[name] for name in names if name in self._keys), None)

    def first(self, *names: str) -> Any:
        """Return the value of the first of the names that the file has, None if none."""
        key = self.key(*names)
        return None if key is None else self.data[key]

    def numbers(self, names: Sequence[str], *counts: int) -> list[float]:
        """Return the numbers of the first of the names, [] where there are none.

        counts: how many there may be; none: any. Raises InputError.
        """
        value = self.first(*names)
        return [] if value is None else read_numbers(value, self.key(*names), self.path, *counts)


def has_matrix(data: Any) -> bool:
    """Return whether a file's data has a camera matrix."""
    return isinstance(data, dict) and any(map(Entries(data, Path()).__contains__, MATRIX))


def cameras(data: Any, path: Path) -> Cameras:
    """Return the camera of a file with a camera matrix; see formats/table.py."""
    return {'': partial(read, data, path)} if has_matrix(data) else {}


def read(data: Data, path: Path, rectification: Sequence[str] = RECTIFICATION,
         projection: Sequence[str] = PROJECTION) -> NamedCamera | OtherLens:
    """Return the camera of a camera matrix and distortion coefficients.

    rectification, projection: the names of ROS's R and P. Raises InputError.
    """
    entries = Entries(data, path)
    k = read_matrix(data, entries.key(*MATRIX), path)
    given = entries.first(*DISTORTION)
    named = isinstance(given, dict) and not isinstance(given.get('data'), list)
    d = [] if named else entries.numbers(DISTORTION)
    r, p = entries.numbers(rectification, 0, 9), entries.numbers(projection, 0, 12)
    size = size_in(entries.first)
    kind, lens = entries.first('distortionmodel'), str(entries.first('cameramodel')).lower()
    ideal = 'distortionmodel' in entries and str(kind).lower() in NO_DISTORTION
    check_lens_kind(lens, path)
    if named or (entries.key(*DISTORTION) is None and not ideal):
        raise no_distortion(data, 'no distortion_coefficients',
                            ' for each: distortion_coefficients: [0, 0, 0, 0, 0]', path)
    if kind is None:
        fisheye = ('fisheye' in lens
                   or entries.first('fisheyemodel', 'fisheye') in (1, '1', True))
        if len(d) == 4 and any(d) and not fisheye and 'pinhole' not in lens:
            raise InputError('E-LENS-AMBIGUOUS',
                             f'{path} has 4 distortion coefficients, which may be those of a '
                             f'fisheye; add a line distortion_model: {PLUMB_BOB}, or '
                             f'{EQUIDISTANT}')
        kind = EQUIDISTANT if fisheye else PLUMB_BOB if len(d) <= 5 else RATIONAL
    if len(d) in PRISMS and any(d[8:]) and kind in (PLUMB_BOB, RATIONAL):
        return OtherLens('thin prisms', read_size(*size, path=path), focal_and_centre(k),
                         undone(distortion(d), plane))
    camera = camera_with(size, focal_and_centre(k), str(kind), d, path)
    return NamedCamera(str(path), camera, faults=ros_faults(camera, k, r, p))


def size_in(first: Callable[..., Any]) -> Sequence[Any]:
    """Return width and height, as they are written. first: the first of these names' values."""
    for names, order in ((SIZES, 1), (SHAPES, -1)):
        both = first(*names)
        both = both.get('data') if isinstance(both, dict) else both
        if isinstance(both, list) and 2 <= len(both) <= 2 + (order < 0):
            return both[:2][::order]
    return first(*WIDTHS), first(*HEIGHTS)


def write(found: NamedCamera) -> str:
    """Return what cv2.FileStorage writes; a fisheye's D is that of cv2.fisheye."""
    camera = found.camera
    file = cv2.FileStorage('.yaml', cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    width, height = camera.image_size
    file.write('image_width', width)
    file.write('image_height', height)
    file.write('camera_model', 'fisheye' if is_fisheye(camera) else 'pinhole')
    file.write('camera_matrix', camera.matrix)
    file.write('distortion_coefficients', np.array([camera.ros_distortion()]))
    return str(file.releaseAndGetString())


def write_rays(found: NamedCamera) -> bytes:
    """Return an .npz with rays (h, w, 3): the unit viewing ray of each pixel, NaN for none."""
    camera, (width, height) = found.camera, found.image_size
    pixels = np.stack(np.meshgrid(np.arange(width, dtype=float),
                                  np.arange(height, dtype=float)), -1)
    ideal = pixels if found.field is None else found.field.ideal(pixels)
    return _npz(camera, rays=camera.rays(ideal).astype(np.float32))


def write_maps(found: NamedCamera) -> bytes:
    """Return an .npz with map_x, map_y (h, w) for cv2.remap: to a pinhole with the same K."""
    x, y = np.moveaxis(source_map(found.camera, field=found.field), -1, 0)
    return _npz(found.camera, map_x=x, map_y=y)


def _npz(camera: Camera, **arrays: npt.NDArray[np.float32]) -> bytes:
    file = io.BytesIO()
    both: dict[str, Any] = {
        **arrays, 'K': camera.matrix, 'D': np.array(camera.ros_distortion()),
        'distortion_model': np.array(camera.ros_model), 'image_size': np.array(camera.image_size)}
    np.savez(file, **both)
    return file.getvalue()
