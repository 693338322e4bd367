# SPDX-License-Identifier: Apache-2.0
"""How much larger or smaller pictures are made before anything else sees them."""
from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from dashcalib_ros.arrays import GreyImage, Mask
from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError
from dashcalib_ros.input.source import Frame

# times; a picture that needs more shows too little, however large it is made
MOST = 4


@dataclass(frozen=True)
class Scale:
    """Pictures are made `shrink` times smaller or `enlarge` times larger; one of them is 1.

    Pixel (x, y) of a resized picture is exactly ((x + 0.5) px - 0.5, (y + 0.5) px - 0.5) of the
    input.
    """

    shrink: int = 1
    enlarge: int = 1

    @classmethod
    def of(cls, size: tuple[int, int], config: Config) -> Scale:
        """Return how pictures of this (width, height) are resized.

        Those wider than max_width are halved until they fit. Narrower ones than min_width are
        enlarged until they reach it, but no side beyond max_width. Raises InputError for pictures
        with too few rows to be shrunk.
        """
        shrink = 1
        while size[0] / shrink > config.max_width:
            shrink *= 2
        if size[1] < shrink and shrink > 1:
            raise InputError('E-IMAGE-SHAPE',
                             f'the images have {size[0]}x{size[1]} pixels, too few '
                             f'rows for a camera: check the input')
        wanted = -(-config.min_width // size[0])
        return cls(shrink, max(1, min(wanted, MOST, config.max_width // max(size))))

    @property
    def px(self) -> float:
        """Return the width of a resized picture's pixel, in pixels of the input."""
        return self.shrink / self.enlarge

    def size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the (width, height) of resized pictures, for the input's."""
        width, height = size
        return width // self.shrink * self.enlarge, height // self.shrink * self.enlarge

    def frame(self, frame: Frame) -> Frame:
        """Return the frame with its picture resized."""
        if self == FULL_SIZE:
            return frame
        small = shrink_image(frame.image, self.shrink)
        return replace(frame, image=enlarge_image(small, self.enlarge))

    def mask(self, valid: Mask) -> Mask:
        """Return the mask (h, w) of resized pictures: valid where all of the input's are."""
        by = self.shrink
        height, width = (side // by for side in valid.shape)
        blocks = valid[:height * by, :width * by].reshape(height, by, width, by)
        small = np.asarray(blocks.all(axis=(1, 3)), bool)
        return small.repeat(self.enlarge, axis=0).repeat(self.enlarge, axis=1)

    def __str__(self) -> str:
        if self == FULL_SIZE:
            return 'at full size'
        return f'enlarged by {self.enlarge}' if self.px < 1 else f'shrunk by {self.shrink}'


# of pictures that are used as they are
FULL_SIZE = Scale()


def enlarge_image(image: GreyImage, factor: int) -> GreyImage:
    """Return the image factor times as large.

    Cubic interpolation moves edges between the pixels by up to 0.04 px of the image, Lanczos' by
    0.01 px.
    """
    if factor == 1:
        return image
    # four times as quick as on uint8
    large = cv2.resize(image.astype(np.float32), None, fx=factor, fy=factor,
                       interpolation=cv2.INTER_LANCZOS4)
    # rounds, and cuts what goes beyond black and white
    return np.asarray(cv2.add(large, np.zeros(4), dtype=cv2.CV_8U), np.uint8)


def shrink_image(image: GreyImage, factor: int) -> GreyImage:
    """Return the image averaged over blocks of factor x factor pixels.

    Incomplete blocks at the right and lower edge are cut off, so that pixel (x, y) of the small
    image is exactly ((x + 0.5) factor - 0.5, (y + 0.5) factor - 0.5) of the large one.
    """
    if factor == 1:
        return image
    height, width = (max(1, side // factor) for side in image.shape)
    whole = image[:height * factor, :width * factor]
    if factor in (3, 5) and min(whole.shape) >= factor:
        # the same means as INTER_AREA's, in half the time
        means = cv2.blur(whole, (factor, factor))
        return np.ascontiguousarray(means[factor // 2::factor, factor // 2::factor])
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
