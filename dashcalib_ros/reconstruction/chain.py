"""A first scene from tracks, at a given camera: a pair by its essential matrix, then one by one.

Images of a drive come in order and their tracks are known, so the general machinery of
incremental mapping (match graph, next-best-view search, local adjustments) is not needed:
resection and triangulation in turn take a tenth of its time, and hold any focal length one asks
for.
"""
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.tracks import Tracks

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
MIN_SHARED = 40
MIN_RESECTION = 15


@dataclass(frozen=True)
class Structure:
    """Poses and points of a scene, up to scale.

    rotations: (k, 3, 3), translations: (k, 3): world to camera; rows of images that are not
    registered are zero. points: (t, 3) in the world's frame.
    registered: (k,); used: (k, t) observations that the structure explains.
    """

    rotations: Array
    translations: Array
    points: Array
    registered: Mask
    used: Mask


def chain(tracks: Tracks, camera: Camera, error_px: float, min_angle_deg: float,
          seed: int = 0) -> Structure | None:
    """Return a first structure, or None where no pair of images starts one.

    error_px: what an observation may be off; generous, as the camera is only a guess.
    min_angle_deg: rays that meet at less than this give no point.
    """
    cv2.setRNGSeed(seed)
    rays = camera.rays(tracks.xy)
    # a camera that folds over cannot reach every pixel
    seen = np.isfinite(rays[:, :, 0])
    tolerance = error_px / camera.fx
    start = _initial_pair(rays, tolerance)
    if start is None:
        return None
    first, second, rotation, translation = start
    count = len(rays)
    rotations, translations = np.zeros((count, 3, 3)), np.zeros((count, 3))
    rotations[first] = np.eye(3)
    rotations[second], translations[second] = rotation, translation
    registered = np.zeros(count, bool)
    registered[[first, second]] = True
    failed = np.zeros(count, bool)
    points = np.zeros((rays.shape[1], 3))
    used = np.zeros(rays.shape[:2], bool)
    newest = second
    while True:
        # only what the newest image sees can have changed
        touched = seen[newest]
        points[touched], used[:, touched] = triangulate(
            rays[:, touched], rotations, translations, registered, tolerance, min_angle_deg)
        known: Mask = np.asarray(used.any(axis=0), bool)
        support = np.where(registered | failed, -1, (seen & known).sum(axis=1))
        nearest = int(np.argmax(support))
        if support[nearest] < MIN_RESECTION:
            return Structure(rotations, translations, points, registered, used)
        pose = _resection(rays[nearest], points, known, tolerance)
        if pose is None:
            failed[nearest] = True
            continue
        rotations[nearest], translations[nearest] = pose
        registered[nearest] = True
        failed[:] = False
        newest = nearest


def triangulate(rays: Array, rotations: Array, translations: Array, registered: Mask,
                tolerance: float, min_angle_deg: float) -> tuple[Array, Mask]:
    """Triangulate every track from all registered images that see it, linearly.

    rays: (k, t, 2) normalised coordinates. tolerance: largest error, in normalised units.
    Returns points (t, 3) and used (k, t): the observations of the points worth keeping, those that
    have at least 2 good observations and rays that meet at an angle of min_angle_deg or more.
    """
    seen = np.isfinite(rays[:, :, 0]) & registered[:, None]
    points = _linear_points(rays, rotations, translations, seen)
    error = ray_error(rays, rotations, translations, points)
    good = seen & (error < tolerance)
    # one bad observation spoils a linear point: solve again without it
    again = (good.sum(axis=0) >= 2) & (good.sum(axis=0) < seen.sum(axis=0))
    if again.any():
        points[again] = _linear_points(rays[:, again], rotations, translations, good[:, again])
        error[:, again] = ray_error(rays[:, again], rotations, translations, points[again])
        good = seen & (error < tolerance)
    enough = (good.sum(axis=0) >= 2) & (
        _widest_angle(rotations, translations, points, good) > np.radians(min_angle_deg))
    return points, good & enough


def ray_error(rays: Array, rotations: Array, translations: Array, points: Array) -> Array:
    """Return (k, t) reprojection errors in normalised units; inf behind the camera or unseen."""
    local = points @ rotations.transpose(0, 2, 1) + translations[:, None]
    depth = local[:, :, 2]
    ahead = depth > 1e-9
    xy = local[:, :, :2] / np.where(ahead, depth, 1.0)[:, :, None]
    error = np.linalg.norm(xy - rays, axis=2)
    return np.asarray(np.where(ahead & np.isfinite(error), error, np.inf))


def _initial_pair(rays: Array, tolerance: float) -> tuple[int, int, Array, Array] | None:
    """Return the pair with the best parallax among those that see many points together."""
    seen = np.isfinite(rays[:, :, 0])
    candidates = []
    for gap in (2, 3, 4, 6):
        for first in range(len(rays) - gap):
            both = seen[first] & seen[first + gap]
            if both.sum() >= MIN_SHARED:
                moved = np.linalg.norm(rays[first, both] - rays[first + gap, both], axis=1)
                # the spread of the motion, not the motion: a rotation moves all points alike
                low, high = np.percentile(moved, (10, 90))
                candidates.append((float(both.sum()) * min(high - low, 0.2), first, first + gap))
    for _, first, second in sorted(candidates, reverse=True)[:5]:
        both = seen[first] & seen[second]
        a, b = rays[first, both], rays[second, both]
        essential, inliers = cv2.findEssentialMat(
            a, b, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.999, threshold=tolerance / 2)
        if essential is None or essential.shape != (3, 3):
            continue
        ahead, rotation, translation, _ = cv2.recoverPose(
            essential, a, b, np.eye(3), mask=inliers.copy())[:4]
        if ahead >= 0.5 * both.sum():
            return (first, second, np.asarray(rotation, np.float64),
                    np.asarray(translation, np.float64).ravel())
    return None


def _resection(rays: Array, points: Array, known: Mask, tolerance: float
               ) -> tuple[Array, Array] | None:
    """Return the pose of one image from the points it sees."""
    common = known & np.isfinite(rays[:, 0])
    # three points make a hypothesis in 2/5 of the time that five take, and find as many inliers
    found, rotvec, translation, inliers = cv2.solvePnPRansac(
        points[common], rays[common], np.eye(3), None, reprojectionError=tolerance,
        iterationsCount=100, flags=cv2.SOLVEPNP_AP3P)
    if not found or inliers is None or len(inliers) < max(12, 0.3 * common.sum()):
        return None
    chosen = inliers.ravel()
    rotvec, translation = cv2.solvePnPRefineLM(
        points[common][chosen], rays[common][chosen], np.eye(3), None, rotvec, translation)
    return (np.asarray(cv2.Rodrigues(rotvec)[0], np.float64),
            np.asarray(translation, np.float64).ravel())


def _linear_points(rays: Array, rotations: Array, translations: Array, seen: Mask) -> Array:
    """Return (t, 3) points that minimise the algebraic error over their observations."""
    poses = np.concatenate([rotations, translations[:, :, None]], axis=2)
    xy = np.where(seen[:, :, None], rays, 0.0)
    rows = np.concatenate([
        (xy[:, :, axis, None] * poses[:, None, 2] - poses[:, None, axis]) * seen[:, :, None]
        for axis in range(2)]).transpose(1, 0, 2)
    normal = rows.transpose(0, 2, 1) @ rows
    homogeneous = np.linalg.eigh(normal)[1][:, :, 0]
    scale = homogeneous[:, 3:]
    scale = np.where(np.abs(scale) < 1e-12, 1e-12, scale)
    return np.asarray(homogeneous[:, :3] / scale)


def _widest_angle(rotations: Array, translations: Array, points: Array, seen: Mask) -> Array:
    """Return (t,) the angle in radians between the first and the last ray of each track."""
    centres = -np.einsum('kji,kj->ki', rotations, translations)
    first = seen.argmax(axis=0)
    last = len(seen) - 1 - seen[::-1].argmax(axis=0)
    a, b = points - centres[first], points - centres[last]
    # atan2 of the cross product is exact for small angles, where arccos is not
    return np.asarray(
        np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))
