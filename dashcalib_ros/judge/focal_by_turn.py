"""What turns say of fx: each alone, and the first few of them together."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.solve.information import Information, noise_of, step_to_wider_model
from dashcalib_ros.solve.picture import picture_covariance
from dashcalib_ros.solve.prior import extra_sigma_of
from dashcalib_ros.solve.solution import Solution


@dataclass(frozen=True)
class FocalEstimate:
    """fx and its standard deviation, px of the scenes' images."""

    fx: float
    sigma: float


def focal_alone(solution: Solution) -> dict[TurnId, FocalEstimate]:
    """Return what each turn says of fx alone, linearised at the common result.

    A field is held, as it is shared. Sigma cannot hold how much turns differ: one turn does not
    show that.
    """
    found, count = {}, len(solution.prior_information)
    for scene, part in zip(solution.scenes, solution.parts, strict=True):
        noise = noise_of([part])
        inverse = np.linalg.inv(part.hessian[:count, :count] / noise + solution.prior_information)
        offset = float(inverse[0] @ part.score[:count] / noise)
        found[scene.turn] = FocalEstimate(solution.camera.fx + offset,
                                          _sigma([part], solution, 0.0))
    return found


def sigma_by_count(solution: Solution) -> list[float]:
    """Return the sigma of fx with the first turn, with the first two, ... and with all, px."""
    return [_sigma(solution.parts[:count], solution, solution.one_turn_sigma)
            for count in range(1, len(solution.parts) + 1)]


def _sigma(parts: Sequence[Information], solution: Solution, one_turn_sigma: float) -> float:
    """Return the sigma of fx from some of the turns, px, as that of all turns is found."""
    step = step_to_wider_model(parts, solution.prior_information, extra_sigma_of(solution.camera))
    found = picture_covariance(solution.camera, parts, solution.prior_information, solution.floor,
                               step, solution.systematic, one_turn_sigma)
    return float(np.sqrt(found[0, 0]))
