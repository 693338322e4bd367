"""What the child process runs: all scenes to one solution."""
from __future__ import annotations

from collections.abc import Callable, Sequence

from dashcalib_ros.config import Config
from dashcalib_ros.intrinsics.solution import Solution
from dashcalib_ros.reconstruction.scene import Scene


def solve_scenes(scenes: Sequence[Scene], config: Config,
                 progress: Callable[[str, float], None] = lambda stage, done: None
                 ) -> Solution | None:
    """Adjust all scenes together; COLMAP is loaded in the process that runs this only."""
    from dashcalib_ros.intrinsics.joint import solve
    return solve(scenes, config.intrinsics, config.scene, config.seed, progress)
