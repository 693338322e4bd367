#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The paper's curves: error of each parameter against number of turns and against frame rate.

    python benchmark/curves.py [--seeds 0 1 2] [--turns 1 2 3 ...] [--data DIR]
                               [--cache DIR] [--out DIR] [--results] [--again] [--plot]

Turns: one rendered drive of ten turns for each seed; each turn is reconstructed once, and the n
most prominent are solved together. Rates: one drive of five turns for each seed, rendered at
10 fps, of which every k-th frame is taken; with --data also kitti03's. Points go to
DIR/curves.json as they come; DIR/curves_turns.png and curves_rate.png are drawn from it (--plot:
do only that; needs matplotlib); --results puts them and the table into benchmark/results/.

Line: median over the rendered drives; points: the drives, marked
by their verdicts; shaded: up to the median sigma, which is what the errors should look like.
"""
from __future__ import annotations

import argparse
import json
import shutil
import statistics
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from drives import DEMO, STREET, Setting, drive_of, pictures_of
from measure import (
    KEYS,
    calibrate,
    commit,
    complain,
    done,
    isolated,
    keep_table,
    load,
    parser_with,
    reconstructed,
    save,
    solved,
    summarised,
    table,
)
from result_tables import RESULTS

from dashcalib_ros import Config, open_frames
from dashcalib_ros.detect.detection import detect
from dashcalib_ros.input import Frame

TURNS = Setting('curve over turns', DEMO, replace(STREET, turns=10))
RATES = Setting('curve over rates', DEMO, STREET)
# of 10 fps: every k-th frame
EVERY = (1, 2, 3, 4, 5, 7, 10)
FULL_RATE = 10.0
MARKS = {'accepted': 'o', 'weak': '^'}


def over_turns(frames: Iterable[Frame], counts: Sequence[int], seed: int,
               truth: Mapping[str, float]) -> dict[int, dict[str, Any]]:
    """Solve with so many turns each, best first; a turn's scene is built for the first only."""
    config = Config(seed=seed).replace({'turns.wanted': 1, 'turns.at_most': 1})
    detection = detect(frames, config)
    scenes = reconstructed(detection, detection.turns(), config)
    return {count: summarised(solved(detection, scenes[:count], config), truth)
            for count in sorted(counts)}


def at_rate(frames: Iterable[Frame], every: int, seed: int, truth: Mapping[str, float]
            ) -> dict[str, Any]:
    """Calibrate with every k-th frame."""
    thinned = (replace(frame, index=index)
               for index, frame in enumerate(islice(frames, 0, None, every)))
    return summarised(calibrate(thinned, Config(seed=seed))[0], truth)


def measure(arguments: argparse.Namespace, rows: dict[str, Any], path: Path, passing: Path
            ) -> None:
    """Fill in what is missing: rows by 'turns 5, seed 0'."""
    def missing(kind: str, values: Sequence[int], name: str) -> list[int]:
        return [value for value in values
                if arguments.again or not done(rows.get(f'{kind} {value}, {name}'))]

    def keep(kind: str, value: int, name: str, row: Mapping[str, Any] | None, why: str) -> None:
        x = FULL_RATE / value if kind == 'every' else value
        rows[f'{kind} {value}, {name}'] = {
            'curve': 'rate' if kind == 'every' else 'turns', 'x': x, 'drive': name,
            'commit': commit(), **(row or {'verdict': 'failed', 'reasons': [why]})}
        save(path, rows)
        complain(f'{kind} {value}, {name}: {rows[f"{kind} {value}, {name}"]["verdict"]}')

    for seed in arguments.seeds:
        name = f'seed {seed}'
        if counts := missing('turns', arguments.turns, name):
            drive = drive_of(TURNS, seed)
            outcome = isolated(over_turns, pictures_of(drive, arguments.cache or passing), counts,
                               seed, drive.truth)
            for count in counts:
                keep('turns', count, name, (outcome.value or {}).get(count), outcome.failure)
        if steps := missing('every', EVERY, name):
            drive = drive_of(RATES, seed)
            pictures = pictures_of(drive, arguments.cache or passing)
            for every in steps:
                outcome = isolated(at_rate, pictures, every, seed, drive.truth)
                keep('every', every, name, outcome.value, outcome.failure)
    if arguments.data is not None:
        folder = arguments.data / 'kitti03'
        truth = json.loads((folder / 'truth.json').read_text())
        for every in missing('every', EVERY, 'kitti03'):
            outcome = isolated(at_rate, open_frames(folder / 'bag'), every, 0,
                               {key: truth[key] for key in KEYS})
            keep('every', every, 'kitti03', outcome.value, outcome.failure)


def plot(rows: Sequence[Mapping[str, Any]], curve: str, path: Path) -> None:
    """Draw one curve: a panel for each parameter."""
    import matplotlib
    matplotlib.use('agg')
    import matplotlib.pyplot as plt
    label = {'turns': 'turns wanted', 'rate': 'frames per second'}[curve]
    chosen = sorted((row for row in rows if row['curve'] == curve), key=lambda row: row['x'])
    figure, panels = plt.subplots(2, 3, figsize=(11, 6), layout='constrained', sharex=True)
    for key, panel in zip(KEYS, panels.T.flat, strict=True):
        xs, medians, sigmas = [], [], []
        for x in sorted({row['x'] for row in chosen}):
            here = [row for row in chosen if row['x'] == x and row['drive'] != 'kitti03'
                    and 'percent' in row and row['percent'][key] is not None]
            if here:
                xs.append(x)
                medians.append(statistics.median(row['percent'][key] for row in here))
                sigmas.append(statistics.median(
                    100 * row['sigma'][key] / abs(row['estimate'][key] - row['error'][key])
                    for row in here))
        panel.plot(xs, medians, color='C0', label='median, rendered')
        panel.fill_between(xs, 0, sigmas, color='C0', alpha=0.15, linewidth=0,
                           label='up to its sigma')
        ceiling = 1.3 * max([*medians, *sigmas], default=1.0)
        _points(panel, chosen, key, ceiling)
        panel.set(title=key, ylabel='error, %', ylim=(0, ceiling))
        panel.grid(alpha=0.3)
    for panel in panels[1]:
        panel.set_xlabel(label)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=4, frameon=False)
    figure.savefig(path, dpi=80, metadata={'Software': None})
    plt.close(figure)


def medians(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the median error over the rendered drives, and what became of them."""
    lines = []
    for curve, x in sorted({(row['curve'], row['x']) for row in rows}):
        here = [row for row in rows if (row['curve'], row['x']) == (curve, x)
                and row['drive'] != 'kitti03']
        found = [row['percent'] for row in here if 'percent' in row]
        lines.append([
            f'turns: {x:.0f}' if curve == 'turns' else f'{x:.1f} Hz',
            f'{sum(row["verdict"] == "accepted" for row in here)} of {len(here)}',
            *(f'{statistics.median(each[key] for each in found):.2f}' if found else ''
              for key in KEYS)])
    return table(['', 'accepted', *(f'{key} %' for key in KEYS)], lines)


def _points(panel: Any, rows: Sequence[Mapping[str, Any]], key: str, ceiling: float) -> None:
    """Mark each drive; one beyond the picture sits at its upper edge, a refusal on the axis."""
    labelled = set()
    for row in rows:
        refused = 'percent' not in row
        if not refused and row['percent'][key] is None:
            continue
        real = row['drive'] == 'kitti03'
        verdict = 'refused or failed' if refused else row['verdict']
        label = f'{"kitti03" if real else "rendered"}, {verdict}'
        y = 0.0 if refused else min(row['percent'][key], 0.98 * ceiling)
        color = 'C1' if real else 'C0'
        panel.plot(row['x'], y, MARKS.get(verdict, 'x'), color=color, clip_on=False, ms=5,
                   mfc=color if verdict == 'accepted' else 'none', ls='none',
                   label='' if label in labelled else label)
        labelled.add(label)


def main() -> None:
    """Run what is asked for."""
    parser = parser_with(__doc__, 'seeds', 'data', 'cache', 'again')
    parser.add_argument('--turns', nargs='+', type=int, default=list(range(1, 11)))
    parser.add_argument('--plot', action='store_true', help='of the rows there are, and end')
    arguments = parser.parse_args()
    path = arguments.out / 'curves.json'
    rows = load(path)
    if not arguments.plot:
        with tempfile.TemporaryDirectory() as passing:
            measure(arguments, rows, path, Path(passing))
    for curve in ('turns', 'rate'):
        plot(list(rows.values()), curve, arguments.out / f'curves_{curve}.png')
    if arguments.results:
        for name in ('curves_turns.png', 'curves_rate.png'):
            shutil.copy(arguments.out / name, RESULTS / name)
    keep_table('curves', medians(list(rows.values())), arguments,
               [row['commit'] for row in rows.values()])


if __name__ == '__main__':
    main()
