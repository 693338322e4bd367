"""The page's section of each turn, and the table of all."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.judge import Calibration, TurnSummary
from dashcalib_ros.judge.agreement import leverages
from dashcalib_ros.judge.calibration import Material, StoredTurnSummary
from dashcalib_ros.judge.focal_by_turn import focal_alone
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.report.turn_figures import (
    direction,
    estimates_svg,
    picture_svg,
    view_svg,
    with_sigma,
)
from dashcalib_ros.report.wording import optional, since_start

AnySummary = TurnSummary | StoredTurnSummary


@dataclass(frozen=True)
class TurnSection:
    """A turn as the page shows it; SVG texts are '' where there is nothing to draw.

    frame: of the picture; magnified: by how much its residuals are, 0 for none drawn. alone: what
    it says of fx, in words.
    """

    name: str
    facts: tuple[str, ...]
    used: bool
    unused_because: str | None
    picture: str
    frame: int | None
    magnified: int
    view: str
    alone: str


def turn_sections(c: Calibration, mask_id: str | None) -> list[TurnSection]:
    """Return a section for each turn of which there is anything to see."""
    if c.material is None:
        return []
    said = _said_of_fx(c, c.material)
    found = [_section(turn, c, c.material, said, mask_id) for turn in c.all_turns]
    return [each for each in found if each.picture or each.view]


@dataclass(frozen=True)
class _SaidOfFx:
    """What each turn says of fx, px of the input, and its share in what is known of it.

    joint: fx of all turns, with its sigma.
    """

    alone: dict[TurnId, tuple[float, float]]
    shares: dict[TurnId, float]
    joint: tuple[float, float]


def _said_of_fx(c: Calibration, material: Material) -> _SaidOfFx | None:
    """Return what the turns say of fx; None of a refused calibration, which has no numbers."""
    solution, sigma = material.solution, (c.sigma or {}).get('fx', math.nan)
    if c.camera is None or solution is None or not 0 < sigma < math.inf:
        return None
    alone = {turn: (found.fx * material.px, found.sigma * material.px)
             for turn, found in focal_alone(solution).items()}
    if not np.isfinite(list(alone.values())).all():
        return None
    return _SaidOfFx(alone, leverages(solution), (c.camera.fx, sigma))


def focal_by_turn(c: Calibration) -> str:
    """Return the plot of what all turns say of fx, '' where there is none."""
    said = None if c.material is None else _said_of_fx(c, c.material)
    if said is None:
        return ''
    return estimates_svg([(f'turn {name}', *said.alone[turn]) for turn, name in names(c).items()
                          if turn in said.alone], said.joint)


def names(c: Calibration) -> dict[TurnId, str]:
    """Return the turns' short names: numbers in the order of time, s1, s2 for stored ones."""
    own = {turn.id: str(n) for n, turn in enumerate(c.turns, 1)}
    return own | {turn.id: f's{n}' for n, turn in enumerate(c.stored_turns, 1)}


def _section(turn: AnySummary, c: Calibration, material: Material,
             of_fx: _SaidOfFx | None, mask_id: str | None) -> TurnSection:
    scene, picture = material.scenes.get(turn.id), material.pictures.get(turn.id)
    camera = None
    if scene is not None and turn.used and material.solution is not None:
        camera = material.solution.camera
    drawn, magnified = ('', 0)
    if picture is not None:
        drawn, magnified = picture_svg(picture, scene, camera, mask_id)
    return TurnSection(
        _title(turn, c), _facts(turn, scene, c), turn.used, turn.unused_because, drawn,
        None if picture is None else picture.frame, magnified,
        '' if scene is None else view_svg(scene, None if picture is None else picture.frame),
        '' if of_fx is None or turn.id not in of_fx.alone else _said(turn.id, of_fx))


def _title(turn: AnySummary, c: Calibration) -> str:
    if isinstance(turn, StoredTurnSummary):
        return f'Stored turn {names(c)[turn.id]}'
    return f'Turn {names(c)[turn.id]}'


def _facts(turn: AnySummary, scene: Scene | None, c: Calibration) -> tuple[str, ...]:
    facts = ['of an earlier drive' if isinstance(turn, StoredTurnSummary)
             else f'at {since_start(turn, c)} s, frames {turn.first} to {turn.last}']
    if turn.yaw_deg is not None:
        way = '' if scene is None else ' ' + direction(scene)
        facts.append(f'{turn.yaw_deg:.0f}°{way}')
    if turn.misfit is not None and turn.misfit > c.config.verdict.max_misfit:
        facts.append(f'fits another camera: {turn.misfit:.1f} times the error of its own')
    return tuple(facts)


def _said(turn: TurnId, of_fx: _SaidOfFx) -> str:
    share = min(max(100 * of_fx.shares.get(turn, 0.0), 0.0), 100.0)
    return (f'Alone it says fx {with_sigma(*of_fx.alone[turn])}, and gives '
            f'{f"{share:.0f}" if share >= 1 else "less than 1"} % of what is known of fx.')


def turn_rows(c: Calibration) -> list[dict[str, str]]:
    """Return the table of all turns: name, time, frames, yaw, keyframes, error, why unused."""
    short = names(c)
    apart = {each.turn: f'{each.px:.3g} px, {each.sigmas:.1f} sigmas' for each in c.held_out}
    rows = []
    for turn in c.all_turns:
        row = {'turn': short[turn.id], 'at': 'earlier', 'frames': '-',
               'yaw': optional(turn.yaw_deg, 0, '°'), 'keyframes': str(turn.images),
               'error': optional(turn.reprojection_error_px, 2, ' px'),
               'held out': apart.get(turn.id, '-'),
               'used': 'used' if turn.used else f'no: {turn.unused_because or "not needed"}'}
        if isinstance(turn, TurnSummary):
            row |= {'at': f'{since_start(turn, c)} s', 'frames': f'{turn.first} to {turn.last}',
                    'keyframes': f'{turn.registered} of {turn.images}' if turn.registered else '-'}
        rows.append(row)
    return rows
