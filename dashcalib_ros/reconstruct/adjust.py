# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of scenes that share one camera: what of them is free, and what counts."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import SceneConfig
from dashcalib_ros.problem.blocks import Imaging, Lens
from dashcalib_ros.problem.observations import Stretch
from dashcalib_ros.problem.steps import FIRST_RADIUS, State, Stepping, optimised
from dashcalib_ros.reconstruct.scene import Scene, retriangulated

# steps of one adjustment at most; 60 move fx by at most 0.03 %, in twice the time
MAX_ITERATIONS = 12
# no lens has a coefficient beyond this: the scene has diverged
MAX_DISTORTION = 1.0
# relative change of the cost that ends an adjustment which another one follows, or whose cost is
# only compared
ROUGH = 1e-3
# cosine (88 degrees); points beside or behind the camera are triangulated anew afterwards
IN_FRONT = 0.035
# coefficients of distortion that one turn determines
FIRST_COEFFICIENTS = 2

# What of the camera is free beside poses and points. 'first distortion': the first coefficients,
# the others stay as they are; 'one focal length': fx = fy with them
Free = Literal['nothing', 'first distortion', 'distortion', 'one focal length']


@dataclass(frozen=True)
class Solver:
    """How to adjust. loss_px: scale of the Cauchy loss, about twice the noise of a track.

    tolerance: relative change of the cost that ends it; iterations: steps at most.
    """

    loss_px: float = 1.0
    iterations: int = 30
    tolerance: float = 1e-5


def adjust(scenes: Sequence[Scene], camera: Camera, solver: Solver, free: Free,
           focal_range: tuple[float, float] | None = None) -> tuple[list[Scene], Camera]:
    """Adjust poses, points and what is free of the camera's n parameters; the others are fixed.

    focal_range: px, lowest and highest, for one focal length. Scenes without observations stay as
    they are.
    """
    parts = _in_front(scenes)
    moving = tuple(part for part in parts if part.structure.used.any())
    if not moving:
        return list(scenes), camera
    found = optimised(
        State(Imaging.of(_lens(camera, free, focal_range)), moving),
        Stepping(solver.loss_px, solver.iterations, unit=1.0, tolerance=solver.tolerance,
                 radius=FIRST_RADIUS))
    moved = iter(found.stretches)
    return _projected([_with_structure_of(next(moved), scene) if part.structure.used.any()
                       else scene for scene, part in zip(scenes, parts, strict=True)],
                      found.camera), found.camera


def _lens(camera: Camera, free: Free, focal_range: tuple[float, float] | None) -> Lens:
    if free == 'nothing':
        return Lens(camera, held=True)
    count = len(camera.params)
    bounds = np.array([np.full(count, -np.inf), np.full(count, np.inf)])
    bounds[:, 4:] = [[-MAX_DISTORTION], [MAX_DISTORTION]]
    directions = np.eye(count)[:, 4:count if free == 'distortion' else 4 + FIRST_COEFFICIENTS]
    if free == 'one focal length':
        both = np.isin(np.arange(count), (0, 1)).astype(np.float64)
        directions = np.column_stack([both, directions])
        bounds[:, :2] = np.reshape(focal_range or (0.0, np.inf), (2, 1))
        camera = camera.with_focal(camera.fx)
    return Lens(camera.with_params(np.clip(camera.params, *bounds)), directions, bounds)


def refined(scene: Scene, config: SceneConfig, reach: tuple[float, float] | None,
            tolerance: float = ROUGH) -> Scene:
    """Return the scene after an adjustment and triangulation."""
    solver = Solver(config.loss_px, MAX_ITERATIONS, tolerance)
    free: Free = 'first distortion' if reach is None else 'one focal length'
    [scene], camera = adjust([scene], scene.camera, solver, free, reach)
    return retriangulated(scene, camera, config.error_px, config.min_angle_deg)


def _in_front(scenes: Sequence[Scene]) -> list[Scene]:
    """Return the scenes with those observations only that are adjusted.

    Points that are left with fewer than two do not move; they are triangulated anew afterwards.
    """
    found = []
    for scene in scenes:
        structure = scene.structure
        local = structure.local
        ahead = local[:, :, 2] > IN_FRONT * np.linalg.norm(local, axis=2)
        used = structure.used & ahead
        used &= used.sum(axis=0) >= 2
        found.append(replace(scene, structure=replace(structure, used=used)))
    return found


def _projected(scenes: Sequence[Scene], camera: Camera) -> list[Scene]:
    """Return the scenes without the observations of points that are behind the camera now.

    They have no residual: one is enough to make noise and sigma NaN.
    """
    found = []
    for scene in scenes:
        used = scene.structure.used.copy()
        ahead = np.isfinite(camera.project(scene.structure.local[used])).all(axis=1)
        if not ahead.all():
            used[used] = ahead
            scene = replace(scene, structure=replace(scene.structure, used=used))
        found.append(scene)
    return found


def _with_structure_of(moved: Stretch, scene: Scene) -> Scene:
    found = moved.structure
    return replace(scene, structure=replace(
        scene.structure, rotations=found.rotations, translations=found.translations,
        points=found.points))
