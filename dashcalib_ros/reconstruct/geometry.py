# SPDX-License-Identifier: Apache-2.0
"""Robust poses from viewing rays of any direction: two engines that do the same.

COLMAP has the estimators that most measurements were made with, but no wheels for arm64. Where it
is not installed, OpenCV's minimal solvers and NumPy take its place.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dashcalib_ros.arrays import Floats
from dashcalib_ros.config import COLMAP
from dashcalib_ros.reconstruct.scene import Pose

# of unit rays (n, 3), others or points (n, 3), the largest error in rad of a ray that agrees, and
# a seed; returns how many rays agree, too, or None for no pose
Estimator = Callable[[Floats, Floats, float, int], tuple[Pose, int] | None]


@dataclass(frozen=True)
class Engine:
    """Robust estimators of poses. The same seed gives the same result.

    relative_pose: of rays of the same points in two images, the pose that takes points from the
    first one's frame to the second one's, with a unit translation. absolute_pose: of rays of an
    image and the points (n, 3) along them, the pose of the image, world to camera.
    """

    relative_pose: Estimator
    absolute_pose: Estimator


def engine_named(name: str) -> Engine:
    """Return an engine, COLMAP or OPENCV of config."""
    if name == COLMAP:
        from dashcalib_ros.reconstruct import colmap
        return Engine(colmap.relative_pose, colmap.absolute_pose)
    from dashcalib_ros.reconstruct import ransac
    return Engine(ransac.relative_pose, ransac.absolute_pose)
