"""What turns say of fx: each alone, and the first few of them together."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.solve.solution import Solution


@dataclass(frozen=True)
class FocalEstimate:
    """fx and its standard deviation, px of the scenes' images."""

    fx: float
    sigma: float


def focal_alone(solution: Solution, with_field: bool = True) -> dict[TurnId, FocalEstimate]:
    """Return what each turn says of fx alone, linearised at the common result.

    A field is fixed, as it is shared; with_field: False leaves it in the tracks. Sigma cannot hold
    how much turns differ: one turn does not show that.
    """
    known, found = replace(solution.known, one_turn_sigma=0.0), {}
    to_no_field = np.zeros(len(known.turns[0].score))
    if not with_field and solution.field is not None and solution.field.used:
        directions = solution.field.directions
        to_no_field[-len(directions):] = -directions
    for n, scene in enumerate(solution.scenes):
        alone = known.of([n])
        own = alone.with_prior(alone.each(known.own)).covariance
        score = alone.turns[0].moved(to_no_field).score[known.own]
        offset = float(own[0] @ score / alone.noise)
        found[scene.turn] = FocalEstimate(solution.camera.fx + offset,
                                          float(np.sqrt(alone.covariance[0, 0])))
    return found


def sigma_by_count(solution: Solution) -> list[float]:
    """Return the sigma of fx with the first turn, with the first two, ... and with all, px."""
    return [float(np.sqrt(solution.known.of(range(count)).covariance[0, 0]))
            for count in range(1, len(solution.known.turns) + 1)]
