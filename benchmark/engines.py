#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Are the engines that estimate poses equal? Drives calibrated with each, in one table.

    python benchmark/engines.py [--data DIR] [--cache DIR] [--workers N] [--results]

fx, its sigma, the verdict and the seconds of processor time of kitti03 and kitti07 (with --data),
of the first ten settings of accuracy.py and of two demo lenses. Random dashcams: population.py
--engine, twice.
"""
from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from drives import SETTINGS, drive_of, pictures_of
from measure import calibrate, complain, isolated, keep_table, parser_with, processor_s, table

from dashcalib_ros import Config, open_frames
from dashcalib_ros.config import COLMAP, OPENCV
from dashcalib_ros.demo import demo_drive
from dashcalib_ros.input import Frame

LENSES = ('radial', 'fisheye')
ENGINES = (COLMAP, OPENCV)
# Hz; of pictures without stamps
KITTI07_FPS = 9.65


def measured(frames: Iterable[Frame], engine: str) -> dict[str, Any]:
    """Calibrate a drive with an engine (in a process of its own) and return what counts."""
    started = processor_s()
    result, _ = calibrate(frames, Config().replace({'reconstruct.engine': engine}))
    camera = result.camera
    return {'verdict': result.verdict.level, 'cpu_s': processor_s() - started,
            'fx': None if camera is None else camera.fx,
            'sigma': None if result.sigma is None else float(result.sigma['fx'])}


def recorded(path: Path, fps: float | None, engine: str) -> dict[str, Any]:
    """Calibrate a recorded drive (in a process of its own)."""
    return measured(open_frames(path, fps=fps), engine)


def with_each_engine(name: str, true_fx: float, calibrated: Any) -> list[dict[str, Any]]:
    """Return a row for each engine; one that failed has its failure for a verdict."""
    rows = []
    for engine in ENGINES:
        outcome = isolated(calibrated, engine)
        found = outcome.value or {'verdict': outcome.failure, 'fx': None, 'sigma': None,
                                  'cpu_s': float('nan')}
        off = None if found['fx'] is None else 100 * (found['fx'] / true_fx - 1)
        rows.append({'drive': name, 'engine': engine, 'off_percent': off, **found})
        complain(' '.join(cells(rows[-1])))
    return rows


def cells(row: Mapping[str, Any]) -> list[str]:
    """Return the cells of a drive and an engine."""
    return [row['drive'], row['engine'], row['verdict'],
            *(['-'] * 3 if row['fx'] is None else
              [f'{row["fx"]:.2f}', f'{row["off_percent"]:+.2f}', f'{row["sigma"]:.2f}']),
            f'{row["cpu_s"]:.1f}']


def compared(pairs: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> str:
    """Return the summary of all drives, each with the first and the second engine."""
    both = [pair for pair in pairs if all(row['fx'] is not None for row in pair)]
    medians = [np.median([abs(pair[n]['off_percent']) for pair in both]) for n in (0, 1)]
    sigmas = [second['sigma'] / first['sigma'] for first, second in both]
    spent = [sum(pair[n]['cpu_s'] for pair in pairs) for n in (0, 1)]
    equal = sum(first['verdict'] == second['verdict'] for first, second in pairs)
    return table(('', *ENGINES, 'second over first'), [
        ['verdicts that are equal', '', '', f'{equal} of {len(pairs)}'],
        ['fx off, %: median', *(f'{median:.3f}' for median in medians),
         f'{medians[1] / medians[0]:.2f}'],
        ['sigma of fx: median; least, most', '', '',
         f'{np.median(sigmas):.2f}; {min(sigmas):.2f}, {max(sigmas):.2f}'],
        ['CPU s', *(f'{seconds:.0f}' for seconds in spent), f'{spent[1] / spent[0]:.2f}']])


def main() -> None:
    """Measure and print."""
    parser = parser_with(__doc__, 'data', 'cache')
    parser.add_argument('--workers', type=int, default=1, help='drives at a time')
    parser.set_defaults(cache=Path('measured/pictures'))
    args = parser.parse_args()
    drives: list[tuple[str, float, Any]] = []
    if args.data is not None:
        for name, path, fps in (('kitti03', 'kitti03/bag', None),
                                ('kitti07', 'kitti07/images', KITTI07_FPS)):
            truth = json.loads((args.data / name / 'truth.json').read_text())
            drives.append((name, truth['fx'], partial(recorded, args.data / path, fps)))
    rendered = {f'demo {lens}': demo_drive(0, lens) for lens in LENSES}
    rendered |= {setting.name: drive_of(setting, 0) for setting in SETTINGS[:10]}
    for name, drive in rendered.items():
        drives.append((name, drive.lens.fx, partial(measured, pictures_of(drive, args.cache))))
    with ThreadPoolExecutor(args.workers) as pool:
        pairs = list(pool.map(lambda drive: with_each_engine(*drive), drives))
    text = table(('drive', 'engine', 'verdict', 'fx px', 'off %', 'sigma px', 'CPU s'),
                 [cells(row) for pair in pairs for row in pair])
    text += f'\n\n{compared([(first, second) for first, second in pairs])}'
    keep_table('engines', text, args)


if __name__ == '__main__':
    main()
