"""The user's mask: a picture as large as the images, black where they are not to be used."""
from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from dashcalib_ros.arrays import Mask
from dashcalib_ros.errors import InputError
from dashcalib_ros.input.decode import decode_pixels
from dashcalib_ros.limits import PICTURE_BYTES, read_file


def read_mask(path: Path) -> Mask:
    """Read a mask picture: (height, width), True where it is not black; ~ is expanded.

    Raises InputError.
    """
    with suppress(RuntimeError):  # ~user of an unknown user: the path stays as it is
        path = path.expanduser()
    what = f'the mask {path}'
    data = read_file(path, PICTURE_BYTES, what)
    try:
        mask: Mask = decode_pixels(data) > 0
    except InputError as error:
        raise InputError(f'{what} is no picture that can be used ({error}); give a PNG, black '
                         'where the image is not to be used') from error
    if not mask.any():
        raise InputError(f'the mask {path} is all black, nothing is left of the image; '
                         'make the part to use white')
    return mask


def check_mask(mask: Mask | None, size: tuple[int, int]) -> None:
    """Raise InputError unless the mask is as large as images of this (width, height)."""
    if mask is not None and (own := mask.shape[::-1]) != size:
        raise InputError(f'the mask is {own[0]}x{own[1]} and the images are '
                         f'{size[0]}x{size[1]}; make the mask as large as the images')
