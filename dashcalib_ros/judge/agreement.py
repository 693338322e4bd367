"""Whether the turns agree on one camera, and how much each of them contributes to fx."""
from __future__ import annotations

from collections.abc import Mapping, Sequence, Set

import numpy as np

from dashcalib_ros.config import VerdictConfig
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.solution import Solution

# least sum of the turns' shares in the information about fx: avoids a division by zero
LEAST_SHARE = 1e-9


def turns_of_another_camera(misfits: Mapping[TurnId, float], config: VerdictConfig) -> set[TurnId]:
    """Return the turns that their own camera explains far better than the shared one.

    The robust loss gives such turns so little weight that they cause no scatter between turns.
    """
    return {turn for turn, misfit in misfits.items() if not misfit <= config.max_misfit}


def evidence_of(solution: Solution | None, config: VerdictConfig) -> set[TurnId]:
    """Return the turns to keep for the next solution: those used, and those of another camera.

    Without the latter the next verdict would not mention that the camera changed.
    """
    if solution is None:
        return set()
    of_another = turns_of_another_camera(solution.misfits, config)
    return {scene.turn for scene in solution.scenes} | of_another


def earlier_of_another_camera(scenes: Sequence[Scene], solution: Solution | None
                              ) -> set[TurnId]:
    """Return the given turns of earlier drives that solve() left out, as this drive says."""
    if solution is None:
        return set()
    return {scene.turn for scene in scenes
            if not scene.turn.of_this_drive and scene.turn not in solution.misfits}


def outdated(turns: Set[TurnId], of_another: Set[TurnId]) -> set[TurnId]:
    """Return the turns that are not of the present camera, judged by this drive's newest two.

    of_another: those of the turns that fit another camera. If the newest turn is not among them,
    they are outdated. If the newest two are, the camera has changed and all others are outdated.
    If only the newest is, nothing is outdated: its misfit may come from traffic.
    """
    # the stored turns of earlier drives have no order in time
    newest = sorted(turn for turn in turns if turn.of_this_drive)[-2:]
    if newest and newest[-1] not in of_another:
        return set(of_another)
    return set(turns - of_another) if len(newest) == 2 and of_another >= set(newest) else set()


def focal_disagreement(solution: Solution) -> float:
    """Return the weighted scatter between the turns' own fx, relative to fx."""
    known = solution.known
    if len(known.turns) < 2:
        return 0.0
    weights, offsets = [], []
    for turn, cost in zip(known.turns, known.each(known.own), strict=True):
        alone = known.with_prior([cost]).covariance
        offsets.append(float((alone @ turn.score[known.own])[0] / known.noise))
        weights.append(1 / float(alone[0, 0]))
    mean = np.average(offsets, weights=weights)
    scatter = np.average((np.array(offsets) - mean) ** 2, weights=weights)
    return float(np.sqrt(scatter) / solution.camera.fx)


def leverages(solution: Solution) -> dict[TurnId, float]:
    """Return each turn's share in the information about fx; the shares sum to 1."""
    known = solution.known
    turns = known.each(known.own)
    together = known.with_prior(turns).covariance
    shares = [float((together @ turn.hessian)[0, 0]) for turn in turns]
    # they sum to less than 1: the prior has the rest
    total = max(sum(shares), LEAST_SHARE)
    return {scene.turn: share / total
            for scene, share in zip(solution.scenes, shares, strict=True)}
