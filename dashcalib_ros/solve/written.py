# SPDX-License-Identifier: Apache-2.0
"""The camera that is written: the model of ROS that comes closest to lens and field together.

camera_info has no field, and no p1, p2, k3 where nobody can see them. So each model of the lens's
kind is fitted to the rays of lens and field, mostly where tracks went, and the simplest one is
written that is as close as the rays are known. What it leaves over is the field that is written
beside it: both together have the rays of the solution.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import AUTO, PINHOLE, Camera, calibrated_models
from dashcalib_ros.camera.field import Field, field_terms
from dashcalib_ros.camera.mapping import grid_of, turned
from dashcalib_ros.problem.blocks import Imaging, Lens, Smooth, displacements, lens_alone
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.spread import SigmaMap, sigma_over

# places of tracks that are looked at; the picture's grid has the rest of the weight
PLACES, GRID_WEIGHT = 600, 0.5
# Gauss-Newton steps of a fit, and px of its last one
STEPS, SETTLED_PX = 20, 1e-6
# parameters that are always written: fx fy cx cy k1 k2; and px that others must be worth
FEW, SMALL_PX = 6, 0.02
# keeps the field's terms small where no pixel determines them, of the number of pixels
RIDGE = 1e-6
# chi-squared of each further coefficient; less, and nobody sees it. And px RMS of 1000 px of
# width, by which they may move the picture all the same
SEEN, LEAST_APART = 3.0, 0.02
# px RMS of 1000 px of width by which the closest pinhole is off a camera that might be one
AS_PINHOLE = 0.1
# px RMS of 1000 px of width; a smaller field is none
LEAST_FIELD = 0.02


@dataclass(frozen=True)
class Written:
    """The camera that is written, and how it follows the solution.

    camera: n parameters. rotation: (3, 3) from the solution's rays to the camera's. field: what it
    leaves over; None where that is nothing. by_solution: (n, m) derivatives of the parameters by
    what turns share. pixels: (k, 2) a grid; left_px: (k,) by how much camera alone and solution
    are apart there; moves: (k, 2, m) derivatives of the solution's pixels; the best rotation is
    removed from both. apart_px: RMS where tracks went, from the model with most parameters.
    wide_by_solution: (w, m) as by_solution, of the widest model of its kind; wide_left: (w,) by
    how much that one's parameters differ from camera's. loose: (n, n) covariance of parameters
    that move nothing that anybody sees.
    """

    camera: Camera
    rotation: Floats
    field: Field | None
    by_solution: Floats
    pixels: Floats
    left_px: Floats
    moves: Floats
    apart_px: float
    wide_by_solution: Floats
    wide_left: Floats
    loose: Floats

    def sigma_map(self, covariance: Floats, with_field: bool = False) -> SigmaMap:
        """Return how far camera_info may be off, or, with_field, camera and field together.

        covariance: (m, m) of what turns share.
        """
        sigma = sigma_over(self.moves, covariance)
        return SigmaMap(self.pixels, sigma if with_field else np.hypot(sigma, self.left_px))

    def seen(self, scene: Scene, imaging: Imaging) -> Scene:
        """Return a turn as this camera alone would have seen it, with poses in its axes."""
        scene = imaging.as_lens_sees(scene)
        structure, known = scene.structure, scene.tracks.seen
        xy = np.full(scene.tracks.xy.shape, np.nan)
        xy[known] = self.camera.project(
            imaging.camera.rays(scene.tracks.xy[known]) @ self.rotation.T)
        return replace(
            scene, camera=self.camera, tracks=replace(scene.tracks, xy=xy),
            structure=replace(
                structure, rotations=self.rotation @ structure.rotations,
                translations=structure.translations @ self.rotation.T,
                used=structure.used & np.isfinite(xy).all(axis=2)))


@dataclass(frozen=True)
class _Places:
    """Pixels (k, 2), their weights (k,), rays (k, 3), and derivatives (k, 2, m) of the pixels."""

    pixels: Floats
    weights: Floats
    rays: Floats
    moves: Floats


@dataclass(frozen=True)
class _Fit:
    """A camera, a rotation (3, 3), and by how much it is off at the places (k, 2)."""

    camera: Camera
    rotation: Floats
    off: Floats


def written(imaging: Imaging, covariance: Floats, scenes: Sequence[Scene], model: str) -> Written:
    """Return the camera to write. model: the requested one, or auto.

    covariance: (m, m) of what turns share. scenes: as measured.
    """
    tracks = np.concatenate([scene.tracks.xy[scene.structure.used] for scene in scenes])
    tracks = tracks[::max(1, len(tracks) // PLACES)]
    grid = grid_of(imaging.camera)
    places = _places(imaging, np.concatenate([tracks, grid]), np.concatenate([
        np.full(len(tracks), (1 - GRID_WEIGHT) / len(tracks)),
        np.full(len(grid), GRID_WEIGHT / len(grid))]))
    fits = [_fit(imaging, places, each) for each in _of_kind(imaging.camera.family)]
    apart = [_rms(each.off - fits[-1].off, places.weights) for each in fits]
    chosen = next(n for n, each in enumerate(fits)
                  if (each.camera.model == model if model != AUTO else
                      _enough(len(each.camera.params), fits[-1], places, covariance)
                      or apart[n] <= LEAST_APART * imaging.camera.image_size[0] / 1000))
    return _written(imaging, places, fits[chosen], _places(imaging, grid), apart[chosen])


def closest(imaging: Imaging, model: type[Camera], scenes: Sequence[Scene]) -> Camera:
    """Return the camera of another model that sees the turns' tracks most alike."""
    tracks = np.concatenate([scene.tracks.xy[scene.structure.used] for scene in scenes])
    places = _places(imaging, tracks[::max(1, len(tracks) // PLACES)])
    return _fit(imaging, places, model).camera


def sees_as_pinhole(camera: Camera) -> bool:
    """Return whether a pinhole sees the whole picture nearly as this camera does."""
    alone = lens_alone(camera)
    places, widest = _places(alone, grid_of(camera)), _of_kind(PINHOLE)[-1]
    fit = _fit(alone, places, widest)
    unseen = ~np.isfinite(fit.camera.project(places.rays @ fit.rotation.T)).all()
    limit_px = AS_PINHOLE * camera.image_size[0] / 1000
    return not unseen and _rms(fit.off, places.weights) < limit_px


def _of_kind(family: str) -> list[type[Camera]]:
    """Return the models of a kind that turns determine, the simplest first."""
    return sorted((each for each in calibrated_models() if each.family == family),
                  key=lambda each: len(each.names()))


def _places(imaging: Imaging, pixels: Floats, weights: Floats | None = None) -> _Places:
    """Return those of the pixels that have a ray."""
    weights = np.full(len(pixels), 1 / len(pixels)) if weights is None else weights
    rays = imaging.camera.rays(imaging.field.ideal(pixels))
    known = np.isfinite(rays).all(axis=1)
    pixels, rays, weights = pixels[known], rays[known], weights[known]
    moves = np.zeros((len(pixels), 2, len(imaging.names)))
    for name, place in imaging.places.items():
        if name == Lens.name:
            moves[:, :, place] = imaging.camera.derivatives(rays)[0]
        elif name == Smooth.name:
            moves[:, :, place] = displacements(
                pixels, imaging.camera.image_size, imaging.smooth.basis)
    return _Places(pixels, weights / weights.sum(), rays, moves)


def _fit(imaging: Imaging, places: _Places, model: type[Camera]) -> _Fit:
    lens = imaging.camera
    start = np.zeros(len(model.names()))
    shared = min(len(start), len(lens.params)) if model.family == lens.family else 4
    start[:shared] = lens.params[:shared]
    camera, rotation = model.of(lens.image_size, start), np.eye(3)
    for _ in range(STEPS):
        step, off = _step(camera, places, rotation)
        camera = camera.with_params(camera.params + step[:-3])
        rotation = cv2.Rodrigues(step[-3:])[0] @ rotation
        moved = camera.project(places.rays @ rotation.T) - places.pixels
        if _rms(moved - off, places.weights) < SETTLED_PX:
            break
    return _Fit(camera, rotation, np.nan_to_num(moved))


def _columns(camera: Camera, rays: Floats) -> Floats:
    """Return (k, 2, n + 3) derivatives of the pixels of rays, by the camera and by a rotation."""
    by_params, by_ray, _ = camera.derivatives(rays)
    return np.concatenate([by_params, by_ray @ turned(rays)], axis=2)


def _step(camera: Camera, places: _Places, rotation: Floats) -> tuple[Floats, Floats]:
    rays = places.rays @ rotation.T
    off = np.nan_to_num(camera.project(rays) - places.pixels)
    return _solved(camera, rays, places.weights, -off[:, :, None], camera.params)[:, 0], off


def _solved(camera: Camera, rays: Floats, weights: Floats, wanted: Floats,
            at: Floats | None = None) -> Floats:
    """Return (n + 3, e) the changes of camera and rotation that come closest to (k, 2, e) px.

    at: (n,) the present parameters, where those that nothing tells are drawn to 0.
    """
    inner, small, columns = _normal(camera, rays, weights)
    root = np.repeat(np.sqrt(weights), 2)[:, None]
    pull = columns.T @ (root * wanted.reshape(len(root), -1))
    if at is not None:
        pull[:-3, 0] -= small[:-3] * at
    scale = np.sqrt(np.diag(inner)) + 1e-12
    return np.asarray(np.linalg.solve(inner / scale[:, None] / scale, pull / scale[:, None])
                      / scale[:, None])


def _normal(camera: Camera, rays: Floats, weights: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the normal matrix, the part of it that keeps small what nothing tells, and columns.

    (n + 3, n + 3), (n + 3,) on its diagonal, and (2 k, n + 3) weighted.
    """
    root = np.repeat(np.sqrt(weights), 2)[:, None]
    columns = root * np.nan_to_num(_columns(camera, rays)).reshape(len(root), -1)
    small = np.zeros(columns.shape[1])
    small[FEW:-3] = (SMALL_PX / np.array(camera.spread[FEW - 4:]))**2
    return columns.T @ columns + np.diag(small), small, columns


def _enough(count: int, widest: _Fit, places: _Places, covariance: Floats) -> bool:
    """Return whether so many parameters are enough: nobody sees the others of the widest."""
    others = widest.camera.params[count:]
    if not len(others):
        return True
    follow = _solved(widest.camera, places.rays @ widest.rotation.T, places.weights,
                     places.moves)[count:-3]
    spread = follow @ covariance @ follow.T + _loose(
        widest.camera, widest, places)[count:, count:]
    return float(others @ np.linalg.solve(spread, others)) <= SEEN * len(others)


def _without_rotation(lens: Camera, rays: Floats, moves: Floats, weights: Floats) -> Floats:
    """Return derivatives (k, 2, m), less what the best rotation makes of each."""
    by_rotation = lens.derivatives(rays)[1] @ turned(rays)
    root = np.repeat(np.sqrt(weights), 2)[:, None]
    flat = moves.reshape(len(root), -1)
    rotation, *_ = np.linalg.lstsq(root * by_rotation.reshape(len(root), 3), root * flat)
    return np.asarray(moves - (by_rotation.reshape(len(root), 3) @ rotation).reshape(moves.shape))


def _written(imaging: Imaging, places: _Places, fit: _Fit, grid: _Places, apart_px: float
             ) -> Written:
    camera, lens = fit.camera, imaging.camera
    follow = _solved(camera, places.rays @ fit.rotation.T, places.weights, places.moves)[:-3]
    off = np.nan_to_num(camera.project(grid.rays @ fit.rotation.T) - grid.pixels)
    left = _without_rotation(lens, grid.rays, off[:, :, None], grid.weights)[:, :, 0]
    field = _field_of(-off, grid.pixels, lens.image_size)
    size = float(np.sqrt(np.mean(np.sum(field.displacement(grid.pixels)**2, axis=1))))
    return Written(
        camera, fit.rotation, field if size > LEAST_FIELD * lens.image_size[0] / 1000 else None,
        follow, grid.pixels, np.linalg.norm(left, axis=1),
        _without_rotation(lens, grid.rays, grid.moves, grid.weights), apart_px,
        *_widened(camera, fit, places), _loose(camera, fit, places))


def _loose(camera: Camera, fit: _Fit, places: _Places) -> Floats:
    """Return the covariance (n, n) of parameters that were drawn to 0 as nothing tells them."""
    inner, small = _normal(camera, places.rays @ fit.rotation.T, places.weights)[:2]
    inverse = np.linalg.inv(inner)
    found = SMALL_PX**2 * (inverse * small) @ inverse
    return np.asarray(found[:-3, :-3])


def _widened(camera: Camera, fit: _Fit, places: _Places) -> tuple[Floats, Floats]:
    """Return how the widest model's parameters follow the solution, and how far they are off."""
    found = _solved(camera.widened(), places.rays @ fit.rotation.T, places.weights,
                    np.concatenate([places.moves, -fit.off[:, :, None]], axis=2))[:-3]
    return found[:, :-1], found[:, -1]


def _field_of(displacement: Floats, pixels: Floats, image_size: tuple[int, int]) -> Field:
    """Return the field that comes closest to displacements (k, 2) at pixels (k, 2)."""
    terms = field_terms(pixels, image_size)
    inner = terms.T @ terms + RIDGE * len(terms) * np.eye(terms.shape[1])
    return Field(image_size, np.asarray(np.linalg.solve(inner, terms.T @ displacement).T))


def _rms(off: Floats, weights: Floats) -> float:
    return float(np.sqrt(weights @ np.sum(np.nan_to_num(off)**2, axis=-1)))
