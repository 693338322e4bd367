"""The lines that the node logs while it learns: one for each event."""
from __future__ import annotations

from dashcalib_ros.errors import counted
from dashcalib_ros.judge import Calibration
from dashcalib_ros.ros.news import NewTurn
from dashcalib_ros.status import Status

NEXT = {
    'weak': 'it is calculated again with each better turn',
    'refused': 'it is tried again with each better turn: those of 60° or more, at town speed and '
               'in daylight, teach most',
}


def turn_text(turn: NewTurn, wanted: int, checking: bool) -> str:
    """Return 'turn 2 of 5: 89°, 179° in all'; checking: the turns check a published one."""
    number = f'turn {turn.number}' + (f' of {wanted}' if turn.number <= wanted else '')
    source = '' if turn.of_this_drive else ' (of an earlier drive)'
    purpose = ' for the next check of the calibration' if checking else ''
    return f'{number}{purpose}{source}: {turn.yaw_deg:.0f}°, {turn.total_deg:.0f}° in all'


def started_text(status: Status) -> str:
    """Return 'calibrating with 5 turns, 402° of yaw…'."""
    if not status.built:
        return f'calibrating, as soon as {counted(status.turns, "turn")} found so far can be used…'
    return f'calibrating with {counted(status.built, "turn")}, {status.yaw_deg:.0f}° of yaw…'


def outcome_text(calibration: Calibration, why: str) -> str:
    """Return a line about a calibration that is not adopted; why: the reasons."""
    level = calibration.verdict.level
    parts = [f'a calibration of {counted(calibration.turns_used, "turn")} is {level}'
             + (f': {why}' if why else ''), NEXT.get(level, '')]
    return '; '.join(part for part in parts if part)
