# SPDX-License-Identifier: Apache-2.0
"""Residuals -> normal equations of one stretch, with its points and then its poses eliminated.

The residuals are linearised by points, by each image's pose and what else it has of its own, and
by what all stretches share. Points go first (Schur), in groups that few images see; then poses,
and with them the blocks of images, each with its prior. What is left is a cost about what is
shared.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera.rotation import crossed, rotation_matrices
from dashcalib_ros.problem.blocks import ImageBlock, Imaging, Seen
from dashcalib_ros.problem.observations import Observed, Stretch
from dashcalib_ros.problem.quadratic import Quadratic

# parameters of a point, of a pose: a small rotation in the camera's axes, then a move, and of how
# the camera turns and moves while the rows are exposed
POINT, POSE, MOTION = 3, 6, 6
# px^2; rendered images without noise would have none
LEAST_VARIANCE = 1e-6
# of damped steps: the least and the greatest diagonal, as Ceres has them
LEAST, GREATEST = 1e-6, 1e32
# of the noise: by how far all tracks drift alike from their first image to their last, for each
# of the smooth patterns over the picture. Of 16 rendered drives: 0.015 px where the noise
# is 0.054 px (benchmark/results/exact.md)
COMMON_DRIFT = 0.28


@dataclass(frozen=True)
class Linear:
    """The observations of a stretch, linearised, and summed up by image and by point.

    Of each observation there are derivatives by its point, by what its image has (own of them: the
    pose, its motion where that counts, the image's blocks), by the g shared parameters, and the
    residual. wide: (2, POINT + own + g + 1, n), weighted so that products with the residual are
    the scores. images: (k, own, own + g + 1); shared: (g, g + 1); points: (t, 3, 3); mixed: of
    each chunk (3, w, c), of its points and the images from begin to end, what is shared, and the
    residual. follow: (6k, 6k) how the motion follows the poses; None where that does not count.
    """

    seen: Seen
    wide: Floats
    own: int
    images: Floats
    shared: Floats
    points: Floats
    mixed: list[Floats]
    follow: Floats | None

    @property
    def stretch(self) -> Stretch:
        """Return the stretch."""
        return self.seen.stretch

    @property
    def imaging(self) -> Imaging:
        """Return the imaging."""
        return self.seen.imaging

    @cached_property
    def extras(self) -> dict[str, Ints]:
        """Return the places (k c,) of each block of images, images by images, its poses first."""
        starts = self.own * np.arange(len(self.images))[:, None]
        found = {'pose': (starts + np.arange(POSE)).ravel()}
        at = POSE
        if self.follow is not None:
            found['motion'] = (starts + at + np.arange(MOTION)).ravel()
            at += MOTION
        for block in self.imaging.of_each_image(self.stretch):
            if block.turns:
                found[block.name] = (starts + POSE + np.arange(block.count)).ravel()
            else:
                found[block.name] = (starts + at + np.arange(block.count)).ravel()
                at += block.count
        return found

    @cached_property
    def without_points(self) -> tuple[Floats, Floats]:
        """Return what is left without the points, none damped, and the inverse of their blocks."""
        return _without_points(self, np.inf)


def linearised(seen: Seen, loss_px: float, safe: bool = False, alone: bool = False) -> Linear:
    """Return the used observations, linearised, under the Cauchy loss of this scale.

    Its weights are w = 1 / (1 + e^2 / loss^2): its gradient is w e, its curvature w^2 on average
    over the directions of e. safe: the curvature is w, that of a parabola which lies above the
    loss: a step to the optimum is shorter, and lowers the cost. alone: what is shared is held.
    """
    stretch, observed, imaging = seen.stretch, seen.observed, seen.imaging
    coupled = imaging.couples(stretch)
    shared = () if alone else imaging.shared
    images = [block for block in imaging.of_each_image(stretch) if not block.turns]
    own = POSE + (MOTION if coupled else 0) + sum(block.count for block in images)
    size, count = POINT + own + sum(block.size for block in shared) + 1, len(seen.off)
    weight = weights(seen.off, loss_px)
    scale = np.sqrt(weight) if safe else weight
    # observations are the last axis: NumPy is slow where that is short
    wide = np.empty((2, size, count))
    local = seen.derivatives[1].transpose(1, 2, 0) * scale
    still = local
    if coupled:
        # a point X moves by turning x X + moving, and both follow the poses
        late = local * seen.late
        still = local + crossed(late, seen.turning.T, -2)
        wide[:, 9:12], wide[:, 12:15] = crossed(seen.still.T, late, -2), late
    for row, some in zip(observed.keyframes, observed.images, strict=True):
        wide[:, :POINT, some] = stretch.structure.rotations[row].T @ still[:, :, some]
    # a small rotation w of the camera moves the local point by w x (R X)
    wide[:, 3:6], wide[:, 6:9] = crossed(seen.rotated.T, still, -2), still
    at = POINT + own - sum(block.count for block in images)
    for block in [*images, *shared]:
        np.multiply(block.columns(seen), scale, out=wide[:, at:at + block.size])
        at += block.size
    wide[:, -1] = seen.off.T * (weight / np.maximum(scale, 1e-12))
    # what the lens does not see counts nothing
    blind = ~np.isfinite(wide.sum(axis=(0, 1))) | ~np.isfinite(seen.projected[:, 0])
    if blind.any():
        wide[:, :, blind] = 0.0
    by_image = np.empty((len(observed.keyframes), own, size - POINT))
    for k, some in enumerate(observed.images):
        u, v = wide[:, POINT:, some]
        by_image[k] = u[:own] @ u.T + v[:own] @ v.T
    u, v = wide[:, POINT + own:]
    points, mixed = np.empty((len(observed.tracks), 3, 3)), []
    # each observation in one piece, and one of zeros, with which short tracks are filled up
    rows = np.zeros((count + 1, 2, size))
    rows[:-1] = wide.transpose(2, 0, 1)
    for chunk in observed.chunks:
        each = rows[chunk.table].reshape(len(chunk.points), -1, size)
        sums = each[:, :, :POINT].transpose(0, 2, 1) @ each
        a, b = wide[:, :POINT + own, chunk.observations]
        span = chunk.end - chunk.begin
        part = np.zeros((POINT, own * span + size - POINT - own, len(chunk.points)))
        part[:, :own * span].reshape(POINT, span, own, -1).transpose(0, 2, 1, 3)[
            :, :, chunk.image, chunk.place] = a[:POINT, None] * a[POINT:] + b[:POINT, None] * b[
                POINT:]
        part[:, own * span:] = sums[:, :, POINT + own:].transpose(1, 2, 0)
        points[chunk.points] = sums[:, :, :POINT]
        mixed.append(part)
    follow = None
    if coupled:
        used = observed.keyframes
        each = stretch.trajectory.follow()[used][:, :, used]
        each[:, :3] = np.einsum('ab,kbjc->kajc', imaging.steering(stretch), each[:, :3])
        follow = imaging.readout_s * each.reshape(POSE * len(used), POSE * len(used))
    # of a matrix and its own transpose only one half is computed
    return Linear(seen, wide, own, by_image, (u @ u.T + v @ v.T)[:-1], points, mixed, follow)


@dataclass(frozen=True)
class Follow:
    """How all of a stretch moves with a step.

    poses: (k, 6); images: of each block (k c,); points: (t, 3).
    """

    poses: Floats
    images: dict[str, Floats]
    points: Floats


@dataclass(frozen=True)
class Normal:
    """The normal equations of one stretch about the m parameters that are left.

    cost: about the blocks of images that were kept, and then what is shared; places: where each of
    the kept ones stands. inverse: (t, 3, 3) of the points' blocks. response: (e, m) of what was
    eliminated beside the points, and optimum: (e,) where it goes; names: the blocks in it.
    gain: by how much what was eliminated lowers the cost, px^2.
    """

    linear: Linear
    cost: Quadratic
    places: dict[str, slice]
    inverse: Floats
    response: Floats
    optimum: Floats
    names: tuple[str, ...]
    gain: float

    def follow(self, step: Floats) -> Follow:
        """Return how all else goes to its optimum where the parameters go by a step (m,)."""
        linear, more = self.linear, len(self.cost.score) - len(self.linear.shared)
        each = self.optimum - self.response @ step
        ends = np.cumsum([len(linear.extras[name]) for name in self.names])[:-1]
        images = dict(zip(self.names, np.split(each, ends), strict=True))
        images |= {name: step[place] for name, place in self.places.items()}
        local = np.zeros(linear.own * len(linear.images))
        for name, values in images.items():
            local[linear.extras[name]] += values
        if linear.follow is not None:
            local[linear.extras['motion']] += linear.follow @ images['pose']
        points = np.empty((POINT, len(self.inverse)))
        for chunk, mixed in zip(linear.seen.observed.chunks, linear.mixed, strict=True):
            known = [*local[linear.own * chunk.begin:linear.own * chunk.end], *step[more:], -1.0]
            points[:, chunk.points] = -np.array(known) @ mixed
        return Follow(images.pop('pose').reshape(-1, POSE), images,
                      np.einsum('tij,jt->ti', self.inverse, points))

    def moved(self, step: Floats, part: float = 1.0) -> Stretch:
        """Return the stretch after a part of the step to its optimum, others going by step."""
        return moved_by(self.linear.stretch, self.follow(step), part)


def moved_by(stretch: Stretch, follow: Follow, part: float = 1.0) -> Stretch:
    """Return the stretch after a part of such a move of its poses and points."""
    structure, observed = stretch.structure, stretch.observed
    turn, move = np.split(part * follow.poses, 2, axis=1)
    rotations, translations = structure.rotations.copy(), structure.translations.copy()
    rotations[observed.keyframes] = rotation_matrices(turn) @ rotations[observed.keyframes]
    translations[observed.keyframes] += move
    points = structure.points.copy()
    points[observed.tracks] += part * follow.points
    return stretch.moved(rotations, translations, points)


def normal_equations(linear: Linear, variance: float = 1.0, kept: Sequence[str] = (),
                     tracks: bool = False, images: bool = False, drift_px: float = 0.0,
                     radius: float = np.inf) -> Normal:
    """Return the normal equations of a stretch.

    variance: of a residual, px^2, against which the priors of images' blocks count. kept: blocks
    of images that are not eliminated, and have no prior. tracks: with by_track, each track being
    one measurement; images: what observations of an image share is in it, too, which holds at the
    optimum only: elsewhere all of them ask for the same change. drift_px: by how much tracks drift
    alike, see common_drifts(). radius: how far the linearisation is trusted; inf: it is not
    damped.
    """
    own, extras = linear.own, linear.extras
    whole, inverse = (linear.without_points if radius == np.inf
                      else _without_points(linear, radius))
    gone = tuple(name for name in extras if name != 'motion' and name not in kept)
    first = np.concatenate([extras[name] for name in gone])
    rest = np.concatenate([*(extras[name] for name in kept if name in extras),
                           np.arange(own * len(linear.images), len(whole))])
    inner, right = whole[np.ix_(first, first)], whole[np.ix_(first, rest)]
    for place, precision, off in _priors(linear, gone):
        inner[place, place] += variance * precision
        right[place, -1] -= variance * (precision @ off)
    solved = _pose_solution(inner, right, linear.stretch)
    left = whole[np.ix_(rest[:-1], rest)] - right[:, :-1].T @ solved
    size, places = len(left), {}
    at = 0
    for name in kept:
        places[name] = slice(at, at := at + len(extras[name]))
    by_track = np.zeros((size, size))
    if tracks or images:
        by_track = _by_track(linear, inverse, solved[:, :-1], first, rest, images, drift_px)
    return Normal(linear, Quadratic(left[:, :-1], left[:, -1], by_track), places, inverse,
                  solved[:, :-1], solved[:, -1], gone,
                  float(right[:, -1] @ solved[:, -1] - whole[-1, -1]))


@dataclass(frozen=True)
class PosesGivenShared:
    """What a stretch says about its k poses where what is shared is known, the points eliminated.

    covariance: (6k, 6k) without the gauge, which is free; follow: (6k, g) of the poses by what is
    shared.
    """

    covariance: Floats
    follow: Floats


def poses_given_shared(linear: Linear, variance: float) -> PosesGivenShared:
    """Return what a stretch says about its poses, its blocks of images free; variance: px^2."""
    whole, _ = linear.without_points
    gone = [name for name in linear.extras if name != 'motion']
    first = np.concatenate([linear.extras[name] for name in gone])
    inner = whole[np.ix_(first, first)]
    for place, precision, _ in _priors(linear, gone):
        inner[place, place] += variance * precision
    count, shared = POSE * len(linear.images), whole[first, linear.own * len(linear.images):-1]
    right = np.concatenate([variance * np.eye(len(first), count), shared], axis=1)
    solved = _pose_solution(inner, right, linear.stretch)[:count]
    covariance = solved[:, :count]
    return PosesGivenShared((covariance + covariance.T) / 2, -solved[:, count:])


def _priors(linear: Linear, names: Sequence[str]) -> Iterator[tuple[slice, Floats, Floats]]:
    """Yield the place, the information of the prior, and how far it is off, of blocks of images.

    names: of the blocks, in their order; of poses nothing is known before.
    """
    at = 0
    for name in names:
        place = slice(at, at := at + len(linear.extras[name]))
        if name != 'pose':
            block = linear.imaging.blocks[name]
            assert isinstance(block, ImageBlock)
            yield place, *block.prior_of(linear.stretch)


def damping(diagonals: Floats, radius: float) -> Floats:
    """Return what is added to the diagonals of normal equations; 0 where they are trusted."""
    return np.asarray(np.clip(diagonals, LEAST, GREATEST) / radius)


def _without_points(linear: Linear, radius: float) -> tuple[Floats, Floats]:
    """Return the normal equations of all but the points, and the inverse of their blocks.

    The score is the last row and column.
    """
    own, count = linear.own, len(linear.images)
    inner, more = own * count, len(linear.shared) + 1
    whole, each = np.zeros((inner + more, inner + more)), np.arange(count)
    of_images = linear.images[:, :, :own]
    if radius < np.inf:
        of_images = of_images + damping(np.einsum('kii->ki', of_images), radius)[
            :, :, None] * np.eye(own)
    whole[:inner, :inner].reshape(count, own, count, own)[each, :, each] = of_images
    whole[:inner, inner:] = linear.images[:, :, own:].reshape(inner, more)
    whole[inner:-1, inner:] = linear.shared
    # a little damping, so that badly determined points have a finite inverse
    small = 1e-9 * np.trace(linear.points, axis1=1, axis2=2)[:, None] + 1e-12
    if radius < np.inf:
        small = damping(np.einsum('tii->ti', linear.points), radius)
    # of the inverse itself the rounding of a point that is nearly undetermined leaves no root
    root = np.linalg.inv(np.linalg.cholesky(linear.points + small[:, :, None] * np.eye(POINT)))
    inverse = root.transpose(0, 2, 1) @ root
    for chunk, mixed in zip(linear.seen.observed.chunks, linear.mixed, strict=True):
        factor = root[chunk.points].transpose(1, 2, 0)
        part = np.concatenate([
            factor[0, 0] * mixed[0], factor[1, 0] * mixed[0] + factor[1, 1] * mixed[1],
            factor[2, 0] * mixed[0] + factor[2, 1] * mixed[1] + factor[2, 2] * mixed[2]], axis=1)
        squares, width = part @ part.T, own * (chunk.end - chunk.begin)
        low, high = own * chunk.begin, own * chunk.end
        whole[low:high, low:high] -= squares[:width, :width]
        whole[low:high, inner:] -= squares[:width, width:]
        whole[inner:, inner:] -= squares[width:, width:]
    whole[inner:, :inner] = whole[:inner, inner:].T
    if linear.follow is not None:
        poses, motion = linear.extras['pose'], linear.extras['motion']
        whole[:, poses] += whole[:, motion] @ linear.follow
        whole[poses] += linear.follow.T @ whole[motion]
    return whole, inverse


def _pose_solution(inner: Floats, right: Floats, stretch: Stretch) -> Floats:
    """Return the solution of the equations of poses, and what goes with them, without the gauge.

    The gauge, position, rotation and scale of the stretch, is free: seven directions.
    """
    used, structure = stretch.observed.keyframes, stretch.structure
    rotations, gauge = structure.rotations[used], np.zeros((len(used), POSE, 7))
    gauge[:, :3, :3] = gauge[:, 3:, 3:6] = rotations
    gauge[:, 3:, 6] = structure.translations[used]
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-12))
    free = np.zeros((len(inner), 7))
    free[:POSE * len(used)] = gauge.reshape(-1, 7)
    held, _ = np.linalg.qr(free * scale[:, None])
    # a little damping, for a scene without motion
    scaled = inner / scale[:, None] / scale + held @ held.T + 1e-11 * np.eye(len(inner))
    return np.asarray(np.linalg.solve(scaled, right / scale[:, None]) / scale[:, None])


def _by_track(linear: Linear, inverse: Floats, response: Floats, first: Ints, rest: Ints,
              images: bool, drift_px: float) -> Floats:
    """Return (m, m) the covariance of the score, all else following.

    response: (e, m) of the parameters first (e,); rest: (m + 1,) the parameters, and the residual.
    """
    own, observed, size = linear.own, linear.seen.observed, len(rest) - 1
    inner = own * len(linear.images)
    # how what each image has follows
    follow = np.zeros((inner, size))
    follow[first] -= response
    kept = rest[rest < inner]
    follow[kept, np.arange(len(kept))] = 1.0
    if linear.follow is not None:
        motion = linear.extras['motion']
        follow[motion] += linear.follow @ follow[linear.extras['pose']]
    # how each point follows
    points = []
    for chunk, mixed in zip(observed.chunks, linear.mixed, strict=True):
        span = own * (chunk.end - chunk.begin)
        part = mixed[:, :span].transpose(0, 2, 1) @ follow[own * chunk.begin:own * chunk.end]
        part[:, :, len(kept):] += mixed[:, span:-1].transpose(0, 2, 1)
        points.append(np.einsum('cij,jcm->icm', inverse[chunk.points], part))

    def scores_of(residuals: Floats) -> Floats:
        """Return (n, m) the score that each observation has by such residuals (2, n)."""
        each = linear.wide[0, :-1] * residuals[0] + linear.wide[1, :-1] * residuals[1]
        found = np.empty((each.shape[1], size))
        for k, some in enumerate(observed.images):
            found[some] = each[POINT:POINT + own, some].T @ follow[own * k:own * (k + 1)]
        found[:, len(kept):] += each[POINT + own:].T
        for chunk, part in zip(observed.chunks, points, strict=True):
            theirs = found[chunk.observations]
            for own_point, point in zip(each[:POINT, chunk.observations], part, strict=True):
                theirs -= own_point[:, None] * point[chunk.place]
            found[chunk.observations] = theirs
        return found

    scores = scores_of(linear.wide[:, -1])
    by_track = np.empty((len(inverse), size))
    for chunk in observed.chunks:
        by_track[chunk.points] = np.add.reduceat(scores[chunk.observations], chunk.starts, axis=0)
    spread = by_track.T @ by_track
    if drift_px:
        drifts = drift_px * common_drifts(observed)
        for axis in np.eye(2):
            asked = drifts @ scores_of(axis[:, None] * np.ones(drifts.shape[1]))
            spread = spread + asked.T @ asked
    if images:
        # a shutter's rows while the car shakes, or blur, move all that an image sees
        starts = [some.start for some in observed.images]
        sums = np.add.reduceat(scores, starts, axis=0)
        values, vectors = np.linalg.eigh(sums.T @ sums - scores.T @ scores)
        spread = spread + (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(spread)


def common_drifts(observed: Observed) -> Floats:
    """Return (6, n) how far observations are off where all tracks drift alike, in units of it.

    Each track drifts by one from its first observation to its last, times a polynomial of the
    second degree over the picture. Thousands of tracks do not average such a drift out, and it
    moves the principal point: without it in sigma, cy was up to 4.7 sigma off. Its cause is not
    known (docs/lessons.md).
    """
    seconds = observed.stamps_ns / 1e9
    begin, end = np.full((2, len(observed.tracks)), [[np.inf], [-np.inf]])
    np.minimum.at(begin, observed.point, seconds)
    np.maximum.at(end, observed.point, seconds)
    middle, span = (begin + end) / 2, np.maximum(end - begin, 1e-9)
    age = (seconds - middle[observed.point]) / span[observed.point]
    x, y = (2 * observed.xy.T - np.array(observed.image_size)[:, None]) / observed.image_size[0]
    return np.asarray(age * np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]))


def weights(residual: Floats, loss_px: float) -> Floats:
    """Return (n,) weights of residuals (n, 2) under the Cauchy loss."""
    return np.asarray(1 / (1 + np.einsum('na,na->n', residual, residual) / loss_px**2))


@dataclass(frozen=True)
class Noise:
    """Of all residuals. variance: px^2. curvature: of the loss, over that of safe steps."""

    variance: float
    curvature: float


def noise_of(seen: Sequence[Seen], parameters: int, loss_px: float) -> Noise:
    """Return the noise of the residuals of each stretch under the Cauchy loss.

    parameters: how many stretches share. The variance is the sum of the squared residuals,
    weighted by w^2 over the mean of w^2, over their degrees of freedom.
    """
    squares = freedom = 0.0
    kept = []
    for each in seen:
        weight, observed = weights(each.off, loss_px), each.observed
        kept.append(weight)
        # the gauge (position, rotation and scale of the scene) is free: seven
        freedom += max(2 * len(weight) - 3 * len(observed.tracks) - 6 * len(observed.keyframes)
                       + 7 - parameters, 1)
        squares += float(np.sum((each.off * weight[:, None])**2) / np.mean(weight**2))
    weight = np.concatenate(kept)
    return Noise(max(squares / freedom, LEAST_VARIANCE),
                 float(np.mean(weight**2) / np.mean(weight)))
