# SPDX-License-Identifier: Apache-2.0
"""A first scene from tracks, with a given camera: two images first, then one image at a time.

Images of a drive come in order and their tracks are known, so most of incremental mapping (match
graph, next-best-view search, local adjustments) is not needed. Resection and triangulation in turn
take a tenth of its time, and keep the given focal length.
"""
from __future__ import annotations

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config, ReconstructConfig
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.problem.observations import Structure, Tracks
from dashcalib_ros.reconstruct.geometry import Engine, engine_named
from dashcalib_ros.reconstruct.scene import Profile, Scene, rays_of, triangulate

# of the image width; the limit of a reprojection error while the lens is still unknown
CHAIN_ERROR = 0.004
# minimum number of points that both images of the first pair see
MIN_SHARED = 40
# points that an image must see to be tried; inliers it must have, in number and as a share
MIN_RESECTION = 15
MIN_INLIERS = 12
MIN_SHARE = 0.3


def chain(tracks: Tracks, camera: Camera, error_px: float, min_angle_deg: float,
          seed: int = 0, engine: Engine | None = None) -> Structure | None:
    """Return a first structure, or None where no pair of images starts one.

    error_px: largest reprojection error; generous, as the camera is only a guess.
    min_angle_deg: smaller triangulation angles give no point. engine: of poses, None for the
    default.
    """
    engine = engine or engine_named(ReconstructConfig().used)
    rays = rays_of(tracks, camera)
    # where the distortion folds over, pixels have no ray
    seen = np.isfinite(rays[:, :, 0])
    error_rad = error_px / camera.fx
    start = _initial_pair(rays, error_rad, seed, engine)
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
        # only points that the newest image sees can have changed
        touched = seen[newest]
        points[touched], used[:, touched] = triangulate(
            camera, rays[:, touched], rotations, translations, registered, error_px,
            min_angle_deg)
        known: Mask = np.asarray(used.any(axis=0), bool)
        support = np.where(registered | failed, -1, (seen & known).sum(axis=1))
        nearest = int(np.argmax(support))
        if support[nearest] < MIN_RESECTION:
            return Structure(rotations, translations, points, registered, used)
        common = known & seen[nearest]
        found = engine.absolute_pose(rays[nearest, common], points[common], error_rad, seed)
        if found is None or found[1] < max(MIN_INLIERS, MIN_SHARE * common.sum()):
            failed[nearest] = True
            continue
        rotations[nearest], translations[nearest] = found[0]
        registered[nearest] = True
        failed[:] = False
        newest = nearest


def chain_scene(tracks: Tracks, turn: TurnId, camera: Camera, profile: Profile,
                config: Config) -> Scene | None:
    """Return a first scene with a camera that is known roughly; None if no pair starts a chain."""
    limits = config.scene
    generous = max(limits.error_px, CHAIN_ERROR * tracks.image_size[0])
    structure = chain(tracks, camera, generous, limits.min_angle_deg, config.seed,
                      engine_named(config.reconstruct.used))
    if structure is None:
        return None
    return Scene(turn, tracks, structure, camera, profile)


def _initial_pair(rays: Floats, error_rad: float, seed: int, engine: Engine
                  ) -> tuple[int, int, Floats, Floats] | None:
    """Return the image pair with the best parallax among those that share many points.

    As the two images' numbers and the second one's pose in the first one's frame.
    """
    seen = np.isfinite(rays[:, :, 0])
    candidates = []
    for gap in (2, 3, 4, 6):
        for first in range(len(rays) - gap):
            both = seen[first] & seen[first + gap]
            if both.sum() >= MIN_SHARED:
                moved = np.linalg.norm(rays[first, both] - rays[first + gap, both], axis=1)
                # the spread of the motion, not the motion: a rotation moves all points alike
                # percentile() takes five times as long
                low, high = np.interp((0.1, 0.9), np.linspace(0, 1, len(moved)), np.sort(moved))
                candidates.append((float(both.sum()) * min(high - low, 0.2), first, first + gap))
    for _, first, second in sorted(candidates, reverse=True)[:5]:
        both = seen[first] & seen[second]
        found = engine.relative_pose(rays[first, both], rays[second, both], error_rad / 2, seed)
        if found is not None and found[1] >= 0.5 * both.sum():
            return first, second, *found[0]
    return None
