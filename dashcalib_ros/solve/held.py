"""Turns explained by a given camera: it is held, poses and points are adjusted anew."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config, SceneConfig
from dashcalib_ros.reconstruct.adjust import Solver, adjust_poses
from dashcalib_ros.reconstruct.scene import Scene, errors_px, truncated_cost
from dashcalib_ros.solve.fitting import is_far, rechain, retriangulate
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

    It is triangulated, and also chained anew where its own camera is far from this one, and
    adjusted with the camera held: the better one counts, as a chain may break where images are
    lost. The first rounds are generous: the camera may be wrong.
    """
    width = camera.image_size[0]
    generous = replace(config.scene, error_px=max(config.scene.error_px,
                                                  config.scene.chain_error * width))
    anew = (rechain(scene, camera, replace(config, scene=generous)) if is_far(scene, camera)
            else None)
    found = [_held(camera, each, generous, config) for each in (scene, anew) if each is not None]
    return min((each for each in found if each is not None), default=None,
               key=lambda each: truncated_cost(each, camera, config.scene.error_px))


def _held(camera: Camera, found: Scene, generous: SceneConfig, config: Config) -> Scene | None:
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
