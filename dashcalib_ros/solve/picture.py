"""How far the whole camera may be off over the picture, in pixels.

The sigmas of single parameters say little about that: an error of one is mostly made up for by the
others. So the variances are taken in directions of the parameters that are independent of each
other, and in each the largest of three estimates counts, as for a single parameter. The scatter
between turns is one number for all directions (Birge's ratio): in one direction, few turns say too
little of it.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.solve.information import Information, pooled

# a turn's information in a direction, as a share of its best one; with less it says nothing there
LEAST_SHARE = 1e-6


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


def sigma_map(camera: Camera, parts: Sequence[Information], prior: Floats, floor: Floats,
              step: Floats, systematic: float = 1.0) -> SigmaMap:
    """Return the sigma at a grid of pixels, those for which the camera has a viewing ray.

    The arguments are those of picture_covariance().
    """
    moves, pixels = sensitivity(camera.widened())
    covariance = picture_covariance(camera, parts, prior, floor, step, systematic)
    return SigmaMap(pixels, sigma_over(moves, covariance))


def sigma_over(moves: Floats, covariance: Floats) -> Floats:
    """Return (m,) the sigma of pixels, px, where the parameters have a covariance (n, n).

    moves: (m, 2, n) derivatives of pixels by the parameters, as sensitivity() returns them.
    """
    variances = np.einsum('mai,ij,maj->m', moves, covariance, moves)
    return np.asarray(np.sqrt(variances))


def picture_covariance(camera: Camera, parts: Sequence[Information], prior: Floats, floor: Floats,
                       step: Floats, systematic: float = 1.0) -> Floats:
    """Return the (lens, lens) covariance of the wider model's parameters that the picture shows.

    parts, prior: (n, n) and systematic as for covariance(). floor: (n,) sigmas of systematic
    errors. step: (lens,) to the wider model; what it would change counts as an error. The wider
    model's first n parameters are the camera's own; of the others, only the step is known.
    """
    count = len(floor)
    covariance = np.outer(step, step)
    covariance[:count, :count] += np.diag(floor**2) + _covariance(camera, parts, prior, systematic)
    return covariance


def _covariance(camera: Camera, parts: Sequence[Information], prior: Floats, systematic: float
                ) -> Floats:
    """Return the (n, n) covariance of the camera's own parameters."""
    together, count = pooled(parts, prior), len(prior)
    inverse = together.inverse
    root = np.linalg.cholesky(inverse)
    # the readout, if there is one, moves nothing in the picture of a camera that stands
    flat = sensitivity(camera)[0].reshape(-1, count) @ root[:count]
    _, _, modes = np.linalg.svd(flat, full_matrices=False)
    basis = root @ modes.T
    back = modes @ np.linalg.inv(root)
    estimates = [np.ones(len(modes)), systematic * np.diag(back @ together.clustered @ back.T)]
    if len(parts) > 1:
        # in these directions the covariance of the first estimate is the unit matrix
        scatter = scatter_between_turns(basis.T @ together.hessians @ basis,
                                        together.scores @ basis)
        estimates.append(np.full(len(modes), scatter))
    own = basis[:count]
    return np.asarray(own * np.max(estimates, axis=0) @ own.T)


def scatter_between_turns(hessians: Floats, scores: Floats) -> float:
    """Return by how much turns scatter more than their noise explains: a ratio of variances.

    hessians: (n, p, p), scores: (n, p) of the turns, in directions in which the sum of the
    hessians, with the prior, is the unit matrix: h - h h is then the covariance of a score.
    """
    squares = freedom = 0.0
    for hessian, score in zip(hessians, scores, strict=True):
        values, vectors = np.linalg.eigh(hessian - hessian @ hessian)
        known = values > LEAST_SHARE * max(float(values[-1]), LEAST_SHARE)
        squares += float(np.sum((score @ vectors)[known]**2 / values[known]))
        freedom += int(known.sum())
    return squares / max(freedom, 1.0)
