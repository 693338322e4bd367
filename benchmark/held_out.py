#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What each turn says about the calibration without it, over all drives that are solved.

    python benchmark/held_out.py --cache DIR [--out DIR] [--results] [--refit NAME ...]

Reads the solutions that check.py keeps in the cache. A drive passes where no turn differs from the
others by more than the sum of both sigmas. --refit: for these drives, the cameras that the linear
step finds without each turn are compared with those of a true adjustment without it.
"""
from __future__ import annotations

import pickle
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from measure import complain, keep_table, parser_with, table
from solutions import RECORDED, Solved, solution_path

from dashcalib_ros import Config
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.mapping import mapping_error
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution, cross_validation


def solved_drives(cache: Path) -> list[Solved]:
    """Return all drives that this commit has solved; ends the script where there is none."""
    found = [Solved(**pickle.loads(path.read_bytes()))
             for path in sorted(solution_path('', 0, cache).parent.glob('*.pickle'))]
    if not found:
        raise SystemExit('no drive is solved at this commit: run check.py with this --cache')
    return found


def without(solution: Solution, number: int) -> Camera:
    """Return the camera without a turn, by one linear step."""
    others = solution.posterior.without(number)
    return solution.camera.with_params(solution.camera.params + solution.offset_of(others))


def refitted(solution: Solution, number: int, config: Config) -> Camera:
    """Return the camera without a turn, of the tracks as the solution has them."""
    found = solve([scene for n, scene in enumerate(solution.scenes) if n != number], config)
    assert found is not None
    return found.camera


def drives_table(drives: Iterable[Solved]) -> str:
    """Return a line for each accepted drive of three turns or more."""
    lines, turns, passed, drives_passed = [], 0, 0, []
    for each in drives:
        if each.solution is None or each.calibration.verdict.level != 'accepted':
            continue
        found = cross_validation(each.solution)
        if not found:
            continue
        good = [turn.px <= turn.sigma_px + turn.others_sigma_px for turn in found]
        turns, passed = turns + len(good), passed + sum(good)
        drives_passed.append(all(good))
        worst = max(found, key=lambda turn: turn.sigmas)
        lines.append([each.name, str(each.seed), f'{sum(good)} of {len(good)}',
                      f'{np.median([turn.px for turn in found]):.2f}', f'{worst.px:.2f}',
                      f'{worst.sigma_px:.2f} + {worst.others_sigma_px:.2f}',
                      f'{worst.sigmas:.1f}'])
    head = ['drive', 'seed', 'turns within σ0 + σ1', 'median px', 'worst turn, px', 'σ0 + σ1',
            'its sigmas']
    return (f'{sum(drives_passed)} of {len(drives_passed)} accepted drives, {passed} of {turns} '
            f'turns within σ0 + σ1.\n\n{table(head, lines)}')


def refit_table(drives: Iterable[Solved], names: Iterable[str]) -> str:
    """Return how far the linear step is from a true adjustment, px over the picture."""
    lines, wanted = [], set(names)
    for each in drives:
        if each.name not in wanted or each.solution is None or (
                each.seed and each.name in RECORDED):
            continue
        solution = each.solution
        for n, scene in enumerate(solution.scenes):
            linear, true = without(solution, n), refitted(solution, n, Config())
            moved = mapping_error(true, solution.camera)
            off = mapping_error(linear, true)
            lines.append([each.name, str(each.seed), str(scene.turn.number), f'{moved:.3f}',
                          f'{off:.3f}'])
            complain(' '.join(lines[-1]))
    return table(['drive', 'seed', 'without the turn at', 'the true adjustment moves by px',
                  'the linear step is off by px'], lines)


def main() -> None:
    """Measure."""
    parser = parser_with(__doc__, 'cache')
    parser.add_argument('--refit', nargs='*', default=[])
    arguments = parser.parse_args()
    drives = solved_drives(arguments.cache)
    text = drives_table(drives)
    if arguments.refit:
        text += f'\n\n{refit_table(drives, arguments.refit)}'
    keep_table('held_out', text, arguments)


if __name__ == '__main__':
    main()
