"""The normal equations of one scene, with its points and poses eliminated (Schur complement).

At the adjusted solution the residuals are linearised by the scene's points and poses, by the
parameters of the wider lens model (those that this model does not have are 0: p1, p2 and k3 beside
the paper's six), by further ones that all turns share (a rolling shutter's readout, a field over
the picture), and, where wanted, by three of each image: a shift of its picture in x and y, and its
zoom.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Floats32, Ints, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.rotation import rotation_matrices
from dashcalib_ros.reconstruct.scene import Scene, Structure, residuals_px
from dashcalib_ros.solve.quadratic import Quadratic, TurnCost

# parameters of a pose, and of an image: its shift in x and y (px), its zoom (1 = 100 %)
POSE = 6
IMAGE = 3


@dataclass(frozen=True)
class Eliminated:
    """How poses and points of a scene follow the m parameters that are left.

    keyframes: (k,), tracks: (t,) those that are used. pose_inverse: (6k, 6k) the inverse of the
    poses' block; pose_score: (6k,); pose_mixed: (6k, m). point_inverse: (t, 3, 3); point_score:
    (t, 3); point_mixed: (t, 3, 6k + m), which is large, so in single precision.
    """

    keyframes: Ints
    tracks: Ints
    pose_inverse: Floats
    pose_score: Floats
    pose_mixed: Floats
    point_inverse: Floats
    point_score: Floats
    point_mixed: Floats32

    def moved(self, structure: Structure, step: Floats) -> Structure:
        """Return the structure at its optimum (of the linearised problem) after a step (m,)."""
        pose = self.pose_inverse @ (self.pose_score - self.pose_mixed @ step)
        both = np.concatenate([pose, step])
        shift = np.einsum('tij,tj->ti', self.point_inverse,
                          self.point_score - self.point_mixed @ both)
        turn, move = np.split(pose.reshape(-1, POSE), 2, axis=1)
        rotations, translations = structure.rotations.copy(), structure.translations.copy()
        rotations[self.keyframes] = rotation_matrices(turn) @ rotations[self.keyframes]
        translations[self.keyframes] += move
        points = structure.points.copy()
        points[self.tracks] += shift
        return replace(structure, rotations=rotations, translations=translations, points=points)


@dataclass(frozen=True)
class Normal:
    """The normal equations of one scene.

    cost: about IMAGE parameters of each of its used keyframes, if they were asked for, and then
    about what turns share. images: how many keyframes have parameters.
    """

    cost: TurnCost
    images: int
    eliminated: Eliminated

    @property
    def shared(self) -> Quadratic:
        """Return the cost about what turns share, the images' parameters fixed."""
        return self.cost.of(np.arange(IMAGE * self.images, len(self.cost.score)))


def used_keyframes(scene: Scene) -> Ints:
    """Return the rows (k,) of the keyframes of which observations are used."""
    return np.flatnonzero(scene.structure.used.any(axis=1))


@dataclass(frozen=True)
class ImagePrior:
    """What may differ between the images of a scene, and how much: a normal distribution.

    free: (p,) the indices of these parameters among the images'; the others are fixed. precision:
    (p, p) the inverse of their covariance around 0, times the noise in px^2. values: (p,) how
    large they are already, in the scene's tracks.
    """

    free: Ints
    precision: Floats
    values: Floats

    def of(self, normal: Normal) -> Quadratic:
        """Return the cost about these parameters with the prior; what turns share is fixed."""
        return Quadratic.together([normal.cost.of(self.free), Quadratic.prior(
            self.precision, score=-self.precision @ self.values)])

    def eliminated(self, normal: Normal) -> Quadratic:
        """Return the cost about what turns share, these parameters at their optimum."""
        own, cost, shared = self.of(normal), normal.cost, slice(IMAGE * normal.images, None)
        mixed = cost.hessian[self.free, shared]
        combine = np.zeros((len(cost.score) - IMAGE * normal.images, len(cost.score)))
        combine[:, shared] = np.eye(len(combine))
        combine[:, self.free] = -mixed.T @ own.covariance
        return Quadratic(cost.hessian[shared, shared] - mixed.T @ own.covariance @ mixed,
                         cost.score[shared] - mixed.T @ own.covariance @ own.score,
                         combine @ cost.by_track @ combine.T)

    def step(self, normal: Normal, others: Ints, step: Floats) -> Floats:
        """Return (p,) their step, given that (s,) of others, indices behind the images'."""
        own = self.of(normal)
        mixed = normal.cost.hessian[np.ix_(self.free, IMAGE * normal.images + others)]
        return np.asarray(own.covariance @ (own.score - mixed @ step))


@dataclass(frozen=True)
class Further:
    """Further parameters that all turns share, beside the lens's: e of them.

    columns: derivatives (n, 2, e) of the n used observations of a scene, in the order of their
    images. sigmas: (e,) of their prior; inf: none.
    """

    columns: Callable[[Scene], Floats]
    sigmas: Floats


def turn_cost(scene: Scene, camera: Camera, loss_px: float, further: Sequence[Further] = (),
              images: ImagePrior | None = None) -> TurnCost:
    """Return what a scene knows of the camera, at the solution.

    loss_px, further: as normal_equations()'. images: what may differ between the images; None:
    nothing.
    """
    normal = normal_equations(scene, camera, loss_px, further, by_image=images is not None)
    cost = normal.shared if images is None else images.eliminated(normal)
    return replace(normal.cost, hessian=cost.hessian, score=cost.score, by_track=cost.by_track)


def noise_in(scenes: Sequence[Scene], camera: Camera, loss_px: float) -> float:
    """Return what noise_of() returns for these scenes, without their normal equations."""
    squares = freedom = 0.0
    for scene in scenes:
        used = scene.structure.used
        residual = residuals_px(scene, camera)[used]
        more = _squares_and_freedom(used, residual, _weights(residual, loss_px),
                                    len(camera.names()))
        squares, freedom = squares + more[0], freedom + more[1]
    return squares / freedom


def normal_equations(scene: Scene, camera: Camera, loss_px: float,
                     further: Sequence[Further] = (), by_image: bool = False) -> Normal:
    """Return the normal equations of a scene at the solution.

    loss_px: scale of the Cauchy loss, whose weights w = 1 / (1 + e^2 / loss^2) apply.
    further: what turns share beside the lens. by_image: with the parameters of each image.
    """
    used = scene.structure.used
    linear = _linearised(scene, camera, loss_px, further, by_image)
    rows, columns = np.nonzero(used)
    keyframes, image = np.unique(rows, return_inverse=True)
    tracks, point = np.unique(columns, return_inverse=True)
    own = IMAGE if by_image else 0
    poses, images = POSE * len(keyframes), own * len(keyframes)
    shared = linear.wide.shape[2] - POSE - own
    where = np.concatenate([
        POSE * image[:, None] + np.arange(POSE), poses + own * image[:, None] + np.arange(own),
        np.broadcast_to(poses + images + np.arange(shared), (len(rows), shared))], axis=1)

    reduced, points = _eliminate_points(linear, where, point, POSE + own)
    pose_inverse = _pose_inverse(reduced[:poses, :poses])
    response = pose_inverse @ reduced[:poses, poses:]
    hessian = reduced[poses:, poses:] - reduced[:poses, poses:].T @ response

    # each track's score with its point at its optimum, then with the poses at theirs, too
    at_optimum = (points.inverse @ points.score[:, :, None])[:, :, 0]
    track_score = points.pull - (at_optimum[:, None] @ points.mixed)[:, 0]
    scores = track_score[:, poses:] - track_score[:, :poses] @ response
    noise = _squares_and_freedom(used, linear.residual, linear.weight, len(camera.names()))
    return Normal(
        TurnCost(hessian, scores.sum(axis=0), scores.T @ scores, *noise,
                 lens=len(camera.widened().names())),
        images // IMAGE,
        Eliminated(keyframes, tracks, pose_inverse, track_score[:, :poses].sum(axis=0),
                   reduced[:poses, poses:], points.inverse, points.score,
                   points.mixed.astype(np.float32)))


@dataclass(frozen=True)
class _Linear:
    """All used observations, linearised.

    wide: (n, 2, c) weighted derivatives by the pose, the image, the lens and the rest. by_point:
    (n, 2, 3). residual: (n, 2) px. weight: (n,).
    """

    wide: Floats
    by_point: Floats
    residual: Floats
    weight: Floats


def _linearised(scene: Scene, camera: Camera, loss_px: float, further: Sequence[Further],
                by_image: bool) -> _Linear:
    structure = scene.structure
    rows, columns = np.nonzero(structure.used)
    rotation = structure.rotations[rows]
    rotated = np.einsum('nij,nj->ni', rotation, structure.points[columns])
    by_camera, by_local, projected = camera.widened().derivatives(
        rotated + structure.translations[rows])
    residual = scene.tracks.xy[rows, columns] - projected
    # the loss has the gradient w e, and the curvature w^2 on average over the directions of e
    weight = _weights(residual, loss_px)
    # a small rotation w of the camera moves the local point by w x (R X)
    parts = [by_local @ -_cross(rotated), by_local]
    if by_image:
        middle = (np.array(camera.image_size) - 1) / 2
        shift = np.broadcast_to(np.eye(2), (len(rows), 2, 2))
        parts += [shift, (projected - middle)[:, :, None]]
    wide = np.concatenate([*parts, by_camera, *(each.columns(scene) for each in further)], axis=2)
    return _Linear(wide * weight[:, None, None], by_local @ rotation * weight[:, None, None],
                   residual, weight)


@dataclass(frozen=True)
class _Points:
    """The points' part of the normal equations.

    inverse: (t, 3, 3) of their blocks. score: (t, 3). mixed: (t, 3, size) blocks with all else.
    pull: (t, size) the scores of all else from the observations of each point.
    """

    inverse: Floats
    score: Floats
    mixed: Floats
    pull: Floats


def _eliminate_points(linear: _Linear, where: npt.NDArray[np.intp], point: npt.NDArray[np.intp],
                      local: int) -> tuple[Floats, _Points]:
    """Return the normal matrix after the points are eliminated (Schur), and their part of it.

    where: (n, c) rows of that matrix for an observation's derivatives, ascending in the first
    column; those behind the first `local` are the same for all. point: (n,) its point.
    """
    wide, size, count = linear.wide, int(where.max()) + 1, int(point.max()) + 1
    normal = np.zeros((size, size))
    starts = np.flatnonzero(np.diff(where[:, 0], prepend=-1))
    ends = np.append(starts, len(where))[1:]
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        # of one image
        rows = where[start, :local]
        flat = wide[start:end].reshape(-1, wide.shape[2])
        block = flat[:, :local].T @ flat
        normal[np.ix_(rows, where[start])] = block
        normal[np.ix_(where[start, local:], rows)] = block[:, local:].T
    flat = wide.reshape(-1, wide.shape[2])
    shared = where[0, local:]
    normal[np.ix_(shared, shared)] = (flat.T @ flat)[local:, local:]

    # the residual is one more column beside a point's three: its products are the scores
    four = np.concatenate([linear.by_point, linear.residual[:, :, None]], axis=2)
    mixed, blocks = np.zeros((count, 4, size)), np.zeros((count, 4, 4))
    order, seen = np.argsort(point, kind='stable'), np.bincount(point)
    first = np.cumsum(seen) - seen
    for times in np.unique(seen):
        # points that are seen equally often, all at once
        same = np.flatnonzero(seen == times)
        theirs = order[first[same][:, None] + np.arange(times)]
        own = four[theirs].reshape(len(same), -1, 4).transpose(0, 2, 1)
        mixed[same, :, shared[0]:] = own @ wide[theirs, :, local:].reshape(
            len(same), own.shape[2], -1)
        blocks[same] = own @ own.transpose(0, 2, 1)
    # a point is seen once in an image
    mixed[point[:, None], :, where[:, :local]] = wide[:, :, :local].transpose(0, 2, 1) @ four
    # a little damping, so that badly determined points have a finite inverse
    of_points = blocks[:, :3, :3]
    damping = 1e-9 * np.trace(of_points, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    inverse = np.linalg.inv(of_points + damping + 1e-12 * np.eye(3))
    scaled = (np.linalg.cholesky(inverse).transpose(0, 2, 1) @ mixed[:, :3]).reshape(-1, size)
    return normal - scaled.T @ scaled, _Points(inverse, blocks[:, :3, 3], mixed[:, :3],
                                               mixed[:, 3])


def _pose_inverse(poses: Floats) -> Floats:
    """Return the inverse of the poses' block.

    The gauge (position, rotation and scale of the scene: seven directions) is free: the
    pseudo-inverse leaves it out.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(poses), 1e-12))
    inner = np.linalg.pinv(poses * scale[:, None] * scale, rcond=1e-10, hermitian=True)
    return np.asarray(inner * scale[:, None] * scale)


def _weights(residual: Floats, loss_px: float) -> Floats:
    """Return (n,) weights of residuals (n, 2) under the Cauchy loss."""
    return np.asarray(1 / (1 + np.sum(residual**2, axis=1) / loss_px**2))


def _squares_and_freedom(used: Mask, residual: Floats, weight: Floats, parameters: int
                         ) -> tuple[float, float]:
    """Return the sum of the weighted squared residuals, px^2, and their degrees of freedom."""
    observations, points, poses = (
        int(each.sum()) for each in (used, used.any(axis=0), used.any(axis=1)))
    # the gauge (position, rotation and scale of the scene) is free: seven
    freedom = max(2 * observations - 3 * points - 6 * poses + 7 - parameters, 1)
    return float(np.sum((residual * weight[:, None])**2) / np.mean(weight**2)), float(freedom)


def _cross(vectors: Floats) -> Floats:
    """Return (n, 3, 3) matrices that take the cross product with each vector (n, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
