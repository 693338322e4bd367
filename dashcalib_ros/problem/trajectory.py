# SPDX-License-Identifier: Apache-2.0
"""The path of a camera through the poses of its keyframes: how fast it turns and moves at each.

A cubic spline goes through the centres of the camera, and one through the rotation vectors from
each keyframe to all. The rows of a rolling shutter are exposed along it, and another camera of the
same car, whose images have times of their own, moves along it.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.camera.rotation import centres_of

# minimum number of knots from which a spline says how the camera moved
LEAST_KNOTS = 4


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
    def centres(self) -> Floats:
        """Return (k, 3) where the camera is at the knots."""
        return centres_of(self.rotations, self.translations)

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
            moving[self.rows] = -np.einsum('kab,kb->ka', self.rotations, slopes @ self.centres)
        return turning, moving

    def later(self, seconds: float) -> Trajectory:
        """Return the same path, driven so much later."""
        return replace(self, seconds=self.seconds + seconds)

    def at(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Return the poses at times (n,), rotations (n, 3, 3) and translations (n, 3).

        The path must move.
        """
        near = np.abs(seconds[:, None] - self.seconds).argmin(axis=1)
        weights = _weights(tuple(self.seconds.tolist()), seconds)
        rotations = exponentials(np.einsum(
            'nk,nkc->nc', weights, self._angles[near])) @ self.rotations[near]
        return rotations, -np.einsum('nab,nb->na', rotations, weights @ self.centres)

    def by_knots(self, seconds: Floats) -> Floats:
        """Return (n, 6, k, 6) derivatives of the poses at times (n,) by the moves of the k knots.

        A move is a small rotation in a pose's own axes, and one of its translation.
        """
        near = np.abs(seconds[:, None] - self.seconds).argmin(axis=1)
        weights, each = _weights(tuple(self.seconds.tolist()), seconds), np.arange(len(near))
        angle = np.einsum('nk,nkc->nc', weights, self._angles[near])
        turned, (rotations, translations) = exponentials(angle), self.at(seconds)
        by_knots = np.zeros((len(near), 6, len(self.seconds), 6))
        left = np.eye(3) + cross(angle) / 2
        by_knots[:, :3, :, :3] = np.einsum('nab,nbjc->najc', left, self._by_turns(weights, near))
        by_knots[each, :3, near, :3] += turned
        # of minus the centre, in the world's axes, by each knot's move
        back = self.rotations.transpose(0, 2, 1)
        shifted = np.concatenate([back @ cross(self.translations), back], axis=2)
        by_knots[:, 3:] = np.einsum('nab,nj,jbc->najc', rotations, weights, shifted)
        by_knots[:, 3:] -= np.einsum('nab,nbjc->najc', cross(translations), by_knots[:, :3])
        return by_knots

    def follow(self) -> Floats:
        """Return (count, 6, count, 6) derivatives of the keyframes' velocities by their moves."""
        found = np.zeros((self.count, 6, self.count, 6))
        if self.moves:
            slopes, each = _slopes(tuple(self.seconds.tolist())), np.arange(len(self.seconds))
            inner = np.zeros((len(each), 6, len(each), 6))
            inner[:, :3, :, :3] = self._by_turns(slopes, each)
            # [k, j]: from the axes of knot j to those of k
            weighted = slopes[:, :, None, None] * self._relative.transpose(0, 1, 3, 2)
            inner[:, 3:, :, 3:] = weighted.transpose(0, 2, 1, 3)
            inner[:, 3:, :, :3] = (weighted @ cross(self.translations)).transpose(0, 2, 1, 3)
            inner[each, 3:, each, :3] -= cross(self.velocity[1][self.rows])
            found[np.ix_(self.rows, np.arange(6), self.rows, np.arange(6))] = inner
        return found

    def _by_turns(self, weights: Floats, near: Ints) -> Floats:
        """Return (n, 3, k, 3) derivatives of weighted (n, k) angles from knots (n,), by turns."""
        turned = cross(self._angles[near].reshape(-1, 3)).reshape(*weights.shape, 3, 3)
        # of the vector of a rotation by one more small rotation, to the third order; gauge-free
        by_turn = weights[:, :, None, None] * (np.eye(3) - turned / 2 + turned @ turned / 12)
        found, each = by_turn.transpose(0, 2, 1, 3).copy(), np.arange(len(weights))
        found[each, :, near] -= np.sum(by_turn @ self._relative[near], axis=1)
        return np.asarray(found)


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


def _weights(knots: tuple[float, ...], seconds: Floats) -> Floats:
    """Return (n, k) the spline's values at times (n,), by the values at all knots.

    Beyond the ends the outer pieces go on.
    """
    times, slopes, unit = np.array(knots), _slopes(knots), np.eye(len(knots))
    piece = np.clip(np.searchsorted(times, seconds, side='right') - 1, 0, len(times) - 2)
    step = (times[piece + 1] - times[piece])[:, None]
    u = (seconds - times[piece])[:, None] / step
    return np.asarray((1 + 2 * u) * (1 - u)**2 * unit[piece] + u * (1 - u)**2 * step
                      * slopes[piece] + u**2 * (3 - 2 * u) * unit[piece + 1]
                      + u**2 * (u - 1) * step * slopes[piece + 1])


def cross(vectors: Floats) -> Floats:
    """Return (n, 3, 3) matrices that take the cross product with each vector (n, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def exponentials(vectors: Floats) -> Floats:
    """Return (n, 3, 3) the rotations of vectors (n, 3), rad, all at once."""
    angle = np.maximum(np.linalg.norm(vectors, axis=1), 1e-12)[:, None, None]
    axis = cross(vectors / angle[:, :, 0])
    return np.asarray(np.eye(3) + np.sin(angle) * axis + (1 - np.cos(angle)) * axis @ axis)


def logarithms(rotations: Floats) -> Floats:
    """Return (..., 3) rad the vectors of rotations (..., 3, 3) of less than 180 degrees."""
    axis = np.stack([rotations[..., 2, 1] - rotations[..., 1, 2],
                     rotations[..., 0, 2] - rotations[..., 2, 0],
                     rotations[..., 1, 0] - rotations[..., 0, 1]], axis=-1) / 2
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, (np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2)
    return np.asarray(axis * (angle / np.maximum(sine, 1e-12))[..., None])
