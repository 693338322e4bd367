"""Pictures are made smaller by an integer factor."""
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from dashcalib_ros.arrays import GreyImage, Mask
from dashcalib_ros.errors import InputError
from dashcalib_ros.frames.frame import Frame


def shrink_factor(size: tuple[int, int], max_width: int) -> int:
    """Return the power of two that an image of this (width, height) is divided by to fit.

    Raises InputError for an image with too few rows to be shrunk.
    """
    factor = 1
    while size[0] / factor > max_width:
        factor *= 2
    if size[1] < factor and factor > 1:
        raise InputError(f'the images are {size[0]}x{size[1]}: a camera has more rows')
    return factor


def shrink_image(image: GreyImage, factor: int) -> GreyImage:
    """Return the image averaged over blocks of factor x factor pixels.

    Incomplete blocks at the right and lower edge are cut off, so that pixel (x, y) of the small
    image is exactly ((x + 0.5) factor - 0.5, (y + 0.5) factor - 0.5) of the large one.
    """
    if factor == 1:
        return image
    height, width = (max(1, side // factor) for side in image.shape)
    small = cv2.resize(image[:height * factor, :width * factor], (width, height),
                       interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def shrink_mask(valid: Mask, factor: int) -> Mask:
    """Return the mask for an image shrunk alike: valid where all of a block is."""
    height, width = (side // factor for side in valid.shape)
    blocks = valid[:height * factor, :width * factor].reshape(height, factor, width, factor)
    return np.asarray(blocks.all(axis=(1, 3)), bool)


def shrink(frame: Frame, factor: int) -> Frame:
    """Return the frame with its image shrunk."""
    return frame if factor == 1 else replace(frame, image=shrink_image(frame.image, factor))
