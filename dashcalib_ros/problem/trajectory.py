# SPDX-License-Identifier: Apache-2.0
"""The path of a camera: poses at knots, and between them value and velocity at any time.

A cubic spline goes through the centres of the camera, and one through the rotation vectors from
the knot that is nearest. A row of a rolling shutter, a second camera with a clock of its own and
a gyro ask for it at times of their own.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.camera.rotation import rotation_matrices

# knots at the least, from which a spline says how the camera moved
LEAST_KNOTS = 4


@dataclass(frozen=True)
class Moment:
    """Pose and velocity at n times.

    rotations: (n, 3, 3), translations: (n, 3): world to camera. turning: (n, 3) rad/s, moving:
    (n, 3) a second: a point X in the camera's axes moves by turning x X + moving.
    """

    rotations: Floats
    translations: Floats
    turning: Floats
    moving: Floats


@dataclass(frozen=True)
class Trajectory:
    """Poses at k knots.

    seconds: (k,); rotations: (k, 3, 3), translations: (k, 3); rows: (k,) their places among count
    keyframes. moves: whether the knots say how the camera moves between them.
    """

    seconds: Floats
    rotations: Floats
    translations: Floats
    rows: Ints
    count: int
    moves: bool

    @classmethod
    def through(cls, rotations: Floats, translations: Floats, known: Mask, stamps_ns: Ints
                ) -> Trajectory:
        """Return the path through the known ones of poses (k, 3, 3), (k, 3) of a camera."""
        rows = np.flatnonzero(known)
        seconds = (stamps_ns[rows] - stamps_ns[rows[0]]) / 1e9 if len(rows) else np.zeros(0)
        return cls(seconds, rotations[rows], translations[rows], rows, len(known),
                   len(rows) >= LEAST_KNOTS and bool(np.all(np.diff(seconds) > 0)))

    @cached_property
    def _centres(self) -> Floats:
        return np.asarray(-np.einsum('kji,kj->ki', self.rotations, self.translations))

    @cached_property
    def _relative(self) -> Floats:
        """Return (k, k, 3, 3) rotations [k, j] from the axes of knot k to those of j."""
        return np.asarray(self.rotations @ self.rotations.transpose(0, 2, 1)[:, None])

    @cached_property
    def _angles(self) -> Floats:
        return logarithms(self._relative)

    @cached_property
    def velocity(self) -> tuple[Floats, Floats]:
        """Return (count, 3) turning and moving at each keyframe; 0 where nothing says them."""
        turning, moving = np.zeros((2, self.count, 3))
        if self.moves:
            slopes = _slopes(tuple(self.seconds.tolist()))
            turning[self.rows] = np.einsum('kj,kjc->kc', slopes, self._angles)
            moving[self.rows] = -np.einsum('kab,kb->ka', self.rotations, slopes @ self._centres)
        return turning, moving

    def at(self, seconds: Floats) -> Moment:
        """Return pose and velocity at times (n,), s after the first knot.

        Raises ValueError where the knots do not say how the camera moves.
        """
        near, value, slope, angle, rate = self._splined(seconds)
        rotations = rotation_matrices(angle) @ self.rotations[near]
        turning = np.einsum('nab,nb->na', _left(angle), rate)
        return Moment(
            rotations, -np.einsum('nab,nb->na', rotations, value @ self._centres), turning,
            -np.einsum('nab,nb->na', rotations, slope @ self._centres))

    def by_knots(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Return (n, 6, k, 6) derivatives of pose and velocity at times (n,) by the knots' moves.

        A move of a pose is a small rotation in its own axes, and of its translation. Velocity:
        of turning and moving.
        """
        near, value, slope, angle, rate = self._splined(seconds)
        now, each = self.at(seconds), np.arange(len(near))
        left = _left(angle)
        by_angle = self._by_turns(near, value)
        pose, velocity = np.zeros((2, len(near), 6, len(self.seconds), 6))
        pose[:, :3, :, :3] = np.einsum('nab,nbjc->najc', left, by_angle)
        pose[each, :3, near, :3] += rotation_matrices(angle)
        velocity[:, :3, :, :3] = (
            np.einsum('nab,nbjc->najc', left, self._by_turns(near, slope))
            + np.einsum('nab,nbjc->najc', _left_by(angle, rate), by_angle))
        # of minus the centre, in the world's axes, by each knot's move
        back = self.rotations.transpose(0, 2, 1)
        shifted = np.concatenate([back @ cross(self.translations), back], axis=2)
        for found, weights, vector in ((pose, value, now.translations),
                                       (velocity, slope, now.moving)):
            found[:, 3:] = np.einsum('nab,nj,jbc->najc', now.rotations, weights, shifted)
            found[:, 3:] -= np.einsum('nab,nbjc->najc', cross(vector), pose[:, :3])
        return pose, velocity

    def follow(self) -> Floats:
        """Return (count, 6, count, 6) derivatives of the keyframes' velocities by their moves."""
        found = np.zeros((self.count, 6, self.count, 6))
        if self.moves:
            slopes, each = _slopes(tuple(self.seconds.tolist())), np.arange(len(self.seconds))
            inner = np.zeros((len(each), 6, len(each), 6))
            inner[:, :3, :, :3] = self._by_turns(each, slopes)
            # [k, j]: from the axes of knot j to those of k
            weighted = slopes[:, :, None, None] * self._relative.transpose(0, 1, 3, 2)
            inner[:, 3:, :, 3:] = weighted.transpose(0, 2, 1, 3)
            inner[:, 3:, :, :3] = (weighted @ cross(self.translations)).transpose(0, 2, 1, 3)
            inner[each, 3:, each, :3] -= cross(self.velocity[1][self.rows])
            found[np.ix_(self.rows, np.arange(6), self.rows, np.arange(6))] = inner
        return found

    def _by_turns(self, near: Ints, weights: Floats) -> Floats:
        """Return (n, 3, k, 3) derivatives of weighted (n, k) angles from knots near by turns."""
        turned = cross(self._angles[near].reshape(-1, 3)).reshape(*weights.shape, 3, 3)
        # of the vector of a rotation by one more small rotation, to the third order; gauge-free
        by_turn = weights[:, :, None, None] * (np.eye(3) - turned / 2 + turned @ turned / 12)
        found = by_turn.transpose(0, 2, 1, 3).copy()
        found[np.arange(len(near)), :, near] -= np.sum(by_turn @ self._relative[near], axis=1)
        return np.asarray(found)

    def _splined(self, seconds: Floats) -> tuple[Ints, Floats, Floats, Floats, Floats]:
        """Return the nearest knot, weights of values and slopes, the angle from it and its rate.

        (n,), (n, k), (n, k), (n, 3) and (n, 3).
        """
        if not self.moves:
            raise ValueError('too few knots for a trajectory')
        near = np.abs(seconds[:, None] - self.seconds).argmin(axis=1)
        value, slope = _weights(tuple(self.seconds.tolist()), seconds)
        angles = self._angles[near]
        return (near, value, slope, np.einsum('nk,nkc->nc', value, angles),
                np.einsum('nk,nkc->nc', slope, angles))


@lru_cache(maxsize=64)
def _slopes(knots: tuple[float, ...]) -> Floats:
    """Return (k, k) the slopes of a cubic spline at each of k knots, by the values at all.

    The second derivative is continuous, and at the second and the last but one knot the third, too
    (not-a-knot). SciPy has this, but takes 0.3 s to load, in each process.
    """
    times = np.array(knots)
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


def _weights(knots: tuple[float, ...], seconds: Floats) -> tuple[Floats, Floats]:
    """Return (n, k) the spline's values and its slopes at times (n,), by the values at all knots.

    Beyond the ends the outer pieces go on.
    """
    times, slopes, unit = np.array(knots), _slopes(knots), np.eye(len(knots))
    piece = np.clip(np.searchsorted(times, seconds, side='right') - 1, 0, len(times) - 2)
    step = (times[piece + 1] - times[piece])[:, None]
    u = (seconds - times[piece])[:, None] / step
    a, b = unit[piece], unit[piece + 1]
    da, db = step * slopes[piece], step * slopes[piece + 1]
    value = ((1 + 2 * u) * (1 - u)**2 * a + u * (1 - u)**2 * da
             + u**2 * (3 - 2 * u) * b + u**2 * (u - 1) * db)
    slope = (6 * u * (1 - u) * (b - a) + (1 - u) * (1 - 3 * u) * da
             + u * (3 * u - 2) * db) / step
    return value, slope


def _left(vectors: Floats) -> Floats:
    """Return (n, 3, 3) how the rotation of vectors (n, 3) turns with them, to the second order."""
    turned = cross(vectors)
    return np.asarray(np.eye(3) + turned / 2 + turned @ turned / 6)


def _left_by(vectors: Floats, rates: Floats) -> Floats:
    """Return (n, 3, 3) derivatives of _left(v) r by v."""
    turned, rate = cross(vectors), cross(rates)
    # of v x (v x r): -(v x r) x - v x (r x)
    twice = -cross(np.einsum('nab,nb->na', turned, rates)) - turned @ rate
    return np.asarray(-rate / 2 + twice / 6)


def cross(vectors: Floats) -> Floats:
    """Return (n, 3, 3) matrices that take the cross product with each vector (n, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def logarithms(rotations: Floats) -> Floats:
    """Return (..., 3) rad the vectors of rotations (..., 3, 3) of less than 180 degrees."""
    axis = np.stack([rotations[..., 2, 1] - rotations[..., 1, 2],
                     rotations[..., 0, 2] - rotations[..., 2, 0],
                     rotations[..., 1, 0] - rotations[..., 0, 1]], axis=-1) / 2
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, (np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2)
    return np.asarray(axis * (angle / np.maximum(sine, 1e-12))[..., None])
