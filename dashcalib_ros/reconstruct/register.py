# SPDX-License-Identifier: Apache-2.0
"""Track positions are registered again, against one reference patch each (affine Lucas-Kanade).

Tracking from image to image drifts: small errors add up along a track, most where a surface comes
closer and its picture grows. The first scene gives the scale of each patch relative to its
reference image. From there an affine registration (Baker and Matthews 2004, inverse compositional)
moves every observation back to the same world point.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, Floats32, GreyImage, Ints, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.problem.observations import Structure, Tracks
from dashcalib_ros.robust import mad_sigma

# px; patches are twice as wide, and one
HALF_WINDOW = 7
# px; a registration that moves a point farther is wrong
MAX_SHIFT_PX = 3.0
# affine steps converge slowly; a patch that has not converged by then is dropped
ITERATIONS = 10
# ratio of scales beyond which a patch and its reference look too different
MAX_SCALE = 3.0
# a patch with less correlation does not show its reference
MIN_CORRELATION = 0.85
# px; a step below this ends the registration of a patch
SETTLED_PX = 0.01
# px of smoothing; in pictures with more noise than so many grey levels it is the larger one: at
# night, too few patches had the least correlation, and good drives were lost
SMOOTHING_PX, NOISY_SMOOTHING_PX, NOISY = 0.5, 0.8, 3.5
# its response to noise is six times the noise; a smooth picture gives none (Immerkaer 1996)
NOISE_FILTER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


def register_tracks(tracks: Tracks, structure: Structure, camera: Camera,
                    images: Sequence[GreyImage]) -> Tracks:
    """Return the tracks with every used observation registered against its track's reference.

    images: the keyframes' pictures. An observation that moves too far, or whose patch does not
    look like the reference, is dropped.
    """
    depth = _depths(structure, camera)
    reference = _reference_rows(structure.used, depth)
    step = np.arange(-HALF_WINDOW, HALF_WINDOW + 1, dtype=np.float32)
    grid = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    noise = _noise_of(images[len(images) // 2])
    smoothing_px = NOISY_SMOOTHING_PX if noise > NOISY else SMOOTHING_PX
    template, steps = _templates(tracks, reference, images, grid, smoothing_px)
    xy = np.full_like(tracks.xy, np.nan)
    every = np.arange(tracks.xy.shape[1])
    for k, image in enumerate(images):
        scale = depth[reference, every] / np.where(depth[k] > 0, depth[k], 1.0)
        wanted = np.flatnonzero(
            structure.used[k] & (scale < MAX_SCALE) & (scale > 1 / MAX_SCALE))
        if len(wanted) == 0:
            continue
        found, good = _align(_doubled(image, smoothing_px), tracks.xy[k, wanted], scale[wanted],
                             template[wanted], steps[wanted], grid)
        shift = np.linalg.norm(found - tracks.xy[k, wanted], axis=1)
        good &= (shift < MAX_SHIFT_PX) | (reference[wanted] == k)
        xy[k, wanted[good]] = found[good]
    return replace(tracks, xy=xy)


def _depths(structure: Structure, camera: Camera) -> Floats:
    """Return (k, t) depths of the points in each image; 0 where not registered or behind."""
    depth = camera.depths(structure.local)
    return np.asarray(np.where(structure.registered[:, None], np.maximum(depth, 0.0), 0.0))


def _reference_rows(used: Mask, depth: Floats) -> Ints:
    """Return (t,) the image of each track where its depth is the median of its observations."""
    order = np.argsort(np.where(used, depth, np.inf), axis=0, kind='stable')
    middle = np.maximum(used.sum(axis=0) - 1, 0) // 2
    return np.asarray(order[middle, np.arange(used.shape[1])], np.int64)


def _noise_of(image: GreyImage) -> float:
    response = cv2.filter2D(image, cv2.CV_16S, NOISE_FILTER)
    # edges, which few pixels are on, do not count in a median; of 16 pixels one is enough
    return mad_sigma(response[::4, ::4].astype(np.float64)) / 6


def _doubled(image: GreyImage, smoothing_px: float) -> Floats32:
    """Return the image, smoothed, at twice the resolution: see _sample().

    Made twice, for a reference and for what is aligned: kept, those of a whole turn would be half
    of a child's memory.
    """
    return np.asarray(cv2.pyrUp(cv2.GaussianBlur(image, (0, 0), smoothing_px).astype(np.float32)))


def _sample(doubled: Floats32, xy: Floats32) -> Floats32:
    """Return (n, p) intensities at positions (n, 2, p), in px of the image before it was doubled.

    OpenCV rounds positions to 1/32 px, and its cubic kernel shifts the picture by up to 0.05 px.
    Linear interpolation in the doubled image is off by 0.004 px. Lanczos in the original image is
    off by 0.008 px, and takes ten times as long (docs/lessons.md).
    """
    where = 2 * xy
    return np.asarray(cv2.remap(doubled, where[:, 0], where[:, 1], cv2.INTER_LINEAR,
                                borderMode=cv2.BORDER_REPLICATE), np.float32)


def _templates(tracks: Tracks, reference: Ints,
               images: Sequence[GreyImage], grid: Floats32, smoothing_px: float
               ) -> tuple[Floats32, Floats32]:
    """Return normalised patches (t, p), and what a difference from them asks for (t, 6, p).

    The latter times the difference (p,) is the step of the six parameters.
    """
    count, pixels = len(reference), len(grid)
    template = np.zeros((count, pixels), np.float32)
    gradient = np.zeros((count, 2, pixels), np.float32)
    for k in np.unique(reference):
        rows = np.flatnonzero((reference == k) & np.isfinite(tracks.xy[k, :, 0]))
        if len(rows) == 0:
            continue  # all of them are tracks that the structure does not use
        centre = tracks.xy[k, rows].astype(np.float32)[:, :, None] + grid.T
        image = _doubled(images[k], smoothing_px)
        template[rows] = _sample(image, centre)
        for axis, ahead in enumerate(np.array([[[0.5], [0]], [[0], [0.5]]], np.float32)):
            gradient[rows, axis] = _sample(image, centre + ahead) - _sample(image, centre - ahead)
    template, contrast = _normalised(template)
    gradient /= contrast[:, :, None]
    # d/dp of T(W(d; p)) at the identity, p = a11 a12 a21 a22 tx ty
    descent = np.concatenate([
        gradient[:, :1] * grid.T, gradient[:, 1:] * grid.T, gradient], axis=1)
    hessian = (descent @ descent.transpose(0, 2, 1)).astype(np.float64)
    damping = 1e-3 * np.trace(hessian, axis1=1, axis2=2)[:, None, None] / 6 + 1e-9
    inverse = np.linalg.inv(hessian + damping * np.eye(6)).astype(np.float32)
    return template, inverse @ descent


def _normalised(patches: Floats32) -> tuple[Floats32, Floats32]:
    """Return patches (n, p) of mean 0 and standard deviation 1, and what that was (n, 1)."""
    centred = patches - patches.mean(axis=1, keepdims=True)
    # einsum makes no array of the products
    variance = np.einsum('np,np->n', centred, centred) / np.float32(patches.shape[1])
    contrast = np.maximum(np.sqrt(variance), 1e-3)[:, None]
    centred /= contrast
    return centred, contrast


def _align(image: Floats32, start: Floats, scale: Floats, template: Floats32, steps: Floats32,
           grid: Floats32) -> tuple[Floats, Mask]:
    """Return (n, 2) positions where the patches match their templates, and (n,) if they do."""
    found, good = start.copy(), np.zeros(len(start), bool)
    # of the patches that still move, in the order of their numbers
    numbers, centre = np.arange(len(start)), start
    linear, pixels = scale[:, None, None] * np.eye(2), np.float32(len(grid))
    for _ in range(ITERATIONS):
        affine = linear.astype(np.float32)
        patch = _sample(image, affine[:, :, :1] * grid[:, 0] + affine[:, :, 1:] * grid[:, 1]
                        + centre[:, :, None].astype(np.float32))
        patch, _ = _normalised(patch)
        correlation = np.einsum('np,np->n', patch, template) / pixels
        step = (steps @ (patch - template)[:, :, None])[:, :, 0].astype(np.float64)
        # keep single steps small: the patch is only a few pixels wide
        warp = np.eye(2) + np.clip(step[:, :4], -0.2, 0.2).reshape(-1, 2, 2)
        linear = linear @ np.linalg.inv(warp)
        move = (linear @ np.clip(step[:, 4:], -1.5, 1.5)[:, :, None])[:, :, 0]
        centre = centre - move
        shift = np.linalg.norm(move, axis=1)
        found[numbers] = centre
        good[numbers] = (shift < 10 * SETTLED_PX) & (correlation > MIN_CORRELATION)
        moving = shift > SETTLED_PX
        if not moving.any():
            break
        numbers, centre, linear = numbers[moving], centre[moving], linear[moving]
        template, steps = template[moving], steps[moving]
    return found, good
