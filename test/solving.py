"""Made scenes, solved."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from synthetic import LENS, SIZE, synthetic_turn

from dashcalib_ros.camera import Camera, Radial
from dashcalib_ros.camera.camera import Prior
from dashcalib_ros.config import Config
from dashcalib_ros.reconstruct.adjust import Solver, adjust
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.joint import solve
from dashcalib_ros.solve.prior import extra_sigma_of
from dashcalib_ros.solve.solution import Solution

CONFIG = Config().replace({'intrinsics.profile_tracks': 60})
START = Radial.centred(SIZE, 1.03 * LENS.fx, -0.25)
YAWS = (80.0, -70.0, 85.0, -90.0, 65.0, -78.0)
NO_PRIOR = Prior(LENS.params, np.diag([1e9, 1e9, 1e9, 1e9, 1e6, 1e6]))
FREE = (LENS.params - [200, 200, 100, 100, 1, 1], LENS.params + [200, 200, 100, 100, 1, 1])
NOTHING = np.zeros((6, 6))
# what p1, p2 and k3 of real lenses are like
EXTRA = extra_sigma_of(LENS)


def scenes_of(count: int, camera: Camera = LENS, seed: int = 0, start: Camera = START,
              **options) -> list[Scene]:
    options = {'tracks': 180, 'keyframes': 14, 'noise_px': 0.25, **options}
    return [synthetic_turn(camera, yaw, seed=seed, world=world, **options).scene(start, world)
            for world, yaw in enumerate(YAWS[:count])]


def solved(scenes: Sequence[Scene], config: Config = CONFIG) -> Solution:
    solution = solve(scenes, config)
    assert solution is not None
    return solution


def z_of(solution: Solution, truth: Camera = LENS) -> np.ndarray:
    return (solution.camera.params - truth.params) / solution.sigma


def adjusted(scenes: list[Scene], loss_px: float, rounds: int = 1) -> tuple[list[Scene], Camera]:
    camera = LENS
    for _ in range(rounds):
        scenes, camera = adjust(scenes, camera, Solver(loss_px, 200, 1e-14), 'everything',
                                prior=NO_PRIOR, bounds=FREE)
    return scenes, camera
