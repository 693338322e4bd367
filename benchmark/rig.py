# SPDX-License-Identifier: Apache-2.0
"""Rigs with known truth: how far each camera's place is off, in its unit and in sigmas.

    python benchmark/rig.py [--kinds KIND ...] [--seeds 0-9] [--turns N] [--cache DIR]
                            [--real FOLDER] [--results]

Rendered rigs have exact truth; of the real pair (FOLDER has left/ and right/) the epipolar
geometry of matches that nothing was fitted to is the witness. Rows go to rig.json in --out;
what is there is not run again.
"""
from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from measure import commit, keep_table, load, parser_with, save

from dashcalib_ros.camera.rotation import rotation_vectors
from dashcalib_ros.demo import RIGS, render_to_bag, rig_drives, true_places
from dashcalib_ros.demo.rig import SPEC
from dashcalib_ros.input.motion import Samples, SensorStream
from dashcalib_ros.rig_session import calibrate_rig
from dashcalib_ros.workers.worker import prepare_process

HEAD = """\
| rig | seed | turns | camera | verdict | rotation off, degrees | its sigma | worst, sigmas | \
lever off, cm (visible axes) | clock off, ms | s |
|---|---|---|---|---|---|---|---|---|---|---|"""


def rendered(kind: str, seed: int, turns: int, cache: Path) -> list[str]:
    """Return the rows of one rendered rig."""
    drives = rig_drives(kind, seed, replace(SPEC, turns=turns))
    base, bags = next(iter(drives)), {}
    for name, drive in drives.items():
        bags[name] = cache / f'{kind}-{seed}-{turns}' / name
        if not bags[name].exists():
            bags[name].parent.mkdir(parents=True, exist_ok=True)
            render_to_bag(drive, bags[name])
    ride = drives[base].ride
    times = np.arange(0.0, ride.duration - 0.2, 0.05)
    moving = np.gradient(np.interp(times + 0.1, ride.t, ride.s), times)
    started = time.perf_counter()
    found = calibrate_rig(bags, motion=SensorStream(speed=Samples(times, moving[:, None]))).rig
    seconds, truth, rows = time.perf_counter() - started, true_places(drives, base), []
    for name, camera in found.cameras.items():
        if name == base:
            continue
        start = f'| {kind} | {seed} | {turns} | {name} | {camera.verdict} |'
        if camera.rotation is None:
            rows.append(f'{start} {"; ".join(camera.reasons)} | | | | | {seconds:.0f} |')
            continue
        off = np.degrees(rotation_vectors((camera.rotation @ truth[name].rotation.T)[None])[0])
        sigma = np.array(camera.rotation_sigma_deg)
        lever = ''
        if camera.translation_m is not None:
            away = 100 * (np.array(camera.translation_m) - truth[name].translation_m)
            lever = ', '.join(f'{value:.1f}' for value, sight in zip(
                away, camera.visible.translation, strict=True) if sight != 'not visible')
        clock = 1e3 * ((camera.time_offset_s or 0.0) - truth[name].time_offset_s)
        rows.append(f'{start} {_text(off)} | {_text(sigma)} | {np.abs(off / sigma).max():.1f} | '
                    f'{lever} | {clock:.2f} | {seconds:.0f} |')
    return rows


def real(folder: Path) -> list[str]:
    """Return the lines of the real pair."""
    started = time.perf_counter()
    found = calibrate_rig({name: str(folder / name) for name in ('left', 'right')}, fps=10).rig
    camera, witness = found.cameras['right'], found.witness[('left', 'right')]
    assert camera.rotation_deg is not None and camera.rotation_sigma_deg is not None
    return ['', f'The real pair {folder.name}, one turn: right against left '
            f'({_text(np.array(camera.rotation_deg))}) degrees, sigma '
            f'({_text(np.array(camera.rotation_sigma_deg))}), {camera.verdict}; epipolar residual '
            f'of {witness.matches} matches with that rotation held: median {witness.median:.2f} '
            f'px, over the picture {witness.cells_rms:.2f} px RMS; '
            f'{time.perf_counter() - started:.0f} s.']


def _text(values: np.ndarray) -> str:
    return ', '.join(f'{value:.3f}' for value in values)


def main() -> None:
    """Measure, and write the table."""
    parser = parser_with(__doc__, 'seeds', seeds=[0])
    parser.add_argument('--kinds', nargs='+', default=list(RIGS))
    parser.add_argument('--turns', type=int, default=3)
    parser.add_argument('--cache', type=Path, default=Path(tempfile.gettempdir()) / 'rigs')
    parser.add_argument('--real', type=Path)
    args = parser.parse_args()
    path, at = args.out / 'rig.json', commit()
    done: dict[str, dict[str, Any]] = load(path)
    for kind in args.kinds:
        for seed in args.seeds:
            if (key := f'{kind}-{seed}-{args.turns}') not in done:
                rows = rendered(kind, seed, args.turns, args.cache)
                done[key] = {'commit': at, 'rows': rows}
                save(path, done)
                print('\n'.join(rows), flush=True)
    if args.real is not None and args.real.name not in done:
        done[args.real.name] = {'commit': at, 'rows': real(args.real)}
        save(path, done)
    # the table first, then what is said of the real pair
    lines = sorted((row for each in done.values() for row in each['rows']),
                   key=lambda row: not row.startswith('|'))
    keep_table('rig', '\n'.join([HEAD, *lines]), args, [each['commit'] for each in done.values()])


if __name__ == '__main__':
    prepare_process()
    main()
