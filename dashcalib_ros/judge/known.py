# SPDX-License-Identifier: Apache-2.0
"""What somebody knows about the camera (known.*), as measurements beside the turns."""
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

# of a solution: the height of its camera above the road and its sigma, m; None: not measured
Height = Callable[[Solution], tuple[float, float] | None]

# sigmas; knowledge that is farther from what the turns say, or one turn, does not count
CONTRADICTED, CONTRADICTED_BY_ONE = 3.0, 6.0
# of what is given without a sigma: of a value; s of a shutter
EXACT, EXACT_S = 1e-4, 1e-5
# of a parameter, for differences
STEP = 1e-5
# of fx: the least and the largest by which it is changed, to see how the height follows
LEAST_CHANGE, LARGEST_CHANGE = 0.02, 0.2


def with_known(solution: Solution, config: Config, px: float, height: Height = lambda found: None
               ) -> tuple[Solution, tuple[Known, ...]]:
    """Return the solution with what is known, and what each piece of it contributed.

    px: of the input's pictures, in one pixel of the solution. A known height is left out where the
    drive does not show the height.
    """
    # pycolmap may start here: the node imports this module, and must not
    from dashcalib_ros.solve.start import scene_with
    found, by_turns = [], solution

    def adjusted(moved: Solution) -> Solution:
        """Return a solution whose scenes are those of its camera."""
        scenes = [scene_with(moved.camera, scene, config) for scene in moved.scenes]
        return replace(moved, scenes=tuple(
            new or old for new, old in zip(scenes, moved.scenes, strict=True)))

    for name in ('fx', 'hfov', 'aspect', 'shutter', 'height'):
        text = getattr(config.known, name)
        if not text:
            continue
        value, sigma = value_of(text, name)
        said = (_by_road(solution, value, height, adjusted) if name == 'height' else
                (*_by_turns(solution, name, px), 0.0))
        if said is None:
            continue
        own, along, own_sigma = said
        by_turns_sigma = float(np.hypot(
            own_sigma, np.sqrt(along @ solution.posterior.covariance @ along)))
        limit = CONTRADICTED if len(solution.scenes) > 1 else CONTRADICTED_BY_ONE
        used = abs(value - own) <= limit * float(np.hypot(sigma, by_turns_sigma))
        before = float(solution.sigma[0])
        if used:
            solution = with_measurement(solution, along, value - own, sigma**2 + own_sigma**2)
        found.append(Known(name, value, sigma, own, by_turns_sigma, used, px * before,
                           px * float(solution.sigma[0])))
    if any(piece.used for piece in found):
        solution = replace(adjusted(solution), by_turns=by_turns)
    return solution, tuple(found)


def value_of(text: str, name: str) -> tuple[float, float]:
    """Return a value and its sigma, as a setting known.* with this name has them."""
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


def _by_road(solution: Solution, known_m: float, height: Height,
             adjusted: Callable[[Solution], Solution]) -> tuple[float, Floats, float] | None:
    """Return the height that the drive shows, m, how it follows what turns share, its own sigma.

    None where it shows none. With a longer focal length the same pictures show the road closer
    below the camera. fx is changed by as much as the known height asks for, and the other
    parameters follow it as the turns let them.
    """
    seen = height(solution)
    if seen is None:
        return None
    by_solution = solution.written.by_solution
    follow = by_solution @ solution.posterior.covariance @ by_solution[0]
    share = seen[0] / known_m - 1
    share = float(np.copysign(np.clip(abs(share), LEAST_CHANGE, LARGEST_CHANGE), share))
    step = follow / follow[0] * share * solution.camera.fx
    there = height(adjusted(replace(solution, written=replace(
        solution.written, camera=solution.camera.with_params(solution.camera.params + step)))))
    if there is None:
        return None
    return seen[0], by_solution[0] * (there[0] - seen[0]) / step[0], seen[1]


def _hfov_deg(camera: Camera) -> float:
    """Return the angle from the left edge to the right one, through the principal point."""
    edges = np.array([[-0.5, camera.cy], [camera.image_size[0] - 0.5, camera.cy]])
    left, right = camera.rays(edges)
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(left, right)), left @ right)))
