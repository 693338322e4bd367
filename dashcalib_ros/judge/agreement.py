"""Whether the turns agree on one camera, and what each of them, and one more, tells of fx."""
from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

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
    own = replace(known, floor=np.zeros_like(known.floor),
                  turns_err_alike=False).own_covariance[0, 0]
    lasting = known.own_covariance[0, 0] - own
    # information grows, and all that makes turns differ goes down with it
    after = own * later.total.covariance[0, 0] / known.total.covariance[0, 0]
    step = float(later.step_to_wider_model[0])
    return float(np.sqrt(after + step**2 + lasting) / solution.camera.fx)
