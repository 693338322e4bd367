"""What each turn knows of the lens: information, score, and honest sigmas.

At the adjusted solution the residuals are linearised, and the points and poses of a turn are
eliminated (Schur complement). What is left of turn i is its information H_i and its score g_i, the
pull of its residuals on fx, fy, cx, cy, k1, k2, and on three parameters that the model holds at
zero: p1, p2, k3. Of the variances that follow, the largest counts in each parameter:

- H^-1 times the noise of the residuals: right if each were independent and the model exact;
- H^-1 (sum over tracks s s') H^-1: residuals of one track may share an error (drift, a car);
- H^-1 (sum over turns g g') H^-1: whatever makes turns disagree (rolling shutter, a bad scene),
  corrected for how few turns there are and for those that dominate: between_turns().

The last two are the sandwich estimator with clusters. To them comes, squared, what the six would
move by if p1, p2 and k3 were free: the error of a model that real lenses do not quite follow.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special

from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.scene import Scene, residuals_px

Array = npt.NDArray[np.float64]
# fx fy cx cy k1 k2, and p1 p2 k3, which the model holds at zero
LENS = 9
# what p1, p2 and k3 of real lenses are like
EXTRA_SIGMA = np.array([1e-3, 1e-3, 0.1])
# of its information; a turn that knows a parameter alone still leaves so much to the others
LEAST_RESIDUAL = 0.01


@dataclass(frozen=True)
class Information:
    """What one turn contributes, in units of its residuals' weight (px^-2).

    hessian: (9, 9) reduced information of fx, fy, cx, cy, k1, k2, p1, p2, k3; (10, 10) where one
    more was asked for, a rolling shutter's readout. score: (9,) minus the gradient.
    by_track: (9, 9) sum over tracks of the outer products of their scores.
    squares: sum of squared residuals, weighted by w^2 over the mean of w^2, px^2: divided by
    freedom (residuals minus parameters) it is the variance that H^-1 is to be multiplied by.
    """

    hessian: Array
    score: Array
    by_track: Array
    squares: float
    freedom: float


def information(scene: Scene, camera: Camera, loss_px: float, also: Array | None = None
                ) -> Information:
    """Return what a scene knows of the camera, at the solution.

    loss_px: scale of the Cauchy loss, whose weights w = 1 / (1 + e^2 / loss^2) apply.
    also: (k, t, 2) derivatives of the observations by one more parameter.
    """
    used = scene.structure.used
    wide, by_point, residual, weight = _linearised(scene, camera, loss_px, also)
    # the poses of the turn come first, six parameters each, then the lens
    rows, columns = np.nonzero(used)
    _, pose = np.unique(rows, return_inverse=True)
    _, point = np.unique(columns, return_inverse=True)
    nuisance, lens = 6 * (int(pose.max()) + 1), wide.shape[2] - 6
    last = np.broadcast_to(np.arange(nuisance, nuisance + lens), (len(rows), lens))
    where = np.concatenate([6 * pose[:, None] + np.arange(6), last], axis=1)

    reduced, inverse, mixed = _without_points(wide, by_point, where, point)
    follow = _poses_follow(reduced, nuisance)
    hessian = reduced[nuisance:, nuisance:] - reduced[:nuisance, nuisance:].T @ follow

    # each track's score, after its poses and its point have followed the lens
    combine = np.concatenate([-follow, np.eye(lens)])
    point_follow = inverse @ (mixed.transpose(0, 2, 1) @ combine)
    effective = (np.einsum('nij,njc->nic', wide, combine[where])
                 - by_point @ point_follow[point])
    scores = np.zeros((len(mixed), lens))
    np.add.at(scores, point, np.einsum('nic,ni->nc', effective, residual))
    return Information(hessian, scores.sum(axis=0), scores.T @ scores,
                       *_squares_and_freedom(used, residual, weight))


def _linearised(scene: Scene, camera: Camera, loss_px: float, also: Array | None
                ) -> tuple[Array, Array, Array, Array]:
    """Return the weighted derivatives of each used observation, its residual and its weight.

    By its pose and the lens (n, 2, 6 + 9), by its point (n, 2, 3); residuals (n, 2), px; (n,).
    """
    structure = scene.structure
    rows, columns = np.nonzero(structure.used)
    rotation = structure.rotations[rows]
    rotated = np.einsum('nij,nj->ni', rotation, structure.points[columns])
    by_camera, by_local, projected = _derivatives(rotated + structure.translations[rows], camera)
    if also is not None:
        by_camera = np.concatenate([by_camera, also[rows, columns, :, None]], axis=2)
    residual = scene.tracks.xy[rows, columns] - projected
    # the loss pulls with w e, and its curvature is w^2 on average over the directions of e
    weight = _weights(residual, loss_px)
    by_camera, by_local = by_camera * weight[:, None, None], by_local * weight[:, None, None]
    # a small turn w of the camera moves the local point by w x (R X)
    wide = np.concatenate([by_local @ -_cross(rotated), by_local, by_camera], axis=2)
    return wide, by_local @ rotation, residual, weight


def _without_points(wide: Array, by_point: Array, where: npt.NDArray[np.intp],
                    point: npt.NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Return the normal matrix of poses and lens once the points are eliminated (Schur).

    where: (n, 6 + 9) places of an observation's pose and of the lens in it; point: (n,). And what
    leads back to the points: (t, 3, 3) their inverse blocks, (t, size, 3) the mixed ones.
    """
    size, points = int(where.max()) + 1, int(point.max()) + 1
    normal = np.zeros((size, size))
    mixed = np.zeros((points, size, 3))
    own = np.zeros((points, 3, 3))
    np.add.at(own, point, by_point.transpose(0, 2, 1) @ by_point)
    np.add.at(normal, (where[:, :, None], where[:, None, :]), wide.transpose(0, 2, 1) @ wide)
    np.add.at(mixed, (point[:, None], where), wide.transpose(0, 2, 1) @ by_point)
    # a point that its rays fix badly gets a little damping instead of a wild inverse
    damping = 1e-9 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    inverse = np.linalg.inv(own + damping + 1e-12 * np.eye(3))
    return normal - np.tensordot(mixed @ inverse, mixed, axes=([0, 2], [0, 2])), inverse, mixed


def _poses_follow(reduced: Array, nuisance: int) -> Array:
    """Return (nuisance, 9) by how much the poses move, negative, with each number of the lens.

    Seven directions of the poses (where, how large) are free: the pseudo-inverse leaves them out.
    """
    poses = reduced[:nuisance, :nuisance]
    scale = 1 / np.sqrt(np.maximum(np.diag(poses), 1e-12))
    inner = np.linalg.pinv(poses * scale[:, None] * scale, rcond=1e-10, hermitian=True)
    return np.asarray((inner * scale[:, None] * scale) @ reduced[:nuisance, nuisance:])


def noise_of(parts: Sequence[Information]) -> float:
    """Return the variance of a residual, px^2, from all turns."""
    return sum(part.squares for part in parts) / sum(part.freedom for part in parts)


def noise_in(scenes: Sequence[Scene], camera: Camera, loss_px: float) -> float:
    """Return noise_of() the scenes' information, without the rest of it."""
    squares = freedom = 0.0
    for scene in scenes:
        used = scene.structure.used
        residual = residuals_px(scene, camera)[used]
        more = _squares_and_freedom(used, residual, _weights(residual, loss_px))
        squares, freedom = squares + more[0], freedom + more[1]
    return squares / freedom


def _weights(residual: Array, loss_px: float) -> Array:
    """Return (n,) weights of residuals (n, 2) under the Cauchy loss."""
    return np.asarray(1 / (1 + np.sum(residual**2, axis=1) / loss_px**2))


def _squares_and_freedom(used: npt.NDArray[np.bool_], residual: Array, weight: Array
                         ) -> tuple[float, float]:
    observations, points, poses = used.sum(), used.any(axis=0).sum(), used.any(axis=1).sum()
    # the scene's own frame and scale are free: seven; the lens takes six
    freedom = max(2 * observations - 3 * points - 6 * poses + 7 - 6, 1)
    return float(np.sum((residual * weight[:, None])**2) / np.mean(weight**2)), float(freedom)


@dataclass(frozen=True)
class Pooled:
    """All turns' information of the p parameters that are free, at unit noise.

    hessians: (n, p, p), scores: (n, p) of the n turns. inverse: (p, p) of the hessians' sum with
    the prior.
    clustered: (p,) variances that take whole tracks as units.
    """

    hessians: Array
    scores: Array
    inverse: Array
    clustered: Array


def pooled(parts: Sequence[Information], prior: Array) -> Pooled:
    """Return what all parts know of the six, and of a readout where they were asked for it.

    prior: (6, 6) as for covariance().
    """
    noise = noise_of(parts)
    free = [*range(6), *range(LENS, len(parts[0].score))]
    block = np.ix_(free, free)
    hessians = np.array([part.hessian[block] for part in parts]) / noise
    whole = hessians.sum(axis=0)
    whole[:6, :6] += prior
    inverse = np.linalg.inv(whole)
    by_track = np.sum([part.by_track[block] for part in parts], axis=0) / noise**2
    return Pooled(hessians, np.array([part.score[free] for part in parts]) / noise,
                  np.asarray(inverse), np.diag(inverse @ by_track @ inverse))


def covariance(parts: Sequence[Information], prior: Array) -> Array:
    """Return the (6, 6) covariance: the largest of the three estimates in each parameter.

    prior: (6, 6) information of the priors, in the same units as the residuals (px^-2 at unit
    noise). The correlations are those of the first estimate. Where the parts know of a readout,
    it is free: (7, 7).
    """
    every = pooled(parts, prior)
    inverse = every.inverse
    estimates = [np.diag(inverse), every.clustered]
    if len(parts) > 1:
        estimates.append(between_turns(every.hessians, every.scores, inverse))
    # without evidence rounding can make a variance negative: such scenes know nothing
    variance = np.where(np.min(estimates, axis=0) >= 0, np.max(estimates, axis=0), np.inf)
    variance[:6] += model_error(parts, prior) ** 2
    sigma = np.sqrt(variance)
    correlation = inverse / np.sqrt(np.outer(np.diag(inverse), np.diag(inverse)))
    return np.asarray(correlation * np.outer(sigma, sigma))


def between_turns(hessians: Array, scores: Array, inverse: Array) -> Array:
    """Return (p,) variances of p parameters from the scatter between turns.

    hessians: (n, p, p), scores: (n, p) of n >= 2 turns at unit noise. inverse: (p, p) of their sum
    with the prior.

    A turn that dominates draws the result to itself and leaves itself no residual: each score is
    first scaled back to what it would be without its own pull (CR2, Bell and McCaffrey 2002). Few
    turns know their own scatter badly: by the degrees of freedom that are left (Satterthwaite)
    Student's t takes the place of the normal, so that 2 sigma hold 95 %.
    """
    adjusted, maps = [], []
    for hessian, score in zip(hessians, scores, strict=True):
        values, vectors = np.linalg.eigh(hessian)
        # a turn may know nothing of a direction, or nothing at all
        values = np.maximum(values, 1e-12 * max(values[-1], 1e-12))
        root = vectors * np.sqrt(values) @ vectors.T
        leverage, axes = np.linalg.eigh(root @ inverse @ root)
        relieved = axes / np.sqrt(np.maximum(1 - leverage, LEAST_RESIDUAL)) @ axes.T
        maps.append(root @ relieved @ np.linalg.inv(root))
        adjusted.append(maps[-1] @ score)
    count, size = scores.shape
    pulls = np.array([inverse @ score for score in adjusted])
    variance = np.sum(pulls**2, axis=0)
    # what the pulls' covariance is if the model holds: p matrices n x n
    expected = np.zeros((size, count, count))
    for i in range(count):
        for j in range(count):
            own = hessians[i] if i == j else np.zeros((size, size))
            middle = maps[i] @ (own - hessians[i] @ inverse @ hessians[j]) @ maps[j].T
            expected[:, i, j] = np.diag(inverse @ middle @ inverse)
    freedom = (np.trace(expected, axis1=1, axis2=2)**2
               / np.maximum(np.sum(expected**2, axis=(1, 2)), 1e-300))
    tails = special.stdtrit(np.maximum(freedom, 1.0), 0.975) / special.ndtri(0.975)
    return np.asarray(variance * tails**2)


def model_error(parts: Sequence[Information], prior: Array) -> Array:
    """Return (6,) by how much each parameter would move if p1, p2 and k3 were free."""
    return np.abs(freed(parts, prior)[:6])


def freed(parts: Sequence[Information], prior: Array) -> Array:
    """Return (9,) how the six would move if p1, p2 and k3 were free, and what these would be.

    prior: (6, 6) as for covariance(). p1, p2 and k3 themselves are believed to be as large as real
    lenses have them (EXTRA_SIGMA). One Gauss-Newton step: the six are at their optimum, so only
    the three pull.
    """
    noise = noise_of(parts)
    # a readout that was asked for is at its optimum
    whole = sum((part.hessian[:LENS, :LENS] for part in parts), np.zeros((LENS, LENS))) / noise
    whole[:6, :6] += prior
    whole[6:, 6:] += np.diag(1 / np.square(EXTRA_SIGMA))
    pull = sum((part.score[:LENS] for part in parts), np.zeros(LENS)) / noise
    pull[:6] = 0.0
    return np.asarray(np.linalg.solve(whole, pull))


def _cross(vectors: Array) -> Array:
    """Return (n, 3, 3) matrices that take the cross product with each vector (n, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _derivatives(local: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Return d pixel / d lens (n, 2, 9), d pixel / d local point (n, 2, 3), pixels (n, 2)."""
    x, y = (local[:, :2] / local[:, 2:]).T
    square = x * x + y * y
    factor = 1 + square * (camera.k1 + square * camera.k2)
    slope = camera.k1 + 2 * camera.k2 * square
    zero, one = np.zeros_like(x), np.ones_like(x)
    by_camera = np.stack([
        np.stack([x * factor, zero, one, zero, camera.fx * x * square,
                  camera.fx * x * square**2, camera.fx * 2 * x * y,
                  camera.fx * (square + 2 * x * x), camera.fx * x * square**3], axis=1),
        np.stack([zero, y * factor, zero, one, camera.fy * y * square,
                  camera.fy * y * square**2, camera.fy * (square + 2 * y * y),
                  camera.fy * 2 * x * y, camera.fy * y * square**3], axis=1)], axis=1)
    by_normal = np.stack([
        np.stack([factor + 2 * slope * x * x, 2 * slope * x * y], axis=1),
        np.stack([2 * slope * x * y, factor + 2 * slope * y * y], axis=1)], axis=1)
    by_normal *= np.array([[camera.fx], [camera.fy]])
    depth = local[:, 2]
    normal_by_local = np.stack([
        np.stack([one / depth, zero, -x / depth], axis=1),
        np.stack([zero, one / depth, -y / depth], axis=1)], axis=1)
    pixels = np.stack([camera.fx * x * factor + camera.cx, camera.fy * y * factor + camera.cy],
                      axis=1)
    return by_camera, by_normal @ normal_by_local, pixels
