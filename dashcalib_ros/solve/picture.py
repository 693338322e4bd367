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


def picture_sigma(camera: Camera, parts: Sequence[Information], prior: Floats, floor: Floats,
                  step: Floats, systematic: float = 1.0) -> PictureSigma:
    """Return the sigma over the picture.

    parts, prior: (n, n) and systematic as for covariance(). floor: (n,) sigmas of systematic
    errors. step: (lens,) to the wider model; what it would change counts as an error.
    """
    wide, _ = sensitivity(camera.widened())
    # the wider model's first parameters are the camera's own
    moves = wide[:, :, :len(floor)]
    variances = _variances(moves, parts, prior, systematic) + _squares(moves * floor).sum(axis=1)
    variances += _squares(wide @ step[:, None])[:, 0]
    return PictureSigma(float(np.sqrt(np.mean(variances))), float(np.sqrt(np.max(variances))))


def _squares(moves: Floats) -> Floats:
    """Return (m, n) squared lengths of moves (m, 2, n)."""
    return np.asarray(np.sum(moves**2, axis=1))


def _variances(moves: Floats, parts: Sequence[Information], prior: Floats, systematic: float
               ) -> Floats:
    """Return (m,) the variances of pixels, px^2. moves: (m, 2, n) by the parameters."""
    together, count = pooled(parts, prior), len(prior)
    inverse = together.inverse
    root = np.linalg.cholesky(inverse)
    # the readout, if there is one, moves nothing in the picture of a camera that stands
    flat = moves.reshape(-1, count) @ root[:count]
    _, _, modes = np.linalg.svd(flat, full_matrices=False)
    basis = root @ modes.T
    back = modes @ np.linalg.inv(root)
    estimates = [np.ones(len(modes)), systematic * np.diag(back @ together.clustered @ back.T)]
    if len(parts) > 1:
        # in these directions the covariance of the first estimate is the unit matrix
        scatter = scatter_between_turns(basis.T @ together.hessians @ basis,
                                        together.scores @ basis)
        estimates.append(np.full(len(modes), scatter))
    largest = np.max(estimates, axis=0)
    return np.asarray(_squares(moves @ basis[:count]) @ largest)


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
