"""What one more turn would bring: the sigma of fx that a calibration with it would state."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from dashcalib_ros.judge.agreement import leverages
from dashcalib_ros.solve.solution import Solution

# of fx; a larger sigma helps nobody to decide
TOLD = 0.2


def next_turn(solution: Solution) -> str:
    """Return what one more turn would bring, in words; '' where nobody can tell."""
    # how much two turns differ is chance; so a single one is told what two more bring
    more = 1 if len(solution.known.turns) > 1 else 2
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
    known, shares = solution.known, leverages(solution)
    best = known.turns[max(range(len(known.turns)),
                           key=lambda n: shares[solution.scenes[n].turn])]
    another = replace(best, score=np.zeros_like(best.score))
    later = replace(known, turns=(*known.turns, *[another] * more))
    own = replace(known, floor=np.zeros_like(known.floor)).own_covariance[0, 0]
    # information grows, and all that makes turns differ goes down with it
    after = own * later.total.covariance[0, 0] / known.total.covariance[0, 0]
    step = float(later.step_to_wider_model[0])
    return float(np.sqrt(after + step**2 + known.floor[0]**2) / solution.camera.fx)
