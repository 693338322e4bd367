#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Whether `dashcalib check` finds what is wrong with a calibration, on rendered drives.

    python benchmark/check.py [--drives NAME ...] [--seeds 0 1 2] [--data DIR] [--cache DIR]
        [--out DIR] [--results] [--again] [--solved]

The drives are all rendered ones, and for monitor.py those of --data.

Each drive is solved once (the cache keeps the solution), and then asked about its true camera,
about that shifted by half a pixel, and about spoiled ones: fx 2 %, k1 0.03, cx 1 %, cy 2 % to
either side, and pictures of another size. Rows go to DIR/check.json after each drive, tables to
DIR/check.md. --solved: only the drives whose solution is there.

Whether a drive can tell is asked of its own covariance: the spoil alone lies so far from the truth
that at least 95 % of the drives as exact as this one would find it.
"""
from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from drives import BY_NAME
from mapping import model_of
from measure import commit, complain, keep_table, load, parser_with, save, table
from solutions import RECORDED, Solved, solution_path, solved_drive
from wide import WIDE

from dashcalib_ros import Config
from dashcalib_ros.camera import MODELS, Camera
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge import check
from dashcalib_ros.judge.difference import difference_of

# of a normal distribution: 95 % lie above minus this
POWER = 1.64
SPOILS = {'fx': 0.02, 'k1': 0.03, 'cx': 0.01, 'cy': 0.02}
ABSOLUTE = ('k1',)
RIGHT = ('truth', 'half a pixel')
# a spoil of so few pixels that it is good enough for detection differs, and is found as well
FOUND = ('differs', 'wrong')


def true_camera(truth: Mapping[str, Any]) -> Camera:
    """Return the camera that took a drive's pictures."""
    model = MODELS[model_of(truth)]
    return model.of((truth['width'], truth['height']),
                    [truth.get(name, 0.0) for name in model.names()])


def calibrations(truth: Camera) -> dict[str, tuple[Camera, Camera]]:
    """Return the calibrations to ask about, and each as it would be taken for these pictures."""
    found = {'truth': truth}
    for sign, name in ((1, '+'), (-1, '-')):
        half = 0.5 * sign
        found[f'half a pixel {name}'] = replace(truth, cx=truth.cx + half, cy=truth.cy + half)
        for key, size in SPOILS.items():
            value = getattr(truth, key)
            step = size if key in ABSOLUTE else size * value
            found[f'{key} {name}'] = replace(truth, **{key: value + sign * step})
    pairs = {name: (camera, camera) for name, camera in found.items()}
    width, height = truth.image_size
    half_size = (width // 2, height // 2)
    # for pictures of half the size: said so, or not
    small = truth.resized(0.5, half_size)
    pairs['half the size'] = (small, replace(small, image_size=truth.image_size))
    pairs['half the size, not told'] = (replace(small, image_size=truth.image_size),) * 2
    cut = replace(truth, image_size=(width, height - height // 5), cy=truth.cy - height // 10)
    pairs['cropped'] = (cut, replace(cut, image_size=truth.image_size))
    return pairs


def ask(solved: Solved) -> dict[str, Any]:
    """Return the answers about each calibration."""
    config, rows = Config(seed=solved.seed), {}
    calibration, solution = solved.calibration, solved.solution
    truth = true_camera(solved.truth)
    px = Scale.of(calibration.image_size, config).px
    for name, (camera, taken) in calibrations(truth).items():
        started = time.perf_counter()
        found = check(camera, calibration.image_size, solution, calibration.verdict, config)
        row = {'answer': found.answer, 'reasons': [*map(str, found.reasons)],
               'rms_px': found.rms_px, 'worst_px': found.worst_px, 'distance': found.distance,
               'limit': found.limit, 'loss': found.loss,
               'seconds': round(time.perf_counter() - started, 2)}
        if solution is not None and calibration.verdict.level == 'accepted':
            spoiled, true = (difference_of(each, solution, px)
                             for each in (taken, truth))
            # the spoil alone, as exactly as this drive would see it
            alone = replace(spoiled, offsets=spoiled.offsets - true.offsets)
            # whoever has a solution has its sigmas
            assert alone.distance is not None
            row['spoil_distance'] = alone.distance
            row['can_tell'] = (name not in pairs_without_size() or
                               alone.distance >= alone.limit + POWER)
        rows[name] = row
    return {'name': solved.name, 'seed': solved.seed, 'verdict': calibration.verdict.level,
            'sigma_px': None if calibration.sigma_px is None else calibration.sigma_px.rms,
            'recorded': solved.name in RECORDED, 'answers': rows, 'commit': commit()}


def pairs_without_size() -> list[str]:
    """Return the names of the spoils that only the drive's geometry can find."""
    return [f'{key} {sign}' for key in SPOILS for sign in '+-']


def tables(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return what became of right and of wrong calibrations, and a line for each drive."""
    rows = [row for row in rows if not row['recorded']]
    names = list(rows[0]['answers']) if rows else []
    lines = []
    for name in names:
        found = [row['answers'][name] for row in rows]
        told = [each for each in found if each.get('can_tell')]
        count = {answer: sum(each['answer'] == answer for each in found)
                 for answer in ('right', 'differs', 'wrong', 'cannot tell')}
        lines.append([name, *(str(value) for value in count.values()),
                      '' if name.startswith(RIGHT) else
                      f'{sum(each["answer"] in FOUND for each in told)} of {len(told)}',
                      _median([each['rms_px'] for each in found])])
    right = [row['answers'][name] for row in rows for name in names if name.startswith(RIGHT)]
    wrong = [row['answers'][name] for row in rows for name in names
             if not name.startswith(RIGHT) and row['answers'][name].get('can_tell')]
    false = sum(each['answer'] == 'wrong' for each in right)
    found_wrong = sum(each['answer'] in FOUND for each in wrong)
    head = ['calibration', 'right', 'differs', 'wrong', 'cannot tell',
            'found where the drive can tell', 'median px']
    by_drive = [[row['name'], str(row['seed']), row['verdict'],
                 '' if row['sigma_px'] is None else f'{row["sigma_px"]:.2f}',
                 *(row['answers'][name]['answer'] for name in names)] for row in rows]
    return (f'{len(rows)} drives: of {len(right)} right calibrations {false} called wrong; of '
            f'{len(wrong)} wrong ones, where the drive can tell, {found_wrong} found.\n\n'
            f'{table(head, lines)}\n\n'
            f'{table(["drive", "seed", "verdict", "sigma px", *names], by_drive)}')


def _median(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f'{np.median(known):.2f}' if known else ''


def main() -> None:
    """Ask every drive."""
    parser = parser_with(__doc__, 'seeds', 'drives', 'data', 'cache', 'again')
    parser.add_argument('--solved', action='store_true', help='only those that are solved already')
    arguments = parser.parse_args()
    cache = arguments.cache or Path('measured/cache')
    names = arguments.drives or [*BY_NAME, *WIDE, *(RECORDED if arguments.data else ())]
    path = arguments.out / 'check.json'
    rows = load(path)
    for seed in arguments.seeds:
        for name in names:
            key = f'{name}, seed {seed}'
            if key in rows and not arguments.again:
                continue
            if arguments.solved and not solution_path(name, seed, cache).exists():
                continue
            if name in RECORDED and seed:
                continue
            rows[key] = ask(solved_drive(name, seed, cache, arguments.data))
            save(path, rows)
            complain(f'{key}: ' + ', '.join(
                f'{what} {row["answer"]}' for what, row in rows[key]['answers'].items()))
    keep_table('check', tables(rows.values()), arguments, [row['commit'] for row in rows.values()])


if __name__ == '__main__':
    main()
