"""When a calibration is published, replaced or given up: pure functions, no ROS.

A car collects turns for ever, but what is published must not wander. After an acceptance every
bank of turns is begun anew, so that each later calibration is an opinion of its own: it confirms
the published one, is so much better that it replaces it, or contradicts it. Contradictions count
from the second turn of such a bank on; several in a row mean that the camera was moved.
"""
from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

from dashcalib_ros.intrinsics import Calibration, Intrinsics
from dashcalib_ros.report import Camera

State = Literal['collecting', 'calibrating', 'calibrated', 'refused_so_far']
Action = Literal['wait', 'adopt', 'keep', 'replace', 'give_up']

# combined sigmas; a difference beyond is no chance
CONTRADICTION = 3.0
# of fx; two good calibrations of one lens differ by this much (FACTS 5), whatever their sigmas say
LEAST_SIGMA = 0.0025
# k1 and k2 trade with the focal length: alone they contradict nothing
COMPARED = ('fx', 'fy', 'cx', 'cy')


@dataclass(frozen=True)
class Rules:
    """better: replace when fx's sigma falls to this ratio. contradictions: so many give it up."""

    better: float
    contradictions: int


@dataclass(frozen=True)
class Judgement:
    """What to do with a new calibration, why, and the contradictions in a row so far."""

    action: Action
    why: str = ''
    contradictions: int = 0


def judge(new: Calibration, complete: bool, published: Camera | None, contradictions: int,
          rules: Rules) -> Judgement:
    """Decide about a calibration.

    complete: it had all the turns wanted. published: what is published now, if anything;
    contradictions: how many in a row contradicted that.
    """
    if new.verdict.level != 'accepted' or new.intrinsics is None or new.sigma is None:
        action: Action = 'wait' if published is None else 'keep'
        return Judgement(action, '; '.join(new.verdict.reasons), contradictions)
    if published is None:
        return Judgement('adopt')
    against = contradicted(published, new.intrinsics, new.sigma)
    if against:
        count = contradictions + 1
        why = (f'{count} of {rules.contradictions} calibrations in a row contradict the published '
               f'one: {", ".join(against)}; was the camera moved, or its lens changed?')
        if count < rules.contradictions:
            return Judgement('keep', why, count)
        return Judgement('replace' if complete else 'give_up', why)
    assert published.sigma is not None
    if complete and new.sigma.fx <= rules.better * published.sigma.fx:
        return Judgement('replace', f"fx's sigma falls from {published.sigma.fx:.2f} "
                                    f'to {new.sigma.fx:.2f} px')
    return Judgement('keep', 'it confirms the published one')


def contradicted(old: Camera, new: Intrinsics, sigma: Intrinsics) -> list[str]:
    """Return the parameters in which the two differ by more than chance, in words."""
    found = []
    floor = LEAST_SIGMA * old.intrinsics.fx
    for name in COMPARED:
        before, after = getattr(old.intrinsics, name), getattr(new, name)
        own = getattr(old.sigma, name) if old.sigma is not None else 0.0
        spread = math.hypot(max(own, floor), max(getattr(sigma, name), floor))
        if abs(after - before) > CONTRADICTION * spread:
            found.append(f'{name} {after:.1f} instead of {before:.1f} px')
    return found


def state_of(published: bool, calibrating: bool, refused: bool) -> State:
    """Return the word for diagnostics; refused: the last calibration was not accepted."""
    if published:
        return 'calibrated'
    if calibrating:
        return 'calibrating'
    return 'refused_so_far' if refused else 'collecting'


def sigma_text(camera: Camera) -> str:
    """Return 'fx 412.31 ± 0.92, ...' of a published camera."""
    parts = []
    for spec in fields(camera.intrinsics):
        digits = 4 if spec.name in ('k1', 'k2') else 2
        value = f'{spec.name} {getattr(camera.intrinsics, spec.name):.{digits}f}'
        if camera.sigma is not None:
            value += f' ± {getattr(camera.sigma, spec.name):.{digits}f}'
        parts.append(value)
    return ', '.join(parts)
