# SPDX-License-Identifier: Apache-2.0
"""Residuals -> normal equations of one turn, with its points and poses eliminated (Schur).

The residuals are linearised by the turn's points and poses, by what all turns share (the lens, a
rolling shutter's readout, the field over the picture), and, where wanted, by three parameters of
each image: a shift of its picture in x and y, and its zoom.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Floats32, Ints
from dashcalib_ros.camera.rotation import rotation_matrices
from dashcalib_ros.reconstruct.scene import Scene, Structure
from dashcalib_ros.solve.imaging import Imaging, cross, local_points, shake_precision
from dashcalib_ros.solve.quadratic import Quadratic

# parameters of a pose, and of an image: its shift in x and y (px), its zoom (1 = 100 %)
POSE = 6
IMAGE = 3
# of how a keyframe shakes
SHAKE = 3
# px; a residual of a point that is behind the camera
BEHIND_PX = 1e3
# s; with a shorter readout, how the poses change the camera's motion does not count
COUPLED_READOUT_S = 1e-3
# groups of tracks, of which each is eliminated at once
CHUNKS = 5
# px^2; rendered images without noise would have none
LEAST_VARIANCE = 1e-6

# (n, 2) pixels where points are projected -> (n, 2, e) derivatives by e further parameters
Columns = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Eliminated:
    """How poses and points of a turn follow the m parameters that are left.

    keyframes: (k,), tracks: (t,) those that are used. pose_inverse: (p, p) the inverse of the
    poses' block, six parameters of each, and behind them three of how each shakes, where that
    counts; pose_score: (p,); pose_mixed: (p, m). point_inverse: (t, 3, 3); point_score: (t, 3);
    point_mixed: (t, 3, p + m), which is large, so in single precision.
    """

    keyframes: Ints
    tracks: Ints
    pose_inverse: Floats
    pose_score: Floats
    pose_mixed: Floats
    point_inverse: Floats
    point_score: Floats
    point_mixed: Floats32

    def moved(self, structure: Structure, step: Floats, part: float = 1.0) -> Structure:
        """Return the structure after a part of the step to its optimum.

        Of the linearised problem, where the other parameters go by the whole step (m,).
        """
        pose = self._poses(step)
        both = np.concatenate([pose, step])
        shift = np.einsum('tij,tj->ti', self.point_inverse,
                          self.point_score - self.point_mixed @ both)
        own = pose[:POSE * len(self.keyframes)].reshape(-1, POSE)
        turn, move = np.split(part * own, 2, axis=1)
        rotations, translations = structure.rotations.copy(), structure.translations.copy()
        rotations[self.keyframes] = rotation_matrices(turn) @ rotations[self.keyframes]
        translations[self.keyframes] += move
        points = structure.points.copy()
        points[self.tracks] += part * shift
        return replace(structure, rotations=rotations, translations=translations, points=points)

    def shaken(self, shaking: Floats, step: Floats, part: float = 1.0) -> Floats:
        """Return (k, 3) how each keyframe shakes after a part of the step."""
        more = self._poses(step)[POSE * len(self.keyframes):].reshape(-1, SHAKE)
        shaking = shaking.copy()
        if len(more):
            shaking[self.keyframes] += part * more
        return shaking

    def _poses(self, step: Floats) -> Floats:
        return np.asarray(self.pose_inverse @ (self.pose_score - self.pose_mixed @ step))


@dataclass(frozen=True)
class Normal:
    """The normal equations of one turn.

    cost: about IMAGE parameters of each of its used keyframes, if they were asked for, and then
    about what turns share. images: how many keyframes have parameters.
    """

    cost: Quadratic
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
    """What may differ between the images of a turn, and how much: a normal distribution.

    free: (p,) the indices of these parameters among the images'; the others are fixed. precision:
    (p, p) the inverse of their covariance around 0, times the noise in px^2. values: (p,) how
    large they are now.
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


def residuals(scene: Scene, imaging: Imaging) -> Floats:
    """Return (n, 2) observed minus projected, px, of the n used observations, image by image.

    Both are where the lens alone would see them; BEHIND_PX where it does not see a point.
    """
    found = local_points(scene, imaging)
    off = (imaging.ideal_of(scene, scene.structure.used)
           - imaging.camera.project(found.local))
    return np.nan_to_num(off, nan=BEHIND_PX)


def normal_equations(scene: Scene, imaging: Imaging, loss_px: float, by_image: bool = False,
                     further: Columns | None = None, safe: bool = False, variance: float = 1.0,
                     clusters: bool = True) -> Normal:
    """Return the normal equations of a turn.

    loss_px: scale of the Cauchy loss, whose weights w = 1 / (1 + e^2 / loss^2) apply: its gradient
    is w e, its curvature w^2 on average over the directions of e. by_image: with the parameters of
    each image. further: more columns of what turns share, behind those of imaging. safe: the
    curvature is w, that of a parabola which lies above the loss: a step to the optimum is shorter,
    and lowers the cost. variance: of a residual, px^2, against which priors of how the camera
    shakes count. clusters: by_track has what observations of one image share, too; at the optimum
    only: elsewhere all of them ask for the same change.
    """
    used = scene.structure.used
    linear = _linearised(scene, imaging, loss_px, by_image, further, safe)
    rows, columns = np.nonzero(used)
    keyframes, image = np.unique(rows, return_inverse=True)
    tracks, point = np.unique(columns, return_inverse=True)
    # of each image: its pose, what it has of its own, and how it moves while its rows are exposed
    own, moving = (IMAGE if by_image else 0), (0 if linear.follow is None else POSE)
    shaking = 0 if linear.follow is None else SHAKE * len(keyframes)
    poses, images = POSE * len(keyframes) + shaking, own * len(keyframes)
    shared = linear.wide.shape[2] - POSE - own - moving
    size = poses + images + shared
    where = np.concatenate([
        POSE * image[:, None] + np.arange(POSE),
        size + moving * image[:, None] + np.arange(moving),
        poses + own * image[:, None] + np.arange(own),
        np.broadcast_to(poses + images + np.arange(shared), (len(rows), shared))], axis=1)

    follow = None if linear.follow is None else _follow(linear.follow, keyframes)
    reduced, points = _eliminate_points(linear, where, point, POSE + moving + own, size, follow)
    shakes, still = np.arange(poses - shaking, poses), np.zeros(poses)
    if shaking:
        precision = variance * np.kron(np.eye(len(keyframes)), shake_precision(
            imaging.axes[scene.turn], imaging.shaken_s))
        reduced[np.ix_(shakes, shakes)] += precision
        still[shakes] = -precision @ imaging.shaking.get(
            scene.turn, np.zeros((len(used), SHAKE)))[keyframes].ravel()
    pose_inverse = _pose_inverse(reduced[:poses, :poses], scene.structure, keyframes)
    response = pose_inverse @ reduced[:poses, poses:]
    hessian = reduced[poses:, poses:] - reduced[:poses, poses:].T @ response

    # each track's score with its point at its optimum, then with the poses at theirs, too
    at_optimum = (points.inverse @ points.score[:, :, None])[:, :, 0]
    track_score = points.pull - (at_optimum[:, None] @ points.mixed)[:, 0]
    scores = track_score[:, poses:] - track_score[:, :poses] @ response
    spread = scores.T @ scores
    if clusters and not by_image:
        each = _scores(linear, points, response, follow, image, point)
        spread = spread + _shared_by_images(each, image)
    return Normal(
        Quadratic(hessian, scores.sum(axis=0) - still @ response, spread),
        images // IMAGE,
        Eliminated(keyframes, tracks, pose_inverse, track_score[:, :poses].sum(axis=0) + still,
                   reduced[:poses, poses:], points.inverse, points.score,
                   points.mixed.astype(np.float32)))


def _scores(linear: _Linear, points: _Points, response: Floats, follow: Floats | None,
            image: Ints, point: Ints) -> Floats:
    """Return (n, m) the score of each observation about what turns share, all else following.

    response: (p, m) of the poses. image, point: (n,) of the observations.
    """
    poses, count = len(response), int(image.max()) + 1
    own = np.einsum('nac,na->nc', linear.wide, linear.residual)
    moving = 0 if follow is None else POSE
    by_pose, by_motion = own[:, :POSE], own[:, POSE:POSE + moving]
    found = own[:, POSE + moving:] - np.einsum(
        'nc,ncm->nm', by_pose, response[:POSE * count].reshape(count, POSE, -1)[image])
    if follow is not None:
        found -= np.einsum('nc,ncm->nm', by_motion, (follow @ response).reshape(
            count, POSE, -1)[image])
    by_points = points.inverse @ (points.mixed[:, :, poses:] - points.mixed[:, :, :poses]
                                  @ response)
    by_point = np.einsum('nac,na->nc', linear.by_point, linear.residual)
    return np.asarray(found - np.einsum('nc,ncm->nm', by_point, by_points[point]))


def _shared_by_images(scores: Floats, image: Ints) -> Floats:
    """Return (m, m) how much more the score scatters by what observations of one image share.

    A shutter's rows while the car shakes, or blur, move all that an image sees.
    """
    starts = np.flatnonzero(np.diff(image, prepend=-1))
    sums = np.add.reduceat(scores, starts, axis=0)
    values, vectors = np.linalg.eigh(sums.T @ sums - scores.T @ scores)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _follow(follow: Floats, keyframes: Ints) -> Floats:
    """Return (6k, 9k) how the motion of k keyframes follows their poses and how they shake."""
    count = len(keyframes)
    poses = follow[keyframes][:, :, keyframes]
    shakes = np.zeros((count, POSE, count, SHAKE))
    shakes[np.arange(count), :SHAKE, np.arange(count)] = np.eye(SHAKE)
    return np.concatenate([poses.reshape(POSE * count, -1),
                           shakes.reshape(POSE * count, -1)], axis=1)


@dataclass(frozen=True)
class _Linear:
    """All used observations, linearised.

    wide: (n, 2, c) weighted derivatives by the pose, its motion, the image and what turns share.
    by_point: (n, 2, 3) the same by the point. residual: (n, 2) px, weighted so that its products
    with these are the scores. follow: (k, 6, k, 6) how the motion of each keyframe follows the
    poses; None where it does not count.
    """

    wide: Floats
    by_point: Floats
    residual: Floats
    follow: Floats | None


def _linearised(scene: Scene, imaging: Imaging, loss_px: float, by_image: bool,
                further: Columns | None, safe: bool) -> _Linear:
    structure, camera = scene.structure, imaging.camera
    rows = np.nonzero(structure.used)[0]
    found = local_points(scene, imaging)
    with np.errstate(divide='ignore', invalid='ignore'):
        by_camera, by_local, projected = camera.derivatives(found.local)
        residual = imaging.ideal_of(scene, structure.used) - projected
        weight = weights(residual, loss_px)
    # a small rotation w of the camera moves the local point by w x (R X)
    by_still, by_motion, follow = by_local, [], None
    if abs(imaging.readout_s) > COUPLED_READOUT_S:
        # a point X moves by turning x X + moving, and both follow the poses
        late = by_local * found.late[:, None, None]
        by_still, by_motion = by_local + late @ cross(found.turning), [
            late @ -cross(found.still), late]
        follow = imaging.readout_s * found.motion.follow(structure)
    parts = [by_still @ -cross(found.rotated), by_still, *by_motion]
    if by_image:
        middle = (np.array(camera.image_size) - 1) / 2
        shift = np.broadcast_to(np.eye(2), (len(rows), 2, 2))
        parts += [shift, (projected - middle)[:, :, None]]
    parts += [by_camera, by_local @ found.by_readout[:, :, None],
              imaging.field_columns(projected)]
    if further is not None:
        parts.append(further(projected))
    scale = np.sqrt(weight) if safe else weight
    wide = np.concatenate(parts, axis=2) * scale[:, None, None]
    by_point = by_still @ structure.rotations[rows] * scale[:, None, None]
    # what the lens does not see counts nothing
    blind = ~np.isfinite(wide).all(axis=(1, 2)) | ~np.isfinite(residual).all(axis=1)
    if blind.any():
        wide[blind], by_point[blind], residual[blind] = 0.0, 0.0, 0.0
    return _Linear(wide, by_point, residual * (weight / np.maximum(scale, 1e-12))[:, None], follow)


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
                      local: int, kept: int, follow: Floats | None
                      ) -> tuple[Floats, _Points]:
    """Return the normal matrix after the points are eliminated (Schur), and their part of it.

    where: (n, c) rows of that matrix for an observation's derivatives, ascending in the first
    column; those behind the first `local` are the same for all. point: (n,) its point. kept: its
    size; what is behind are motions, which follow the poses and how they shake (6k, 9k).
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
        mixed[same, :, shared[0]:kept] = own @ wide[theirs, :, local:].reshape(
            len(same), own.shape[2], -1)
        blocks[same] = own @ own.transpose(0, 2, 1)
    # a point is seen once in an image
    mixed[point[:, None], :, where[:, :local]] = wide[:, :, :local].transpose(0, 2, 1) @ four
    if follow is not None:
        poses = follow.shape[1]
        normal[:poses] += follow.T @ normal[kept:]
        normal[:, :poses] += normal[:, kept:] @ follow
        normal, size = normal[:kept, :kept], kept
        mixed[:, :, :poses] += mixed[:, :, kept:] @ follow
        mixed = mixed[:, :, :kept]
    # a little damping, so that badly determined points have a finite inverse
    of_points = blocks[:, :3, :3]
    damping = 1e-9 * np.trace(of_points, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    inverse = np.linalg.inv(of_points + damping + 1e-12 * np.eye(3))
    scaled = np.linalg.cholesky(inverse).transpose(0, 2, 1) @ mixed[:, :3]
    # tracks that begin together are seen by some of the images only
    for some in np.array_split(np.argsort(mixed[:, 0].argmax(axis=1), kind='stable'), CHUNKS):
        filled = np.flatnonzero(scaled[some].any(axis=(0, 1)))
        flat = scaled[some][:, :, filled].reshape(3 * len(some), len(filled))
        normal[np.ix_(filled, filled)] -= flat.T @ flat
    return normal, _Points(inverse, blocks[:, :3, 3], mixed[:, :3],
                                               mixed[:, 3])


def _pose_inverse(poses: Floats, structure: Structure, keyframes: Ints) -> Floats:
    """Return the inverse of the poses' block, where the gauge does not move.

    The gauge, position, rotation and scale of the scene, is free: seven directions.
    """
    rotations, gauge = structure.rotations[keyframes], np.zeros((len(keyframes), POSE, 7))
    gauge[:, :3, :3] = gauge[:, 3:, 3:6] = rotations
    gauge[:, 3:, 6] = structure.translations[keyframes]
    scale = np.sqrt(np.maximum(np.diag(poses), 1e-12))
    free = np.zeros((len(poses), 7))
    free[:POSE * len(keyframes)] = gauge.reshape(-1, 7)
    held, _ = np.linalg.qr(free * scale[:, None])
    # a little damping, for a scene without motion
    inner = poses / scale[:, None] / scale + held @ held.T + 1e-11 * np.eye(len(poses))
    return np.asarray(np.linalg.inv(inner) / scale[:, None] / scale)


def weights(residual: Floats, loss_px: float) -> Floats:
    """Return (n,) weights of residuals (n, 2) under the Cauchy loss."""
    return np.asarray(1 / (1 + np.sum(residual**2, axis=1) / loss_px**2))


@dataclass(frozen=True)
class Noise:
    """Of all residuals. variance: px^2. curvature: of the loss, over that of safe steps."""

    variance: float
    curvature: float


def noise_of(scenes: Sequence[Scene], off: Sequence[Floats], parameters: int, loss_px: float
             ) -> Noise:
    """Return the noise of residuals (n, 2) of each turn under the Cauchy loss.

    parameters: how many turns share. The variance is the sum of the squared residuals, weighted by
    w^2 over the mean of w^2, over their degrees of freedom.
    """
    squares = freedom = 0.0
    kept = []
    for scene, residual in zip(scenes, off, strict=True):
        used, weight = scene.structure.used, weights(residual, loss_px)
        kept.append(weight)
        observations, points, poses = (
            int(each.sum()) for each in (used, used.any(axis=0), used.any(axis=1)))
        # the gauge (position, rotation and scale of the scene) is free: seven
        freedom += max(2 * observations - 3 * points - 6 * poses + 7
                       - parameters, 1)
        squares += float(np.sum((residual * weight[:, None])**2) / np.mean(weight**2))
    weight = np.concatenate(kept)
    return Noise(max(squares / freedom, LEAST_VARIANCE),
                 float(np.mean(weight**2) / np.mean(weight)))
