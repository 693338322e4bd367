# SPDX-License-Identifier: Apache-2.0
"""What two cameras see at the same time: matches that no calibration was made of, as a witness.

With the right lenses and the right rotation, every match lies in its epipolar plane. Only the
direction from one camera to the other is fitted, where the rotation is held.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, GreyImage
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.camera.mapping import grid_of
from dashcalib_ros.camera.rotation import rotation_matrices, rotation_vectors
from dashcalib_ros.judge.mount import epipolar
from dashcalib_ros.rig.joint import Matched
from dashcalib_ros.robust import cauchy_weights

# of a match's distance to that of the second best one (Lowe 2004), and features of a picture
RATIO, FEATURES = 0.75, 3000
# px: the loss of the fit, narrowing; and beyond which a match is wrong
LOSSES_PX, WRONG_PX = (30.0, 10.0, 3.0, 1.5, 1.0, 1.0, 1.0, 1.0), 3.0
# columns and rows of the cells over the first picture; matches of a cell, and of a pair of cameras
CELLS, LEAST_IN_CELL, LEAST_MATCHES = (6, 3), 15, 60
# share of matches that must fit to one rotation: without a common view 23 % did by chance, with a
# small one 73 % (two pairs of a rendered rig); of a stereo pair 98 %
LEAST_INSIDE = 0.4


@dataclass(frozen=True)
class Epipolar:
    """How well matches fit. matches: how many. median: px, of the residuals' sizes.

    cells_rms: px, of the cells' median residuals over the first camera's picture: what noise does
    not explain.
    """

    matches: int
    median: float
    cells_rms: float


def matched(first: GreyImage, second: GreyImage) -> tuple[Floats, Floats]:
    """Return the pixels (n, 2) of points that both pictures show, and where the second does."""
    sift, matcher = cv2.SIFT.create(FEATURES), cv2.BFMatcher()
    (points, these), (others, those) = (sift.detectAndCompute(each, None)
                                        for each in (first, second))
    empty = np.zeros((0, 2))
    if these is None or those is None or min(len(points), len(others)) < 2:
        return empty, empty
    back = {pair[0].queryIdx: pair[0].trainIdx for pair in matcher.knnMatch(those, these, 2)}
    kept = [(points[a.queryIdx].pt, others[a.trainIdx].pt)
            for a, b in matcher.knnMatch(these, those, 2)
            if a.distance < RATIO * b.distance and back.get(a.trainIdx) == a.queryIdx]
    if not kept:
        return empty, empty
    found = np.array(kept, np.float64)
    return found[:, 0], found[:, 1]


@dataclass(frozen=True)
class Fitted:
    """A rotation from the first camera's axes to the second's (3, 3), and what it leaves, (n,) px.

    inside: (n,) whether a match is an inlier. covariance: (3, 3) of the rotation; where it is
    held, of nothing.
    """

    rotation: Floats
    left_px: Floats
    inside: Floats
    covariance: Floats


def fitted(rays: tuple[Floats, Floats], rotation: Floats, px: float, free: bool = False
           ) -> Fitted | None:
    """Return how matches' rays (n, 3) fit to a rotation; free: it is refined, too.

    px: of a radian. None where there are too few matches, or, if free, where too small a share of
    them fits: cameras that see nothing in common have matches by chance.
    """
    first, second = rays
    if len(first) < LEAST_MATCHES:
        return None
    turned, back = rotation[None], _first_direction(first @ rotation.T, second)[None]
    columns = slice(0 if free else 3, 5)
    hessian = np.eye(5)[columns, columns]
    errors = np.zeros(len(first))
    for loss_px in LOSSES_PX:
        off, slopes, tangents = epipolar(turned, back, first[None], second[None])
        errors, slope = off[0], slopes[0][:, columns]
        weighted = cauchy_weights(errors, loss_px / px)[:, None] * slope
        hessian = weighted.T @ slope + 1e-12 * np.eye(slope.shape[1])
        change = np.zeros(5)
        change[columns] = -np.linalg.solve(hessian, weighted.T @ errors)
        change *= min(1.0, 0.1 / max(float(np.linalg.norm(change)), 1e-12))
        turned = rotation_matrices(change[None, :3]) @ turned
        back = back + change[None, 3:] @ tangents[0]
        back /= np.linalg.norm(back)
    errors = px * epipolar(turned, back, first[None], second[None])[0][0]
    inside = np.abs(errors) < WRONG_PX
    least = max(LEAST_MATCHES, LEAST_INSIDE * len(first) if free else 0)
    if inside.sum() < least:
        return None
    variance = float(np.mean((errors[inside] / px)**2))
    covariance = np.zeros((3, 3))
    if free:
        covariance += variance * np.linalg.inv(hessian)[:3, :3]
    return Fitted(turned[0], errors, inside, covariance)


# degrees; what no rotation by matches is better than
MATCHED_DEG = 0.02


def rotation_by_matches(pair: tuple[str, str], cameras: Sequence[Camera],
                        matches: Sequence[tuple[Floats, Floats]],
                        fields: Sequence[Field | None], across: Floats,
                        lens_sigmas: Sequence[Floats]) -> Matched | None:
    """Return the rotation that matches of two cameras show, and how it follows both lenses.

    cameras: in the widest models of their kinds. across: (3, 3) near it. lens_sigmas: (n,) of each
    camera's parameters; what a lens has more than these does not move it.
    """
    def rotation(each: Sequence[Camera], near: Floats) -> Fitted | None:
        return fitted(rays_of(each, matches, fields)[0], near, each[0].fx, free=True)

    found = rotation(cameras, across)
    if found is None:
        return None
    follow = {}
    for side, name in enumerate(pair):
        params, sigmas = cameras[side].params, lens_sigmas[side]
        follow[name] = np.zeros((3, len(sigmas)))
        for column in range(len(params)):
            step = sigmas[column] * np.eye(len(params))[column]
            others = list(cameras)
            others[side] = cameras[side].with_params(params + step)
            moved = rotation(others, found.rotation)
            if moved is None:
                return None
            follow[name][:, column] = rotation_vectors(
                (moved.rotation @ found.rotation.T)[None])[0] / sigmas[column]
    return Matched(*pair, found.rotation, found.covariance + np.radians(MATCHED_DEG)**2
                   * np.eye(3), follow)


def _first_direction(turned: Floats, second: Floats) -> Floats:
    """Return the direction (3,) that lies in most of the matches' epipolar planes."""
    normals = np.cross(turned, second)
    size = np.linalg.norm(normals, axis=1)
    weights = np.ones(len(normals))
    found = np.array([1.0, 0.0, 0.0])
    for _ in range(10):
        found = np.linalg.eigh((weights[:, None] * normals).T @ normals)[1][:, 0]
        off = np.abs(normals @ found)
        weights = cauchy_weights(off, max(float(np.median(off)), 1e-6)) / np.maximum(
            size, 1e-3)
    return np.asarray(found)


def residual_over(picture: Camera, xy: Floats, found: Fitted) -> Epipolar:
    """Return the residual over a picture in which the matches are at xy (n, 2)."""
    xy, left = xy[found.inside], found.left_px[found.inside]
    width, height = picture.image_size
    cell = (np.clip(xy[:, 0] * CELLS[0] / width, 0, CELLS[0] - 1).astype(int)
            + CELLS[0] * np.clip(xy[:, 1] * CELLS[1] / height, 0, CELLS[1] - 1).astype(int))
    medians = [float(np.median(left[cell == each])) for each in np.unique(cell)
               if np.sum(cell == each) >= LEAST_IN_CELL]
    return Epipolar(len(left), float(np.median(np.abs(left))),
                    float(np.sqrt(np.mean(np.square(medians)))) if medians else 0.0)


def rays_of(cameras: Sequence[Camera], matches: Sequence[tuple[Floats, Floats]],
            fields: Sequence[Field | None] = (None, None)
            ) -> tuple[tuple[Floats, Floats], Floats]:
    """Return the rays of matches in both cameras, and the pixels in the first, of finite ones."""
    xy = [np.concatenate([each[side] for each in matches]) for side in range(2)]
    rays = [camera.rays(places if field is None else field.ideal(places))
            for camera, places, field in zip(cameras, xy, fields, strict=True)]
    seen = np.isfinite(rays[0]).all(axis=1) & np.isfinite(rays[1]).all(axis=1)
    return (rays[0][seen], rays[1][seen]), xy[0][seen]


# of the cells of a grid over the first picture that the second sees, too
LEAST_COMMON = 0.2


def sees_alike(first: Camera, second: Camera, rotation: Floats) -> bool:
    """Return whether two cameras see the same far things. rotation: from the first's axes."""
    rays = first.rays(grid_of(first))
    pixels = second.project(rays[np.isfinite(rays).all(axis=1)] @ rotation.T)
    width, height = second.image_size
    with np.errstate(invalid='ignore'):
        inside = ((pixels >= 0) & (pixels <= [width - 1, height - 1])).all(axis=1)
    return bool(np.mean(inside) > LEAST_COMMON)
