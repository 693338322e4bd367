"""The user's mask: a picture as large as the images, black where they are not to be used."""
from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

import dashcalib_ros.frames.quiet  # noqa: F401
from dashcalib_ros.errors import InputError


def read_mask(path: Path) -> npt.NDArray[np.bool_]:
    """Read a mask picture: (height, width), True where it is not black; ~ is expanded.

    Raises InputError.
    """
    with suppress(RuntimeError):  # there is no such user: there will be no such file
        path = path.expanduser()
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f'cannot read the mask {path} ({error.strerror}); '
                         'check the path') from error
    picture = None
    if data.size:
        picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if picture is None:
        raise InputError(f'the mask {path} is no picture; give a PNG, black where the image is '
                         'not to be used')
    mask: npt.NDArray[np.bool_] = np.asarray(picture) > 0
    if not mask.any():
        raise InputError(f'the mask {path} is all black, nothing is left of the image; '
                         'make the part to use white')
    return mask


def check_mask(mask: npt.NDArray[np.bool_] | None, size: tuple[int, int]) -> None:
    """Raise InputError unless the mask is as large as images of this (width, height)."""
    if mask is not None and (own := mask.shape[::-1]) != size:
        raise InputError(f'the mask is {own[0]}x{own[1]} and the images are '
                         f'{size[0]}x{size[1]}; make the mask as large as the images')
