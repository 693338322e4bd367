# SPDX-License-Identifier: Apache-2.0
"""Robust poses from viewing rays by OpenCV's minimal solvers, in a RANSAC on angles.

A solver takes pixels of a pinhole, which sees less than 180 degrees. So each sample is turned in
front of a pinhole of its own; all rays, in whatever direction, say how good its poses are. The
best pose so far is refined on the rays that agree (Chum, Matas and Kittler 2003).
"""
from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.camera.rotation import crossed, rotation_matrices
from dashcalib_ros.problem.trajectory import cross
from dashcalib_ros.reconstruct.scene import Pose

# samples drawn at least and at most: drives have many inliers
RELATIVE_TRIALS = (50, 1000)
ABSOLUTE_TRIALS = (10, 100)
CONFIDENCE = 0.999
# rays that a minimal solver takes
FIVE, THREE = 5, 3
# Gauss-Newton steps of a refinement: the adjustments that follow go on from there
REFINEMENTS = 10
# cosine (80 degrees); a pinhole sees nothing farther out
IN_FRONT = 0.17
# rad; scale of the Cauchy loss of a refinement
LOSS_RAD = 1e-3
NO_DISTORTION = np.zeros(4)


def relative_pose(before: Floats, after: Floats, error_rad: float, seed: int
                  ) -> tuple[Pose, int] | None:
    """Return the relative pose of two images; see Engine."""
    def solve(some: Ints) -> list[Floats]:
        one, other = _to_front(before[some]), _to_front(after[some])
        if one is None or other is None:
            return []
        # of five points, all solutions
        found, _ = cv2.findEssentialMat(_pixels(before[some] @ one.T),
                                        _pixels(after[some] @ other.T), np.eye(3))
        return [] if found is None else [
            other.T @ each @ one for each in found.reshape(-1, 3, 3)]

    def errors(essentials: Floats) -> Floats:
        along, back = before @ essentials.transpose(0, 2, 1), after @ essentials
        off = np.einsum('mnc,nc->mn', along, after)
        # Sampson's: how far both rays are off, together
        return np.asarray(off**2 / np.maximum(
            np.einsum('mnc,mnc->mn', along, along) + np.einsum('mnc,mnc->mn', back, back), 1e-30))

    def refine(essential: Floats, good: Mask) -> Floats:
        rotation, translation = _in_front(essential, before[good], after[good])
        return _refined_relative(rotation, translation, before[good], after[good])

    found = _ransac(len(before), FIVE, solve, errors, refine, error_rad, seed, RELATIVE_TRIALS)
    if found is None:
        return None
    essential, good = found
    return _in_front(essential, before[good], after[good]), int(good.sum())


def absolute_pose(rays: Floats, points: Floats, error_rad: float, seed: int
                  ) -> tuple[Pose, int] | None:
    """Return the pose of an image that sees points; see Engine."""
    def solve(some: Ints) -> list[Floats]:
        turn = _to_front(rays[some])
        if turn is None:
            return []
        _, vectors, moves = cv2.solveP3P(points[some], _pixels(rays[some] @ turn.T), np.eye(3),
                                         NO_DISTORTION, cv2.SOLVEPNP_P3P)
        return [turn.T @ np.column_stack([cv2.Rodrigues(vector)[0], move])
                for vector, move in zip(vectors, moves, strict=True)]

    def errors(poses: Floats) -> Floats:
        off = _directions(points @ poses[:, :, :3].transpose(0, 2, 1)
                          + poses[:, None, :, 3]) - rays
        return np.asarray(np.einsum('mnc,mnc->mn', off, off))

    def refine(pose: Floats, good: Mask) -> Floats:
        return _refined_absolute(pose, rays[good], points[good])

    found = _ransac(len(rays), THREE, solve, errors, refine, error_rad, seed, ABSOLUTE_TRIALS)
    if found is None:
        return None
    pose, good = found
    return (pose[:, :3], pose[:, 3]), int(good.sum())


def _ransac(count: int, sample: int, solve: Callable[[Ints], list[Floats]],
            errors: Callable[[Floats], Floats], refine: Callable[[Floats, Mask], Floats],
            error_rad: float, seed: int, trials: tuple[int, int]) -> tuple[Floats, Mask] | None:
    """Return the model with the least truncated error, refined, and which of count rays agree.

    solve: indices (sample,) -> models. errors: models (m, ...) -> their squared errors (m, count),
    rad^2. refine: a model, and which rays agree -> a better one.
    """
    if count < sample:
        return None
    random, limit = np.random.default_rng(seed), error_rad**2
    best, least, good = None, limit * count, np.zeros(count, bool)
    drawn, needed = 0, trials[1]
    while drawn < needed:
        drawn += 1
        models = solve(random.choice(count, sample, replace=False, shuffle=False))
        if not models:
            continue
        model, cost, agree = _best_of(np.stack(models), errors, limit)
        if cost >= least:
            continue
        best, least, good = model, cost, agree
        for _ in range(REFINEMENTS):
            model, cost, agree = _best_of(refine(best, good)[None], errors, limit)
            if cost >= least:
                break
            best, least, good = model, cost, agree
        # how many samples until one of them has no outlier
        clean = min(float(good.mean())**sample, 1 - 1e-12)
        enough = np.log(1 - CONFIDENCE) / np.log1p(-clean) if clean > 0 else trials[1]
        needed = int(np.clip(np.ceil(enough), *trials))
    return None if best is None else (best, good)


def _best_of(models: Floats, errors: Callable[[Floats], Floats], limit: float
             ) -> tuple[Floats, float, Mask]:
    squares = errors(models)
    costs = np.minimum(squares, limit).sum(axis=1)
    n = int(np.argmin(costs))
    return models[n], float(costs[n]), np.asarray(squares[n] < limit)


def _to_front(rays: Floats) -> Floats | None:
    """Return a rotation (3, 3) after which a pinhole sees these rays; None if there is none."""
    middle = rays.sum(axis=0)
    length = float(np.linalg.norm(middle))
    if length < 1e-9 or (rays @ middle).min() < IN_FRONT * length:
        return None
    x, y, z = (middle / length).tolist()
    # the shortest turn of the middle to the axis, where half a turn comes first if it is behind
    half = 1.0 if z >= 0 else -1.0
    y, z = half * y, half * z
    k = 1 / (1 + z)
    return np.array([[1 - x * x * k, -x * y * k, -x], [-x * y * k, 1 - y * y * k, -y], [x, y, z]]
                    ) * [1.0, half, half]


def _pixels(rays: Floats) -> Floats:
    return np.ascontiguousarray(rays[:, :2] / rays[:, 2:])


def _directions(points: Floats) -> Floats:
    squares = np.einsum('...c,...c->...', points, points)
    return np.asarray(points / np.sqrt(np.maximum(squares, 1e-300))[..., None])


def _in_front(essential: Floats, before: Floats, after: Floats) -> Pose:
    """Return the one of an essential matrix' four poses with most points along both rays."""
    first, second, move = cv2.decomposeEssentialMat(essential)
    poses = [(np.asarray(rotation, np.float64), np.asarray(sign * move[:, 0], np.float64))
             for rotation in (first, second) for sign in (1.0, -1.0)]

    def ahead(pose: Pose) -> int:
        rotation, translation = pose
        turned = before @ rotation.T
        cosine = np.einsum('nc,nc->n', turned, after)
        a, b = after @ translation, turned @ translation
        # the signs of the two depths
        return int(((cosine * a > b) & (a > cosine * b)).sum())

    return max(poses, key=ahead)


def _refined_relative(rotation: Floats, translation: Floats, before: Floats, after: Floats
                      ) -> Floats:
    """Return the essential matrix after one Gauss-Newton step on Sampson's errors."""
    turned = before @ rotation.T
    across = cross(translation[None])[0]
    normal = after @ across
    back, along = normal @ rotation, turned @ across
    scale = 1 / np.sqrt(np.maximum(np.sum(along**2, axis=1) + np.sum(back**2, axis=1), 1e-30))
    off = scale * np.einsum('nc,nc->n', normal, turned)
    weight = scale / np.sqrt(1 + (off / LOSS_RAD)**2)
    # the translation is a unit vector: it moves in the plane across it
    plane = np.linalg.svd(translation[None])[2][1:]
    columns = np.column_stack([crossed(turned, normal), crossed(turned, after) @ plane.T])
    step = _solved(columns * weight[:, None], off / scale * weight)
    rotation = rotation_matrices(-step[None, :3])[0] @ rotation
    translation = translation - step[3:] @ plane
    return np.asarray(cross(translation[None] / np.linalg.norm(translation))[0] @ rotation)


def _refined_absolute(pose: Floats, rays: Floats, points: Floats) -> Floats:
    """Return the pose (3, 4) after one Gauss-Newton step on angles."""
    turned = points @ pose[:, :3].T
    local = turned + pose[:, 3]
    distance = np.sqrt(np.maximum(np.einsum('nc,nc->n', local, local), 1e-300))
    ahead = local / distance[:, None]
    off = ahead - rays
    weight = 1 / np.sqrt(1 + np.einsum('nc,nc->n', off, off) / LOSS_RAD**2)
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None]
    by_local = across * (weight / distance)[:, None, None]
    by_turn = crossed(turned[:, None], by_local)
    step = _solved(np.concatenate([by_turn, by_local], axis=2).reshape(-1, 6),
                   (off * weight[:, None]).ravel())
    return np.column_stack([rotation_matrices(-step[None, :3])[0] @ pose[:, :3],
                            pose[:, 3] - step[3:]])


def _solved(columns: Floats, values: Floats) -> Floats:
    normal = columns.T @ columns
    return np.asarray(np.linalg.solve(
        normal + 1e-12 * max(float(np.trace(normal)), 1e-300) * np.eye(len(normal)),
        columns.T @ values))
