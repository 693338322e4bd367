"""Scenes and solution -> verdict: every rule by which a result is refused or called weak.

Registration and residuals do not tell garbage from a calibration; the focal profile, the yaw, the
agreement of the turns and the sigmas do.
"""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dashcalib_ros.config import VerdictConfig
from dashcalib_ros.intrinsics.agreement import focal_disagreement, leverages, strangers
from dashcalib_ros.intrinsics.calibration import Verdict
from dashcalib_ros.intrinsics.solution import Solution

NAMES = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2')
# a parameter this near to its bound, as a share of the range, lies on it
ON_BOUND = 0.01


def judge(solution: Solution, config: VerdictConfig) -> Verdict:
    """Return the verdict on a solution, with every reason against it."""
    rules: tuple[Callable[[Solution, VerdictConfig], tuple[list[str], list[str]]], ...] = (
        _too_few_turns, _too_little_yaw, _flat_profile, _far_from_profile, _sigma_too_large,
        _one_knows_all, _turns_disagree, _other_camera, _strange_aspect, _strange_shutter,
        _on_bound, _folds_over)
    refused: list[str] = []
    weak: list[str] = []
    for rule in rules:
        against, doubts = rule(solution, config)
        refused += against
        weak += doubts
    if refused:
        return Verdict('refused', tuple(refused + weak))
    if weak:
        return Verdict('weak', tuple(weak))
    return Verdict('accepted')


def _too_few_turns(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    count = len(solution.scenes)
    if count < config.min_turns:
        return [], [f'only {count} of at least {config.min_turns} turns could be used: '
                    f'drive more turns']
    return [], []


def _too_little_yaw(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    yaw = sum(scene.yaw_deg for scene in solution.scenes)
    message = f'the turns add up to {yaw:.0f} degrees of yaw only: drive sharper turns'
    if yaw < config.refused_yaw_deg:
        return [message], []
    return [], [message] if yaw < config.min_yaw_deg else []


def _flat_profile(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    """The cost must rise to both sides of its minimum, or the turns know nothing of the focal."""
    contrast = profile_contrast(solution)
    message = (f'the turns hardly tell one focal length from another (the error rises by '
               f'{100 * max(contrast, 0.0):.1f} % when it is 20 % off): drive sharper turns in '
               f'daylight')
    if not contrast >= config.refused_contrast:  # NaN is no evidence either
        return [message], []
    return [], [message] if contrast < config.min_contrast else []


def profile_contrast(solution: Solution) -> float:
    """Return by how much the cost rises, relatively, from the result to the next best probe.

    Negative when another focal length explains the observations better than the result.
    """
    at = _of_result(solution)
    costs = solution.around.costs
    return float(np.delete(costs, at).min() / costs[at] - 1)


def _of_result(solution: Solution) -> int:
    """Return which probe of the profile is the result itself."""
    ratio = solution.camera.fx / solution.camera.image_size[0]
    return int(np.argmin(np.abs(solution.around.ratios - ratio)))


def _far_from_profile(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    width = solution.camera.image_size[0]
    best = solution.around.best * width
    if not np.isclose(best, solution.camera.fx):
        return [f'the focal length {solution.camera.fx:.0f} px contradicts the one that explains '
                f'most observations, about {best:.0f} px'], []
    return [], []


def _sigma_too_large(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    relative = float(solution.sigma[0] / solution.camera.fx)
    message = f'fx is uncertain by {100 * relative:.1f} %: more or sharper turns are needed'
    if not np.isfinite(relative) or relative > config.refused_sigma:
        return [message], []
    return [], [message] if relative > config.max_sigma else []


def _one_knows_all(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    """Turns that know little of fx confirm nothing, and their scatter tells nothing of it."""
    shares = leverages(solution)
    center = max(shares, key=lambda center: shares[center])
    if len(shares) > 1 and not shares[center] <= config.max_leverage:
        return [], [f'{_turns([center])} alone gives {100 * min(shares[center], 1.0):.0f} % of '
                    f'what is known of fx: drive another turn that is as sharp']
    return [], []


def _turns_disagree(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    """Each turn alone says what fx it would rather have: compare that with its own sigma."""
    spread = focal_disagreement(solution)
    if not spread <= config.max_disagreement:
        return [], [f'the turns disagree about fx by {100 * spread:.1f} %: was the camera moved, '
                    f'or is there much traffic?']
    return [], []


def _other_camera(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    centers = sorted(strangers(solution.misfits, config))
    if not centers:
        return [], []
    fit = f'{_turns(centers)} fit{"s" * (len(centers) == 1)}'
    return [], [f'{fit} another camera far better than the one of the others: was the '
                f'camera zoomed or exchanged, or its picture cropped?']


def _turns(centers: list[int]) -> str:
    """Say which turns; those of earlier drives have negative numbers."""
    own = [str(center) for center in centers if center >= 0]
    stored = len(centers) - len(own)
    names = []
    if own:
        names.append(f'the turn{"s" * (len(own) > 1)} at frame {", ".join(own)}')
    if stored:
        names.append(f'{stored} turn{"s" * (stored > 1)} of earlier drives')
    return ' and '.join(names)


def _strange_aspect(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    """A rolling shutter that was not undone stretches what passes: fy takes the blame first."""
    aspect = solution.camera.fy / solution.camera.fx
    if abs(aspect - 1) > config.max_aspect:
        return [], [f'fy is {100 * (aspect - 1):+.1f} % off fx, more than pixels are out of '
                    f'square: a decentred lens or a strong rolling shutter looks like this']
    return [], []


def _strange_shutter(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    readout_ms = 1e3 * abs(solution.readout_s)
    if readout_ms > config.max_readout_ms:
        return [], [f'the rows seem to be exposed over {readout_ms:.0f} ms, longer than rolling '
                    f'shutters are: are the stamps right?']
    return [], []


def _on_bound(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    low, high = solution.bounds
    share = (solution.camera.params - low) / (high - low)
    names = [name for name, value in zip(NAMES, share, strict=True)
             if not ON_BOUND < value < 1 - ON_BOUND]
    if names:
        return [], [f'{", ".join(names)} ran into the bound: the scene is not to be trusted']
    return [], []


def _folds_over(solution: Solution, config: VerdictConfig) -> tuple[list[str], list[str]]:
    if not solution.camera.monotonic():
        return [], ['the distortion folds over inside the picture: points near its corners are '
                    'missing']
    return [], []
