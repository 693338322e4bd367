"""OpenCV's rational distortion: a quotient of two polynomials, ROS's rational_polynomial.

As plumb_bob.py, with x (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3) in its place.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.polynomial import Polynomial

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.camera import ColmapModel
from dashcalib_ros.camera.plumb_bob import WIDEST, Brown


@dataclass(frozen=True)
class Rational(Brown):
    """A pinhole camera with OpenCV's eight coefficients. Turns cannot tell these apart.

    image_size: (width, height) in pixels. fx, fy, cx, cy: pixels; the centre of the first pixel is
    at (0, 0). The coefficients are in the order k1, k2, p1, p2, k3, k4, k5, k6.
    """

    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    model: ClassVar[str] = 'rational_polynomial'
    ros_model: ClassVar[str] = 'rational_polynomial'
    given_only: ClassVar[bool] = True
    colmap: ClassVar[ColmapModel] = ColmapModel('FULL_OPENCV', 12, tuple(range(12)))
    spread: ClassVar[tuple[float, ...]] = (1.0, 1.0, 1e-3, 1e-3, 0.1, 1.0, 1.0, 0.1)

    def ros_distortion(self) -> list[float]:
        """Return k1, k2, p1, p2, k3, k4, k5, k6, the order of ROS and OpenCV."""
        return [float(value) for value in self.params[4:]]

    def _stretch(self, square: Floats) -> Floats:
        above, below = self._polynomials
        return np.asarray(above(square) / below(square))

    @cached_property
    def fold(self) -> float:
        """Return the undistorted radius at which the model folds over, or has a pole."""
        above, below = self._polynomials
        square = Polynomial([0.0, 1.0])
        # of radius times above / below: where its slope is 0, by the squared radius
        slope = (above + 2 * square * above.deriv()) * below - 2 * square * above * below.deriv()
        roots = np.concatenate([slope.roots(), below.roots()])
        real = roots[np.abs(roots.imag) < 1e-9].real
        return float(np.sqrt(min([WIDEST**2, *real[real > 0]])))

    @cached_property
    def _polynomials(self) -> tuple[Polynomial, Polynomial]:
        return (Polynomial([1.0, self.k1, self.k2, self.k3]),
                Polynomial([1.0, self.k4, self.k5, self.k6]))
