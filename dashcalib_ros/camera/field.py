# SPDX-License-Identifier: Apache-2.0
"""The smooth displacements over the picture that no lens model has.

A windscreen bends the picture, and so does an imperfect rectification, by 0.2 to 2 px. Products of
Legendre polynomials in x and y describe that: they are few, smooth, and known at every pixel.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.camera import Camera
from dashcalib_ros.camera.mapping import grid_of

# of x and y together; 5 left 1.1 px of a windscreen's 2, and 7 0.3
DEGREE = 7
TERMS = tuple((i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i))
# what result.json says about the coefficients
BASIS = {
    'about': 'px by which a pixel (u, v) is observed beside where the model sees it: the sum over '
             'n of coefficients[axis][n] P_i(x) P_j(y), with (i, j) = degrees[n], Legendre '
             'polynomials P, x = (2 u + 1) / width - 1, y = (2 v + 1) / height - 1',
    'degrees': TERMS}
# of half the picture's size; beyond, the field is that of the nearest place
BEYOND = 1.1
# fixed-point steps of observed(); each makes the error some fifty times smaller
STEPS = 8


# fields are compared by identity, as arrays cannot be: source_map() keeps the last one's map
@dataclass(frozen=True, eq=False)
class Field:
    """Where a pixel is observed, less where the camera's model alone would see it.

    image_size: (width, height). coefficients: (2, len(TERMS)) of x and y, px.
    """

    image_size: tuple[int, int]
    coefficients: Floats

    def displacement(self, pixels: Floats) -> Floats:
        """Return (..., 2) the field at observed pixels (..., 2), px; NaN where these are."""
        known = np.isfinite(pixels).all(axis=-1)
        found = np.full(pixels.shape, np.nan)
        found[known] = field_terms(pixels[known], self.image_size) @ self.coefficients.T
        return found

    def ideal(self, pixels: Floats) -> Floats:
        """Return (..., 2) where the model alone would see what is observed at pixels (..., 2)."""
        return np.asarray(pixels - self.displacement(pixels))

    def observed(self, ideal: Floats) -> Floats:
        """Return (..., 2) the inverse of ideal()."""
        pixels = ideal
        for _ in range(STEPS):
            pixels = ideal + self.displacement(pixels)
        return np.asarray(pixels)

    def resized(self, factor: float, image_size: tuple[int, int]) -> Field:
        """Return the field of images that are factor times as large; image_size: theirs."""
        return replace(self, image_size=image_size, coefficients=factor * self.coefficients)

    def over(self, camera: Camera) -> Floats:
        """Return (n,) the field's lengths at a grid over the camera's picture, px."""
        return np.asarray(np.linalg.norm(self.displacement(grid_of(camera)), axis=-1))


def field_terms(pixels: Floats, image_size: tuple[int, int]) -> Floats:
    """Return (..., len(TERMS)) the values of all terms at pixels (..., 2)."""
    # the picture's edges are at -1 and 1
    places = ((pixels + 0.5) / np.array(image_size) * 2 - 1).clip(-BEYOND, BEYOND)
    # terms are the first axis inside: NumPy is slow where the last one is short
    x, y = (np.moveaxis(legendre.legvander(places[..., axis], DEGREE), -1, 0) for axis in (0, 1))
    i, j = np.array(TERMS).T
    return np.moveaxis(x[i] * y[j], 0, -1)
