# SPDX-License-Identifier: Apache-2.0
"""The problem of all turns: its state, the sizes of its priors by the evidence, and its steps."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config, IntrinsicsConfig
from dashcalib_ros.problem import steps
from dashcalib_ros.problem.blocks import (
    NOT_SQUARE,
    NOT_SQUARE_NATS,
    Block,
    Imaging,
    SharedBlock,
    Shift,
    bounds_of,
)
from dashcalib_ros.problem.normal import Linear, normal_equations
from dashcalib_ros.problem.quadratic import Quadratic
from dashcalib_ros.reconstruct.scene import Scene, errors_px, retriangulated

# rendered images without noise would make the loss cut off everything
LEAST_LOSS_PX = 0.05
# times the loss of the solution: what another camera, or a picture that moves, leaves is in the
# tails
TEST_LOSS = 2.0
# of each turn, where a part of its tracks is enough
FIRST_TRACKS = 200
# of points with fixed poses: Gauss-Newton steps, and the damping of their blocks
POINT_STEPS, POINT_DAMPING = 3, 1e-3
# px of 1000 px of width: sizes of the field among which the evidence chooses
FIELD_SIZES = tuple(0.0125 * 2.0**n for n in range(9))


@dataclass(frozen=True)
class Estimate(steps.State):
    """The present state of the problem."""

    stretches: tuple[Scene, ...] = ()
    inflation: float = 2.0
    config: Config = field(default_factory=Config)

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """Return the turns, each with its tracks as measured."""
        return self.stretches

    def having(self, *blocks: Block) -> Estimate:
        """Return it with other blocks."""
        return replace(self, imaging=self.imaging.having(*blocks))

    @property
    def centred(self) -> Camera:
        """Return the camera that the prior and the bounds of the lens are about."""
        lens = self.imaging.lens
        return lens.camera if lens.centred is None else lens.centred

    def about(self, centred: Camera) -> Estimate:
        """Return it with another camera that the prior and the bounds of the lens are about."""
        return self.having(replace(
            self.imaging.lens, centred=centred, bounds=bounds_of(centred)))

    @property
    def seen_by_lens(self) -> list[Scene]:
        """Return the turns with the tracks that the lens alone would have seen."""
        return [self.imaging.as_lens_sees(scene) for scene in self.scenes]

    @property
    def moves(self) -> bool:
        """Return whether each image's picture may be shifted."""
        return Shift.name in self.imaging.blocks

    @property
    def still(self) -> Estimate:
        """Return it with those turns only whose pictures cannot be shifted; itself without any."""
        shift = self.imaging.blocks.get(Shift.name)
        kept = tuple(scene for scene in self.scenes
                     if isinstance(shift, Shift) and not shift.within(scene))
        return replace(self, imaging=self.imaging.without(Shift.name),
                       stretches=kept) if kept else self

    def retriangulated(self, least_px: float = 0.0) -> Estimate:
        """Return it with every track triangulated anew; turns without points are dropped.

        least_px: of the largest error that is allowed.
        """
        limits, kept = self.config.scene, []
        loss_px = self.loss_px(least_px / 2)
        for scene in self.scenes:
            found = retriangulated(self.imaging.as_lens_sees(scene), self.camera,
                                   max(limits.error_px, least_px), limits.min_angle_deg)
            if found.structure.used.any():
                found = with_points_settled(found, self.camera, loss_px)
                kept.append(replace(found, tracks=scene.tracks))
        return replace(self, stretches=tuple(kept))

    def with_tracks(self, count: int) -> Estimate:
        """Return it with at most so many tracks of each turn."""
        return replace(self, stretches=tuple(
            subsample_tracks(scene, count) for scene in self.scenes))

    def loss_px(self, least_px: float = 0.0) -> float:
        """Return the scale of the Cauchy loss: intrinsics.loss times the median residual, px.

        Raises Undetermined where no observation is left.
        """
        off = np.concatenate([np.zeros((0, 2)), *(each.off for each in self.seen)])
        if not len(off):
            raise steps.Undetermined('no observation is left')
        median = float(np.median(np.linalg.norm(off, axis=1)))
        return max(self.config.intrinsics.loss * median, LEAST_LOSS_PX, least_px)


def optimised(start: Estimate, least_px: float, count: int, settled: float = steps.SETTLED,
              choose: bool = True) -> Estimate:
    """Return the estimate after at most `count` steps that lower its cost.

    least_px: of the scale of the loss. settled: a smaller gain ends it. choose: the sizes of the
    priors, too.
    """
    loss_px = start.loss_px(least_px)

    def chosen(now: Estimate, linear: Sequence[Linear], n: int) -> Estimate:
        # sizes hardly change from step to step
        return now if not choose or n % 2 else _with_sizes_chosen(now, linear, loss_px)

    return steps.optimised(start, steps.Stepping(loss_px, count, settled=settled), chosen)


def _with_sizes_chosen(now: Estimate, linear: Sequence[Linear], loss_px: float) -> Estimate:
    """Return the estimate with the sizes of noise and priors that the evidence favours."""
    noise = now.noise(loss_px)
    total = Quadratic.together([
        cost.at_noise(noise.variance).curved(noise.curvature)
        for cost in costs_by_track(linear, noise.variance * now.inflation)])
    inflation = inflation_of(total, now.imaging.prior())
    total = total.at_noise(inflation)
    smooth, width = now.imaging.smooth, now.camera.image_size[0]
    fields = [replace(smooth, sigma=size * width / 1000) for size in FIELD_SIZES]
    imaging = now.imaging.having(likeliest(total, now.imaging, fields))
    square = replace(imaging.lens, aspect_sigma=now.config.intrinsics.aspect_sigma)
    loose = replace(square, aspect_sigma=NOT_SQUARE)
    return now.sized(imaging.having(square if square.aspect_sigma >= NOT_SQUARE else likeliest(
        total, imaging, [square, loose], NOT_SQUARE_NATS)), inflation)


def costs_by_track(linear: Sequence[Linear], unit: float, drift_px: float = 0.0
                   ) -> list[Quadratic]:
    """Return the cost of each stretch, each track being one measurement.

    What observations of one image share counts, too, where its picture is not shifted. drift_px:
    by how much all tracks drift alike.
    """
    return [normal_equations(each, unit, tracks=True, images=all(
        block.turns for block in each.imaging.of_each_image(each.stretch)), drift_px=drift_px).cost
        for each in linear]


def other_shape_of_pixels(now: Estimate) -> tuple[tuple[float, Quadratic], ...]:
    """Return the prior of pixels that are square where now's are not, or the other way round.

    With the log of how much likelier it is before. Turns about one axis hardly see fy / fx: where
    they do not decide it, sigma contains both.
    """
    square = now.config.intrinsics.aspect_sigma
    if square >= NOT_SQUARE:
        return ()
    lens = now.imaging.lens
    nats = NOT_SQUARE_NATS if lens.aspect_sigma == NOT_SQUARE else -NOT_SQUARE_NATS
    other = replace(lens, aspect_sigma=square if nats > 0 else NOT_SQUARE)
    return ((nats + other.log_density - lens.log_density, now.imaging.having(other).prior()),)


def inflation_of(total: Quadratic, prior: Quadratic) -> float:
    """Return by how much errors that a track's observations share inflate the noise."""
    inverse = Quadratic.together([total, prior]).covariance
    return max(1.0, float(np.sum(inverse * total.by_track) / np.sum(inverse * total.hessian)))


def likeliest(total: Quadratic, imaging: Imaging, sizes: Sequence[SharedBlock],
              least: float = 0.0) -> Block:
    """Return the block with the prior of most evidence; the first one if others lack least nats.

    The evidence is the marginal likelihood: all else is at its optimum. total: of all turns, at
    unit noise.
    """
    nats = [evidence(total, imaging.having(block), block) for block in sizes]
    best = int(np.argmax(nats))
    return sizes[best if nats[best] > nats[0] + least else 0]


def evidence(total: Quadratic, imaging: Imaging, block: SharedBlock) -> float:
    """Return the log of the marginal likelihood, up to a constant, with the prior of a block."""
    cost = Quadratic.together([total, imaging.prior()])
    return block.log_density + 0.5 * float(
        cost.score @ cost.optimum - np.linalg.slogdet(cost.hessian)[1])


def with_points_settled(scene: Scene, camera: Camera, loss_px: float) -> Scene:
    """Return the scene with each used point where its observations ask for it; poses are fixed.

    Triangulation is linear and knows no loss: joint steps from its points lead astray.
    """
    structure, used = scene.structure, scene.structure.used
    rows, columns = np.nonzero(used)
    tracks, point = np.unique(columns, return_inverse=True)
    rotation, observed = structure.rotations[rows], scene.tracks.xy[rows, columns]

    def local(points: Floats) -> Floats:
        return np.asarray(np.einsum('nij,nj->ni', rotation, points[point])
                          + structure.translations[rows])

    def squares(points: Floats) -> Floats:
        off = camera.project(local(points)) - observed
        return np.asarray(np.sum(off**2, axis=1) / loss_px**2)

    def summed(values: Floats) -> Floats:
        columns = values.reshape(len(point), -1).T
        sums = np.stack([np.bincount(point, column) for column in columns], axis=1)
        return np.asarray(sums.reshape(-1, *values.shape[1:]), np.float64)

    points = structure.points[tracks]
    off = squares(points)
    for _ in range(POINT_STEPS):
        _, by_local, projected = camera.derivatives(local(points))
        by_point, residual = by_local @ rotation, observed - projected
        weighted = (by_point / (1 + off)[:, None, None]).transpose(0, 2, 1)
        blocks = summed(weighted @ by_point)
        # a badly determined point has a solution, too
        damping = (POINT_DAMPING * np.einsum('tii->ti', blocks)[:, :, None] + 1e-12) * np.eye(3)
        step = np.linalg.solve(blocks + damping, summed(weighted @ residual[:, :, None]))
        moved = points + step[:, :, 0]
        after = squares(moved)
        # NaN, of a point that has gone behind a camera, is not a gain
        gains = summed(np.log1p(after)) < summed(np.log1p(off))
        points = np.where(gains[:, None], moved, points)
        off = np.where(gains[point], after, off)
    found = structure.points.copy()
    found[tracks] = points
    return replace(scene, structure=replace(structure, points=found))


def subsample_tracks(scene: Scene, wanted: int) -> Scene:
    """Return the scene with at most this many of its tracks, evenly chosen."""
    chosen = np.unique(np.linspace(0, scene.tracks.xy.shape[1] - 1, wanted).astype(int))
    structure = scene.structure
    return replace(
        scene, tracks=replace(scene.tracks, xy=scene.tracks.xy[:, chosen]),
        structure=replace(structure, points=structure.points[chosen],
                          used=structure.used[:, chosen]))


def loss_px_of(scenes: Sequence[Scene], camera: Camera, config: IntrinsicsConfig) -> float:
    """Return the scale of the Cauchy loss for a camera that may be wrong, px."""
    errors = np.concatenate([errors_px(scene, camera)[scene.structure.used] for scene in scenes])
    return max(TEST_LOSS * config.loss * float(np.median(errors)), LEAST_LOSS_PX)
