# SPDX-License-Identifier: Apache-2.0
"""What somebody knows of the camera, as measurements beside the turns: known.* of the settings."""
from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.judge.calibration import Known
from dashcalib_ros.solve.solution import Solution, with_measurement

# sigmas; knowledge that is farther from what the turns say, or one turn, does not count
CONTRADICTED, CONTRADICTED_BY_ONE = 3.0, 6.0
# of what is given without a sigma: of a value; s of a shutter
EXACT, EXACT_S = 1e-4, 1e-5
# of a parameter, for differences
STEP = 1e-5


def with_known(solution: Solution, config: Config, px: float
               ) -> tuple[Solution, tuple[Known, ...]]:
    """Return the solution with what is known, and what each piece of it contributed.

    px: of the input's pictures, in one pixel of the solution.
    """
    # pycolmap may start here: the node imports this module, and must not
    from dashcalib_ros.solve.start import scene_with
    found = []
    for name in ('fx', 'hfov', 'aspect', 'shutter'):
        text = getattr(config.known, name)
        if not text:
            continue
        value, sigma = _value(text, name)
        own, along = _by_turns(solution, name, px)
        variance = float(along @ solution.posterior.covariance @ along)
        limit = CONTRADICTED if len(solution.scenes) > 1 else CONTRADICTED_BY_ONE
        used = abs(value - own) <= limit * float(np.hypot(sigma, np.sqrt(variance)))
        before = float(solution.sigma[0])
        if used:
            solution = with_measurement(solution, along, value - own, sigma**2)
        found.append(Known(name, value, sigma, own, float(np.sqrt(variance)), used,
                           px * before, px * float(solution.sigma[0])))
    if any(piece.used for piece in found):
        scenes = [scene_with(solution.camera, scene, config) for scene in solution.scenes]
        solution = replace(solution, scenes=tuple(
            new or old for new, old in zip(scenes, solution.scenes, strict=True)))
    return solution, tuple(found)


def _value(text: str, name: str) -> tuple[float, float]:
    numbers = [float(number) for number in re.findall(r'\d+\.?\d*', text)]
    if name == 'shutter':
        value, sigma = ([each / 1e3 for each in numbers] + [0.0, 0.0])[:2]
        return value, sigma or EXACT_S
    return numbers[0], numbers[1] if len(numbers) > 1 else EXACT * numbers[0]


def _by_turns(solution: Solution, name: str, px: float) -> tuple[float, Floats]:
    """Return what the turns say, and (m,) how it follows what they share."""
    if name == 'shutter':
        # behind the lens
        count = len(solution.posterior.lens.params)
        return solution.readout_s, np.eye(len(solution.posterior.prior.score))[count]
    of: Callable[[Camera], float] = {'fx': lambda camera: px * camera.fx, 'hfov': _hfov_deg,
                                     'aspect': lambda camera: camera.fy / camera.fx}[name]
    params, slopes = solution.camera.params, []
    for place, value in enumerate(params):
        step = np.zeros(len(params))
        step[place] = STEP * max(abs(value), 1.0)
        slopes.append((of(solution.camera.with_params(params + step))
                       - of(solution.camera.with_params(params - step))) / (2 * step[place]))
    return of(solution.camera), np.asarray(np.array(slopes) @ solution.written.by_solution)


def _hfov_deg(camera: Camera) -> float:
    """Return the angle from the left edge to the right one, through the principal point."""
    edges = np.array([[-0.5, camera.cy], [camera.image_size[0] - 0.5, camera.cy]])
    left, right = camera.rays(edges)
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(left, right)), left @ right)))
