#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Two turns whose pictures wander or are stretched: none may be accepted and wrong.

    python benchmark/spoilt_tracks.py [--seeds 4000-4009] [--out DIR] [--results] [--again]

The cameras are those of population.py, whose scenes of DIR are used (made where they are missing).
The first two turns' tracks are moved as a crop moves them that wanders by so much of the width in
so many seconds, or stretched sideways. Rows go to DIR/spoilt_tracks.json.
"""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from measure import isolated, keep_table, load, parser_with, save, table
from population import Case, calibrated, drive_of, load_case, reconstructed, save_case

from dashcalib_ros import Config
from dashcalib_ros.reconstruct.scene import Scene

# share of the width and period in s; share of the width, and 0 for a stretch
WAYS = {'crop wanders by 0.5 % in 10 s': (0.005, 10.0), 'crop wanders by 1 % in 8 s': (0.01, 8.0),
        'crop wanders by 2 % in 5 s': (0.02, 5.0), 'crop wanders by 3 % in 1 s': (0.03, 1.0),
        'stretched by 1 %': (0.01, 0.0), 'stretched by 3.5 %': (0.035, 0.0)}
MOST_SIGMAS = 3.5


def spoilt(case: Case, share: float, period_s: float) -> Case:
    """Return a case with two turns, their tracks changed, and the truth with them."""
    def changed(scene: Scene, number: int) -> Scene:
        xy, width = scene.tracks.xy, scene.tracks.image_size[0]
        if period_s:
            phase = np.random.default_rng([case.seed, number]).uniform(0, 2 * np.pi, 2)
            seconds = scene.tracks.stamps_ns[:, None] / 1e9
            moved = share * width * np.sin(2 * np.pi * seconds / period_s + phase) * (1.0, 0.5)
            xy = xy + moved[:, None]
        else:
            xy = xy * (1.0 + share, 1.0)
        return replace(scene, tracks=replace(scene.tracks, xy=xy.astype(scene.tracks.xy.dtype)))

    truth = case.closest if period_s else {model: {
        **camera, 'fx': camera['fx'] * (1 + share), 'cx': (camera['cx'] + 0.5) * (1 + share) - 0.5}
        for model, camera in case.closest.items() if camera}
    return replace(case, config=Config(), more=(), closest=truth, scenes=tuple(
        changed(scene, number) for number, scene in enumerate(case.scenes[:2])))


def measured(path: Path, way: str) -> dict[str, Any]:
    """Return what comes of a case (in a process of its own)."""
    cv2.setNumThreads(1)
    case = spoilt(load_case(path), *WAYS[way])
    found = calibrated(case)
    row: dict[str, Any] = {'verdict': found.verdict.level, 'codes': list(found.verdict.codes)}
    if found.camera is None or not case.closest.get(found.camera.model):
        return row
    truth, values = case.closest[found.camera.model], found.camera.named
    return {**row, 'model': found.camera.model, 'z': {
        name: (values[name] - truth[name]) / sigma
        for name, sigma in (found.sigma or {}).items() if sigma and name in truth}}


def main() -> None:
    """Calibrate all and print the table."""
    parser = parser_with(__doc__, 'seeds', 'again', seeds=range(4000, 4010))
    args = parser.parse_args()
    path, scenes = args.out / 'spoilt_tracks.json', args.out / 'population_auto'
    scenes.mkdir(parents=True, exist_ok=True)
    rows = {} if args.again else load(path)
    for seed in args.seeds:
        case = scenes / f'{seed}.scenes.pkl'
        if not case.exists():
            save_case(reconstructed(drive_of(seed), Config()), case)
        for way in WAYS:
            if f'{seed} | {way}' not in rows:
                done = isolated(measured, case, way)
                rows[f'{seed} | {way}'] = done.value or {'verdict': 'failed', 'codes': [
                    done.failure]}
                save(path, rows)
                print(seed, way, rows[f'{seed} | {way}'], flush=True)
    lines = []
    for way in WAYS:
        mine = [row for key, row in rows.items() if key.endswith(f'| {way}')]
        worst = [max(map(abs, row['z'].values())) for row in mine if row.get('z')]
        wrong = [row for row in mine if row['verdict'] == 'accepted' and max(
            map(abs, row.get('z', {'model': np.inf}).values())) > MOST_SIGMAS]
        lines.append([way, f'{len(mine)}', *(f'{sum(row["verdict"] == level for row in mine)}' for
                                             level in ('accepted', 'weak', 'refused')),
                      f'{len(wrong)}', f'{np.median(worst):.1f}' if worst else '',
                      f'{max(worst):.1f}' if worst else ''])
    keep_table('spoilt_tracks', table(
        ['two turns', 'cameras', 'accepted', 'weak', 'refused',
         f'accepted, a parameter more than {MOST_SIGMAS:g} sigma off',
         'worst parameter in sigmas: median', 'of all'], lines), args)


if __name__ == '__main__':
    main()
