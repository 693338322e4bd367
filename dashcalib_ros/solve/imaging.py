# SPDX-License-Identifier: Apache-2.0
"""How a point becomes a pixel: the lens, the shutter's rows, the field, and what each image has.

These are the blocks of the one problem. Each is a value here, its columns in the linearised
problem, and a prior (blocks.py). A pixel (u, v) is observed where

    ideal(u, v) = lens(pose at the time of row v, point)

and ideal() takes out what the image was shifted and zoomed by, and then the field.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import TERMS, Field, field_terms
from dashcalib_ros.camera.mapping import sensitivity, turned
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.scene import Scene, Structure, main_axis

# singular values below this share of the largest: the camera cannot make such a field
LEAST_PART = 1e-3
# keyframes at the least, from which a spline says how the camera moved
LEAST_KEYFRAMES = 4
# prior sigmas of how much faster a camera turns than the spline says: about the axis of the turn,
# and about the others (3 degrees a second)
STEERING_RAD_S, BUMPS_RAD_S = 0.005, 0.05
# s; with a shorter readout, shaking is held as with this
LEAST_SHAKEN_S = 1e-3


@dataclass(frozen=True)
class Imaging:
    """The present values of all blocks.

    camera: the lens, in the widest model of its kind. readout_s: from the first row to the last.
    basis: (2 len(TERMS), f) the field's directions, see field_basis(); directions: (f,) how far it
    goes in each, px. images: by turn (k, 3), the shift of each keyframe's picture in x and y, px,
    and its zoom; a turn that is not in it has none. shaking: by turn (k, 3) rad, by how much each
    keyframe's camera turns more, from the first row to the last, than the spline through the poses
    says, as bumps make it. shaken_s: the readout at which the prior of that is taken; a step does
    not change it, or a longer readout would make the same shaking likelier. axes: by turn (3,)
    about which the car turns, in the camera's axes.
    """

    camera: Camera
    readout_s: float
    basis: Floats
    directions: Floats
    images: Mapping[TurnId, Floats] = field(default_factory=dict)
    shaking: Mapping[TurnId, Floats] = field(default_factory=dict)
    axes: Mapping[TurnId, Floats] = field(default_factory=dict)
    shaken_s: float = 0.0

    @cached_property
    def field(self) -> Field:
        """Return the field over the picture."""
        return Field(self.camera.image_size, (self.basis @ self.directions).reshape(2, -1))

    def ideal(self, scene: Scene) -> Floats:
        """Return (k, t, 2) where the lens alone would see what was measured in a turn."""
        found = np.full(scene.tracks.xy.shape, np.nan)
        seen = scene.tracks.seen
        found[seen] = self.ideal_of(scene, seen)
        return found

    def ideal_of(self, scene: Scene, chosen: Mask) -> Floats:
        """Return (n, 2) the same of chosen observations (k, t), image by image."""
        xy = scene.tracks.xy[chosen]
        if scene.turn in self.images:
            moved = self.images[scene.turn][np.nonzero(chosen)[0]]
            middle = (np.array(self.camera.image_size) - 1) / 2
            xy = middle + (xy - middle - moved[:, :2]) / (1 + moved[:, 2:])
        return self.field.ideal(xy) if self.directions.any() else xy

    def field_columns(self, projected: Floats) -> Floats:
        """Return (n, 2, f) derivatives of pixels (n, 2) by the field's directions.

        projected: where the points are projected; the errors of observations would correlate with
        the terms.
        """
        return displacements(projected, self.camera.image_size, self.basis)

    def stepped(self, step: Floats) -> Imaging:
        """Return the imaging after a step (m,) of the lens, the readout and the field."""
        count = len(self.camera.params)
        return replace(self, camera=self.camera.with_params(self.camera.params + step[:count]),
                       readout_s=self.readout_s + float(step[count]),
                       directions=self.directions + step[count + 1:])

    def held(self) -> Imaging:
        """Return the imaging with the prior of the shaking at the present readout."""
        coupled = abs(self.readout_s) > LEAST_SHAKEN_S
        return replace(self, shaken_s=self.readout_s, shaking=self.shaking if coupled else {})

    def as_lens_sees(self, scene: Scene) -> Scene:
        """Return the turn with the tracks that the lens alone would have seen, all rows at once.

        That is a global shutter exposed with the middle row.
        """
        xy = self.ideal(scene)
        if self.readout_s:
            xy = xy - row_shift(scene, self)
        return replace(scene, tracks=replace(scene.tracks, xy=xy))


def imaging_with(camera: Camera, scenes: Sequence[Scene] = ()) -> Imaging:
    """Return the imaging by a lens, where nothing is known of the other blocks."""
    basis = field_basis(camera)
    return Imaging(camera, 0.0, basis, np.zeros(basis.shape[1]), axes={
        scene.turn: main_axis(scene.turned) for scene in scenes})


def lens_alone(camera: Camera) -> Imaging:
    """Return the imaging by a lens, which no field can join."""
    return Imaging(camera, 0.0, np.zeros((2 * len(TERMS), 0)), np.zeros(0))


def displacements(pixels: Floats, image_size: tuple[int, int], basis: Floats) -> Floats:
    """Return (..., 2, f) the fields of f directions (2 len(TERMS), f) at pixels (..., 2)."""
    terms, count = field_terms(pixels, image_size), len(TERMS)
    return np.stack([terms @ basis[:count], terms @ basis[count:]], axis=-2)


def field_basis(camera: Camera) -> Floats:
    """Return (2 len(TERMS), f) directions that no change of the camera and no rotation makes.

    They are scaled so that the prior of a field of size 1 is the unit matrix: smaller for higher
    degrees.
    """
    moves, pixels = sensitivity(camera)
    fields = displacements(pixels, camera.image_size, np.eye(2 * len(TERMS)))
    # rotations of the camera move all pixels, and sensitivity() leaves them out
    rays = camera.rays(pixels)
    by_rotation = camera.derivatives(rays)[1] @ turned(rays)
    by_camera = np.concatenate([moves, by_rotation], axis=2).reshape(-1, moves.shape[2] + 3)
    made, _ = np.linalg.qr(by_camera / np.linalg.norm(by_camera, axis=0))
    _, parts, rows = np.linalg.svd(made.T @ fields.reshape(len(made), -1))
    free = rows[int((parts > LEAST_PART * parts[0]).sum()):].T
    degree = np.maximum(np.array(TERMS).sum(axis=1) - 1, 1)
    precision = free.T * np.tile(degree.astype(np.float64)**2, 2) @ free
    return np.asarray(free @ np.linalg.inv(np.linalg.cholesky(precision)).T)


def lens_like(camera: Camera) -> Floats:
    """Return (n, n) the covariance of the camera's parameters by a smooth error of the pictures.

    Of a field of size 1: what of it the parameters would take up.
    """
    moves, pixels = sensitivity(camera)
    degree = np.array(TERMS).sum(axis=1)
    scale = np.where(degree > 1, 1 / np.maximum(degree - 1, 1), 0.0)
    fields = displacements(pixels, camera.image_size, np.diag(np.tile(scale, 2)))
    made, *_ = np.linalg.lstsq(moves.reshape(-1, moves.shape[2]),
                               fields.reshape(-1, fields.shape[2]))
    return np.asarray(made @ made.T)


# the shutter: a point is seen from where the camera is at the time of its row

@dataclass(frozen=True)
class Motion:
    """How each keyframe's camera turns and moves, (k, 3) rad/s and (k, 3) a second.

    A point X in the camera's axes moves by turning x X + moving. derivative: (p, p) of what is
    known at p poses, by time.
    """

    turning: Floats
    moving: Floats
    derivative: Floats
    poses: Ints

    def follow(self, structure: Structure) -> Floats:
        """Return (k, 6, k, 6) derivatives of turning and moving by rotations and translations.

        By the small rotation, in its own axes, and the move of each keyframe's camera.
        """
        count = len(structure.translations)
        weights = np.zeros((count, count))
        weights[np.ix_(self.poses, self.poses)] = self.derivative
        # [k, j]: from the axes of keyframe k to those of j
        relative = np.einsum('jab,kcb->kjac', structure.rotations, structure.rotations)
        turned = cross(_logarithms(relative).reshape(-1, 3)).reshape(relative.shape)
        # of the vector of a rotation by one more small rotation, to the third order; gauge-free
        by_turn = weights[:, :, None, None] * (np.eye(3) - turned / 2 + turned @ turned / 12)
        each, found = np.arange(count), np.zeros((count, 6, count, 6))
        found[:, :3, :, :3] = by_turn.transpose(0, 2, 1, 3)
        found[each, :3, each, :3] -= np.sum(by_turn @ relative, axis=1)
        weighted = weights[:, :, None, None] * relative.transpose(0, 1, 3, 2)
        found[:, 3:, :, 3:] = weighted.transpose(0, 2, 1, 3)
        found[:, 3:, :, :3] = (weighted @ cross(structure.translations)).transpose(0, 2, 1, 3)
        found[each, 3:, each, :3] -= cross(self.moving)
        return found


@dataclass(frozen=True)
class LocalPoints:
    """Points of the n used observations in the camera's axes.

    rotated: (n, 3) the world's points, rotated. still: (n, 3) at the time of the middle row;
    local: (n, 3) at the time of their rows. turning: (n, 3) rad by which the camera turns from the
    first row to the last. by_readout: (n, 3) how far they move for a second of readout. late: (n,)
    when their rows are exposed, in readouts after the middle one. motion: of the camera.
    """

    rotated: Floats
    still: Floats
    local: Floats
    turning: Floats
    by_readout: Floats
    late: Floats
    motion: Motion


def local_points(scene: Scene, imaging: Imaging) -> LocalPoints:
    """Return the points of the used observations, image by image, in the camera's axes."""
    structure = scene.structure
    rows, columns = np.nonzero(structure.used)
    rotated = np.einsum('nij,nj->ni', structure.rotations[rows], structure.points[columns])
    still = rotated + structure.translations[rows]
    motion = motion_of(structure, scene.tracks.stamps_ns)
    late = (scene.tracks.xy[rows, columns, 1] + 0.5) / imaging.camera.image_size[1] - 0.5
    by_readout = late[:, None] * (
        np.cross(motion.turning[rows], still) + motion.moving[rows])
    # rad and units from the first row to the last
    turning = imaging.readout_s * motion.turning[rows]
    local = still + imaging.readout_s * by_readout
    if scene.turn in imaging.shaking:
        shaking = imaging.shaking[scene.turn][rows]
        turning, local = turning + shaking, local + late[:, None] * np.cross(shaking, still)
    return LocalPoints(rotated, still, local, turning, by_readout, late, motion)


def row_shift(scene: Scene, imaging: Imaging) -> Floats:
    """Return (k, t, 2) px by which each observation is displaced by the readout.

    0 where the turn has no point for a track, or no pose.
    """
    structure, camera = scene.structure, imaging.camera
    seen = scene.tracks.seen & structure.registered[:, None] & structure.used.any(axis=0)
    found = local_points(replace(scene, structure=replace(structure, used=seen)), imaging)
    shift = np.zeros(scene.tracks.xy.shape)
    shift[seen] = np.nan_to_num(camera.project(found.local) - camera.project(found.still))
    return shift


def motion_of(structure: Structure, stamps_ns: Ints) -> Motion:
    """Return how each keyframe's camera turns and moves, of cubic splines through the poses.

    A chord between neighbours is slower than the car turns in its middle. 0 where stamps or
    keyframes do not say.
    """
    turning, moving = np.zeros((2, *structure.translations.shape))
    poses = np.flatnonzero(structure.registered)
    seconds = stamps_ns[poses] / 1e9
    if len(poses) < LEAST_KEYFRAMES or not np.all(np.diff(seconds) > 0):
        return Motion(turning, moving, np.zeros((len(poses), len(poses))), poses)
    derivative = _derivative(tuple((seconds - seconds[0]).tolist()))
    rotations, centres = structure.path()
    relative = np.einsum('jab,kcb->kjac', rotations, rotations)
    turning[poses] = np.einsum('kj,kjc->kc', derivative, _logarithms(relative))
    moving[poses] = -np.einsum('kab,kb->ka', rotations, derivative @ centres)
    return Motion(turning, moving, derivative, poses)


@lru_cache(maxsize=64)
def _derivative(seconds: tuple[float, ...]) -> Floats:
    """Return (k, k) the derivatives of a cubic spline at each of k times, by the values at all.

    The second derivative is continuous, and at the second and the last but one time the third, too
    (not-a-knot). SciPy has this, but takes 0.3 s to load, in each process.
    """
    times = np.array(seconds)
    step, count = np.diff(times), len(times)
    slope = np.diff(np.eye(count), axis=0) / step[:, None]
    left, right = np.zeros((count, count)), np.zeros((count, count))
    inner = np.arange(1, count - 1)
    left[inner, inner - 1], left[inner, inner + 1] = step[1:], step[:-1]
    left[inner, inner] = 2 * (step[:-1] + step[1:])
    right[1:-1] = 3 * (step[1:, None] * slope[:-1] + step[:-1, None] * slope[1:])
    for end, next_one, (h, k), (a, b) in (
            (0, 1, step[:2], slope[:2]), (-1, -2, step[:-3:-1], slope[:-3:-1])):
        left[end, end], left[end, next_one] = k, h + k
        right[end] = ((3 * h + 2 * k) * k * a + h * h * b) / (h + k)
    return np.asarray(np.linalg.solve(left, right))


def shake_precision(axis: Floats, readout_s: float) -> Floats:
    """Return (3, 3) the inverse of the prior covariance of how a keyframe shakes, rad^-2.

    Bumps pitch and roll the car; about the axis of the turn, (3,), it is the driver who turns it.
    """
    return np.asarray((np.eye(3) / BUMPS_RAD_S**2 + np.outer(axis, axis) * (
        STEERING_RAD_S**-2 - BUMPS_RAD_S**-2)) / max(abs(readout_s), LEAST_SHAKEN_S)**2)


def cross(vectors: Floats) -> Floats:
    """Return (n, 3, 3) matrices that take the cross product with each vector (n, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _logarithms(rotations: Floats) -> Floats:
    """Return (..., 3) rad the vectors of rotations (..., 3, 3) of less than 180 degrees."""
    axis = np.stack([rotations[..., 2, 1] - rotations[..., 1, 2],
                     rotations[..., 0, 2] - rotations[..., 2, 0],
                     rotations[..., 1, 0] - rotations[..., 0, 1]], axis=-1) / 2
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, (np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2)
    return np.asarray(axis * (angle / np.maximum(sine, 1e-12))[..., None])
