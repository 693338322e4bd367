"""The information that each turn gives about the lens, and the covariance from all turns.

At the adjusted solution the residuals are linearised, and the points and poses of a turn are
eliminated (Schur complement). What remains of turn i is its information matrix H_i and its score
g_i (the negative gradient of its cost), for the camera's n parameters and for those that only the
wider model has and this one holds at zero (p1, p2 and k3 beside the paper's six). There are three
estimates of the variances; in each parameter the largest counts:

- H^-1 times the noise of the residuals: right if they were independent and the model exact;
- H^-1 (sum over tracks s s') H^-1: residuals of one track may share an error (drift, a car);
- H^-1 (sum over turns g g') H^-1: whatever makes turns disagree (rolling shutter, a bad scene),
  corrected for few turns and for turns that dominate: between_turns().

The last two are the sandwich estimator with clusters. The square of the step to the wider model
is added: the error of a model that real lenses do not follow exactly.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.reconstruction.scene import Scene, residuals_px
from dashcalib_ros.solve.normal import (
    ImagePrior,
    normal_equations,
    squares_and_freedom,
    weights,
)

# least value of 1 - leverage: a turn that alone determines a parameter has leverage 1
LEAST_RESIDUAL = 0.01


@dataclass(frozen=True)
class Information:
    """The information of one turn, in px^-2, and what its noise is estimated from.

    lens: how many parameters the wider model has. hessian: (lens, lens) their information with
    points and poses eliminated; (lens + 1, lens + 1) with a rolling shutter's readout as the last
    parameter. score: (lens,) the negative gradient. by_track: (lens, lens) sum over tracks of the
    outer products of their scores.
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


def information(scene: Scene, camera: Camera, loss_px: float, by_extra: Floats | None = None,
                images: ImagePrior | None = None) -> Information:
    """Return the information that a scene gives about the camera, at the solution.

    loss_px: scale of the Cauchy loss, whose weights w = 1 / (1 + e^2 / loss^2) apply.
    by_extra: (k, t, 2) derivatives of the observations by one more parameter. images: what may
    differ between the images; None: nothing.
    """
    normal = normal_equations(scene, camera, loss_px,
                              None if by_extra is None else by_extra[..., None],
                              by_image=images is not None)
    hessian, score, by_track = (normal.without_images() if images is None
                                else images.eliminated(normal))
    return Information(hessian, score, by_track, normal.squares, normal.freedom, normal.lens)


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

    hessians: (n, p, p), scores: (n, p) of the n turns. inverse: (p, p) of the sum of the hessians
    and the prior. clustered: (p, p) covariance that treats each track as one measurement.
    """

    hessians: Floats
    scores: Floats
    inverse: Floats
    clustered: Floats


def pooled(parts: Sequence[Information], prior: Floats) -> Pooled:
    """Return all parts' information about the n parameters, and about the readout if they have it.

    prior: (n, n) as for covariance().
    """
    noise, count = noise_of(parts), len(prior)
    free = [*range(count), *range(parts[0].lens, len(parts[0].score))]
    block = np.ix_(free, free)
    hessians = np.array([part.hessian[block] for part in parts]) / noise
    total = hessians.sum(axis=0)
    total[:count, :count] += prior
    inverse = np.linalg.inv(total)
    by_track = np.sum([part.by_track[block] for part in parts], axis=0) / noise**2
    return Pooled(hessians, np.array([part.score[free] for part in parts]) / noise,
                  np.asarray(inverse), np.asarray(inverse @ by_track @ inverse))


def covariance(parts: Sequence[Information], prior: Floats, extra_sigma: Floats,
               systematic: float = 1.0) -> Floats:
    """Return the (n, n) covariance: the largest of the three estimates in each parameter.

    prior: (n, n) information of the prior, at unit noise. extra_sigma: as for
    step_to_wider_model(). systematic: by how much the errors that tracks share inflate the
    variance of the second estimate. The correlations are those of the first estimate. If the parts
    have a readout, it is one more parameter: (n + 1, n + 1).
    """
    together = pooled(parts, prior)
    inverse = together.inverse
    estimates = [np.diag(inverse), systematic * np.diag(together.clustered)]
    if len(parts) > 1:
        estimates.append(between_turns(together.hessians, together.scores, inverse))
    # rounding can make a variance negative where there is no information
    variance = np.where(np.min(estimates, axis=0) >= 0, np.max(estimates, axis=0), np.inf)
    variance[:len(prior)] += step_to_wider_model(parts, prior, extra_sigma)[:len(prior)] ** 2
    sigma = np.sqrt(variance)
    correlation = inverse / np.sqrt(np.outer(np.diag(inverse), np.diag(inverse)))
    return np.asarray(correlation * np.outer(sigma, sigma))


def between_turns(hessians: Floats, scores: Floats, inverse: Floats) -> Floats:
    """Return (p,) variances of p parameters from the scatter between turns.

    hessians: (n, p, p), scores: (n, p) of n >= 2 turns at unit noise. inverse: (p, p) of their sum
    with the prior.

    The result is close to a turn that dominates, so that this turn has too small a score: each
    score is first corrected for the turn's leverage (CR2, Bell and McCaffrey 2002). The scatter of
    few turns is itself uncertain: Student's t with the degrees of freedom that are left
    (Satterthwaite) takes the place of the normal distribution, so that 2 sigma hold 95 %.
    """
    adjusted, maps = [], []
    for hessian, score in zip(hessians, scores, strict=True):
        values, vectors = np.linalg.eigh(hessian)
        # a turn may have no information in some direction, or none at all
        values = np.maximum(values, 1e-12 * max(values[-1], 1e-12))
        root = vectors * np.sqrt(values) @ vectors.T
        leverage, axes = np.linalg.eigh(root @ inverse @ root)
        correction = axes / np.sqrt(np.maximum(1 - leverage, LEAST_RESIDUAL)) @ axes.T
        maps.append(root @ correction @ np.linalg.inv(root))
        adjusted.append(maps[-1] @ score)
    count, size = scores.shape
    shifts = np.array([inverse @ score for score in adjusted])
    variance = np.sum(shifts**2, axis=0)
    # the covariance of the shifts if the model holds: p matrices n x n
    expected = np.zeros((size, count, count))
    for i in range(count):
        for j in range(count):
            own = hessians[i] if i == j else np.zeros((size, size))
            middle = maps[i] @ (own - hessians[i] @ inverse @ hessians[j]) @ maps[j].T
            expected[:, i, j] = np.diag(inverse @ middle @ inverse)
    freedom = (np.trace(expected, axis1=1, axis2=2)**2
               / np.maximum(np.sum(expected**2, axis=(1, 2)), 1e-300))
    # loaded where it is needed: the processes that reconstruct turns have no use for it
    from scipy import special
    tails = special.stdtrit(np.maximum(freedom, 1.0), 0.975) / special.ndtri(0.975)
    return np.asarray(variance * tails**2)


def step_to_wider_model(parts: Sequence[Information], prior: Floats, extra_sigma: Floats
                        ) -> Floats:
    """Return (lens,) the Gauss-Newton step when all parameters of the wider model are free.

    First come the n parameters of this model, then those that only the wider model has. prior:
    (n, n) as for covariance(). extra_sigma: (lens - n,) the latter's prior sigmas. The n are at
    their optimum, so only the others have a gradient.
    """
    noise, count, lens = noise_of(parts), len(prior), parts[0].lens
    # a readout, if the parts have one, is at its optimum
    total = sum((part.hessian[:lens, :lens] for part in parts), np.zeros((lens, lens))) / noise
    total[:count, :count] += prior
    total[count:, count:] += np.diag(1 / np.square(extra_sigma))
    score = sum((part.score[:lens] for part in parts), np.zeros(lens)) / noise
    score[:count] = 0.0
    return np.asarray(np.linalg.solve(total, score))
