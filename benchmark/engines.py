#!/usr/bin/env python3
"""Are the engines that estimate poses equal? Drives calibrated with each, in one table.

    python benchmark/engines.py --data DIR [--cache DIR]

fx, its sigma, the verdict and the seconds of processor time of kitti03 and kitti07 (with --data),
of rendered lenses and settings. Prints a Markdown table.
"""
from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

from drives import BY_NAME, drive_of, pictures_of
from measure import calibrate, commit, isolated, parser_with, processor_s, table

from dashcalib_ros import Config, open_frames
from dashcalib_ros.config import COLMAP, OPENCV
from dashcalib_ros.demo import demo_drive
from dashcalib_ros.input import Frame

LENSES = ('radial', 'fisheye')
SETTINGS = ('KITTI raw lens, 1392x512', 'dashcam: bonnet, text', '640x480, fy/fx 1.01, noise 3')
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


def row(name: str, engine: str, true_fx: float, found: dict[str, Any]) -> list[str]:
    """Return the cells of a drive and an engine."""
    fx = found['fx']
    return [name, engine, found['verdict'],
            *(['-'] * 3 if fx is None else [f'{fx:.2f}', f'{100 * (fx / true_fx - 1):+.2f} %',
                                            f'{found["sigma"]:.2f}']),
            f'{found["cpu_s"]:.1f}']


def main() -> int:
    """Measure and print."""
    parser = parser_with(__doc__, 'data', 'cache')
    parser.set_defaults(cache=Path('measured/pictures'))
    args = parser.parse_args()
    drives: dict[str, tuple[float, Any]] = {}
    if args.data is not None:
        for name, path, fps in (('kitti03', 'kitti03/bag', None),
                                ('kitti07', 'kitti07/images', KITTI07_FPS)):
            truth = json.loads((args.data / name / 'truth.json').read_text())
            drives[name] = truth['fx'], partial(recorded, args.data / path, fps)
    rendered = {f'demo {lens}': demo_drive(0, lens) for lens in LENSES}
    rendered |= {name: drive_of(BY_NAME[name], 0) for name in SETTINGS}
    for name, drive in rendered.items():
        drives[name] = drive.lens.fx, partial(measured, pictures_of(drive, args.cache))
    rows, failed = [], False
    for name, (true_fx, calibrated) in drives.items():
        for engine in ENGINES:
            outcome = isolated(calibrated, engine)
            failed |= outcome.value is None
            rows.append([name, engine, outcome.failure, *['-'] * 4] if outcome.value is None
                        else row(name, engine, true_fx, outcome.value))
            print(' '.join(rows[-1]), file=sys.stderr, flush=True)
    print(f'commit {commit()}\n')
    print(table(('drive', 'engine', 'verdict', 'fx px', 'off', 'sigma px', 'CPU s'), rows))
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
