"""What one more turn would bring: the sigma of fx that a calibration with it would state."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from dashcalib_ros.judge.agreement import leverages
from dashcalib_ros.solve.information import pooled, step_to_wider_model
from dashcalib_ros.solve.picture import picture_covariance
from dashcalib_ros.solve.prior import extra_sigma_of
from dashcalib_ros.solve.solution import Solution

# of fx; a larger sigma helps nobody to decide
TOLD = 0.2


def next_turn(solution: Solution) -> str:
    """Return what one more turn would bring, in words; '' where nobody can tell."""
    # how much two turns differ is chance; so a single one is told what two more bring
    more = 1 if len(solution.parts) > 1 else 2
    sigma = with_right_angles(solution, more)
    if not sigma < TOLD:
        return ''
    # one digit is all that is known
    return (f'{("one more right angle", "two more right angles")[more - 1]}: fx to about '
            f'{float(f"{100 * sigma:.1g}"):g} %')


def with_right_angles(solution: Solution, more: int) -> float:
    """Return the sigma of fx, of fx, that a calibration with more right angles would state.

    Each is taken to know as much as the turn here that knows most, and turns to differ as they do
    here. How much a single turn differs is not known: it is taken to be its own sigma.
    """
    parts, prior, camera = solution.parts, solution.prior_information, solution.camera
    shares = leverages(solution)
    best = max(range(len(parts)), key=lambda n: shares[solution.scenes[n].turn])
    another = replace(parts[best], score=np.zeros_like(parts[best].score))
    later = [*parts, *[another] * more]
    nothing = np.zeros(parts[0].lens)
    own = picture_covariance(camera, parts, prior, np.zeros(len(prior)), nothing,
                             solution.systematic)[0, 0]
    # information grows, and all that makes turns differ goes down with it
    after = own * pooled(later, prior).inverse[0, 0] / pooled(parts, prior).inverse[0, 0]
    step = float(step_to_wider_model(later, prior, extra_sigma_of(camera))[0])
    return float(np.sqrt(after + step**2 + solution.floor[0]**2) / camera.fx)
