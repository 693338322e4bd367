# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment in NumPy: Levenberg-Marquardt, with points and then poses eliminated (Schur).

Adjusts the poses and points of turns that share one camera, and some of its parameters. The steps
are chosen, and ended, as Ceres does: from one start both take the same steps.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.rotation import rotation_matrices

# parameters of a pose: a small rotation in the camera's axes, then a move
POSE = 6
# tracks that are eliminated at once: those that begin together are seen by few images
CHUNK = 100
# px; a residual of a point that the camera does not see
UNSEEN_PX = 1e3
# the region in which the linearisation is trusted at first, and the least and greatest damping
FIRST_RADIUS, LARGEST_RADIUS, LEAST, GREATEST = 1e4, 1e16, 1e-6, 1e32
# of the gain that was expected; a step that gains less is not taken
WORTH = 1e-3
# steps in a row that lower nothing
FAILURES = 5


@dataclass(frozen=True)
class Observed:
    """The n used observations of one turn: of k images, t points.

    image: (n,) ascending; point: (n,); observed: (n, 2) px. rotations: (k, 3, 3), translations:
    (k, 3) world to camera; points: (t, 3). keyframes: (k,), tracks: (t,) their rows in the scene.
    """

    image: Ints
    point: Ints
    observed: Floats
    rotations: Floats
    translations: Floats
    points: Floats
    keyframes: Ints
    tracks: Ints

    @cached_property
    def images(self) -> list[slice]:
        """Return the observations of each image."""
        ends = np.cumsum(np.bincount(self.image, minlength=len(self.rotations))).tolist()
        return [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]

    @cached_property
    def chunks(self) -> list[_Chunk]:
        """Return the points in groups that are seen by few images."""
        first = np.full(len(self.points), len(self.rotations))
        np.minimum.at(first, self.point, self.image)
        order = np.argsort(first, kind='stable')
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        by_point = np.lexsort([self.image, rank[self.point]])
        sorted_rank = rank[self.point[by_point]]
        found = []
        for start in range(0, len(order), CHUNK):
            some = order[start:start + CHUNK]
            low, high = np.searchsorted(sorted_rank, [start, start + len(some)])
            theirs = by_point[low:high]
            images = self.image[theirs]
            begin = int(images.min())
            place = sorted_rank[low:high] - start
            found.append(_Chunk(some, theirs, place, images - begin, begin,
                                int(images.max()) + 1,
                                np.flatnonzero(np.diff(place, prepend=-1))))
        return found

    def moved(self, poses: Floats, points: Floats) -> Observed:
        """Return the turn after a step of its poses (k, 6) and points (t, 3)."""
        moved = replace(self, rotations=rotation_matrices(poses[:, :3]) @ self.rotations,
                        translations=self.translations + poses[:, 3:],
                        points=self.points + points)
        # what does not change
        moved.__dict__.update({name: value for name, value in self.__dict__.items()
                               if name in ('images', 'chunks')})
        return moved


@dataclass(frozen=True)
class _Chunk:
    """Points (c,), their observations (m,) point by point, and where each point's begin (c,).

    place: (m,) of the point; image: (m,) counted from the first one that sees any, begin; end:
    behind the last one.
    """

    points: Ints
    observations: Ints
    place: Ints
    image: Ints
    begin: int
    end: int
    starts: Ints


@dataclass(frozen=True)
class Lens:
    """A camera, and which of its parameters are free.

    directions: (n, q) of a step, in the camera's n parameters. low, high: (n,) bounds.
    """

    camera: Camera
    directions: Floats
    low: Floats
    high: Floats

    def moved(self, step: Floats) -> Lens:
        """Return the lens after a step (q,), inside its bounds."""
        params = np.clip(self.camera.params + self.directions @ step, self.low, self.high)
        return Lens(self.camera.with_params(params), self.directions, self.low, self.high)


@dataclass(frozen=True)
class _Seen:
    """Where the n observed points of a turn are projected.

    rotated, local: (n, 3) points in the camera's axes, from the world's origin and from the
    camera. off: (n, 2) px, observed minus projected; UNSEEN_PX where seen (n,) is False.
    """

    rotated: Floats
    local: Floats
    off: Floats
    seen: Mask

    @classmethod
    def of(cls, turn: Observed, camera: Camera) -> _Seen:
        """Return where a camera sees the points."""
        rotated = np.empty((len(turn.image), 3))
        points = turn.points[turn.point]
        for rotation, some in zip(turn.rotations, turn.images, strict=True):
            rotated[some] = points[some] @ rotation.T
        local = rotated + turn.translations[turn.image]
        off = turn.observed - camera.project(local)
        seen = np.isfinite(off[:, 0])
        return cls(rotated, local, off if seen.all() else np.nan_to_num(off, nan=UNSEEN_PX), seen)

    def cost(self, loss_px: float) -> float:
        """Return the robust cost, half a squared residual in px for small ones."""
        squares = np.einsum('na,na->n', self.off, self.off)
        return 0.5 * loss_px**2 * float(np.log1p(squares / loss_px**2).sum())


def adjusted(turns: Sequence[Observed], lens: Lens, loss_px: float, iterations: int,
             tolerance: float) -> tuple[list[Observed], Lens]:
    """Return turns and lens after steps that lower the robust cost.

    loss_px: scale of the Cauchy loss. tolerance: of the cost; a step that changes it by a smaller
    share is the last one.
    """
    turns, radius, shrink, failures = list(turns), FIRST_RADIUS, 2.0, 0
    seen = [_Seen.of(turn, lens.camera) for turn in turns]
    cost = sum(each.cost(loss_px) for each in seen)
    linear: list[_Linear] = []
    for _ in range(iterations):
        linear = linear or [_linearised(turn, each, lens, loss_px)
                            for turn, each in zip(turns, seen, strict=True)]
        step, moves, expected = _step(linear, radius)
        gain = -np.inf
        if np.isfinite(expected):
            after = [turn.moved(*move) for turn, move in zip(turns, moves, strict=True)]
            other = lens.moved(step)
            there = [_Seen.of(turn, other.camera) for turn in after]
            gain = cost - sum(each.cost(loss_px) for each in there)
        settled = abs(gain) <= tolerance * cost
        if gain > WORTH * expected:
            turns, lens, seen, cost, linear, failures = after, other, there, cost - gain, [], 0
            radius = min(radius / max(1 / 3, 1 - (2 * gain / expected - 1)**3), LARGEST_RADIUS)
            shrink = 2.0
        else:
            radius, shrink, failures = radius / shrink, 2 * shrink, failures + 1
        if settled or failures > FAILURES:
            break
    return turns, lens


@dataclass(frozen=True)
class _Linear:
    """The weighted normal equations of one turn; q parameters of the lens are free.

    Of its k poses: poses (k, 6, 6), pose_right (k, 6, q + 1); of its t points: points (t, 3, 3),
    point_right (3, q + 1, t); of the lens: lens (q, q + 1). The last column is the score. mixed:
    (3, 6, n) the blocks of each observation's point and pose.
    """

    turn: Observed
    poses: Floats
    pose_right: Floats
    points: Floats
    point_right: Floats
    lens: Floats
    mixed: Floats


def _linearised(turn: Observed, seen: _Seen, lens: Lens, loss_px: float) -> _Linear:
    free, count = lens.directions.shape[1], len(turn.image)
    with np.errstate(divide='ignore', invalid='ignore'):
        by_params, by_local, _ = lens.camera.derivatives(seen.local)
    squares = np.einsum('na,na->n', seen.off, seen.off)
    # what the camera does not see has a cost, and moves nothing
    weight = np.where(seen.seen, np.sqrt(1 / (1 + squares / loss_px**2)), 0.0)
    if not seen.seen.all():
        by_params[~seen.seen], by_local[~seen.seen] = 0.0, 0.0
    # derivatives by the point, by the pose, by the lens, and the residual. Observations are the
    # last axis: NumPy is slow where that is short
    wide = np.empty((2, 3 + POSE + free + 1, count))
    local = wide[:, 6:9]
    np.multiply(by_local.transpose(1, 2, 0), weight, out=local)
    for rotation, some in zip(turn.rotations, turn.images, strict=True):
        wide[:, :3, some] = rotation.T @ local[:, :, some]
    # a small rotation w of the camera moves the local point by w x (R X)
    x, y, z = seen.rotated.T
    a, b, c = local[:, 0], local[:, 1], local[:, 2]
    wide[:, 3], wide[:, 4], wide[:, 5] = y * c - z * b, z * a - x * c, x * b - y * a
    if free:
        flat = lens.directions.T @ by_params.reshape(2 * count, -1).T
        wide[:, 9:-1] = flat.reshape(free, count, 2).transpose(2, 0, 1) * weight
    wide[:, -1] = seen.off.T * weight
    own = np.empty((len(turn.rotations), POSE, POSE + free + 1))
    for k, some in enumerate(turn.images):
        u, v = wide[:, 3:, some]
        own[k] = u[:POSE] @ u.T + v[:POSE] @ v.T
    u, v = wide
    across = np.stack([u[i] * u + v[i] * v for i in range(3)])
    more = np.concatenate([across[:, :3], across[:, 9:]], axis=1)
    summed = np.empty((3, 4 + free, len(turn.points)))
    for chunk in turn.chunks:
        summed[:, :, chunk.points] = np.add.reduceat(
            more[:, :, chunk.observations], chunk.starts, axis=2)
    return _Linear(turn, own[:, :, :POSE], own[:, :, POSE:], summed[:, :3].transpose(2, 0, 1),
                   summed[:, 3:], u[9:-1] @ u[9:].T + v[9:-1] @ v[9:].T, across[:, 3:9])


def _damping(blocks: Floats, radius: float) -> Floats:
    """Return (..., n) what is added to the diagonals of blocks (..., n, n)."""
    diagonals = np.diagonal(blocks, axis1=-2, axis2=-1)
    return np.asarray(np.clip(diagonals, LEAST, GREATEST) / radius)


def _damped(blocks: Floats, damping: Floats) -> Floats:
    return np.asarray(blocks + damping[..., None] * np.eye(blocks.shape[-1]))


@dataclass(frozen=True)
class _Reduced:
    """A turn's damped normal equations without its points.

    inverse: (t, 3, 3) of the points' blocks. poses: (6k, 6k); right: (6k, q + 1); lens:
    (q, q + 1). mixed: of each chunk (3, w, c), of its points, and of the poses and the lens.
    """

    inverse: Floats
    poses: Floats
    right: Floats
    lens: Floats
    mixed: list[Floats]


def _reduced(linear: _Linear, radius: float) -> _Reduced:
    turn, more = linear.turn, linear.point_right.shape[1]
    count = len(turn.rotations)
    size = POSE * count
    inverse = np.asarray(np.linalg.inv(
        _damped(linear.points, _damping(linear.points, radius))), np.float64)
    root = np.linalg.cholesky(inverse).transpose(2, 1, 0)
    whole, each = np.zeros((size + more, size + more)), np.arange(count)
    whole[:size, :size].reshape(count, POSE, count, POSE)[each, :, each] = _damped(
        linear.poses, _damping(linear.poses, radius))
    whole[:size, size:] = linear.pose_right.reshape(size, more)
    whole[size:-1, size:] = linear.lens
    kept = []
    for chunk in turn.chunks:
        span = chunk.end - chunk.begin
        inner = POSE * span
        mixed = np.zeros((3, inner + more, len(chunk.points)))
        mixed[:, :inner].reshape(3, span, POSE, -1).transpose(0, 2, 1, 3)[
            :, :, chunk.image, chunk.place] = linear.mixed[:, :, chunk.observations]
        mixed[:, inner:] = linear.point_right[:, :, chunk.points]
        kept.append(mixed)
        factor = root[:, :, chunk.points]
        squares = np.zeros((inner + more, inner + more))
        for part in (factor[0, 0] * mixed[0] + factor[0, 1] * mixed[1] + factor[0, 2] * mixed[2],
                     factor[1, 1] * mixed[1] + factor[1, 2] * mixed[2], factor[2, 2] * mixed[2]):
            squares += part @ part.T
        low, high = POSE * chunk.begin, POSE * chunk.end
        whole[low:high, low:high] -= squares[:inner, :inner]
        whole[low:high, size:] -= squares[:inner, inner:]
        whole[size:, size:] -= squares[inner:, inner:]
    return _Reduced(inverse, whole[:size, :size], whole[:size, size:], whole[size:-1, size:], kept)


def _step(linear: Sequence[_Linear], radius: float
          ) -> tuple[Floats, list[tuple[Floats, Floats]], float]:
    """Return the steps of the lens (q,) and of each turn's poses and points, and their gain.

    The gain is NaN where the equations have no solution.
    """
    try:
        return _solution(linear, radius)
    except np.linalg.LinAlgError:
        return np.zeros(0), [], np.nan


def _solution(linear: Sequence[_Linear], radius: float
              ) -> tuple[Floats, list[tuple[Floats, Floats]], float]:
    of_lens = np.sum([each.lens for each in linear], axis=0)
    damping = _damping(of_lens[:, :-1], radius)
    left = np.column_stack([np.diag(damping), np.zeros(len(damping))])
    reduced, solved = [_reduced(each, radius) for each in linear], []
    for less in reduced:
        solved.append(np.linalg.solve(less.poses, less.right))
        left = left + less.lens - less.right[:, :-1].T @ solved[-1]
    step = np.linalg.solve(left[:, :-1], left[:, -1])
    # half of what the score gives, and of what the damping holds back
    gain, moves = float(step @ (of_lens[:, -1] + damping * step)), []
    for each, less, right in zip(linear, reduced, solved, strict=True):
        poses = right[:, -1] - right[:, :-1] @ step
        points = np.empty((3, len(each.points)))
        for chunk, mixed in zip(each.turn.chunks, less.mixed, strict=True):
            known = [*poses[POSE * chunk.begin:POSE * chunk.end], *step, -1.0]
            points[:, chunk.points] = -np.array(known) @ mixed
        points = np.einsum('tij,jt->ti', less.inverse, points)
        poses = poses.reshape(-1, POSE)
        for move, blocks, score in ((poses, each.poses, each.pose_right[:, :, -1]),
                                    (points, each.points, each.point_right[:, -1].T)):
            gain += float(np.sum(move * (score + _damping(blocks, radius) * move)))
        moves.append((poses, points))
    return step, moves, 0.5 * gain
