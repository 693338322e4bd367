# SPDX-License-Identifier: Apache-2.0
"""Rows of accuracy.json -> medians beside the bars, honesty, false accepts and refusals."""
from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from measure import ALL_KEYS, FALSE_PERCENT, KEYS, mapping_cell, table

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
    # what is known of a recorded drive's lens is not exact
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
