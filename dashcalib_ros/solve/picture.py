"""The covariance of the camera, and how far it may be off over the picture, in pixels.

The variances are taken in directions of the parameters that are independent of each other in the
picture. In each, the largest of three estimates counts:

- what the noise of the residuals makes of it: right if they were independent and the model exact;
- the same with each track as one measurement: residuals of one track may share an error (drift, a
  moving car);
- the scatter between turns, whatever makes them disagree: one number for all directions (Birge's
  ratio), for in one direction few turns say too little of it. It is itself uncertain: Student's t
  takes the place of the normal distribution, so that 2 sigma hold 95 %.

The square of the step to the wider model is added: the error of a model that real lenses do not
follow exactly. Where a field is left that no model has, camera_info is off by that, too.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.solve.information import Information, Pooled, pooled

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
              step: Floats, systematic: float = 1.0, one_turn_sigma: float = 0.0,
              field: Field | None = None) -> SigmaMap:
    """Return the sigma at a grid of pixels, those for which the camera has a viewing ray.

    field: what the camera leaves out. The other arguments are those of picture_covariance().
    """
    moves, pixels = sensitivity(camera.widened())
    covariance = picture_covariance(camera, parts, prior, floor, step, systematic, one_turn_sigma)
    sigma = sigma_over(moves, covariance)
    if field is not None:
        sigma = np.hypot(sigma, np.linalg.norm(field.displacement(pixels), axis=-1))
    return SigmaMap(pixels, sigma)


def sigma_over(moves: Floats, covariance: Floats) -> Floats:
    """Return (m,) the sigma of pixels, px, where the parameters have a covariance (n, n).

    moves: (m, 2, n) derivatives of pixels by the parameters, as sensitivity() returns them.
    """
    variances = np.einsum('mai,ij,maj->m', moves, covariance, moves)
    return np.asarray(np.sqrt(variances))


def picture_covariance(camera: Camera, parts: Sequence[Information], prior: Floats, floor: Floats,
                       step: Floats, systematic: float = 1.0, one_turn_sigma: float = 0.0
                       ) -> Floats:
    """Return the (lens, lens) covariance of the wider model's parameters that the picture shows.

    parts, prior: (n, n) as for pooled(). systematic: by how much the errors that tracks share
    inflate the variance of the second estimate. floor: (n,) sigmas of systematic errors. step:
    (lens,) to the wider model; what it would change counts as an error. The wider model's first n
    parameters are the camera's own; of the others, only the step is known. one_turn_sigma: px by
    which fx differs between turns: a single one does not show that.
    """
    count, together = len(floor), pooled(parts, prior)
    left = together.left[:count]
    covariance = np.outer(step, step)
    covariance[:count, :count] += (np.diag(floor**2) + np.outer(left, left)
                                   + _covariance(camera, together, count, systematic))
    if len(parts) == 1:
        covariance[:count, :count] += of_one_turn(together, count, one_turn_sigma)
    return covariance


def of_one_turn(together: Pooled, count: int, sigma: float) -> Floats:
    """Return the (n, n) covariance that a single turn does not show: how much turns differ.

    sigma: of fx, px; the other parameters follow it as the turn lets them make up for it.
    """
    own = together.inverse[:count, :count]
    along = sigma * own[0] / own[0, 0]
    return np.outer(along, along)


def _covariance(camera: Camera, together: Pooled, count: int, systematic: float) -> Floats:
    """Return the (n, n) covariance of the camera's own parameters, the first count of all."""
    inverse = together.inverse
    root = np.linalg.cholesky(inverse)
    # the readout, if there is one, moves nothing in the picture of a camera that stands
    flat = sensitivity(camera)[0].reshape(-1, count) @ root[:count]
    _, _, modes = np.linalg.svd(flat, full_matrices=False)
    basis = root @ modes.T
    back = modes @ np.linalg.inv(root)
    estimates = [np.ones(len(modes)), systematic * np.diag(back @ together.clustered @ back.T)]
    if len(together.scores) > 1:
        # in these directions the covariance of the first estimate is the unit matrix
        estimates.append(np.full(len(modes), scatter_between_turns(together, basis)))
    own = basis[:count]
    return np.asarray(own * np.max(estimates, axis=0) @ own.T)


def scatter_between_turns(together: Pooled, basis: Floats) -> float:
    """Return by how much turns scatter more than their noise explains: a ratio of variances.

    basis: (p, d) directions of the p free parameters, in which the covariance of the first
    estimate is the unit matrix. The ratio is that of the d (t - 1) degrees of freedom that t turns
    have, times what makes 2 sigma hold 95 % (Student's t).
    """
    squares, freedom = 0.0, 0
    for hessian, score in zip(together.hessians, together.scores, strict=True):
        # the covariance of a score where the model holds, the turns' own optimum counted
        expected = basis.T @ (hessian - hessian @ together.inverse @ hessian) @ basis
        values, vectors = np.linalg.eigh(expected)
        known = values > LEAST_SHARE * max(float(values[-1]), LEAST_SHARE)
        squares += float(np.sum((score @ basis @ vectors)[known]**2 / values[known]))
        freedom += int(known.sum())
    # loaded where it is needed: the processes that reconstruct turns have no use for it
    from scipy import special
    left = max(freedom * (1 - 1 / len(together.scores)), 1.0)
    tail = special.stdtrit(left, 0.975) / special.ndtri(0.975)
    return float(squares / max(freedom, 1) * tail**2)
