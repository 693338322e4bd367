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
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from drives import BY_NAME, SETTINGS, Pictures, drive_of, pictures_of
from measure import (
    ALL_KEYS,
    FALSE_PERCENT,
    KEYS,
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
from views import BY_VIEW, INEXACT, SMALL, Viewed, inexact_view, recorded_view, small_view
from wide import WIDE, wide_drive_of

from dashcalib_ros import Config, open_frames
from dashcalib_ros.input import Frame

Row = Mapping[str, Any]

# percent of the truth: median over settings (rendered, five turns, global shutter); worst
MEDIAN_BARS = {'fx': 0.2, 'fy': 0.4, 'cx': 0.2, 'cy': 0.5, 'k1': 0.5, 'k2': 2.0}
WORST_BARS = {'fx': 1.0}
KITTI_BARS = {'fx': 0.75, 'fy': 0.75, 'cx': 0.5, 'cy': 1.0}
ONE_TURN_FX = SHUTTER_FX = 1.5
HONEST_SHARE = 0.9
# of the picture's width, where the focal lengths cannot be compared: what 3 % of fx come to
FALSE_MAPPING_PERCENT = 0.8


def summary(rows: Iterable[Row]) -> str:
    """Return the whole summary in Markdown."""
    rows = list(rows)
    parts = [settings_table(rows), _accuracy(rows), _bars(rows), _mapping(rows), _honesty(rows),
             _mistakes(rows), _cost(rows)]
    return '\n\n'.join(part for part in parts if part)


def settings_table(rows: Sequence[Row]) -> str:
    """Return a line for each setting, over its seeds: the table of results/accuracy.md."""
    lines = []
    for name in dict.fromkeys(row['setting'] for row in rows):
        drives = [row for row in rows if row['setting'] == name]
        found = [row for row in drives if 'error' in row]
        counts = Counter(row['verdict'] for row in drives)
        verdict = ', '.join(f'{count} {level}' for level, count in sorted(counts.items()))
        worst = max((abs(z) for row in found for z in row.get('z', {}).values()), default=None)
        models = dict.fromkeys(row['model'] for row in drives if row.get('model'))
        mapping = [row['mapping_px'] for row in drives if row.get('mapping_px') is not None]
        lines.append([name, drives[0]['verdict'] if drives[0].get('recorded') else verdict,
                      ', '.join(models), _median_px(mapping),
                      *(_median_cell(found, key) for key in KEYS),
                      '' if worst is None else f'{worst:.1f}'])
    return ('Each setting: median of its seeds, the worst in sigmas.\n\n'
            + table(['drive', 'verdict', 'model', 'mapping px', *(f'{key} %' for key in KEYS),
                     'worst error in sigmas'], lines))


def _median_cell(rows: Sequence[Row], key: str) -> str:
    """Return the median error: percent of the truth, or 'abs' where that is 0."""
    rows = [row for row in rows if key in row['error']]
    if not rows:
        return ''
    if any(row['percent'][key] is None for row in rows):
        return f'{statistics.median(abs(row["error"][key]) for row in rows):.3f} abs'
    return f'{statistics.median(row["percent"][key] for row in rows):.2f}'


def _median_px(errors: Sequence[float]) -> str:
    return f'{statistics.median(errors):.2f}' if errors else ''


def _accuracy(rows: Sequence[Row]) -> str:
    """Return the medians over settings of each setting's median over seeds, and the worst."""
    counted = [row for row in rows
               if row['counts'] and row['verdict'] == 'accepted' and 'percent' in row]
    if not counted:
        return ''
    lines = []
    for key in KEYS:
        by_setting: dict[str, list[float]] = {}
        for row in counted:
            if row['percent'][key] is not None:
                by_setting.setdefault(row['setting'], []).append(row['percent'][key])
        if not by_setting:
            continue
        median = statistics.median(map(statistics.median, by_setting.values()))
        name, worst = max(((name, max(values)) for name, values in by_setting.items()),
                          key=lambda item: item[1])
        lines.append([key, f'{median:.3f}', f'{MEDIAN_BARS[key]:g}',
                      _met(median <= MEDIAN_BARS[key]), f'{worst:.3f} ({name})',
                      f'{WORST_BARS[key]:g}' if key in WORST_BARS else '',
                      _met(worst <= WORST_BARS[key]) if key in WORST_BARS else ''])
    settings = len({row['setting'] for row in counted})
    return (f'Rendered, five turns, global shutter, accepted: {len(counted)} drives in {settings} '
            f'settings, error in %.\n\n'
            + table(['', 'median over settings', 'bar', '', 'worst drive', 'bar', ''], lines))


def _bars(rows: Sequence[Row]) -> str:
    """Return the bars on single settings."""
    lines = []
    for row in (row for row in rows if row['setting'] == 'kitti03' and 'percent' in row):
        for key, bar in KITTI_BARS.items():
            off = row['percent'][key]
            lines.append([f'kitti03 {key}', f'{off:.2f} %', f'{bar:g} %', _met(off <= bar)])
        lines.append(['kitti03 verdict', row['verdict'], 'accepted',
                      _met(row['verdict'] == 'accepted')])
    for name, bar in (('one turn', ONE_TURN_FX), ('rolling shutter 20 ms', SHUTTER_FX)):
        for row in (row for row in rows if row['setting'] == name):
            off = f', fx {row["percent"]["fx"]:.2f} %' if 'percent' in row else ''
            flagged = row['verdict'] in ('weak', 'refused')
            lines.append([f'{name}, seed {row["seed"]}', row['verdict'] + off,
                          f'fx {bar:g} % or flagged',
                          _met(flagged or ('percent' in row and row['percent']['fx'] <= bar))])
    return table(['drive', 'measured', 'bar', ''], lines) if lines else ''


def _mapping(rows: Sequence[Row]) -> str:
    """Return for each kind of lens whether it was recognised, and the errors in pixels."""
    rows = [row for row in rows if row.get('truth_model') and row['must'] != 'refuse']
    lines = []
    # what is known about a recorded drive's lens is not exact
    kinds = {(bool(row.get('recorded')), row['truth_model']) for row in rows}
    for recorded, truth in sorted(kinds):
        of_truth = [row for row in rows
                    if row['truth_model'] == truth and bool(row.get('recorded')) == recorded]
        found = [row for row in of_truth if row.get('mapping_px') is not None]
        chosen = Counter(row['model'] for row in found)
        worst = max(found, key=lambda row: row['mapping_px'], default=None)
        lines.append([
            truth + ', recorded' * recorded, str(len(of_truth)),
            f'{chosen[truth]} of {len(found)}',
            ', '.join(f'{count} {name}' for name, count in sorted(chosen.items())
                      if name != truth),
            str(sum(row['verdict'] == 'accepted' for row in of_truth)),
            _median_px([row['mapping_px'] for row in found]),
            '' if worst is None else (f'{mapping_cell(worst)} ({worst["setting"]}, seed '
                                      f'{worst["seed"]}, {worst["verdict"]})')])
    if not lines:
        return ''
    return ('Mapping error: RMS over the picture, px, the best rotation removed; of all drives '
            'that have a camera.\n\n'
            + table(['true model', 'drives', 'that model chosen', 'other models', 'accepted',
                     'median px', 'worst px'], lines))


def _honesty(rows: Sequence[Row]) -> str:
    """Return how often the truth lies within 1 and 2 sigma."""
    lines = []
    for title, chosen in (
            ('accepted', [row for row in rows if row['verdict'] == 'accepted']),
            ('weak', [row for row in rows if row['verdict'] == 'weak'])):
        found = [row['z'] for row in chosen if 'z' in row and not row.get('recorded')]
        for key in ALL_KEYS:
            z = [abs(values[key]) for values in found if key in values]
            if not z:
                continue
            within = [sum(value <= sigmas for value in z) / len(z) for sigmas in (1, 2)]
            bar = title == 'accepted' and key == 'fx'
            lines.append([title, key, str(len(z)), f'{within[0]:.0%}', f'{within[1]:.0%}',
                          f'{statistics.median(z):.2f}', f'{max(z):.1f}',
                          f'{HONEST_SHARE:.0%}' if bar else '',
                          _met(within[1] >= HONEST_SHARE) if bar else ''])
    if not lines:
        return ''
    return ('Truth within so many sigma, rendered drives (a normal error: 68 % and 95 %, '
            'median 0.67).\n\n'
            + table(['verdict', '', 'drives', '1 sigma', '2 sigma', 'median of z', 'worst z',
                     'bar', ''], lines))


def _mistakes(rows: Sequence[Row]) -> str:
    """Return verdicts that are wrong."""
    false = [row for row in rows if row['verdict'] == 'accepted'
             and (row['must'] == 'refuse' or _far_off(row))]
    clean = [row for row in rows if row['must'] == 'accept']
    withheld = [row for row in clean if row['verdict'] != 'accepted']
    hopeless = [row for row in rows if row['must'] == 'refuse']
    kept = [row for row in hopeless if row['verdict'] != 'refused']
    failed = [row for row in rows if row['verdict'] == 'failed']
    lines = [
        [f'false accepts (fx off by more than {FALSE_PERCENT:g} %, or no turn at all; another '
         f'kind of lens, and off by more than {FALSE_MAPPING_PERCENT:g} % of the width)',
         *_count(false, rows), '0', _met(not false)],
        ['false refusals (clean drives of five turns or more, not accepted)',
         *_count(withheld, clean), '', ''],
        ['hopeless drives that were not refused', *_count(kept, hopeless), '', ''],
        ['crashes', *_count(failed, rows), '', '']]
    return table(['', 'drives', 'which', 'bar', ''], lines)


def _far_off(row: Row) -> bool:
    """Return whether a result would mislead."""
    if 'percent' in row:
        return bool(row['percent']['fx'] > FALSE_PERCENT)
    limit = FALSE_MAPPING_PERCENT / 100 * row['truth']['width']
    return bool(row['mapping_px'] is None or row['mapping_px'] > limit)


def _cost(rows: Sequence[Row]) -> str:
    """Return time by stage and memory, medians over the counted drives."""
    counted = [row for row in rows if row['counts'] and row['seconds']]
    if not counted:
        return ''
    stages = list(dict.fromkeys(name for row in counted for name in row['seconds']))
    lines = [[f'{name}, s'] + _spread([row['seconds'].get(name, 0.0) for row in counted])
             for name in stages]
    lines.append(['peak memory of all processes, MB',
                  *_spread([row['peak_mb'] for row in counted])])
    return table(['drives of five turns or more', 'median', 'most'], lines)


def _spread(values: Sequence[float]) -> list[str]:
    return [f'{statistics.median(values):.1f}', f'{max(values):.1f}']


def _count(found: Sequence[Row], of: Sequence[Row]) -> list[str]:
    return [f'{len(found)} of {len(of)}',
            '; '.join(f'{row["setting"]}, seed {row["seed"]} ({row["verdict"]})'
                      for row in found)]


def _met(condition: bool) -> str:
    return 'met' if condition else 'missed'


RECORDED = {'kitti03': 'bag', 'carnd': 'drive.mp4', 'ntu_campus': 'images'}
# images per second, of folders
FPS = {'ntu_campus': 3.0}
# what is known about a lens, where that is not all
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
