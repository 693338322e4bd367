"""Robust poses from viewing rays of any direction, by COLMAP's estimators.

COLMAP's estimators work with rays, but take pixels and a camera. An equirectangular camera sees
all directions, so every ray can be given to them as a pixel of such a camera.
"""
from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.reconstruct.colmap import pycolmap

# px for each radian of the equirectangular camera
SCALE = 1000.0
# samples drawn at the least and at the most: drives have many inliers
RELATIVE_TRIALS = (50, 1000)
ABSOLUTE_TRIALS = (10, 100)
# steps of a pose's refinement: the adjustments that follow go on from there
REFINEMENTS = 5

Pose = tuple[Floats, Floats]


def relative_pose(before: Floats, after: Floats, error_rad: float, seed: int
                  ) -> tuple[Pose, int] | None:
    """Return the pose of the second image in the first one's frame, and how many rays agree.

    before, after: (n, 3) unit rays of the same points. error_rad: largest error of an inlier. The
    pose takes points from the first frame to the second: rotation (3, 3), unit translation (3,).
    """
    found = pycolmap.estimate_essential_matrix(
        _pixels(before), _pixels(after), _all_around(), _all_around(),
        _ransac(error_rad, seed, RELATIVE_TRIALS))
    if found is None:
        return None
    return _pose(found['cam2_from_cam1']), int(found['num_inliers'])


def absolute_pose(rays: Floats, points: Floats, error_rad: float, seed: int
                  ) -> tuple[Pose, int] | None:
    """Return the pose of an image that sees points (n, 3) along unit rays (n, 3).

    The pose is world to camera, refined on the inliers; their number is returned with it.
    """
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac = _ransac(error_rad, seed, ABSOLUTE_TRIALS)
    pixels = _pixels(rays)
    found = pycolmap.estimate_absolute_pose(pixels, points, _all_around(), options)
    if found is None:
        return None
    how = pycolmap.AbsolutePoseRefinementOptions()
    how.max_num_iterations = REFINEMENTS
    how.print_summary = False
    refined = pycolmap.refine_absolute_pose(
        found['cam_from_world'], pixels, points, found['inlier_mask'], _all_around(), how)
    if refined is None:
        return None
    return _pose(refined['cam_from_world']), int(found['num_inliers'])


@cache
def _all_around() -> Any:
    return pycolmap.Camera.create_from_model_name(
        1, 'EQUIRECTANGULAR', 0.0, round(2 * np.pi * SCALE), round(np.pi * SCALE))


def _pixels(rays: Floats) -> Floats:
    return np.asarray(_all_around().img_from_cam(rays), np.float64)


def _ransac(error_rad: float, seed: int, trials: tuple[int, int]) -> Any:
    options = pycolmap.RANSACOptions()
    options.max_error = error_rad * SCALE
    options.random_seed = seed
    options.min_num_trials, options.max_num_trials = trials
    options.confidence = 0.999
    return options


def _pose(transform: Any) -> Pose:
    return (np.asarray(transform.rotation.matrix(), np.float64),
            np.asarray(transform.translation, np.float64))
