# SPDX-License-Identifier: Apache-2.0
"""Lenses that ROS has no model for: their viewing rays, and the nearest camera that it has.

A file's camera is one of these where its model is known and none of models.py is the same. Each is
only read: pixels become places (x, y) on the plane at distance 1, distortion is removed from them,
and they are lifted to rays.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.camera import Camera
from dashcalib_ros.camera.mapping import UNSEEN_PX, as_model, grid_of
from dashcalib_ros.camera.models import MODELS

# places (n, 2) to places, or to rays (n, 3) of any length
Places = Callable[[Floats], Floats]
# Newton's steps, the step of its derivatives, and what it must reach, of the focal length
STEPS, SMALL, REACHED = 30, 1e-6, 1e-9
# a camera with more parameters is taken where it is so much nearer, and by so many px
NEARER, NEARER_PX = 0.9, 0.01
# columns and rows of pixels at which a camera is compared with the lens
FINE = (97, 61)


@dataclass(frozen=True)
class OtherLens:
    """model: what its program calls it. view: fx, fy, cx, cy. lift: places to rays."""

    model: str
    image_size: tuple[int, int]
    view: Sequence[float]
    lift: Places

    def rays(self, pixels: Floats) -> Floats:
        """Return the unit viewing rays (..., 3) of pixels (..., 2); NaN where there is none."""
        fx, fy, cx, cy = self.view
        places = (pixels.reshape(-1, 2) - [cx, cy]) / [fx, fy]
        with np.errstate(all='ignore'):
            rays = self.lift(places)
            rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return np.asarray(rays.reshape(*pixels.shape[:-1], 3))

    def centred(self, model: type[Camera]) -> Camera:
        """Return the camera without distortion that magnifies the picture's middle alike."""
        _, _, cx, cy = self.view
        near = self.rays(np.array([[cx - 1, cy], [cx + 1, cy], [cx, cy - 1], [cx, cy + 1]]))
        across, down = near[1] - near[0], near[3] - near[2]
        params = np.zeros(len(model.names()))
        params[:4] = 2 / np.linalg.norm(across), 2 / np.linalg.norm(down), cx, cy
        return model.of(self.image_size, params)


@dataclass(frozen=True)
class Nearest:
    """The camera of ROS that is nearest to a lens, with the same axes.

    rms_px, worst_px: by how much it is off over the picture; worst_at: the pixel. unseen: share of
    the picture for which the lens has no ray.
    """

    camera: Camera
    rms_px: float
    worst_px: float
    worst_at: tuple[int, int]
    unseen: float


def nearest(lens: OtherLens) -> Nearest:
    """Return the nearest camera: of about equal ones that with the fewest parameters."""
    found = [_apart(as_model(lens.centred(model), model, lens.rays), lens)
             for model in sorted(MODELS.values(), key=lambda each: len(each.names()))]
    best = min(each.rms_px for each in found)
    return next(each for each in found if each.rms_px <= best / NEARER + NEARER_PX)


def _apart(camera: Camera, lens: OtherLens) -> Nearest:
    pixels = grid_of(camera, FINE)
    rays = lens.rays(pixels)
    known = np.isfinite(rays).all(axis=1)
    with np.errstate(all='ignore'):
        off = np.linalg.norm(camera.project(rays[known]) - pixels[known], axis=1)
        back = camera.rays(pixels[known])[:, 0]
    off = np.where(np.isfinite(off + back), off, UNSEEN_PX)
    x, y = pixels[known][np.argmax(off)].round().astype(int).tolist()
    return Nearest(camera, float(np.sqrt(np.mean(off**2))), float(off.max()), (x, y),
                   1 - float(np.mean(known)))


def plane(places: Floats) -> Floats:
    """Lift places of a pinhole."""
    return np.concatenate([places, np.ones((len(places), 1))], axis=1)


def angles(places: Floats) -> Floats:
    """Lift places whose distance from the centre is the angle of the ray to the axis."""
    angle = np.linalg.norm(places, axis=1, keepdims=True)
    return np.concatenate([places * np.sinc(angle / np.pi), np.cos(angle)], axis=1)


def omni(xi: float) -> Places:
    """Lift places of the unified (Mei's) model; xi = 1 is a parabolic mirror."""
    def lift(places: Floats) -> Floats:
        square = np.sum(places**2, axis=1, keepdims=True)
        scale = (xi + np.sqrt(1 + (1 - xi**2) * square)) / (1 + square)
        return np.concatenate([scale * places, scale - xi], axis=1)
    return lift


def double_sphere(xi: float, alpha: float) -> Places:
    """Lift places of the double sphere (Usenko et al.)."""
    def lift(places: Floats) -> Floats:
        square = np.sum(places**2, axis=1, keepdims=True)
        depth = (1 - alpha**2 * square) / (
            alpha * np.sqrt(1 - (2 * alpha - 1) * square) + 1 - alpha)
        scale = (depth * xi + np.sqrt(depth**2 + (1 - xi**2) * square)) / (depth**2 + square)
        return np.concatenate([scale * places, scale * depth - xi], axis=1)
    return lift


def extended_unified(alpha: float, beta: float) -> Places:
    """Lift places of the extended unified model (Khomutenko et al.)."""
    def lift(places: Floats) -> Floats:
        square = beta * np.sum(places**2, axis=1, keepdims=True)
        depth = (1 - alpha**2 * square) / (
            alpha * np.sqrt(1 - (2 * alpha - 1) * square) + 1 - alpha)
        return np.concatenate([places, depth], axis=1)
    return lift


def division(k: float) -> Places:
    """Lift places that were divided by 1 + k r^2 to be those of a pinhole (Fitzgibbon)."""
    return lambda places: plane(places / (1 + k * np.sum(places**2, axis=1, keepdims=True)))


def field_of_view(omega: float) -> Places:
    """Lift places of the FOV model (Devernay and Faugeras): COLMAP's FOV, SVO's ATAN."""
    def lift(places: Floats) -> Floats:
        radius = np.linalg.norm(places, axis=1, keepdims=True)
        angle = radius * omega
        grown = np.where((radius > 0) & (np.abs(angle) < np.pi / 2),
                         np.tan(angle) / (2 * np.tan(omega / 2)) / np.maximum(radius, 1e-12),
                         np.where(radius > 0, np.nan, omega / (2 * np.tan(omega / 2))))
        return plane(places * grown)
    return lift


def polynomial(coefficients: Sequence[float]) -> Places:
    """Lift places whose rays have the depth a0 + a1 r + a2 r^2 ... there (Scaramuzza)."""
    def lift(places: Floats) -> Floats:
        radius = np.linalg.norm(places, axis=1, keepdims=True)
        return np.concatenate([places, np.polynomial.polynomial.polyval(
            radius, list(coefficients))], axis=1)
    return lift


def bent(radial: Sequence[float], tangential: Sequence[float] = (0.0, 0.0),
         prism: Sequence[float] = (0.0, 0.0)) -> Places:
    """Return Brown's distortion with any number of terms k1, k2 ..., p1, p2, and thin prisms'."""
    def distort(places: Floats) -> Floats:
        x, y = places.T
        square = x * x + y * y
        scale = 1 + square * np.polynomial.polynomial.polyval(square, list(radial))
        p1, p2 = tangential
        return np.stack([x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x)
                         + prism[0] * square,
                         y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y
                         + prism[1] * square], axis=1)
    return distort


def opencv(d: Sequence[float]) -> Places:
    """Return OpenCV's distortion with thin prisms and a tilted sensor: 12 or 14 coefficients."""
    def distort(places: Floats) -> Floats:
        return np.asarray(cv2.projectPoints(plane(places), np.zeros(3), np.zeros(3), np.eye(3),
                                            np.array(d))[0].reshape(-1, 2))
    return distort


def undone(distort: Places, lift: Places) -> Places:
    """Return how places are lifted from which a distortion is removed first, by Newton's method.

    NaN where it folds over.
    """
    def lifted(places: Floats) -> Floats:
        at = places.copy()
        for _ in range(STEPS):
            off = distort(at) - places
            slope = np.stack([(distort(at + step) - distort(at - step)) / (2 * SMALL)
                              for step in SMALL * np.eye(2)], axis=2)
            turn = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
            step = np.stack([slope[:, 1, 1] * off[:, 0] - slope[:, 0, 1] * off[:, 1],
                             slope[:, 0, 0] * off[:, 1] - slope[:, 1, 0] * off[:, 0]], axis=1)
            at = at - step / turn[:, None]
        reached = (np.abs(distort(at) - places).max(axis=1) < REACHED) & (turn > 0)
        return lift(np.where(reached[:, None], at, np.nan))
    return lifted
