"""A calibration for pictures of another size: a resized picture, or a part of one."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.judge.difference import Difference

# of the ratio of the sides; pictures that were resized keep it but for rounding
SAME_ASPECT = 0.01
# of 1; nearer to it, parameters are not said to be for pictures of another size
LEAST_SCALE = 0.05
# pictures are mostly resized by a simple fraction: with so many parts, and if it is so near
MOST_PARTS = 4
SIMPLE = 0.01

Compare = Callable[[Camera], Difference]


def size_reason(given: Camera, image_size: tuple[int, int], compare: Compare | None) -> str:
    """Return what is wrong with a calibration for another size.

    compare: with the drive's own solution; None where there is none.
    """
    width, height = image_size
    theirs = f'{given.image_size[0]}x{given.image_size[1]}'
    text = f'it is for {theirs} pictures, and those of the drive have {width}x{height}'
    factor = width / given.image_size[0]
    if abs(height / given.image_size[1] / factor - 1) <= SAME_ASPECT:
        if compare is None:
            return text
        scaled = compare(given.resized(factor, image_size))
        if scaled.significant:
            unscaled = compare(replace(given, image_size=image_size))
            return text + ('; scaled to that size, it is wrong, too' if unscaled.significant else
                           f'; its parameters fit these as they are (to {unscaled.bound_px:.1f} '
                           f'px): only the size is wrong')
        return (f'{text}; scaled to that size, it fits them (to {scaled.bound_px:.1f} px): '
                f'dashcalib export --size {width}x{height}')
    part = None if compare is None else _part(given, image_size, compare)
    if part is None:
        return text
    if min(part) < 0:
        return f'{text}; its focal length and distortion fit: it is for a part of these pictures'
    return (f'{text}; its focal length and distortion fit a part of its pictures: dashcalib '
            f'export --crop {part[0]},{part[1]},{width},{height}')


def _part(given: Camera, image_size: tuple[int, int], compare: Compare) -> tuple[int, int] | None:
    """Return where the drive's pictures lie in the given camera's; None if they are no part."""
    found = compare(replace(given, image_size=image_size))
    spare = np.subtract(given.image_size, image_size)
    x, y = (int(value) for value in np.clip(np.round(found.offsets[2:4]), np.minimum(spare, 0),
                                            np.maximum(spare, 0)))
    shifted = replace(given, image_size=image_size, cx=given.cx - x, cy=given.cy - y)
    return None if compare(shifted).significant else (x, y)


def scaled_parameters(found: Difference, compare: Compare) -> str:
    """Return what is wrong where the parameters are for resized pictures; '' where they are not.

    The calibration says the drive's size, but its focal lengths and its centre do not fit it.
    """
    given, own = found.given, found.found
    ratios = [given.fx / own.fx, given.fy / own.fy, (given.cx + 0.5) / (own.cx + 0.5),
              (given.cy + 0.5) / (own.cy + 0.5)]
    factor = float(np.mean(ratios))
    simple = float(Fraction(factor).limit_denominator(MOST_PARTS))
    factor = simple if abs(simple / factor - 1) < SIMPLE else factor
    if abs(factor - 1) < LEAST_SCALE or np.ptp(ratios) > LEAST_SCALE * factor:
        return ''
    if compare(given.resized(1 / factor, given.image_size)).significant:
        return ''
    width, height = (round(side * factor) for side in given.image_size)
    return (f'its parameters are for pictures of {width}x{height}, and it says '
            f'{given.image_size[0]}x{given.image_size[1]}')
