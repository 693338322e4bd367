"""The information that each turn gives about the lens, and what all turns say together.

At the adjusted solution the residuals are linearised, and the points and poses of a turn are
eliminated (Schur complement). What remains of turn i is its information matrix H_i and its score
g_i (the negative gradient of its cost), for the camera's n parameters, for those that only the
wider model has and this one holds at zero (p1, p2 and k3 beside the paper's six), and for what
else all turns share: a rolling shutter's readout, a field over the picture.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.reconstruct.scene import Scene, residuals_px
from dashcalib_ros.solve.normal import (
    ImagePrior,
    normal_equations,
    squares_and_freedom,
    weights,
)


@dataclass(frozen=True)
class Information:
    """The information of one turn, in px^-2, and what its noise is estimated from.

    lens: how many parameters the wider model has. hessian: (m, m) the information about them, and
    about e = m - lens more that all turns share (a rolling shutter's readout, a field), with
    points and poses eliminated. score: (m,) the negative gradient. by_track: (m, m) sum over
    tracks of the outer products of their scores. prior, pull: (e,) information and negative
    gradient of the others' priors.
    squares: sum of squared residuals, weighted by w^2 over the mean of w^2, px^2. freedom: its
    degrees of freedom (residuals minus parameters). squares / freedom is the variance of a
    residual, by which H^-1 is multiplied.
    """

    hessian: Floats
    score: Floats
    by_track: Floats
    squares: float
    freedom: float
    lens: int
    prior: Floats
    pull: Floats


def information(scene: Scene, camera: Camera, loss_px: float, by_extra: Floats | None = None,
                extra_prior: tuple[Floats, Floats] | None = None,
                images: ImagePrior | None = None) -> Information:
    """Return the information that a scene gives about the camera, at the solution.

    loss_px: scale of the Cauchy loss, whose weights w = 1 / (1 + e^2 / loss^2) apply.
    by_extra: (k, t, 2, e) derivatives of the observations by e more parameters; extra_prior: (e,)
    information and negative gradient of their priors; None: they have none. images: what may
    differ between the images; None: nothing.
    """
    normal = normal_equations(scene, camera, loss_px, by_extra, by_image=images is not None)
    hessian, score, by_track = (normal.without_images() if images is None
                                else images.eliminated(normal))
    nothing = np.zeros(len(score) - normal.lens)
    return Information(hessian, score, by_track, normal.squares, normal.freedom, normal.lens,
                       *(extra_prior or (nothing, nothing)))


def noise_of(parts: Sequence[Information]) -> float:
    """Return the variance of a residual, px^2, from all turns."""
    return sum(part.squares for part in parts) / sum(part.freedom for part in parts)


def noise_in(scenes: Sequence[Scene], camera: Camera, loss_px: float) -> float:
    """Return what noise_of() returns for these scenes, without computing their information."""
    squares = freedom = 0.0
    for scene in scenes:
        used = scene.structure.used
        residual = residuals_px(scene, camera)[used]
        more = squares_and_freedom(used, residual, weights(residual, loss_px),
                                   len(camera.names()))
        squares, freedom = squares + more[0], freedom + more[1]
    return squares / freedom


@dataclass(frozen=True)
class Pooled:
    """All turns' information about the p parameters that are free, at unit noise.

    hessians: (n, p, p), scores: (n, p) of the n turns, at the optimum of all. inverse: (p, p) of
    the sum of the hessians and the prior. clustered: (p, p) covariance that treats each track as
    one measurement. left: (p,) the step to that optimum: 0 but for a field that was left in.
    """

    hessians: Floats
    scores: Floats
    inverse: Floats
    clustered: Floats
    left: Floats


def pooled(parts: Sequence[Information], prior: Floats) -> Pooled:
    """Return all parts' information about the n parameters, and about what else turns share.

    prior: (n, n) information of the camera's prior, at unit noise.
    """
    noise, count = noise_of(parts), len(prior)
    free = [*range(count), *range(parts[0].lens, len(parts[0].score))]
    block = np.ix_(free, free)
    hessians = np.array([part.hessian[block] for part in parts]) / noise
    total = hessians.sum(axis=0) + np.diag(np.r_[np.zeros(count), parts[0].prior])
    total[:count, :count] += prior
    inverse = np.linalg.inv(total)
    by_track = np.sum([part.by_track[block] for part in parts], axis=0) / noise**2
    scores = np.array([part.score[free] for part in parts]) / noise
    # the camera and the readout are at their optimum
    field = np.r_[np.zeros(count), parts[0].prior] > 0
    pull = np.r_[np.zeros(count), parts[0].pull] + np.where(field, scores.sum(axis=0), 0.0)
    left = inverse @ pull
    return Pooled(hessians, scores - hessians @ left, np.asarray(inverse),
                  np.asarray(inverse @ by_track @ inverse), np.asarray(left))


def step_to_wider_model(parts: Sequence[Information], prior: Floats, extra_sigma: Floats
                        ) -> Floats:
    """Return (lens,) the Gauss-Newton step when all parameters of the wider model are free.

    First come the n parameters of this model, then those that only the wider model has. prior:
    (n, n) as for pooled(). extra_sigma: (lens - n,) the latter's prior sigmas. The n are at their
    optimum, so only the others have a gradient; what else turns share is held.
    """
    noise, count, lens = noise_of(parts), len(prior), parts[0].lens
    total = sum((part.hessian[:lens, :lens] for part in parts), np.zeros((lens, lens))) / noise
    total[:count, :count] += prior
    total[count:, count:] += np.diag(1 / np.square(extra_sigma))
    score = sum((part.score[:lens] for part in parts), np.zeros(lens)) / noise
    score[:count] = 0.0
    return np.asarray(np.linalg.solve(total, score))
