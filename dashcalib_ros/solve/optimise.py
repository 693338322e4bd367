# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton steps over all blocks at once, the structures of all turns included.

The tracks stay as they were measured. In each step poses and points are eliminated, the sizes of
the priors are chosen by the evidence, and the step is shortened until the cost falls.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.reconstruct.scene import Scene, retriangulated
from dashcalib_ros.solve.imaging import Imaging, shake_precision
from dashcalib_ros.solve.linear import (
    IMAGE,
    SHAKE,
    ImagePrior,
    Noise,
    Normal,
    noise_of,
    normal_equations,
    residuals,
)
from dashcalib_ros.solve.prior import (
    CROP_SIGMA,
    LEAST_LOSS_PX,
    NOT_SQUARE,
    NOT_SQUARE_NATS,
    bounds_of,
    crop_prior,
    prior_of_all,
)
from dashcalib_ros.solve.quadratic import Quadratic

# shares of a step that are tried, the longest first: safe steps are a little short
PARTS = (1.3, 0.7, 0.3, 0.1, 0.02)
# of poses and points, where a step does not lower the cost at once
SETTLING = 3
# of the cost, in units of the noise: by how much a step of what turns share lowers it at the most
# where it is the last one; 0.2 of a sigma
SETTLED = 0.04
# of each turn, where a part of its tracks is enough
FIRST_TRACKS = 200
# of points with fixed poses: Gauss-Newton steps, and the damping of their blocks
POINT_STEPS, POINT_DAMPING = 3, 1e-3
# px of 1000 px of width: sizes of the field among which the evidence chooses
FIELD_SIZES = tuple(0.0125 * 2.0**n for n in range(9))


@dataclass(frozen=True)
class Estimate:
    """The present state of the problem.

    scenes: structures, each with its tracks as measured. centred: the camera that priors and
    bounds are about. focal_reach: ratio by which focal lengths may be off its own. field_sigma: of
    the prior of the field's directions, px; aspect_sigma: of that of fy / fx; shift_sigma: of that
    of the images' shifts, of the width. inflation: of the noise, by errors that the observations
    of a track share.
    """

    imaging: Imaging
    scenes: tuple[Scene, ...]
    centred: Camera
    config: Config
    focal_reach: float
    field_sigma: float = 0.1
    aspect_sigma: float = 0.0
    shift_sigma: float = CROP_SIGMA
    inflation: float = 2.0

    @property
    def camera(self) -> Camera:
        """Return the lens."""
        return self.imaging.camera

    @cached_property
    def residuals(self) -> list[Floats]:
        """Return (n, 2) px of the n used observations of each turn."""
        return [residuals(scene, self.imaging) for scene in self.scenes]

    def noise(self, loss_px: float) -> Noise:
        """Return the noise of the residuals."""
        return noise_of(self.scenes, self.residuals, len(self.camera.params), loss_px)

    @property
    def seen_by_lens(self) -> list[Scene]:
        """Return the turns with the tracks that the lens alone would have seen."""
        return [self.imaging.as_lens_sees(scene) for scene in self.scenes]

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
        return replace(self, scenes=tuple(kept))

    def with_tracks(self, count: int) -> Estimate:
        """Return it with at most so many tracks of each turn."""
        return replace(self, scenes=tuple(
            subsample_tracks(scene, count) for scene in self.scenes))

    def loss_px(self, least_px: float = 0.0) -> float:
        """Return the scale of the Cauchy loss: intrinsics.loss times the median residual, px.

        Raises LinAlgError where no turn is left: nothing determines the camera then.
        """
        if not self.scenes:
            raise np.linalg.LinAlgError('no turn is left')
        median = float(np.median(np.linalg.norm(np.concatenate(self.residuals), axis=1)))
        return max(self.config.intrinsics.loss * median, LEAST_LOSS_PX, least_px)

    def prior(self) -> Quadratic:
        """Return the priors of the lens, the readout and the field, from the present values."""
        return prior_of_all(self.imaging, self.centred, self.aspect_sigma, self.field_sigma)

    def image_priors(self, variance: float) -> list[ImagePrior | None]:
        """Return for each turn the prior of its images' shifts; None where its pictures are fixed.

        variance: of a residual, px^2.
        """
        images = self.imaging.images
        return [crop_prior(scene, variance, images[scene.turn], self.shift_sigma)
                if scene.turn in images else None for scene in self.scenes]

    def cost(self, loss_px: float, variance: float) -> float:
        """Return the robust cost of all residuals and of the priors, in units of the noise."""
        total = 0.0
        for off in self.residuals:
            total += float(np.sum(np.log1p(np.sum(off * off, axis=1) / loss_px**2)))
        prior = self.prior()
        away = np.linalg.solve(prior.hessian, prior.score)
        images = sum(float(each.values @ each.precision @ each.values)
                     for each in self.image_priors(1.0) if each is not None)
        shaking = sum(
            float(np.sum((each @ shake_precision(
                self.imaging.axes[turn], self.imaging.shaken_s)) * each))
            for turn, each in self.imaging.shaking.items())
        return (loss_px**2 * total / variance + float(away @ prior.hessian @ away) + images
                + shaking)


def optimised(start: Estimate, least_px: float, steps: int, free: Ints | None = None,
              settled: float = SETTLED) -> Estimate:
    """Return the estimate after steps that lower its cost, so many at the most.

    least_px: of the scale of the loss. free: the places of those of the lens, the readout and the
    field that are not held; None: all. settled: a smaller gain ends it.
    """
    now, loss_px = start, start.loss_px(least_px)
    for n in range(steps):
        # sizes hardly change from step to step
        now, gain = _step(now, loss_px, free, free is None and n % 2 == 0)
        if gain < settled:
            break
    return now


def _step(now: Estimate, loss_px: float, free: Ints | None, choose: bool
          ) -> tuple[Estimate, float]:
    """Return the estimate after one step, and what its part of what turns share should gain.

    0 where no step lowers the cost. choose: the sizes of the priors, too.
    """
    now = replace(now, imaging=now.imaging.held())
    noise = now.noise(loss_px)
    normals = _normals(now, loss_px, noise.variance * now.inflation, choose)
    if choose:
        now = _with_sizes_chosen(now, [
            cost.at_noise(noise.variance).curved(noise.curvature)
            for cost in about_shared(now, normals, noise.variance * now.inflation)])
    unit = noise.variance * now.inflation
    costs = [cost.at_noise(unit) for cost in about_shared(now, normals, unit)]
    total = Quadratic.together([*costs, now.prior()])
    places = np.arange(len(total.score)) if free is None else free
    move = np.zeros(len(total.score))
    move[places] = total.of(places).optimum
    moves = _with_images(now, normals, move, unit)
    before = now.cost(loss_px, unit)
    for part in PARTS:
        after = _moved(now, normals, moves, part)
        for _ in range(SETTLING):
            if after.cost(loss_px, unit) < before:
                return after, part * float(total.score @ move)
            # far from the optimum poses and points follow in a curve
            after = _settled(after, loss_px, unit)
    return now, 0.0


def _normals(now: Estimate, loss_px: float, variance: float, clusters: bool = False
             ) -> list[Normal]:
    return [normal_equations(scene, now.imaging, loss_px, scene.turn in now.imaging.images,
                             safe=True, variance=variance, clusters=clusters)
            for scene in now.scenes]


def _settled(now: Estimate, loss_px: float, variance: float) -> Estimate:
    """Return the estimate with poses and points one step nearer to what all else asks of them."""
    normals = _normals(now, loss_px, variance)
    count = len(now.camera.params) + 1 + len(now.imaging.directions)
    return _moved(now, normals, _with_images(now, normals, np.zeros(count), variance), 1.0)


def about_shared(now: Estimate, normals: Sequence[Normal], variance: float) -> list[Quadratic]:
    """Return each turn's cost about what turns share, px^2; its images' shifts follow."""
    return [normal.cost if prior is None else prior.eliminated(normal)
            for prior, normal in zip(now.image_priors(variance), normals, strict=True)]


def _with_sizes_chosen(now: Estimate, costs: Sequence[Quadratic]) -> Estimate:
    """Return the estimate with the sizes of noise and priors that the evidence favours.

    costs: of each turn, at unit noise.
    """
    total = Quadratic.together(costs)
    now = replace(now, inflation=inflation_of(total, now.prior()))
    total = total.at_noise(now.inflation)

    def with_prior(sizes: Estimate) -> Quadratic:
        return Quadratic.together([total, sizes.prior()])

    now = replace(now, field_sigma=chosen_field_sigma(
        with_prior(replace(now, field_sigma=np.inf)), now.imaging))
    square = now.config.intrinsics.aspect_sigma
    loose = replace(now, aspect_sigma=NOT_SQUARE)
    return loose if square < NOT_SQUARE and _not_square(
        with_prior(loose), now.camera, square) else replace(now, aspect_sigma=square)


def _not_square(loose: Quadratic, camera: Camera, square: float) -> bool:
    """Return whether the turns contradict pixels whose fy / fx is 1 to within a sigma.

    loose: the cost with a prior of NOT_SQUARE for it, at unit noise.
    """
    step, along = loose.optimum, np.array([-camera.fy / camera.fx, 1.0]) / camera.fx
    found = camera.fy / camera.fx - 1 + float(along @ step[:2])
    variance = float(along @ loose.covariance[:2, :2] @ along)
    # without that prior
    weight = max(1 / variance - NOT_SQUARE**-2, 1e-12)
    found, variance = found / variance / weight, 1 / weight
    logs = [-0.5 * (np.log(variance + sigma**2) + found**2 / (variance + sigma**2))
            for sigma in (square, NOT_SQUARE)]
    return bool(logs[1] - logs[0] > NOT_SQUARE_NATS)


def inflation_of(total: Quadratic, prior: Quadratic) -> float:
    """Return by how much errors that a track's observations share inflate the noise."""
    inverse = Quadratic.together([total, prior]).covariance
    return max(1.0, float(np.sum(inverse * total.by_track) / np.sum(inverse * total.hessian)))


def chosen_field_sigma(cost: Quadratic, imaging: Imaging) -> float:
    """Return the sigma of the prior of the field's directions with most evidence, px.

    The evidence is the marginal likelihood: all else is at its optimum. cost: of all turns and of
    the priors, with none of the field; at unit noise.
    """
    at = imaging.directions
    field = cost.eliminated(len(cost.score) - len(at)).moved(-at)
    values, vectors = np.linalg.eigh(field.hessian)
    values, squares = np.maximum(values, 0.0), (vectors.T @ field.score)**2

    def nats(sigma: float) -> float:
        return 0.5 * float(np.sum(squares / (values + sigma**-2))
                           - np.sum(np.log1p(sigma**2 * values)))

    return max((size * imaging.camera.image_size[0] / 1000 for size in FIELD_SIZES), key=nats)


def _with_images(now: Estimate, normals: Sequence[Normal], move: Floats, variance: float
                 ) -> list[Floats]:
    """Return each turn's whole step: of its images' parameters, then of what turns share."""
    everything, found = np.arange(len(move)), []
    for prior, normal in zip(now.image_priors(variance), normals, strict=True):
        images = np.zeros(IMAGE * normal.images)
        if prior is not None:
            images[prior.free] = prior.step(normal, everything, move)
        found.append(np.concatenate([images, move]))
    return found


def _moved(now: Estimate, normals: Sequence[Normal], moves: Sequence[Floats], part: float
           ) -> Estimate:
    """Return the estimate after a part of a step, poses and points with it."""
    count = len(now.imaging.camera.params) + 1 + len(now.imaging.directions)
    imaging = now.imaging.stepped(part * moves[0][-count:])
    low, high = bounds_of(now.centred, now.focal_reach)
    imaging = replace(imaging, camera=imaging.camera.with_params(
        np.clip(imaging.camera.params, low, high)))
    scenes, images, shaking = [], dict(imaging.images), dict(imaging.shaking)
    for scene, normal, move in zip(now.scenes, normals, moves, strict=True):
        scenes.append(replace(scene, structure=normal.eliminated.moved(
            scene.structure, move, part)))
        still = np.zeros((len(scene.tracks.frames), SHAKE))
        shaking[scene.turn] = normal.eliminated.shaken(
            shaking.get(scene.turn, still), move, part)
        if scene.turn in images:
            images[scene.turn] = images[scene.turn].copy()
            images[scene.turn][normal.eliminated.keyframes] += (
                part * move[:-count].reshape(-1, IMAGE))
    return replace(now, imaging=replace(imaging, images=images, shaking=shaking),
                   scenes=tuple(scenes))


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
        # NaN, of a point that has gone behind a camera, is no gain
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
