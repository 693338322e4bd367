# SPDX-License-Identifier: Apache-2.0
"""Results as rich renderables for a terminal; nothing is printed here."""
from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from dashcalib_ros.errors import visible
from dashcalib_ros.judge import CalibrationData, TurnSummary, Verdict
from dashcalib_ros.report.compare import (
    Comparison,
    answers,
    comparison_rows,
    difference_row,
    unseen_text,
)
from dashcalib_ros.report.wording import (
    PARAMETERS,
    number,
    optional,
    parameter_rows,
    remedies,
    run_facts,
    since_start,
)

# columns between two of a table
APART = 3
TURNS = ('at s', 'frames', 'yaw °', 'images', 'error px', 'used')
# of verdicts, and of answers
COLOURS = {'accepted': 'bold green', 'weak': 'bold yellow', 'refused': 'bold red',
           'right': 'bold green', 'differs': 'bold cyan', 'cannot tell': 'bold yellow',
           'wrong': 'bold red'}


def line(text: str) -> Text:
    """Return one literal line: names of topics, files and cameras cannot act on the terminal."""
    return Text(visible(text))


def summary(calibration: CalibrationData) -> RenderableType:
    """Return the estimate with its sigma, the table of turns, and a few facts."""
    c = calibration
    parts: list[RenderableType] = []
    if c.camera is not None:
        parts.append(TextTable(PARAMETERS, parameter_rows(c)))
        if c.caveat:
            parts += [line(c.caveat), line('')]
    if c.turns:
        parts.append(TextTable(TURNS, [_turn_row(turn, c) for turn in c.turns]))
        parts += [line(f'not used: {why}: the turn{"s" * (len(at) > 1)} at {", ".join(at)} s')
                  for why, at in _unused(c).items()]
    return Group(*parts, *(line(f'{name}: {text}') for name, text in run_facts(c)))


def _unused(c: CalibrationData) -> dict[str, list[str]]:
    """Return why turns of this drive are not used, and when those were."""
    found: dict[str, list[str]] = {}
    for turn in c.turns:
        if turn.unused_because:
            found.setdefault(turn.unused_because, []).append(since_start(turn, c))
    return found


def conclusion(verdict: Verdict) -> RenderableType:
    """Return the verdict, coloured, and its reasons; of a refused result the cause."""
    parts: list[RenderableType] = [labelled('verdict', verdict.level)]
    parts += [Padding.indent(line(f'{each.what} [{each.code}]' if each.code else each.what), 2)
              for each in verdict.main_reasons]
    return Group(*parts)


def labelled(label: str, word: str) -> Text:
    """Return the line that all others explain: its word is coloured."""
    return Text.assemble(f'{label}: ', (word, COLOURS[word]))


def next_step(verdict: Verdict) -> RenderableType:
    """Return what to do next: all remedies, the likeliest to help first."""
    first, *others = remedies(verdict)
    return Group(line(f'next: {first}'), *(line(f'also: {remedy}') for remedy in others))


def _turn_row(turn: TurnSummary, c: CalibrationData) -> tuple[str, ...]:
    return (since_start(turn, c), f'{turn.first} to {turn.last}',
            optional(turn.yaw_deg, 1), f'{turn.registered} of {turn.images}',
            optional(turn.reprojection_error_px, 2), 'yes' if turn.used else 'no')


def comparison(found: Comparison) -> RenderableType:
    """Return two calibrations side by side, and the mapping error."""
    sides = (f'{side}: {camera.name}' + (f' ({camera.verdict})' if camera.verdict else '')
             for side, camera in (('A', found.a), ('B', found.b)))
    return Group(*map(line, sides), *map(line, answers(found)), TextTable(*comparison_rows(found)))


def against_truth(found: Comparison) -> RenderableType:
    """Return an estimate with its sigma beside the truth, and the mapping error."""
    rows = [(d.name, number(d.name, d.a),
             '-' if d.sigma is None else '± ' + number(d.name, d.sigma), number(d.name, d.b),
             *difference_row(d)[-2:]) for d in found.differences]
    head = ('', 'estimate', 'sigma', 'truth', 'error', 'in sigmas')
    known = found.mapping_px is not None and math.isfinite(found.mapping_px)
    mapping = (f'{found.mapping_px:.2f} px{unseen_text(found)}' if known else
               'unknown, a lens model folds over inside the image')
    return Group(TextTable(head, rows), line(f'mapping error: {mapping}'))


class TextTable:
    """A plain table of literal text: the first column to the left, numbers to the right.

    What does not fit beside it on a narrow terminal comes below, again with the first column.
    """

    def __init__(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        self._columns = list(zip(head, *rows, strict=True))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Return as many tables as the width asks for."""
        first, *others = self._columns
        while others:
            room = options.max_width - _width(first)
            table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
            table.add_column(line(first[0]), no_wrap=True)
            shown = [first]
            while others and (len(shown) == 1 or APART + _width(others[0]) <= room):
                shown.append(others.pop(0))
                room -= APART + _width(shown[-1])
                table.add_column(line(shown[-1][0]), justify='right', no_wrap=True)
            for row in zip(*(column[1:] for column in shown), strict=True):
                table.add_row(*map(line, row))
            yield table


def _width(column: Sequence[str]) -> int:
    return max(map(cell_len, column))
