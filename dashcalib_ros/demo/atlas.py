# SPDX-License-Identifier: Apache-2.0
"""All textures, each with its mip levels, in one picture that cv2.remap can sample at once."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats32, GreyImage
from dashcalib_ros.errors import ConfigError

Texture = GreyImage

LEVELS = 13
# cv2.remap addresses its source with 16 bit
MAX_SIDE = 32700


@dataclass(frozen=True)
class Atlas:
    """image: (h, w) uint8. table: (textures, LEVELS, 4) float32, x0, y0, width, height in texels.

    Texel (i, j) of a level has its centre at (x0 + i, y0 + j); the levels of a texture cover the
    same area exactly, each with a border of one texel that repeats its edge.
    """

    image: Texture
    table: Floats32


def pack(textures: Sequence[Texture]) -> Atlas:
    """Build the mip levels and place them on shelves, the highest first."""
    levels: list[tuple[int, int, Texture]] = []
    for index, texture in enumerate(textures):
        for level, image in enumerate(_pyramid(texture)):
            levels.append((index, level, image))
    width = max(8192, max(image.shape[1] for _, _, image in levels) + 2)
    levels.sort(key=lambda item: (-item[2].shape[0], item[0], item[1]))
    table = np.zeros((len(textures), LEVELS, 4), np.float32)
    places: list[tuple[int, int, Texture]] = []
    x = y = shelf = 0
    for index, level, image in levels:
        high, wide = image.shape
        if x + wide + 2 > width:
            x, y, shelf = 0, y + shelf, 0
        shelf = max(shelf, high + 2)
        places.append((x, y, image))
        table[index, level] = (x + 1, y + 1, wide, high)
        x += wide + 2
    if max(width, y + shelf) > MAX_SIDE:
        raise ConfigError('E-DEMO-TOO-LONG', 'the rendered drive is too long: use fewer turns or '
                                             'shorter straights')
    atlas = np.zeros((y + shelf, width), np.uint8)
    for x, y, image in places:
        high, wide = image.shape
        cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_REPLICATE,
                           dst=atlas[y:y + high + 2, x:x + wide + 2])
    for level in range(1, LEVELS):
        missing = table[:, level, 2] == 0.0
        table[missing, level] = table[missing, level - 1]
    return Atlas(atlas, table)


def _pyramid(texture: Texture) -> list[Texture]:
    """Return the texture and its halvings down to a texel, averaged over areas."""
    levels = [np.ascontiguousarray(texture)]
    while len(levels) < LEVELS and max(levels[-1].shape) > 1:
        high, wide = levels[-1].shape
        size = (max(1, (wide + 1) // 2), max(1, (high + 1) // 2))
        levels.append(np.asarray(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA),
                                 np.uint8))
    return levels
