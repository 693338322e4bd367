"""How far a camera may be off over the picture, in pixels."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats


@dataclass(frozen=True)
class PictureSigma:
    """Standard deviation of where the camera sees a ray, the best common rotation removed, px.

    rms: over the picture. worst: where it is largest, mostly a corner.
    """

    rms: float
    worst: float


@dataclass(frozen=True)
class SigmaMap:
    """The same at single pixels. pixels: (m, 2), a grid over the picture; sigma: (m,), px."""

    pixels: Floats
    sigma: Floats

    @property
    def whole(self) -> PictureSigma:
        """Return the sigma over the whole picture."""
        return PictureSigma(float(np.sqrt(np.mean(self.sigma**2))), float(self.sigma.max()))


def sigma_over(moves: Floats, covariance: Floats) -> Floats:
    """Return (m,) the sigma of pixels, px, where the parameters have a covariance (n, n).

    moves: (m, 2, n) derivatives of pixels by the parameters, as sensitivity() returns them.
    """
    variances = np.einsum('mai,ij,maj->m', moves, covariance, moves)
    return np.asarray(np.sqrt(variances))
