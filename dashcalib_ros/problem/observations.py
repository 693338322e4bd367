# SPDX-License-Identifier: Apache-2.0
"""Tracks of a stretch of a drive, the poses and points that explain them, and flat arrays of both.

A stretch is a turn, or any other part of a drive that was reconstructed.
"""
from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.camera.field import field_terms
from dashcalib_ros.camera.rotation import centres_of, rotation_vectors
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.problem.trajectory import Trajectory

# tracks that are eliminated at once: those that begin together are seen by few images
CHUNK = 60


@dataclass(frozen=True)
class Tracks:
    """Correspondences of one stretch.

    frames: (k,) indices of the keyframes among the input's frames.
    xy: (k, t, 2) pixel coordinates (first pixel's centre at 0, 0), NaN where a track is not seen.
    image_size: (width, height). stamps_ns: (k,) when the keyframes were taken.
    """

    frames: Ints
    xy: Floats
    image_size: tuple[int, int]
    stamps_ns: Ints

    @property
    def seen(self) -> Mask:
        """Return (k, t): whether the track is seen in the keyframe."""
        return np.isfinite(self.xy[:, :, 0])


@dataclass(frozen=True)
class Structure:
    """Poses and points of a stretch, up to scale.

    rotations: (k, 3, 3), translations: (k, 3): world to camera; rows of images that are not
    registered are zero. points: (t, 3) in the world's frame.
    registered: (k,); used: (k, t) observations that the structure explains.
    """

    rotations: Floats
    translations: Floats
    points: Floats
    registered: Mask
    used: Mask

    @property
    def local(self) -> Floats:
        """Return (k, t, 3) the points in the axes of each camera."""
        return np.asarray(
            self.points @ self.rotations.transpose(0, 2, 1) + self.translations[:, None])

    def path(self) -> tuple[Floats, Floats]:
        """Return the rotations (n, 3, 3) and the centres (n, 3) of the n registered images."""
        rotations = self.rotations[self.registered]
        return rotations, centres_of(rotations, self.translations[self.registered])


@dataclass(frozen=True)
class Chunk:
    """Points (c,), their observations (m,) point by point, and where each point's begin (c,).

    place: (m,) of the point; image: (m,) counted from the first one that sees any, begin; end:
    behind the last one. table: (c, l) the observations of each point, filled up with one more
    than there are.
    """

    points: Ints
    observations: Ints
    place: Ints
    image: Ints
    begin: int
    end: int
    starts: Ints
    table: Ints


@dataclass(frozen=True)
class Observed:
    """n observations of a stretch, image by image.

    turn: the stretch. rows, columns: (n,) their keyframes and tracks; xy: (n, 2) px. keyframes:
    (k,), tracks: (t,) those that are seen; image, point: (n,) their places among these.
    stamps_ns: (n,).
    """

    turn: TurnId
    rows: Ints
    columns: Ints
    xy: Floats
    keyframes: Ints
    tracks: Ints
    image: Ints
    point: Ints
    stamps_ns: Ints
    image_size: tuple[int, int]

    @classmethod
    def of(cls, turn: TurnId, tracks: Tracks, chosen: Mask) -> Observed:
        """Return the chosen observations (k, t) of tracks."""
        rows, columns = np.nonzero(chosen)
        by_row, by_track = chosen.any(axis=1), chosen.any(axis=0)
        return cls(turn, rows, columns, tracks.xy[rows, columns], np.flatnonzero(by_row),
                   np.flatnonzero(by_track), (np.cumsum(by_row) - 1)[rows],
                   (np.cumsum(by_track) - 1)[columns], tracks.stamps_ns[rows], tracks.image_size)

    @cached_property
    def images(self) -> list[slice]:
        """Return the observations of each image."""
        ends = np.cumsum(np.bincount(self.image, minlength=len(self.keyframes))).tolist()
        return [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]

    @cached_property
    def terms(self) -> Floats:
        """Return (n, len(TERMS)) the field's terms where the points were observed."""
        return field_terms(self.xy, self.image_size)

    @cached_property
    def chunks(self) -> list[Chunk]:
        """Return the points in groups that are seen by few images."""
        first = np.full(len(self.tracks), len(self.keyframes))
        np.minimum.at(first, self.point, self.image)
        order = np.lexsort([np.bincount(self.point), first])
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
            starts = np.flatnonzero(np.diff(place, prepend=-1))
            nth = np.arange(len(theirs)) - starts[place]
            table = np.full((len(some), int(nth.max()) + 1), len(self.rows))
            table[place, nth] = theirs
            found.append(Chunk(some, theirs, place, images - begin, begin, int(images.max()) + 1,
                               starts, table))
        return found


def main_axis(turned: Floats) -> Floats:
    """Return the unit vector about which was turned most, its largest component positive."""
    axis = np.linalg.svd(turned, full_matrices=False)[2][0]
    return np.asarray(axis * np.sign(axis[np.argmax(np.abs(axis))]))


Self = TypeVar('Self', bound='Stretch')


@dataclass(frozen=True)
class Stretch:
    """A part of a drive: its tracks, and the structure that explains them. turn: its name."""

    turn: TurnId
    tracks: Tracks
    structure: Structure

    @cached_property
    def observed(self) -> Observed:
        """Return the used observations."""
        return Observed.of(self.turn, self.tracks, self.structure.used)

    @cached_property
    def trajectory(self) -> Trajectory:
        """Return the path of the camera through the registered keyframes."""
        structure = self.structure
        return Trajectory.through(structure.rotations, structure.translations,
                                  structure.registered, self.tracks.stamps_ns)

    @property
    def turned(self) -> Floats:
        """Return (k, 3) rad, by how much each registered keyframe turned about x, y and z.

        It is the sum of the steps since the first one, each in the camera's own frame: a car turns
        about one axis of it, the vertical, which is (0, 1, 0) where the pictures are upright.
        """
        rotations = self.structure.rotations[self.structure.registered]
        steps = rotation_vectors(rotations[1:] @ rotations[:-1].transpose(0, 2, 1))
        return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def moved(self: Self, rotations: Floats, translations: Floats, points: Floats) -> Self:
        """Return the stretch with other poses of all keyframes and other points of all tracks."""
        found = replace(self, structure=replace(
            self.structure, rotations=rotations, translations=translations, points=points))
        # which observations are used does not change
        found.__dict__['observed'] = self.observed
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Return what is stored: what is computed from it again takes more room than it."""
        return {each.name: self.__dict__[each.name] for each in fields(self)}
