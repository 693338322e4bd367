# SPDX-License-Identifier: Apache-2.0
"""When a calibration is published, replaced or given up: pure functions, no ROS.

A car always collects turns, but the published calibration must be stable. After an accepted one a
new bank of turns is begun, so that each later calibration is independent. A lens wanders: what is
known about the published one fades with time. A later one that differs by no more than chance
confirms it, and it follows by the share of what both know that the new one has. One that differs
by more contradicts it. Contradictions count from the second turn of a bank on; several in
a row mean that the camera was moved.
"""
from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from dashcalib_ros.errors import counted
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.judge.difference import LEAST_SIGMA, contradicted
from dashcalib_ros.judge.verdict import MOVES, STEADY
from dashcalib_ros.report import Calibration, NamedCamera
from dashcalib_ros.report.wording import digits_of
from dashcalib_ros.ros.settings import NodeConfig

Action = Literal['wait', 'adopt', 'keep', 'follow', 'replace', 'give_up']
# of fx, after a day: 0.5 % in ten days are three sigmas. Days count up to a year
WANDERS, MOST_DAYS = 0.0005, 365.0
# the published one follows where that moves it by half of its sigma of fx, or where the new one
# knows twice as much: it stays as it is at most drives of a steady lens
MOVED, KNOWS_MORE = 0.5, 2 / 3
NEXT = {
    'weak': 'it is calculated again with each better turn',
    'refused': 'it is repeated with each better turn; turns of 60° or more, at town speed and in '
               'daylight, help most',
}


@dataclass(frozen=True)
class Judgement:
    """What to do with a new calibration, why, and the contradictions in a row so far.

    confirmed: it agrees with the published one. calibration: to publish, where it is another now.
    """

    action: Action
    why: str = ''
    contradictions: int = 0
    confirmed: bool = False
    calibration: Calibration | None = None


def judge(new: Calibration, complete: bool, published: NamedCamera | None, contradictions: int,
          limits: NodeConfig, days: float = 0.0) -> Judgement:
    """Decide about a calibration.

    complete: it had all the turns wanted. published: what is published now, if anything, since so
    many days; contradictions: how many in a row contradicted that. limits: `contradictions`.
    """
    if published is not None and MOVES in new.verdict.codes:
        return _contradicted(f'the published one, because the picture moves now: {STEADY}',
                             contradictions, limits, 'give_up')
    if new.verdict.level != 'accepted' or new.camera is None or new.sigma is None:
        action: Action = 'wait' if published is None else 'keep'
        return Judgement(action, new.verdict.main_text, contradictions)
    if published is None:
        return Judgement('adopt', calibration=new)
    before = _now(published, days, new.temperature_c)
    against = contradicted(before.camera, before.sigma, new.camera, new.sigma)
    if against:
        judged = _contradicted(
            f'the published one: {", ".join(against)}; check whether the camera was moved or its '
            f'lens changed', contradictions, limits, 'replace' if complete else 'give_up')
        return replace(judged, calibration=new) if judged.action == 'replace' else judged
    following = _following(before, new) if complete else None
    if following is None or following.camera is None:
        return Judgement('keep', 'it confirms the published one', confirmed=True)
    return Judgement('follow', f'fx {published.camera.fx:.2f} -> {following.camera.fx:.2f} px',
                     confirmed=True, calibration=following)


def _now(camera: NamedCamera, days: float, now_c: float | None) -> NamedCamera:
    """Return what is known about a camera after so many days, at a temperature if known."""
    wandered = WANDERS * camera.camera.fx * math.sqrt(min(max(days, 0.0), MOST_DAYS))
    sigma = None if camera.sigma is None else {
        name: math.hypot(value, wandered) if name in ('fx', 'fy') else value
        for name, value in camera.sigma.items()}
    return replace(camera, sigma=sigma, camera=(
        camera.camera if now_c is None else camera.at_temperature(now_c)))


def _following(before: NamedCamera, new: Calibration) -> Calibration | None:
    """Return a calibration between the old camera and a new one; None where the old one may stay.

    Each counts by what it knows about fx. What both got wrong alike makes neither better: so the
    variance is the mean of both, which holds whatever they have in common.
    """
    old, camera, sigma = before.camera, new.camera, new.sigma
    assert camera is not None and sigma is not None
    if before.drift is not None and (
            new.drift is None or new.drift.fx_percent_per_kelvin is None):
        # it was as warm all the time
        new = replace(new, drift=before.drift)
    if new.temperature_c is None:
        new = replace(new, temperature_c=before.temperature_c)
    if before.sigma is None:
        return new  # of a file that was edited
    floor = LEAST_SIGMA * old.fx
    variances = [max(each['fx'], floor)**2 for each in (before.sigma, sigma)]
    share = variances[0] / sum(variances)
    moves = share * abs(camera.fx - old.fx) > MOVED * before.sigma['fx']
    if share < KNOWS_MORE and not moves:
        return None
    if type(old) is not type(camera):
        # there is nothing between two models
        return new if share >= KNOWS_MORE else None
    params = (1 - share) * old.params + share * camera.params
    between = {name: math.sqrt((1 - share) * before.sigma[name]**2 + share * value**2)
               for name, value in sigma.items()}
    return replace(new, camera=old.with_params(params), sigma=between, covariance=None,
                   picture_covariance=None)


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
