"""Texts and numbers that the page and the terminal have in common."""
from __future__ import annotations

import math
from collections.abc import Sequence

from dashcalib_ros.judgement import Calibration, TurnSummary
from dashcalib_ros.judgement.calibration import Shutter, Stabiliser, StoredTurnSummary
from dashcalib_ros.solve.picture import PictureSigma

ADVICE = {
    'accepted': 'Good to use: calibration.yaml was written.',
    'weak': 'Look at the sigmas before you use it: it is in calibration.weak.yaml only.',
    'refused': 'There is no calibration: the evidence in this drive was not enough.',
}

# parameters that are lengths in the picture; the others have no unit
PIXELS = ('fx', 'fy', 'cx', 'cy')

TURN_COLUMNS = ('frame', 'from', 'to', 'at s', 'prominence', 'yaw °', 'images', 'error px', 'used')


def parameter_rows(calibration: Calibration) -> list[tuple[str, str, str, str]]:
    """Return each parameter's name, value, sigma and sigma in percent, as text."""
    if calibration.camera is None:
        return []
    sigma = calibration.sigma or {}
    return [_parameter_row(name, value, sigma.get(name))
            for name, value in calibration.camera.named.items()]


def _parameter_row(name: str, value: float, sigma: float | None) -> tuple[str, str, str, str]:
    if sigma is None or not math.isfinite(sigma):
        return name, number(name, value), 'unknown', ''
    relative = f'{100 * sigma / abs(value):.2f} %' if value else ''
    return name, number(name, value), '± ' + number(name, sigma), relative


def number(name: str, value: float) -> str:
    """Return a parameter's value with its significant digits and its unit."""
    return f'{value:.{digits_of(name)}f}' + (' px' if name in PIXELS else '')


def digits_of(name: str) -> int:
    """Return how many digits after the point a parameter and its sigma need."""
    if name in PIXELS:
        return 2
    # the coefficients of higher terms, and of a lens that is decentred, are small
    return 4 if name in ('k1', 'k2') else 6


def turn_row(turn: TurnSummary) -> tuple[str, ...]:
    """Return a turn's cells for TURN_COLUMNS."""
    return (str(turn.center), str(turn.first), str(turn.last), f'{turn.stamp_s:.1f}',
            f'{turn.prominence:.4f}', optional(turn.yaw_deg, 1),
            f'{turn.registered} of {turn.images}', optional(turn.reprojection_error_px, 2),
            'yes' if turn.used else 'no')


def stored_text(turns: Sequence[StoredTurnSummary]) -> str:
    """Return how many turns of earlier drives were used."""
    used = sum(turn.used for turn in turns)
    return f'{used} of {len(turns)} stored turn{"" if len(turns) == 1 else "s"} used'


def stabiliser_text(stabiliser: Stabiliser) -> str:
    """Return what became of a stabilised video."""
    return f'picture stabilised by up to {stabiliser.largest_px:.0f} px, found and removed'


def shutter_text(shutter: Shutter) -> str:
    """Return a line about the rolling shutter that was found."""
    return (f'rolling shutter of {shutter.readout_ms:.1f} ± {shutter.sigma_ms:.1f} ms found and '
            'removed')


def picture_text(sigma: PictureSigma) -> str:
    """Return a line about how far the whole camera may be off."""
    return f'{sigma.rms:.2f} px over the picture, {sigma.worst:.2f} px at the worst'


def optional(value: float | None, digits: int, unit: str = '') -> str:
    """Return a number with its unit, or a dash for one that is not known."""
    return '-' if value is None or not math.isfinite(value) else f'{value:.{digits}f}{unit}'
