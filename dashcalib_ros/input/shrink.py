"""Pictures and masks are made smaller by a whole number."""
from __future__ import annotations

import cv2
import numpy as np

from dashcalib_ros.arrays import GreyImage, Mask


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
