# SPDX-License-Identifier: Apache-2.0
"""When a calibration is published, replaced or given up: pure functions, no ROS.

A car always collects turns, but the published calibration must be stable. After an accepted one a
new bank of turns is begun, so that each later calibration is independent. It confirms the
published one, replaces it if it is much more exact, or contradicts it. Contradictions count from
the second turn of a bank on; several in a row mean that the camera was moved.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dashcalib_ros.errors import counted
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.judge.difference import contradicted
from dashcalib_ros.judge.verdict import MOVES, STEADY
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.report.wording import digits_of
from dashcalib_ros.ros.settings import NodeConfig

Action = Literal['wait', 'adopt', 'keep', 'replace', 'give_up']
NEXT = {
    'weak': 'it is calculated again with each better turn',
    'refused': 'it is repeated with each better turn; turns of 60° or more, at town speed and in '
               'daylight, help most',
}


@dataclass(frozen=True)
class Judgement:
    """What to do with a new calibration, why, and the contradictions in a row so far.

    confirmed: it agrees with the published one.
    """

    action: Action
    why: str = ''
    contradictions: int = 0
    confirmed: bool = False


def judge(new: CalibrationData, complete: bool, published: NamedCamera | None, contradictions: int,
          limits: NodeConfig) -> Judgement:
    """Decide about a calibration.

    complete: it had all the turns wanted. published: what is published now, if anything;
    contradictions: how many in a row contradicted that. limits: `better` and `contradictions`.
    """
    if published is not None and MOVES in new.verdict.codes:
        return _contradicted(f'the published one, because the picture moves now: {STEADY}',
                             contradictions, limits, 'give_up')
    if new.verdict.level != 'accepted' or new.camera is None or new.sigma is None:
        action: Action = 'wait' if published is None else 'keep'
        return Judgement(action, '; '.join(new.verdict.told), contradictions)
    if published is None:
        return Judgement('adopt')
    before_now = (published.camera if new.temperature_c is None
                  else published.at_temperature(new.temperature_c))
    against = contradicted(before_now, published.sigma, new.camera, new.sigma)
    if against:
        return _contradicted(f'the published one: {", ".join(against)}; check whether the camera '
                             f'was moved or its lens changed', contradictions, limits,
                             'replace' if complete else 'give_up')
    # the sigma of a file that was edited is unknown
    before = 'unknown' if published.sigma is None else f'{published.sigma["fx"]:.2f} px'
    after = new.sigma['fx']
    if complete and (published.sigma is None
                     or after <= limits.better * published.sigma['fx']):
        return Judgement('replace', f'the new one is more precise: the standard deviation (sigma) '
                                    f'of fx is {after:.2f} px; before, it was {before}')
    return Judgement('keep', 'it confirms the published one', confirmed=True)


def _contradicted(what: str, contradictions: int, limits: NodeConfig, last: Action) -> Judgement:
    """Count one more contradiction. what: is contradicted, and why; last: done at the last one."""
    count = contradictions + 1
    why = f'{count} of {limits.contradictions} calibrations in a row contradict {what}'
    return Judgement('keep', why, count) if count < limits.contradictions else Judgement(last, why)


def sigma_text(camera: NamedCamera) -> str:
    """Return 'fx 412.31 ± 0.92, ...' of a published camera."""
    parts = []
    for name, number in camera.camera.named.items():
        digits = digits_of(name)
        value = f'{name} {number:.{digits}f}'
        if camera.sigma is not None:
            value += f' ± {camera.sigma[name]:.{digits}f}'
        parts.append(value)
    return ', '.join(parts)


def outcome_text(calibration: CalibrationData, why: str) -> str:
    """Return a line about a calibration that is not adopted; why: the reasons."""
    level = calibration.verdict.level
    parts = [f'a calibration of {counted(calibration.turns_used, "turn")} is {level}'
             + (f': {why}' if why else ''), NEXT.get(level, '')]
    return '; '.join(part for part in parts if part)
