"""What the verdict rests on: what this drive has beside what is needed."""
from __future__ import annotations

from dataclasses import dataclass

from dashcalib_ros.config import VerdictConfig
from dashcalib_ros.judge import Calibration
from dashcalib_ros.judge.agreement import focal_disagreement, leverages
from dashcalib_ros.judge.verdict import profile_contrast
from dashcalib_ros.solve.solution import Solution


@dataclass(frozen=True)
class Check:
    """One of the verdict's conditions, in words. passed: whether this drive meets it."""

    name: str
    found: str
    needed: str
    passed: bool


def checks(calibration: Calibration) -> tuple[Check, ...]:
    """Return the conditions that can be put in a number, those of the evidence first."""
    needed = calibration.config.verdict
    solution = None if calibration.material is None else calibration.material.solution
    count = calibration.turns_used
    yaw = calibration.yaw_deg
    found = [Check('turns used', f'{count}', f'at least {needed.min_turns}',
                   count >= needed.min_turns),
             Check('yaw of these turns together', f'{yaw:.0f}°',
                   f'at least {needed.min_yaw_deg:.0f}°', yaw >= needed.min_yaw_deg)]
    return (*found, *([] if solution is None else _of_solution(solution, needed)))


def _of_solution(solution: Solution, needed: VerdictConfig) -> list[Check]:
    contrast, spread = profile_contrast(solution), focal_disagreement(solution)
    sigma = float(solution.sigma[0] / solution.camera.fx)
    share = max(leverages(solution).values(), default=1.0)
    misfit = max(solution.misfits.values(), default=0.0)
    return [
        Check('rise of the error when the focal length is 20 % off',
              f'{100 * max(contrast, 0.0):.1f} %', f'at least {100 * needed.min_contrast:.0f} %',
              contrast >= needed.min_contrast),
        Check('uncertainty of fx', f'{100 * sigma:.2g} %',
              f'at most {100 * needed.max_sigma:.3g} %', sigma <= needed.max_sigma),
        Check('scatter of fx between the turns', f'{100 * spread:.2g} %',
              f'at most {100 * needed.max_disagreement:.3g} %',
              spread <= needed.max_disagreement),
        Check('share of the turn that knows most of fx', f'{100 * min(share, 1.0):.0f} %',
              f'at most {100 * needed.max_leverage:.0f} %',
              len(solution.scenes) < 2 or share <= needed.max_leverage),
        Check('a turn’s error, over that with a camera of its own', f'{misfit:.2g} times',
              f'at most {needed.max_misfit:.2g} times', misfit <= needed.max_misfit)]
