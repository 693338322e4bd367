"""Solution -> verdict: every rule by which a result is refused or called weak.

Registered images and residuals do not separate good solutions from bad ones; the focal profile,
the yaw, the agreement of the turns and the sigmas do. A new rule is a function here and a row in
RULES.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dashcalib_ros.config import VerdictConfig
from dashcalib_ros.judgement.agreement import (
    focal_disagreement,
    leverages,
    turns_of_another_camera,
)
from dashcalib_ros.judgement.calibration import Verdict
from dashcalib_ros.solve.departures import Departure
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.turns.turn import TurnId

# of the range between its bounds; a parameter nearer to one of them counts as lying on it
ON_BOUND = 0.01


@dataclass(frozen=True)
class Finding:
    """A rule's objection to a solution: the verdict it leads to, and the reason, with a cure."""

    level: Literal['weak', 'refused']
    text: str


def judge(solution: Solution, config: VerdictConfig) -> Verdict:
    """Return the verdict on a solution, its reasons sorted: those that refuse it come first."""
    findings = [found for rule in RULES if (found := rule(solution, config)) is not None]
    if not findings:
        return Verdict('accepted')
    findings.sort(key=lambda found: found.level != 'refused')
    return Verdict(findings[0].level, tuple(found.text for found in findings))


def _too_few_turns(solution: Solution, config: VerdictConfig) -> Finding | None:
    count = len(solution.scenes)
    if count >= config.min_turns:
        return None
    return Finding('weak', f'only {count} of at least {config.min_turns} turns could be used: '
                           f'drive more turns')


def _too_little_yaw(solution: Solution, config: VerdictConfig) -> Finding | None:
    yaw = sum(scene.yaw_deg for scene in solution.scenes)
    return _graded(
        yaw < config.refused_yaw_deg, yaw < config.min_yaw_deg,
        f'the turns add up to {yaw:.0f} degrees of yaw only: drive sharper turns')


def _flat_profile(solution: Solution, config: VerdictConfig) -> Finding | None:
    """The cost must rise on both sides of its minimum, or the focal length is not observable."""
    contrast = profile_contrast(solution)
    return _graded(
        # written with not: a contrast of NaN is refused, too
        not contrast >= config.refused_contrast, contrast < config.min_contrast,
        f'the turns hardly tell one focal length from another (the error rises by '
        f'{100 * max(contrast, 0.0):.1f} % when it is 20 % off): drive sharper turns in daylight')


def profile_contrast(solution: Solution) -> float:
    """Return the relative rise of the cost from the result to the lowest of the other probes.

    Negative when another focal length explains the observations better than the result.
    """
    at = _index_of_result(solution)
    costs = solution.around.costs
    return float(np.delete(costs, at).min() / costs[at] - 1)


def _index_of_result(solution: Solution) -> int:
    """Return the index of the profile's probe at the resulting focal length."""
    ratio = solution.camera.fx / solution.camera.image_size[0]
    return int(np.argmin(np.abs(solution.around.ratios - ratio)))


def _far_from_profile(solution: Solution, config: VerdictConfig) -> Finding | None:
    best = solution.around.best * solution.camera.image_size[0]
    if np.isclose(best, solution.camera.fx):
        return None
    return Finding('refused', f'the focal length {solution.camera.fx:.0f} px contradicts the one '
                              f'that explains most observations, about {best:.0f} px')


def _sigma_too_large(solution: Solution, config: VerdictConfig) -> Finding | None:
    relative = float(solution.sigma[0] / solution.camera.fx)
    return _graded(
        not np.isfinite(relative) or relative > config.refused_sigma, relative > config.max_sigma,
        f'fx is uncertain by {100 * relative:.1f} %: more or sharper turns are needed')


def _one_turn_dominates(solution: Solution, config: VerdictConfig) -> Finding | None:
    """If one turn gives nearly all information about fx, the others cannot confirm it."""
    shares = leverages(solution)
    turn = max(shares, key=lambda turn: shares[turn])
    if len(shares) < 2 or shares[turn] <= config.max_leverage:
        return None
    return Finding('weak', f'{_turns([turn])} alone gives {100 * min(shares[turn], 1.0):.0f} '
                           f'% of the information about fx: drive another turn that is as sharp')


def _turns_disagree(solution: Solution, config: VerdictConfig) -> Finding | None:
    """Compare the values of fx that the turns would give separately."""
    spread = focal_disagreement(solution)
    if spread <= config.max_disagreement:
        return None
    return Finding('weak', f'the turns disagree about fx by {100 * spread:.1f} %: was the camera '
                           f'moved, or is there much traffic?')


def _other_camera(solution: Solution, config: VerdictConfig) -> Finding | None:
    turns = sorted(turns_of_another_camera(solution.misfits, config))
    if not turns:
        return None
    fit = f'{_turns(turns)} fit{"s" * (len(turns) == 1)}'
    return Finding('weak', f'{fit} another camera far better than the one of the other turns: was '
                           f'the camera zoomed or exchanged, or its picture cropped?')


def _turns(turns: list[TurnId]) -> str:
    """Return the turns' names, for messages."""
    own = [str(turn.number) for turn in turns if turn.of_this_drive]
    stored = len(turns) - len(own)
    names = []
    if own:
        names.append(f'the turn{"s" * (len(own) > 1)} at frame {", ".join(own)}')
    if stored:
        names.append(f'{stored} turn{"s" * (stored > 1)} of earlier drives')
    return ' and '.join(names)


def _not_fixed(solution: Solution, config: VerdictConfig) -> Finding | None:
    """Name what no fixed camera does; a stabilised video's movement may have been taken out."""
    clear = [each for each in solution.departures if each.clear]
    if not clear:
        return None
    return Finding('weak', _departure_text(clear[0], solution))


def _departure_text(departure: Departure, solution: Solution) -> str:
    if departure.kind == 'shift':
        share = 100 * departure.size / solution.camera.image_size[0]
        return (f'the picture moves against the lens by about {share:.1f} % of its width, as that '
                f'of a stabilised video does: switch the stabiliser off')
    if departure.kind == 'bend':
        return (f'the picture is bent locally, as no lens of the model {solution.camera.model} '
                f'bends it: is there a windscreen or a cover that does so, or another kind of '
                f'lens?')
    zooms = departure.by_turn
    larger = sorted(turn for turn, zoom in zooms.items() if zoom > np.mean(list(zooms.values())))
    apart = max(zooms.values()) - min(zooms.values())
    if apart < departure.size:
        return (f'the zoom changes from image to image, by about {100 * departure.size:.1f} %: '
                f'fix the zoom and the focus')
    return (f'the zoom changes by about {100 * apart:.1f} %: it is larger in {_turns(larger)} '
            f'than in the others; fix the zoom and the focus')


def _strange_aspect(solution: Solution, config: VerdictConfig) -> Finding | None:
    """A rolling shutter that was not removed changes fy first."""
    aspect = solution.camera.fy / solution.camera.fx
    if abs(aspect - 1) <= config.max_aspect:
        return None
    return Finding('weak', f'fy is {100 * (aspect - 1):+.1f} % off fx, more than pixels are out '
                           f'of square: a decentred lens or a strong rolling shutter looks like '
                           f'this')


def _strange_shutter(solution: Solution, config: VerdictConfig) -> Finding | None:
    readout_ms = 1e3 * abs(solution.readout_s)
    if readout_ms <= config.max_readout_ms:
        return None
    return Finding('weak', f'the rows seem to be exposed over {readout_ms:.0f} ms, longer than '
                           f'rolling shutters are: are the stamps right?')


def _on_bound(solution: Solution, config: VerdictConfig) -> Finding | None:
    low, high = solution.bounds
    share = (solution.camera.params - low) / (high - low)
    names = [name for name, value in zip(solution.camera.names(), share, strict=True)
             if not ON_BOUND < value < 1 - ON_BOUND]
    if not names:
        return None
    return Finding('weak', f'{", ".join(names)} reached the bound: do not trust the scene')


def _folds_over(solution: Solution, config: VerdictConfig) -> Finding | None:
    if solution.camera.covers_picture():
        return None
    return Finding('weak', 'the distortion folds over inside the picture: points near its corners '
                           'are missing')


def _graded(refused: bool, weak: bool, text: str) -> Finding | None:
    """Return a finding of the graver condition that holds, None if neither does."""
    if refused:
        return Finding('refused', text)
    return Finding('weak', text) if weak else None


RULES: tuple[Callable[[Solution, VerdictConfig], Finding | None], ...] = (
    _too_few_turns, _too_little_yaw, _flat_profile, _far_from_profile, _sigma_too_large,
    _one_turn_dominates, _turns_disagree, _other_camera, _not_fixed, _strange_aspect,
    _strange_shutter, _on_bound, _folds_over)
