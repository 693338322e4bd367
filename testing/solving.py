# SPDX-License-Identifier: Apache-2.0
"""Made scenes, solved."""
from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from synthetic import LENS, SIZE, synthetic_turn

from dashcalib_ros.camera import Camera, Radial
from dashcalib_ros.config import Config
from dashcalib_ros.input.motion import Samples
from dashcalib_ros.problem.quadratic import Quadratic
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution

CONFIG = Config().replace({'intrinsics.profile_tracks': 60})
START = Radial.centred(SIZE, 1.03 * LENS.fx, -0.25)
YAWS = (80.0, -70.0, 85.0, -90.0, 65.0, -78.0)


def scenes_of(count: int, camera: Camera = LENS, seed: int = 0, start: Camera = START,
              **options) -> list[Scene]:
    options = {'tracks': 180, 'keyframes': 14, 'noise_px': 0.25, **options}
    return [synthetic_turn(camera, yaw, seed=seed, world=world, **options).scene(start, world)
            for world, yaw in enumerate(YAWS[:count])]


def solved(scenes: Sequence[Scene], config: Config = CONFIG, temperature: Samples | None = None
           ) -> Solution:
    solution = solve(scenes, config, temperature)
    assert solution is not None
    return solution


def remembered(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with its results kept, where the same is asked again and again."""
    kept: dict[bytes, bytes] = {}

    def call(*arguments: Any) -> Any:
        key = pickle.dumps(arguments)
        if key not in kept:
            kept[key] = pickle.dumps(function(*arguments))
        return pickle.loads(kept[key])

    return call


def z_of(solution: Solution, truth: Camera = LENS) -> np.ndarray:
    """Return how many sigmas each parameter is off; those that truth's model lacks are 0."""
    more = len(solution.camera.params) - len(truth.params)
    return (solution.camera.params - np.pad(truth.params, (0, more))) / solution.sigma


def with_camera(solution: Solution, camera: Camera) -> Solution:
    """Return the solution as if this camera were the written one."""
    return replace(solution, written=replace(solution.written, camera=camera))


def with_covariance(solution: Solution, covariance: np.ndarray) -> Solution:
    """Return the solution as if this were the covariance (n, n) of its camera."""
    loose = solution.written.loose + covariance - solution.covariance
    return replace(solution, written=replace(solution.written, loose=loose))


def with_turns(solution: Solution, turns: Sequence[Quadratic]) -> Solution:
    """Return the solution as if its turns knew this."""
    return replace(solution, posterior=replace(solution.posterior, turns=tuple(turns)))


def only(solution: Solution, places: Sequence[int]) -> Solution:
    """Return the solution as if only these turns had been there."""
    return replace(solution, scenes=tuple(solution.scenes[n] for n in places),
                   posterior=solution.posterior.of(places))
