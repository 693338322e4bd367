"""Turns explained by a given camera: it is held, poses and points are adjusted anew."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.reconstruction.adjust import Solver, adjust_poses
from dashcalib_ros.reconstruction.scene import Scene, errors_px
from dashcalib_ros.solve.fitting import adapted_to, retriangulate
from dashcalib_ros.solve.prior import loss_px_of

# of an adjustment; it moves poses and points only, and is cheap
ITERATIONS = 20
ROUNDS = 3


def costs_with(camera: Camera, scenes: Sequence[Scene], loss_px: float, limit_px: float
               ) -> list[float]:
    """Return what each scene costs with a camera held, px^2 for each observation it uses.

    loss_px: scale of the Cauchy loss. limit_px: larger errors, and points that the camera cannot
    see, count as this.
    """
    held = adjust_poses(scenes, camera, Solver(loss_px, ITERATIONS))
    return [_cost(scene, camera, loss_px, limit_px) for scene in held]


def scene_with(camera: Camera, scene: Scene, config: Config) -> Scene | None:
    """Return the scene as a camera explains it; None where it explains no observation.

    It is triangulated, or chained anew where its own camera is far from this one, and adjusted
    with the camera held. The first rounds are generous: the camera may be wrong.
    """
    width = camera.image_size[0]
    generous = replace(config.scene, error_px=max(config.scene.error_px,
                                                  config.scene.chain_error * width))
    found = adapted_to(scene, camera, replace(config, scene=generous))
    for n in range(ROUNDS):
        limits = generous if n < ROUNDS - 1 else config.scene
        found = retriangulate(found, camera, limits)
        if not found.structure.used.any():
            return None
        loss_px = loss_px_of([found], camera, config.intrinsics)
        [found] = adjust_poses([found], camera, Solver(loss_px, ITERATIONS))
    return found


def _cost(scene: Scene, camera: Camera, loss_px: float, limit_px: float) -> float:
    errors = np.minimum(errors_px(scene, camera), limit_px)
    used = errors[scene.structure.used]
    return float(loss_px**2 * np.mean(np.log1p(used**2 / loss_px**2)))
