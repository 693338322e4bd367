#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Rendered drives through a windscreen, a poor rectification, a decentred lens; exact truth.

    python benchmark/glass.py [--drives PART ...] [--seeds 0 1 2] [--cache DIR] [--out DIR]
                              [--results] [--again]

PART: part of a setting's name; default: all. The decentred lens is run on ten streets, whatever
--seeds says. Rows go to DIR/glass.json after each drive, the table to benchmark/results/glass.md.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
from drives import DEMO, STREET, Setting, drive_of, pictures_of
from measure import (
    calibrate,
    commit,
    complain,
    done,
    isolated,
    keep_table,
    load,
    parser_with,
    save,
    table,
)
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dashcalib_ros import Config
from dashcalib_ros.demo import Drive, Glass, Lens
from dashcalib_ros.demo.glass import moves_of_a_lens
from dashcalib_ros.judge.calibration import CalibrationData

Floats = npt.NDArray[np.float64]
DECENTRED = replace(Lens.of(1280, 720, 75.0, -0.30, 0.10, (14.0, -9.0), 1.003),
                    p1=0.0016, p2=-0.0011, k3=-0.02)
GLASSES = {f'{look}, {rms:g} px': Glass(rms, look)
           for look in ('rectified', 'windscreen') for rms in (0.3, 1.0, 2.0)}
STREETS = tuple(range(10))
# columns and rows of the grid over the picture
GRID = (41, 25)


def drives(seeds: list[int]) -> Iterator[tuple[str, int, Drive]]:
    """Yield each setting's name and seed, and the drive."""
    for seed in seeds:
        for name, glass in GLASSES.items():
            drive = drive_of(Setting(f'glass, {name}', DEMO, STREET), seed)
            lens = replace(drive.lens, glass=replace(glass, seed=drive.spec.seed))
            yield name, seed, Drive(lens, drive.spec)
    for seed in STREETS:
        name = 'decentred'
        spec = replace(STREET, bonnet=True, timestamp=True)
        yield name, seed, drive_of(Setting(name, DECENTRED, spec), seed)


def measured(pictures: Any, lens: Lens, seed: int) -> dict[str, Any]:
    """Calibrate a drive; return what is wrong with the result (in a process of its own)."""
    found, seconds = calibrate(pictures, Config(seed=seed))
    about = {'verdict': found.verdict.level, 'reasons': [*map(str, found.verdict.reasons)],
             'warnings': [*map(str, found.warnings)], 'seconds': seconds}
    if found.camera is None or found.sigma_px is None:
        return about
    x, y = np.meshgrid(np.linspace(0, lens.width - 1, GRID[0]),
                       np.linspace(0, lens.height - 1, GRID[1]))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    return {**about, 'model': type(found.camera).__name__.lower(),
            'rays_px': off(found.project, lens, pixels),
            'camera_px': off(found.camera.project, lens, pixels),
            'camera_sigma_px': found.sigma_px.rms,
            'fx_percent': 100 * (found.camera.fx / lens.fx - 1),
            'fx_sigma_percent': 100 * (found.sigma or {})['fx'] / found.camera.fx,
            'field': None if found.field is None else {
                'used': found.field.used, 'rms_px': found.field.rms_px,
                'sigma_px': found.field.sigma_px,
                'correlation': correlation(found, lens, pixels)}}


def off(project: Callable[[Floats], Floats], lens: Lens, pixels: Floats) -> float:
    """Return the RMS px between where both see the lens's rays, the best rotation removed."""
    rays = np.column_stack([lens.undistort(pixels), np.ones(len(pixels))])

    def residual(turn: Floats) -> Floats:
        return np.asarray(project(Rotation.from_rotvec(turn).apply(rays)) - pixels).ravel()

    rest = least_squares(residual, np.zeros(3)).fun.reshape(-1, 2)
    return float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))


def correlation(found: CalibrationData, lens: Lens, pixels: Floats) -> float | None:
    """Return that of the field that was found and the true one, of both what no lens does."""
    if found.field is None or not found.field.used or lens.glass is None:
        return None
    moves = moves_of_a_lens((pixels - (np.array(lens.size) - 1) / 2) / (lens.width / 2))
    basis, _ = np.linalg.qr(moves.reshape(-1, moves.shape[2]))
    ours, true = (each.ravel() - basis @ (basis.T @ each.ravel()) for each in (
        found.field.field.displacement(pixels), lens.glass.displacement(pixels, lens.size)))
    return float(ours @ true / np.linalg.norm(ours) / np.linalg.norm(true))


def summary(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a row for each setting; the numbers of its seeds stand side by side."""
    lines = []
    for name in dict.fromkeys(row['setting'] for row in rows.values()):
        mine = [row for row in rows.values() if row['setting'] == name]

        def each(key: str, form: str = '.2f', mine: list[Mapping[str, Any]] = mine) -> str:
            values = [row.get(key, (row.get('field') or {}).get(key)) for row in mine]
            return ' '.join('–' if value is None else format(value, form) for value in values)

        verdicts = [row['verdict'] for row in mine]
        models = [row.get('model', 'none') for row in mine]
        lines.append([name, *(', '.join(f'{them.count(one)} {one}' for one in dict.fromkeys(them))
                              for them in (verdicts, models)),
                      each('rays_px'), each('camera_px'), each('camera_sigma_px'),
                      each('correlation'), each('fx_percent', '+.2f'), each('fx_sigma_percent')])
    return table(('drive', 'verdict', 'model', 'rays off, px', 'camera alone off, px',
                  'its sigma_px', 'correlation of the field', 'fx off, %', 'its σ, %'), lines)


def main() -> None:
    """Measure."""
    arguments = parser_with(__doc__, 'cache', 'seeds', 'drives', 'again').parse_args()
    path = arguments.out / 'glass.json'
    rows = load(path)
    with TemporaryDirectory() as passing:
        for name, seed, drive in drives(arguments.seeds):
            key = f'{name}, seed {seed}'
            if not all(part in key for part in arguments.drives or ()) or (
                    done(rows.get(key)) and not arguments.again):
                continue
            pictures = pictures_of(drive, arguments.cache or Path(passing))
            outcome = isolated(measured, pictures, drive.lens, seed)
            rows[key] = {'setting': name, 'seed': seed, 'commit': commit(),
                         **(outcome.value or {'verdict': 'failed', 'reasons': [outcome.failure]})}
            save(path, rows)
            complain(f'{key}: {rows[key]}')
    keep_table('glass', summary(rows), arguments, [row['commit'] for row in rows.values()])


if __name__ == '__main__':
    main()
