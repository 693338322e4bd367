#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Accuracy, honesty and refusals, measured on rendered drives with exact truth and on real ones.

    python benchmark/accuracy.py [--drives SETTING ...] [--seeds 0 1 2] [--data DIR] [--cache DIR]
                                 [--out DIR] [--results] [--again] [--list] [--summary]
                                 [--solved]

Runs every setting (or those named; part of a name will do) with every seed. Rows go to
DIR/accuracy.json after each drive, and one that is there is not run again (--again: it is);
DIR/accuracy.md has each setting, the bars and honesty; --results writes the same into
benchmark/results/accuracy.md. --data: a folder with kitti03/,
carnd/ and ntu_campus/ (bag, video or images beside a truth.json); kitti03 is seen through other
lenses, too (views.py). --cache: where rendered pictures are kept, about 100 MB a drive; a second
run renders nothing.
"""
from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from drives import BY_NAME, SETTINGS, Pictures, drive_of, pictures_of
from measure import (
    ALL_KEYS,
    Outcome,
    calibrate,
    commit,
    complain,
    done,
    error_cells,
    isolated,
    keep_table,
    load,
    mapping_cell,
    parser_with,
    save,
    summarised,
    table,
)
from solutions import solution_path, solved_drive
from summary import summary
from views import BY_VIEW, INEXACT, SMALL, Viewed, inexact_view, recorded_view, small_view
from wide import WIDE, wide_drive_of

from dashcalib_ros import Config, open_frames
from dashcalib_ros.input import Frame

RECORDED = {'kitti03': 'bag', 'carnd': 'drive.mp4', 'ntu_campus': 'images'}
# images per second, of folders
FPS = {'ntu_campus': 3.0}
# what is known of a lens, where that is not all
KNOWN = {'ntu_campus': ('fx', 'fy')}


def rendered(pictures: Pictures, seed: int, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Calibrate a rendered drive (in a process of its own)."""
    return _row(pictures, Config(seed=seed), truth)


def viewed(drive: Viewed, seed: int) -> dict[str, Any]:
    """Calibrate a drive as another camera would have seen it (in a process of its own)."""
    return _row(drive, Config(seed=seed), drive.truth)


def recorded(name: str, data: Path) -> dict[str, Any]:
    """Calibrate a real drive (in a process of its own)."""
    truth = {key: value for key, value in json.loads((data / name / 'truth.json').read_text()
                                                     ).items() if not isinstance(value, list)}
    return _row(open_frames(data / name / RECORDED[name], fps=FPS.get(name)), Config(), truth,
                KNOWN.get(name, ALL_KEYS))


def _row(frames: Iterable[Frame], config: Config, truth: Mapping[str, Any],
         known: Sequence[str] = ALL_KEYS) -> dict[str, Any]:
    result, seconds = calibrate(frames, config)
    return summarised(result, truth, known) | {'truth': dict(truth), 'seconds': seconds}


def _finished(outcome: Outcome, about: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row to keep; a crash is a verdict too."""
    row = outcome.value or {'verdict': 'failed', 'reasons': [outcome.failure], 'seconds': {}}
    return {**about, **row, 'peak_mb': round(outcome.peak_mb), 'commit': commit()}


def run_rendered(name: str, seed: int, cache: Path) -> dict[str, Any]:
    """Render a drive, or take it from the cache, and calibrate it."""
    setting = BY_NAME[name]
    drive = drive_of(setting, seed)
    started = time.monotonic()
    pictures = pictures_of(drive, cache)
    about = {'setting': name, 'seed': seed, 'must': setting.must, 'counts': setting.counts,
             'true_turns': list(drive.turn_centers),
             'render_s': round(time.monotonic() - started, 1)}
    truth = {**drive.truth, 'width': drive.lens.width, 'height': drive.lens.height}
    return _finished(isolated(rendered, pictures, seed, truth), about)


def run_recorded(name: str, data: Path) -> dict[str, Any]:
    """Calibrate a real drive."""
    about = {'setting': name, 'seed': 0, 'must': 'accept' if name == 'kitti03' else 'judge',
             'counts': False, 'recorded': True}
    if name in RECORDED:
        return _finished(isolated(recorded, name, data), about)
    drive = recorded_view(name, data / 'kitti03' / RECORDED['kitti03'],
                          data / 'kitti03' / 'truth.json')
    return _finished(isolated(viewed, drive, 0), about)


def run_viewed(name: str, seed: int, cache: Path) -> dict[str, Any]:
    """Calibrate a rendered drive whose lens has p1, p2 or k3, or whose pictures are small."""
    about = {'setting': name, 'seed': seed, 'must': 'judge', 'counts': False}
    view = (small_view if name in SMALL else inexact_view)(name, seed, cache)
    return _finished(isolated(viewed, view, seed), about)


def run_wide(name: str, seed: int, cache: Path) -> dict[str, Any]:
    """Render a drive through a fisheye lens, or take it from the cache, and calibrate it."""
    drive = wide_drive_of(name, seed)
    started = time.monotonic()
    pictures = pictures_of(drive, cache)
    about = {'setting': name, 'seed': seed, 'must': 'accept', 'counts': False,
             'true_turns': list(drive.turn_centers),
             'render_s': round(time.monotonic() - started, 1)}
    return _finished(isolated(rendered, pictures, seed, drive.truth), about)


def already_solved(name: str, seed: int, cache: Path) -> dict[str, Any] | None:
    """Return the row of a rendered drive that check.py has calibrated; None if it has not."""
    if name not in BY_NAME or not solution_path(name, seed, cache).exists():
        return None
    solved, setting = solved_drive(name, seed, cache), BY_NAME[name]
    return {'setting': name, 'seed': seed, 'must': setting.must, 'counts': setting.counts,
            'true_turns': list(drive_of(setting, seed).turn_centers),
            **summarised(solved.calibration, solved.truth), 'truth': dict(solved.truth),
            'seconds': {}, 'peak_mb': 0, 'commit': solved.commit}


def drives_table(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return a line for each drive."""
    head = ['drive', 'seed', 'verdict', 'turns', 'model', 'mapping px', 'fx %', 'fy %', 'cx %',
            'cy %', 'k1 %', 'k2 %', 'z of fx', 'worst z', 's', 'MB']
    lines = []
    for row in rows:
        z = row.get('z')
        lines.append([
            row['setting'], str(row['seed']), row['verdict'], str(row.get('turns_used', '')),
            row.get('model', ''), mapping_cell(row),
            *error_cells(row), f'{z["fx"]:+.1f}' if z else '',
            f'{max(map(abs, z.values())):.1f}' if z else '',
            f'{row["seconds"].get("total", 0.0):.0f}', str(row['peak_mb'])])
    return table(head, lines)


def _chosen(wanted: list[str], data: Path | None) -> list[str]:
    real = [name for name in RECORDED if data is not None and (data / name).is_dir()]
    names = [*real, *BY_NAME, *INEXACT, *WIDE, *SMALL, *(BY_VIEW if 'kitti03' in real else ())]
    for part in wanted:
        if not any(part in name for name in names):
            raise SystemExit(f'no setting has {part!r} in its name; --list shows them all')
    return [name for name in names
            if not wanted or name in wanted
            # a whole name means that one, not those that begin with it
            or any(part in name for part in set(wanted) - set(names))]


def _real(name: str) -> bool:
    return name in RECORDED or name in BY_VIEW


def main() -> None:
    """Run what is asked for."""
    parser = parser_with(__doc__, 'seeds', 'drives', 'data', 'cache', 'again')
    parser.add_argument('--list', action='store_true', help='name the settings, and end')
    parser.add_argument('--solved', action='store_true',
                        help='take the solutions that check.py has in the cache, and run nothing')
    parser.add_argument('--summary', action='store_true', help='of the rows there are, and end')
    arguments = parser.parse_args()
    if arguments.list:
        print('\n'.join([*(f'{setting.name} ({setting.must})' for setting in SETTINGS),
                         *INEXACT, *(f'{name} (accept)' for name in WIDE), *SMALL,
                         *BY_VIEW]))
        return
    path = arguments.out / 'accuracy.json'
    rows = load(path)
    if not arguments.summary:
        names = _chosen(arguments.drives or [], arguments.data)
        # one seed of everything before the next seed: an interrupted run covers all settings
        jobs = [(name, seed) for seed in arguments.seeds for name in names
                if seed == arguments.seeds[0] or not _real(name)]
        with tempfile.TemporaryDirectory() as passing:
            for number, (name, seed) in enumerate(jobs, 1):
                seed = 0 if _real(name) else seed
                key = f'{name}, seed {seed}'
                if done(rows.get(key)) and not arguments.again:
                    continue
                cache = arguments.cache or Path(passing) / str(number)
                if arguments.solved:
                    if (row := already_solved(name, seed, cache)) is not None:
                        rows[key] = row
                    continue
                row = (run_recorded(name, arguments.data) if _real(name)
                       else run_wide(name, seed, cache) if name in WIDE
                       else run_viewed(name, seed, cache) if name in INEXACT or name in SMALL
                       else run_rendered(name, seed, cache))
                rows[key] = row
                save(path, rows)
                complain(f'{number} of {len(jobs)}, rendered in {row.get("render_s", 0)} s')
                print(drives_table([row]).splitlines()[-1], '; '.join(row['reasons']), flush=True)
                if not arguments.cache:
                    _forget(Path(passing) / str(number))
    save(path, rows)
    keep_table('accuracy', summary(_ordered(rows)), arguments, _commits(rows))


def _ordered(rows: Mapping[str, dict[str, Any]]) -> list[dict[str, Any]]:
    order = [*RECORDED, *BY_NAME, *INEXACT, *WIDE, *SMALL, *BY_VIEW]
    known = [row for row in rows.values() if row['setting'] in order]
    return sorted(known, key=lambda row: (order.index(row['setting']), row['seed']))


def _commits(rows: Mapping[str, dict[str, Any]]) -> list[str]:
    return sorted({row['commit'] for row in rows.values() if row['commit']})


def _forget(folder: Path) -> None:
    import shutil
    shutil.rmtree(folder, ignore_errors=True)


if __name__ == '__main__':
    main()
