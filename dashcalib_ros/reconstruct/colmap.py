# SPDX-License-Identifier: Apache-2.0
"""Robust poses from viewing rays by COLMAP: the one module that loads it.

zlib must be imported first: pycolmap's wheel exports the symbols of another version of zlib, and
the version that a process loads first is used by all its libraries.

COLMAP's estimators of poses work with rays, but take pixels and a camera. An equirectangular
camera sees all directions, so every ray can be given to them as a pixel of such a camera.
"""
from __future__ import annotations

import zlib  # noqa: F401
from functools import cache
from typing import Any

import numpy as np
import pycolmap

from dashcalib_ros.arrays import Floats
from dashcalib_ros.reconstruct.scene import Pose

# what it logs goes to stderr anyway; without this, it also leaves files of it in TMPDIR
pycolmap.logging.logtostderr = True
# px for each radian of the equirectangular camera
SCALE = 1000.0
# samples drawn at least and at most: drives have many inliers
RELATIVE_TRIALS = (50, 1000)
ABSOLUTE_TRIALS = (10, 100)
# steps of a pose's refinement: the adjustments that follow go on from there
REFINEMENTS = 5


def relative_pose(before: Floats, after: Floats, error_rad: float, seed: int
                  ) -> tuple[Pose, int] | None:
    """Return the relative pose of two images; see Engine."""
    found = pycolmap.estimate_essential_matrix(
        _pixels(before), _pixels(after), _all_around(), _all_around(),
        _ransac(error_rad, seed, RELATIVE_TRIALS))
    if found is None:
        return None
    return _pose(found['cam2_from_cam1']), int(found['num_inliers'])


def absolute_pose(rays: Floats, points: Floats, error_rad: float, seed: int
                  ) -> tuple[Pose, int] | None:
    """Return the pose of an image that sees points; see Engine."""
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
