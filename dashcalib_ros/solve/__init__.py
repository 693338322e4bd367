# SPDX-License-Identifier: Apache-2.0
"""Scenes -> one shared camera with its covariance (paper, 3.2), as one problem.

The lens, a rolling shutter's readout, a smooth residual distortion, where a stabiliser moves
the picture its shift in each image, and the structures of all turns are found together.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence

from dashcalib_ros.config import Config
from dashcalib_ros.input.motion import Samples
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.solution import Solution


def solve(scenes: Sequence[Scene], config: Config, temperature: Samples | None = None,
          progress: Callable[[str, float], None] = lambda stage, done: None) -> Solution | None:
    """Adjust all scenes with one camera (paper, 3.2); None where it explains none of them.

    scenes: at least one, each as its turn was reconstructed. Those of earlier drives are not in
    the solution, nor in its misfits, where this drive's turns contradict them. temperature: (n, 1)
    degrees Celsius, on the images' clock, which the focal length may follow.
    """
    from dashcalib_ros.solve import joint
    return joint.solve(scenes, config, temperature, progress)
