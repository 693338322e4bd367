"""Poses and points of a scene; triangulation of points from poses and viewing rays."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera import Camera

# cosine (11 degrees); a point farther off its viewing ray is an outlier, wherever it projects
ALONG = 0.98


@dataclass(frozen=True)
class Structure:
    """Poses and points of a scene, up to scale.

    rotations: (k, 3, 3), translations: (k, 3): world to camera; rows of images that are not
    registered are zero. points: (t, 3) in the world's frame.
    registered: (k,); used: (k, t) observations that the structure explains.
    """

    rotations: Floats
    translations: Floats
    points: Floats
    registered: Mask
    used: Mask


def triangulate(camera: Camera, rays: Floats, rotations: Floats, translations: Floats,
                registered: Mask, error_px: float, min_angle_deg: float
                ) -> tuple[Floats, Mask]:
    """Triangulate every track from all registered images that see it, linearly.

    rays: (k, t, 3) unit viewing rays. error_px: largest error, see ray_errors_px().
    Returns points (t, 3) and used (k, t): the good observations of the points that are kept. Those
    have at least 2 good observations and a triangulation angle of at least min_angle_deg.
    """
    seen = np.isfinite(rays[:, :, 0]) & registered[:, None]

    def good_of(points: Floats, tracks: Mask | slice) -> Mask:
        error = ray_errors_px(camera, rays[:, tracks], rotations, translations, points)
        return np.asarray(seen[:, tracks] & (error < error_px), bool)

    points = _linear_points(rays, rotations, translations, seen)
    good = good_of(points, np.s_[:])
    # a bad observation makes a linear solution wrong: solve again without it
    spoiled = (good.sum(axis=0) >= 2) & (good.sum(axis=0) < seen.sum(axis=0))
    if spoiled.any():
        points[spoiled] = _linear_points(
            rays[:, spoiled], rotations, translations, good[:, spoiled])
        good[:, spoiled] = good_of(points[spoiled], spoiled)
    enough = (good.sum(axis=0) >= 2) & (
        _widest_angle(rotations, translations, points, good) > np.radians(min_angle_deg))
    return points, good & enough


def ray_errors_px(camera: Camera, rays: Floats, rotations: Floats, translations: Floats,
                  points: Floats) -> Floats:
    """Return (k, t) reprojection errors, px; inf where a point does not lie along its ray.

    They are those of a picture without distortion: barrel distortion makes the rim of the picture
    small, and errors there, too. A model that folds over projects other directions to the same
    pixel, too: those do not count.
    """
    flat = camera.without_distortion()
    local = points @ rotations.transpose(0, 2, 1) + translations[:, None]
    along = np.einsum('ktc,ktc->kt', local, rays) > ALONG * np.linalg.norm(local, axis=2)
    error = np.linalg.norm(flat.project(local) - flat.project(rays), axis=2)
    return np.asarray(np.where(along & np.isfinite(error), error, np.inf))


def _linear_points(rays: Floats, rotations: Floats, translations: Floats, seen: Mask) -> Floats:
    """Return (t, 3) points that minimise the algebraic error over their observations.

    With P = [R t] and a unit ray r, the error of a homogeneous point X is P X - r (r . P X).
    """
    poses = np.concatenate([rotations, translations[:, :, None]], axis=2)
    along = np.where(seen[:, :, None], rays, 0.0) @ poses
    squares = (poses.transpose(0, 2, 1) @ poses).reshape(-1, 16)
    normal = (seen.T.astype(np.float64) @ squares).reshape(-1, 4, 4)
    normal -= along.transpose(1, 2, 0) @ along.transpose(1, 0, 2)
    homogeneous = np.linalg.eigh(normal)[1][:, :, 0]
    scale = homogeneous[:, 3:]
    scale = np.where(np.abs(scale) < 1e-12, 1e-12, scale)
    return np.asarray(homogeneous[:, :3] / scale)


def _widest_angle(rotations: Floats, translations: Floats, points: Floats, seen: Mask) -> Floats:
    """Return (t,) the angle in radians between the first and the last ray of each track."""
    centres = -np.einsum('kji,kj->ki', rotations, translations)
    first = seen.argmax(axis=0)
    last = len(seen) - 1 - seen[::-1].argmax(axis=0)
    a, b = points - centres[first], points - centres[last]
    # atan2 is exact for small angles, arccos is not
    return np.asarray(
        np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))
