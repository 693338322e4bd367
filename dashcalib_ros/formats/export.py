# SPDX-License-Identifier: Apache-2.0
"""A camera as the file of another program, of its pictures or of resized or cropped ones."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dashcalib_ros.camera import Camera
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.formats.load import Given, given_camera
from dashcalib_ros.formats.table import FORMATS
from dashcalib_ros.input.source import size_text
from dashcalib_ros.judge.check import same_shape
from dashcalib_ros.limits import check_pixels

EXPORTS = {name: form for name, form in FORMATS.items() if form.write}


def export(calibration: Given, kind: str) -> str | bytes:
    """Return a calibration as another program's camera file.

    calibration: a Calibration, what load_camera() returns, a camera, or the path of a file that
    load_camera() reads. kind: colmap, gyroflow, kalibr, opensfm, nerfstudio, mrcal, foxglove, ros,
    opencv, rays or maps; urdf or tf for how the camera sits on the car. What the kind has no place
    for (the residual distortion, the readout time of a rolling shutter) is omitted.

    Returns the file's text; the bytes of an .npz for rays and maps. Raises InputError for a file
    that cannot be read, ConfigError for an unknown kind, a lens that it cannot describe, or a
    mounting that is not known, and OutputError for a lens that mrcal's spline cannot describe.
    """
    write = EXPORTS[kind].write if kind in EXPORTS else None
    if write is None:
        raise ConfigError('E-EXPORT-KIND',
                          f'{kind!r} is not a kind of export; use one of {", ".join(EXPORTS)}')
    return write(given_camera(calibration))


def check_suffix(path: Path, kind: str) -> None:
    """Raise ConfigError where a file's name promises another content than an export's."""
    # export() refuses a kind that does not exist
    known = EXPORTS[kind].suffixes if kind in EXPORTS else ()
    if known and path.suffix.lower() not in known:
        raise ConfigError('E-EXPORT-SUFFIX',
                          f'--to {kind} writes {" or ".join(filter(None, known))}, not what '
                          f'{path.name!r} says; use --out {path.with_suffix(known[0])}')


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the camera of pictures that were resized to (width, height).

    Raises ConfigError where that would stretch them, and InputError beyond limits.
    """
    if min(size) < 1:
        raise ConfigError('E-SIZE-NOT-POSITIVE',
                          f'{size_text(size)} is not a picture size; write its width and '
                          f'height in px')
    check_pixels(*size, 'the resized picture')
    if not same_shape(camera.image_size, size):
        raise ConfigError('E-SIZE-SHAPE',
                          f'{size_text(size)} has another shape than the '
                          f'{size_text(camera.image_size)} of the '
                          f'calibration; if the picture was cropped, use --crop')
    x, y = (new / old for new, old in zip(size, camera.image_size, strict=True))
    return camera.resized(x, size, y)


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """Return the camera of a part of its pictures. Raises ConfigError where it sticks out."""
    if (min(left, top) < 0 or min(width, height) < 1 or left + width > camera.image_size[0]
            or top + height > camera.image_size[1]):
        raise ConfigError('E-CROP-OUTSIDE',
                          f'{left},{top},{width},{height} is not a part of a picture of '
                          f'{size_text(camera.image_size)}; write X,Y,W,H in px: the top left '
                          f'corner of the part, and its size')
    return replace(camera, image_size=(width, height), cx=camera.cx - left, cy=camera.cy - top)
