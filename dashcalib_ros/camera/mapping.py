# SPDX-License-Identifier: Apache-2.0
"""Cameras compared by what they do: where in the picture they see the same viewing rays.

Parameters of a camera, and all the more of two models, may differ much and map rays alike. What
counts is the distance in the picture, after the best common rotation of the rays: a rotation of
the camera cannot be distinguished from one of its mounting (Hagemann et al.).
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera.camera import Camera

# what moves pixels (n, 2)
Moved = Callable[[Floats], Floats] | None
# the viewing rays (n, 3) of pixels (n, 2)
Rays = Callable[[Floats], Floats] | None

# columns, rows: enough for a smooth field, and as in the benchmarks
GRID = (25, 15)
# px; where a camera that is fitted does not see a ray, that counts as this
UNSEEN_PX = 100.0
# degrees off the axis; cameras that do not see behind are compared up to here
IN_FRONT_DEG = 88.0
# of the search for the best rotation: steps at most, parts of one that are tried, and the
# relative gain that ends it
ROTATIONS, PARTS, SETTLED = 50, tuple(0.5**n for n in range(8)), 1e-12
# px; cameras that are this near need no fit
SAME_PX = 1e-6


def grid_of(camera: Camera, counts: tuple[int, int] = GRID) -> Floats:
    """Return (n, 2) pixels spread over the picture. counts: of columns and rows."""
    u, v = np.meshgrid(*(np.linspace(0, side - 1, count)
                         for side, count in zip(camera.image_size, counts, strict=True)))
    return np.stack([u.ravel(), v.ravel()], -1)


@dataclass(frozen=True)
class Apart:
    """By how much two cameras' images of the same rays differ, the best common rotation removed.

    pixels: (n, 2) where the reference sees the rays; offsets: (n, 2) from there to where the other
    camera sees them, px.
    """

    pixels: Floats
    offsets: Floats

    @property
    def lengths(self) -> Floats:
        """Return (n,) how many pixels they are apart."""
        return np.asarray(np.linalg.norm(self.offsets, axis=1))

    @property
    def rms(self) -> float:
        """Return how many pixels they are apart over the picture."""
        return float(np.sqrt(np.mean(self.lengths**2)))

    @property
    def worst(self) -> float:
        """Return how many pixels they are apart where it is most."""
        return float(self.lengths.max())


def mapping_error(camera: Camera, reference: Camera) -> float | None:
    """Return the RMS pixel distance between both cameras' images of the same rays.

    None where apart() is.
    """
    found = apart(camera, reference)
    return None if found is None else found.rms


def apart(camera: Camera, reference: Camera, observed: Moved = None, ideal: Moved = None
          ) -> Apart | None:
    """Return how far the images of the same rays are apart in both cameras.

    observed: of the camera's field, and ideal: of the reference's; see Field.
    The rays are those of a grid over the reference's image, without those that no camera of this
    kind can see (unseen_share()). None when the reference has no ray for a pixel of the grid, when
    the camera cannot see one of the others, and where none is left.
    """
    pixels = grid_of(reference)
    rays = reference.rays(pixels if ideal is None else ideal(pixels))
    return apart_at(camera, rays, pixels, observed)


def apart_at(camera: Camera, rays: Floats, pixels: Floats, observed: Moved = None
             ) -> Apart | None:
    """Return how far the camera's images of rays (n, 3) are from the pixels (n, 2) that see them.

    None where apart() is.
    """
    if not np.isfinite(rays).all():
        return None
    possible = _possible(camera, rays)
    if not possible.any():
        return None
    pixels, rays = pixels[possible], rays[possible]

    def off(rays: Floats) -> Floats:
        with np.errstate(all='ignore'):
            seen = camera.project(rays)
            return np.asarray((seen if observed is None else observed(seen)) - pixels)

    # Gauss-Newton: SciPy's optimiser takes longer to load than this takes
    best = off(rays)
    if not np.isfinite(best).all():
        return None
    for _ in range(ROTATIONS):
        by_rotation = (camera.derivatives(rays)[1] @ turned(rays)).reshape(-1, 3)
        step, *_ = np.linalg.lstsq(by_rotation, -best.ravel(), rcond=None)
        for part in PARTS:
            moved = rays @ cv2.Rodrigues(part * step)[0].T
            found = off(moved)
            gain = float(np.sum(best**2) - np.sum(found**2))
            if gain > 0:
                break
        else:
            break
        rays, best = moved, found
        if gain <= SETTLED * float(np.sum(best**2)):
            break
    return Apart(pixels, best)


def unseen_share(camera: Camera, reference: Camera) -> float:
    """Return of how much of the reference's picture no camera of this kind can see the rays."""
    rays = reference.rays(grid_of(reference))
    return float(np.mean(~_possible(camera, rays[np.isfinite(rays[:, 0])])))


def _possible(camera: Camera, rays: Floats) -> Mask:
    """Return (n,) which rays are not too far from the axis for this kind of camera."""
    return np.asarray(rays[:, 2] > (-2.0 if camera.sees_behind
                                    else np.cos(np.radians(IN_FRONT_DEG))))


def sensitivity(camera: Camera, at: Floats | None = None) -> tuple[Floats, Floats]:
    """Return by how much parameters move the picture, the best common rotation removed.

    (m, 2, n) derivatives of the pixels of m viewing rays by the n parameters, and the rays'
    pixels (m, 2): those of a grid over the picture, or those given, for which the camera has a
    ray. The rotation is the best one over the grid.
    """
    pixels, flat, by_rotation = _derivatives(camera, grid_of(camera))
    rotation, *_ = np.linalg.lstsq(by_rotation, flat, rcond=None)
    if at is not None:
        pixels, flat, by_rotation = _derivatives(camera, at)
    return (flat - by_rotation @ rotation).reshape(len(pixels), 2, -1), pixels


def _derivatives(camera: Camera, pixels: Floats) -> tuple[Floats, Floats, Floats]:
    """Return those of the pixels that have a ray, (m, 2), and derivatives of them.

    (2 m, n) by the parameters, and (2 m, 3) by a rotation of the ray.
    """
    rays = camera.rays(pixels)
    known = np.isfinite(rays[:, 0])
    by_params, by_ray, _ = camera.derivatives(rays[known])
    return (pixels[known], by_params.reshape(-1, by_params.shape[2]),
            (by_ray @ turned(rays[known])).reshape(-1, 3))


def turned(rays: Floats) -> Floats:
    """Return (m, 3, 3) derivatives of rays (m, 3) by a small rotation of all."""
    x, y, z = rays.T
    zero = np.zeros_like(x)
    return np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)


def as_model(camera: Camera, model: type[Camera], seen: Rays = None) -> Camera:
    """Return the camera of another model that maps rays most alike; fitted, not exact.

    seen: the rays (n, 3) of pixels (n, 2), where they are not the camera's own.
    """
    pixels = grid_of(camera)
    rays = camera.rays(pixels) if seen is None else seen(pixels)
    known = np.isfinite(rays[:, 0])
    pixels, rays = pixels[known], rays[known]
    start = model.centred(camera.image_size, camera.fx).params
    start[:4] = camera.params[:4]
    if model.family == camera.family:
        shared = min(len(start), len(camera.params))
        start[4:shared] = camera.params[4:shared]
    scale = np.ones(len(start))
    scale[:4] = camera.fx

    def residual(params: Floats) -> Floats:
        off = model.of(camera.image_size, params * scale).project(rays) - pixels
        return np.clip(np.nan_to_num(off, nan=UNSEEN_PX), -UNSEEN_PX, UNSEEN_PX).ravel()

    with np.errstate(all='ignore'):
        found = start / scale
        if np.abs(residual(found)).max() > SAME_PX:
            # it takes 0.4 s to load
            from scipy.optimize import least_squares
            found = least_squares(residual, found, loss='soft_l1').x
    return model.of(camera.image_size, found * scale)
