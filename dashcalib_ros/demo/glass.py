# SPDX-License-Identifier: Apache-2.0
"""What stands before a rendered lens: a windscreen, or what a rectification left over."""
from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.polynomial import legendre

from dashcalib_ros.arrays import Floats

Look = Literal['windscreen', 'rectified']
# of a windscreen, in widths of the picture: pressed glass is smooth
WAVES, WAVELENGTHS = 8, (0.7, 2.5)
# of x and y together: higher ones were not found in KITTI's pictures, and lower ones weigh more
DEGREE = 5
# fixed-point steps of the inverse; the largest fields need them all, in the corners
STEPS = 30


@dataclass(frozen=True)
class Glass:
    """A smooth displacement over the picture that no lens with five coefficients takes up.

    rms_px: over the picture. look: a 'windscreen' is waves in all directions; 'rectified' is a
    polynomial, as KITTI's rectification left one. The same seed gives the same glass.
    """

    rms_px: float
    look: Look = 'windscreen'
    seed: int = 0

    def displacement(self, pixels: Floats, size: tuple[int, int]) -> Floats:
        """Return (n, 2) px by which pixels (n, 2) of a picture (width, height) are moved."""
        places = (pixels - (np.array(size) - 1) / 2) / (size[0] / 2)
        by_a_lens, scale = _fitted(self, size)
        return scale * (_shape(self, places) - moves_of_a_lens(places) @ by_a_lens)

    def before(self, pixels: Floats, size: tuple[int, int]) -> Floats:
        """Return (n, 2) where the lens alone would see what is seen at pixels (n, 2)."""
        return np.asarray(pixels - self.displacement(pixels, size))

    def behind(self, pixels: Floats, size: tuple[int, int]) -> Floats:
        """Return (n, 2) the inverse of before()."""
        found = pixels
        for _ in range(STEPS):
            found = pixels + self.displacement(found, size)
        return found


@functools.lru_cache(maxsize=16)
def _fitted(glass: Glass, size: tuple[int, int]) -> tuple[Floats, float]:
    """Return what of the glass's shape a lens takes up, (c,), and the scale of the rest."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 49), np.linspace(-1.0, 1.0, 33) * size[1] / size[0])
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    shape, moves = _shape(glass, places), moves_of_a_lens(places)
    by_a_lens, *_ = np.linalg.lstsq(moves.reshape(-1, moves.shape[2]), shape.ravel())
    rest = shape - moves @ by_a_lens
    return np.asarray(by_a_lens), glass.rms_px / float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))


def _shape(glass: Glass, places: Floats) -> Floats:
    """Return (n, 2) the displacement in any unit; places (n, 2) from the middle, half widths."""
    rng = np.random.default_rng([glass.seed, 11])
    moved = np.zeros_like(places)
    if glass.look == 'rectified':
        for i, j in np.ndindex(DEGREE + 1, DEGREE + 1):
            if 2 <= i + j <= DEGREE:
                both = legendre.legval(places[:, 0], np.eye(DEGREE + 1)[i]) \
                    * legendre.legval(places[:, 1], np.eye(DEGREE + 1)[j])
                moved += both[:, None] * rng.normal(size=2) / (i + j - 1)
        return moved
    for _ in range(WAVES):
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        number = np.pi / rng.uniform(*WAVELENGTHS)
        along = places @ (number * np.array([np.cos(angle), np.sin(angle)]))
        moved += np.cos(along + phase)[:, None] * rng.normal(size=2) / number
    return moved


def moves_of_a_lens(places: Floats) -> Floats:
    """Return (n, 2, c): what small changes of a lens and of its direction do at places (n, 2)."""
    x, y = places.T
    q, zero, one = x * x + y * y, np.zeros_like(x), np.ones_like(x)
    return np.asarray(np.stack([
        [one, zero], [zero, one], [x, zero], [zero, y], [-y, x], [x * x, x * y], [x * y, y * y],
        [x * q, y * q], [x * q**2, y * q**2], [x * q**3, y * q**3],
        [2.0 * x * y, q + 2.0 * y * y], [q + 2.0 * x * x, 2.0 * x * y]]).transpose(2, 1, 0))
