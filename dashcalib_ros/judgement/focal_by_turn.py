"""What turns say of fx: each alone, and the first few of them together."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.config import Config
from dashcalib_ros.solve.information import Information, covariance, pooled
from dashcalib_ros.solve.prior import extra_sigma_of, floor_of
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.turns.turn import TurnId


@dataclass(frozen=True)
class FocalEstimate:
    """fx and its standard deviation, px of the scenes' images."""

    fx: float
    sigma: float


def focal_alone(solution: Solution, config: Config) -> dict[TurnId, FocalEstimate]:
    """Return what each turn says of fx alone, linearised at the common result.

    Sigma cannot hold how much turns differ: one turn does not show that.
    """
    found = {}
    for scene, part in zip(solution.scenes, solution.parts, strict=True):
        alone = pooled([part], solution.prior_information)
        offset = float((alone.inverse @ alone.scores[0])[0])
        found[scene.turn] = FocalEstimate(solution.camera.fx + offset,
                                          _sigma([part], solution, config))
    return found


def sigma_by_count(solution: Solution, config: Config) -> list[float]:
    """Return the sigma of fx with the first turn, with the first two, ... and with all, px."""
    return [_sigma(solution.parts[:count], solution, config)
            for count in range(1, len(solution.parts) + 1)]


def _sigma(parts: Sequence[Information], solution: Solution, config: Config) -> float:
    """Return the sigma of fx from some of the turns, px, as that of all turns is found."""
    floor = floor_of(solution.camera, config.intrinsics)[0]
    found = covariance(parts, solution.prior_information, extra_sigma_of(solution.camera),
                       solution.systematic)
    return float(np.sqrt(found[0, 0] + floor**2))
