"""Robust poses from viewing rays of any direction: two engines that do the same.

COLMAP has the estimators that most measurements were made with, but no wheels for arm64. Where it
is not installed, OpenCV's minimal solvers and NumPy take its place.
"""
from __future__ import annotations

from importlib.util import find_spec
from typing import Protocol

from dashcalib_ros.arrays import Floats
from dashcalib_ros.config import AUTO_ENGINE, ENGINES
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.reconstruct.scene import Pose

_, COLMAP, OPENCV = ENGINES


class Engine(Protocol):
    """Robust poses from unit rays (n, 3); both return how many rays agree, None for no pose.

    error_rad: largest error of a ray that agrees. The same seed gives the same result.
    """

    @staticmethod
    def relative_pose(before: Floats, after: Floats, error_rad: float, seed: int
                      ) -> tuple[Pose, int] | None:
        """Return the pose that takes points from the first image's frame to the second one's.

        before, after: rays of the same points. The translation is a unit vector.
        """

    @staticmethod
    def absolute_pose(rays: Floats, points: Floats, error_rad: float, seed: int
                      ) -> tuple[Pose, int] | None:
        """Return the pose, world to camera, of an image that sees points (n, 3) along rays."""


def engine_name(wanted: str) -> str:
    """Return the engine that the setting reconstruct.engine selects here; loads none.

    Raises ConfigError where pycolmap is wanted, but not installed.
    """
    installed = find_spec('pycolmap') is not None
    if wanted == COLMAP and not installed:
        raise ConfigError('E-ENGINE-MISSING', 'reconstruct.engine is pycolmap, which is not '
                          'installed: pip install pycolmap, or set it to opencv or auto')
    if wanted == AUTO_ENGINE:
        return COLMAP if installed else OPENCV
    return wanted


def engine_named(wanted: str) -> Engine:
    """Return the engine that the setting reconstruct.engine selects here."""
    if engine_name(wanted) == COLMAP:
        from dashcalib_ros.reconstruct import colmap
        return colmap
    from dashcalib_ros.reconstruct import ransac
    return ransac
