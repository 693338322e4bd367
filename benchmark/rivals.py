#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""dashcalib beside COLMAP's defaults and a trivial guess, on the same frames in the same run.

    python benchmark/rivals.py [--drives SETTING ...] [--rivals NAME ...] [--seeds 0] [--turns 5]
        [--matcher sequential|exhaustive] [--whole] [--limit S] [--data DIR] [--cache DIR]
        [--out DIR] [--again] [--list]

Detection finds the turns; then each rival gets its frames, in a process of its own: dashcalib the
turns, or as many random windows of the same lengths; COLMAP the same turns, the same windows, or
(--whole) every frame. COLMAP runs SIFT, its matcher and incremental mapping with every option at
its default, but one camera for all images, of the model RADIAL, as the truth is; GLOMAP is the
same with its view graph calibrated and global mapping. The sequential matcher is the cheaper one.
Ratios are of processor time, of all processes. Rows go to DIR/rivals.json as they come, a table to
DIR/rivals.md.
"""
from __future__ import annotations

import argparse
import json
import tempfile
import time
import zlib  # noqa: F401  before pycolmap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from drives import BY_NAME, DEMO, KITTI_RAW, NARROW, STREET, Setting, drive_of, pictures_of
from measure import (
    Stopwatch,
    commit,
    complain,
    done,
    error_cells,
    errors,
    isolated,
    keep_table,
    load,
    parser_with,
    processor_s,
    reconstructed,
    save,
    solved,
    summarised,
    table,
)

from dashcalib_ros import Config, open_frames
from dashcalib_ros.detect import Turn
from dashcalib_ros.detect.detection import Detection, detect
from dashcalib_ros.input import Frame
from dashcalib_ros.input.scale import Scale

# straights as long as the turns, so that random windows are not turns by necessity
LONG = replace(STREET, straight_m=75.0, lead_m=50.0)
OWN = (
    Setting('dashcam, long straights', DEMO, replace(LONG, bonnet=True, timestamp=True)),
    Setting('KITTI raw lens, long straights', KITTI_RAW, LONG),
    Setting('48 deg, long straights', NARROW, LONG),
)
RENDERED = {**{setting.name: setting for setting in OWN}, **BY_NAME}
RECORDED = {'kitti03': 'bag', 'carnd': 'drive.mp4'}


@dataclass(frozen=True)
class Task:
    """What a rival gets. frames: all of the drive; truth: fx .. k2; limit_s for all it does."""

    frames: Iterable[Frame]
    truth: Mapping[str, float]
    config: Config
    seed: int
    matcher: str
    limit_s: float


def trivial(task: Task) -> dict[str, Any]:
    """f = 1.2 max(w, h), the centre in the middle, no distortion: COLMAP's first guess."""
    width, height = next(iter(task.frames)).size
    focal = 1.2 * max(width, height)
    guess = {'fx': focal, 'fy': focal, 'cx': (width - 1) / 2, 'cy': (height - 1) / 2,
             'k1': 0.0, 'k2': 0.0}
    return {'seconds': 0.0, **errors(guess, task.truth)}


def ours_on_turns(task: Task) -> dict[str, Any]:
    """dashcalib as it is."""
    detection = detect(task.frames, task.config)
    return _ours(task, detection, _best(task, detection))


def ours_on_windows(task: Task) -> dict[str, Any]:
    """dashcalib's reconstruction without its turns."""
    detection = detect(task.frames, task.config)
    return _ours(task, detection, _windows(task, detection))


def colmap_on_turns(task: Task) -> dict[str, Any]:
    """COLMAP on the turns that dashcalib used, together."""
    return _colmap(task, _best(task, detect(task.frames, task.config)))


def glomap_on_turns(task: Task) -> dict[str, Any]:
    """COLMAP's global mapping on the turns that dashcalib used."""
    return _colmap(task, _best(task, detect(task.frames, task.config)), globally=True)


def colmap_on_windows(task: Task) -> dict[str, Any]:
    """COLMAP on the random windows, together."""
    return _colmap(task, _windows(task, detect(task.frames, task.config)))


def colmap_on_all(task: Task) -> dict[str, Any]:
    """COLMAP on every frame of the drive (thinned to the detector's rate)."""
    return _colmap(task, [_window(_thinned(task))])


RIVALS: dict[str, Callable[[Task], dict[str, Any]]] = {
    'trivial guess': trivial,
    'dashcalib': ours_on_turns,
    'dashcalib, random windows': ours_on_windows,
    'COLMAP, turns': colmap_on_turns,
    'GLOMAP, turns': glomap_on_turns,
    'COLMAP, random windows': colmap_on_windows,
    'COLMAP, whole drive': colmap_on_all,
}


def _best(task: Task, detection: Detection) -> Sequence[Turn]:
    return detection.turns()[:task.config.turns.wanted]


def _windows(task: Task, detection: Detection) -> list[Turn]:
    """Return as many windows as turns, as long as these, anywhere in the drive, none over another.

    Raises ValueError when the drive has no room for them.
    """
    frames = _thinned(task)
    lengths = [turn.images for turn in _best(task, detection)]
    rng = np.random.default_rng([task.seed, 8])
    if sum(lengths) > len(frames):
        raise ValueError('the drive is too short for so many windows')
    # the gaps share what the windows leave, each division as likely as the next
    free = len(frames) - sum(lengths)
    starts = np.sort(rng.integers(0, free + 1, len(lengths)))
    starts += np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(int)
    return [_window(frames[start:start + length])
            for start, length in zip(starts, lengths, strict=True)]


def _thinned(task: Task) -> tuple[Frame, ...]:
    """Return the frames at the detector's rate, as large as they are reconstructed."""
    kept: list[Frame] = []
    for frame in task.frames:
        if not kept or frame.stamp_ns - kept[-1].stamp_ns > 0.9e9 / task.config.tracking.rate:
            kept.append(Scale.of(frame.size, task.config).frame(frame))
    return tuple(kept)


def _window(frames: tuple[Frame, ...]) -> Turn:
    middle = frames[len(frames) // 2]
    return Turn(middle.index, frames[0].index, frames[-1].index, middle.stamp_ns / 1e9, 0.0,
                frames)


def _ours(task: Task, detection: Detection, turns: Sequence[Turn]) -> dict[str, Any]:
    before, began = processor_s(), time.monotonic()
    scenes = reconstructed(detection, turns, task.config)
    result = solved(detection, scenes, task.config)
    return {'seconds': time.monotonic() - began, 'cpu_s': processor_s() - before,
            'images': sum(len(scene.tracks.frames) for scene in scenes),
            'registered': sum(int(scene.structure.registered.sum()) for scene in scenes),
            **summarised(result, task.truth)}


def _colmap(task: Task, windows: Sequence[Turn], globally: bool = False) -> dict[str, Any]:
    """Return what COLMAP's defaults make of these windows; the largest model counts."""
    names = {frame.index for window in windows for frame in window.frames}
    before = processor_s()
    # as they were recorded, not as dashcalib resizes them
    models, stages = colmap_models((frame for frame in task.frames if frame.index in names),
                                   'RADIAL', task.matcher, globally)
    row: dict[str, Any] = {'seconds': sum(stages.values()), 'cpu_s': processor_s() - before,
                           'images': len(names), 'models': [], 'stages': stages}
    for model in models:
        focal, cx, cy, k1, k2 = next(iter(model.cameras.values())).params
        # COLMAP has the first pixel's centre at (0.5, 0.5)
        estimate = {'fx': focal, 'fy': focal, 'cx': cx - 0.5, 'cy': cy - 0.5, 'k1': k1, 'k2': k2}
        row['models'].append({'registered': model.num_reg_images(), 'camera': estimate,
                              **errors(estimate, task.truth)})
    if not row['models']:
        return {**row, 'registered': 0, 'reasons': ['no model']}
    return {**row, **row['models'][0]}


def colmap_models(frames: Iterable[Frame], lens: str, matcher: str = 'sequential',
                  globally: bool = False) -> tuple[list[Any], dict[str, float]]:
    """Return the models of COLMAP's defaults, the largest first, and the seconds of each stage."""
    import pycolmap
    # a line for every image otherwise
    pycolmap.logging.minloglevel = 2
    with tempfile.TemporaryDirectory() as folder:
        root, database = Path(folder), Path(folder) / 'database.db'
        (root / 'images').mkdir()
        (root / 'sparse').mkdir()
        for frame in frames:
            cv2.imwrite(str(root / 'images' / f'{frame.index:06}.png'), frame.image)
        watch = Stopwatch('extract')
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = lens
        pycolmap.extract_features(database, root / 'images', reader_options=reader,
                                  camera_mode=pycolmap.CameraMode.SINGLE)
        watch.enter('match')
        if matcher == 'sequential':
            pycolmap.match_sequential(database)
        else:
            pycolmap.match_exhaustive(database)
        watch.enter('map')
        if globally:
            pycolmap.calibrate_view_graph(database)
        mapping = pycolmap.global_mapping if globally else pycolmap.incremental_mapping
        models = mapping(database, root / 'images', root / 'sparse')
        watch.enter('end')
    return sorted(models.values(), key=lambda model: -model.num_reg_images()), watch.seconds


def run(rival: str, task: Task) -> dict[str, Any]:
    """Run one rival in a process of its own."""
    outcome = isolated(RIVALS[rival], task, limit_s=task.limit_s)
    row = outcome.value or {'seconds': outcome.seconds, 'reasons': [outcome.failure],
                            'verdict': 'failed'}
    return {'rival': rival, 'matcher': task.matcher, **row, 'peak_mb': round(outcome.peak_mb),
            'commit': commit()}


def rivals_table(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return a line for each rival and drive; the ratio is to dashcalib on the same drive."""
    rows = list(rows)
    own = {(row['setting'], row['seed']): row['cpu_s'] for row in rows
           if row['rival'] == 'dashcalib' and 'cpu_s' in row}
    head = ['drive', 'rival', 'fx %', 'fy %', 'cx %', 'cy %', 'k1 %', 'k2 %', 'registered', 's',
            'CPU s', 'times', 'MB', 'said']
    lines = []
    for row in rows:
        base = own.get((row['setting'], row['seed']))
        used = row.get('cpu_s')
        said = row.get('verdict', '')
        if row.get('reasons'):
            said += f' ({"; ".join(row["reasons"])})' if said else '; '.join(row['reasons'])
        if len(row.get('models', ())) > 1:
            said = f'{len(row["models"])} models, the largest'
        lines.append([
            f'{row["setting"]}, seed {row["seed"]}', row['rival'], *error_cells(row),
            f'{row["registered"]} of {row["images"]}' if 'registered' in row else '',
            f'{row["seconds"]:.1f}', f'{used:.1f}' if used else '',
            f'{used / base:.1f}' if used and base else '', str(row['peak_mb']),
            said.strip()])
    return table(head, lines)


def main() -> None:
    """Run what is asked for."""
    parser = parser_with(__doc__, 'data', 'cache', 'seeds', 'drives', 'again', seeds=[0])
    parser.add_argument('--rivals', nargs='+', choices=list(RIVALS), metavar='NAME',
                        help=f'of {", ".join(RIVALS)}')
    parser.add_argument('--turns', type=int, default=5)
    parser.add_argument('--matcher', choices=('sequential', 'exhaustive'), default='sequential')
    parser.add_argument('--whole', action='store_true', help='COLMAP on the whole drive, too')
    parser.add_argument('--limit', type=float, default=1200.0, help='s, for each rival')
    parser.add_argument('--list', action='store_true', help='name settings and rivals, and end')
    arguments = parser.parse_args()
    if arguments.list:
        print('\n'.join([*RENDERED, *RECORDED, '', *RIVALS]))
        return
    settings = arguments.drives or [OWN[0].name, *(['kitti03'] if arguments.data else [])]
    for name in settings:
        if name not in RENDERED and (name not in RECORDED or arguments.data is None):
            raise SystemExit(f'no setting {name!r}; --list shows all (recorded ones need --data)')
    chosen = arguments.rivals or [name for name in RIVALS
                                  if arguments.whole or name != 'COLMAP, whole drive']
    path = arguments.out / 'rivals.json'
    rows = load(path)
    with tempfile.TemporaryDirectory() as passing:
        for name in settings:
            for seed in arguments.seeds if name in RENDERED else [0]:
                task: Task | None = None
                for rival in chosen:
                    key = f'{name}, seed {seed}, {arguments.turns} turns, {rival}'
                    if 'MAP' in rival:
                        key += f', {arguments.matcher}'
                    if done(rows.get(key)) and not arguments.again:
                        continue
                    task = task or _task(name, seed, arguments, Path(passing))
                    complain(key)
                    rows[key] = {'setting': name, 'seed': seed, **run(rival, task)}
                    save(path, rows)
                    print(rivals_table([rows[key]]).splitlines()[-1], flush=True)
    text = rivals_table(rows.values())
    keep_table('rivals', f's: from the turns\' frames to the result.\n\n{text}', arguments,
               [row['commit'] for row in rows.values()])


def _task(name: str, seed: int, arguments: argparse.Namespace, passing: Path) -> Task:
    """Render or open a drive."""
    config = Config(seed=seed).replace(
        {'turns.wanted': arguments.turns, 'turns.at_most': arguments.turns})
    if name in RECORDED:
        folder = arguments.data / name
        frames: Iterable[Frame] = open_frames(folder / RECORDED[name])
        truth = json.loads((folder / 'truth.json').read_text())
    else:
        setting = RENDERED[name]
        if isinstance(setting.spec.turns, int) and setting.spec.turns > arguments.turns:
            setting = replace(setting, spec=replace(setting.spec, turns=arguments.turns))
        drive = drive_of(setting, seed)
        frames = pictures_of(drive, arguments.cache or passing)
        truth = drive.truth
    return Task(frames, truth, config, seed, arguments.matcher, arguments.limit)


if __name__ == '__main__':
    main()
