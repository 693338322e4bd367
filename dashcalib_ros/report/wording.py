"""The words and numbers that the page and the terminal share."""
from __future__ import annotations

import math
from collections.abc import Sequence

from dashcalib_ros.intrinsics import Intrinsics, TurnSummary
from dashcalib_ros.intrinsics.calibration import Shutter, StoredTurnSummary
from dashcalib_ros.report.camera import PARAMETERS

PARAMETER_NAMES = PARAMETERS

ADVICE = {
    'accepted': 'Good to use: calibration.yaml was written.',
    'weak': 'Look at the sigmas before you use it: it is in calibration.weak.yaml only.',
    'refused': 'There is no calibration: the evidence in this drive was not enough.',
}

TURN_COLUMNS = ('frame', 'from', 'to', 'at s', 'prominence', 'yaw °', 'images', 'error px', 'used')


def parameter_row(name: str, intrinsics: Intrinsics,
                  sigma: Intrinsics | None) -> tuple[str, str, str, str]:
    """Return a parameter's name, value, sigma and sigma in percent, as text."""
    value = getattr(intrinsics, name)
    spread = None if sigma is None else getattr(sigma, name)
    if spread is None or not math.isfinite(spread):
        return name, number(name, value), 'unknown', ''
    relative = f'{100 * spread / abs(value):.2f} %' if value else ''
    return name, number(name, value), '± ' + number(name, spread), relative


def number(name: str, value: float) -> str:
    """Return a parameter's value with as many digits as it deserves, and its unit."""
    return f'{value:.4f}' if name in ('k1', 'k2', 'k3', 'p1', 'p2') else f'{value:.2f} px'


def turn_row(turn: TurnSummary) -> tuple[str, ...]:
    """Return a turn's cells for TURN_COLUMNS."""
    return (str(turn.center), str(turn.first), str(turn.last), f'{turn.stamp_s:.1f}',
            f'{turn.prominence:.4f}', optional(turn.yaw_deg, 1),
            f'{turn.registered} of {turn.images}', optional(turn.reprojection_error_px, 2),
            'yes' if turn.used else 'no')


def stored_text(turns: Sequence[StoredTurnSummary]) -> str:
    """Return what became of the turns of earlier drives."""
    used = sum(turn.used for turn in turns)
    return f'{used} of {len(turns)} stored turn{"" if len(turns) == 1 else "s"} used'


def shutter_text(shutter: Shutter) -> str:
    """Return what was found of a rolling shutter."""
    return (f'rolling shutter of {shutter.readout_ms:.1f} ± {shutter.sigma_ms:.1f} ms found and '
            'undone')


def optional(value: float | None, digits: int, unit: str = '') -> str:
    """Return a number with its unit, or a dash for one that is not known."""
    return '-' if value is None or not math.isfinite(value) else f'{value:.{digits}f}{unit}'
