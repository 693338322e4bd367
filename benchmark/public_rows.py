#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""dashcalib and COLMAP on the drives of benchmark/public: the first rows of its table.

    python benchmark/public_rows.py [--seeds 0 1 2] [--drives NAME ...] [--calibrators NAME ...]
        [--limit S] [--data DIR] [--out DIR] [--again] [--results]

Each gets every picture of a drive, in a process of its own, and leaves its camera in
DIR/public/CALIBRATOR/DRIVE/ for benchmark/public/score.py. COLMAP runs SIFT, its sequential
matcher and incremental mapping with every option at its default, but one camera for all pictures,
and the lens model that a user would choose; its largest model counts. It has no sigma and refuses
nothing.
"""
from __future__ import annotations

import sys
import zlib  # noqa: F401  before pycolmap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
from measure import calibrate as calibrate_frames
from measure import commit, complain, done, isolated, keep_table, load, parser_with, save, table
from rivals import colmap_models
from without_turns import DRIVES

from dashcalib_ros import Calibration, Config, open_frames
from dashcalib_ros.input import Frame

sys.path.append(str(Path(__file__).resolve().parent / 'public'))
from score import HEAD, Known, camera_in, cells, drives, score


def dashcalib(frames: Iterable[Frame], known: Known, folder: Path) -> str:
    """Leave dashcalib's files; return what it said."""
    found, _ = calibrate_frames(frames, Config())
    Calibration.of(found).save(folder)
    return found.verdict.level


def colmap(frames: Iterable[Frame], known: Known, folder: Path) -> str:
    """Leave the largest model of COLMAP's; return how many there were."""
    fisheye = known.drive is not None and known.drive.lens.model == 'fisheye'
    models, _ = colmap_models(frames, 'OPENCV_FISHEYE' if fisheye else 'RADIAL')
    if not models:
        return 'no model'
    folder.mkdir(parents=True, exist_ok=True)
    models[0].write_text(str(folder))
    return f'{models[0].num_reg_images()} pictures in the largest of {len(models)}'


CALIBRATORS: dict[str, Callable[[Iterable[Frame], Known, Path], str]] = {
    'dashcalib': dashcalib, 'COLMAP': colmap}


def one(calibrator: str, known: Known, folder: Path, data: Path | None) -> str:
    """Give a drive to a calibrator (in a process of its own)."""
    cv2.setNumThreads(1)
    if known.drive is not None:
        frames: Iterable[Frame] = map(known.drive.frame, range(len(known.drive)))
    else:
        assert data is not None
        place, fps, *_ = DRIVES[known.name]
        frames = open_frames(data / known.name / place, fps=fps)
    return CALIBRATORS[calibrator](frames, known, folder)


def number(value: float | None, form: str) -> str:
    """Return a cell."""
    return '' if value is None else f'{value:{form}}'


def main() -> None:
    """Measure."""
    parser = parser_with(__doc__, 'data', 'seeds', 'drives', 'again', seeds=[0, 1, 2])
    parser.add_argument('--calibrators', nargs='+', choices=CALIBRATORS, metavar='NAME',
                        default=list(CALIBRATORS), help=f'of {", ".join(CALIBRATORS)}')
    parser.add_argument('--limit', type=float, default=3600.0, help='s, for each drive')
    args = parser.parse_args()
    chosen = [known for known in drives(args.seeds)
              if (known.drive is not None or args.data is not None)
              and (not args.drives or known.name in args.drives)]
    path = args.out / 'public_rows.json'
    rows: dict[str, Any] = load(path)
    for known in chosen:
        for calibrator in args.calibrators:
            key = f'{calibrator} | {known.name}'
            if done(rows.get(key)) and not args.again:
                continue
            complain(key)
            outcome = isolated(one, calibrator, known, args.out / 'public' / calibrator /
                               known.name, args.data, limit_s=args.limit)
            rows[key] = {'said': outcome.value or outcome.failure, 'seconds': outcome.seconds,
                         'verdict': 'failed' if outcome.failure else 'done', 'commit': commit()}
            save(path, rows)
    each, whole = [], []
    for calibrator in CALIBRATORS:
        ran = [known for known in chosen if f'{calibrator} | {known.name}' in rows]
        if not ran:
            continue
        folder = args.out / 'public' / calibrator
        folder.mkdir(parents=True, exist_ok=True)
        scores = [score(known, camera_in(folder, known.name)) for known in ran]
        # what was not done is no refusal
        if ended := [each for each in scores if done(rows[f'{calibrator} | {each.known.name}'])]:
            whole.append(cells(calibrator, ended))
        for known, scored in zip(ran, scores, strict=True):
            row = rows[f'{calibrator} | {known.name}']
            each.append([known.name, calibrator, row['said'], number(scored.off_percent, '+.2f'),
                         number(scored.rays_px, '.2f'),
                         number(max(map(abs, scored.sigmas), default=None), '.1f'),
                         f'{row["seconds"]:.0f}'])
    text = table(['drive', 'calibrator', 'said', 'fx off, %', 'rays off, px',
                  'farthest off, in sigmas', 's'], sorted(each))
    keep_table('public_rows', f'{table(HEAD, whole)}\n\n{text}', args,
               [row['commit'] for row in rows.values()])


if __name__ == '__main__':
    main()
