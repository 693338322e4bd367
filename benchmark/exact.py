#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Exact tracks of random dashcams, and the same with noise: what `solve` alone leaves.

    python benchmark/exact.py --cases DIR --seeds 1000-1009 --out DIR [--noise 0 0.03 0.1]
                              [--again] [--summary]

CASES/SEED.scenes.pkl are the turns that `population.py --stage scenes` has reconstructed. Each of
their observations is put where the true lens sees the true point from where the camera was at the
time of its row. So tracks are as many, as long and as badly spread as real ones. Lengths are px of
the pictures that are solved. What the real tracks without glass are off by also says by how far
they drift alike (problem/normal.py). Rows go to OUT/exact.json, the table is printed.
"""
from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from measure import commit, complain, done, isolated, load, parser_with, processor_s, save, table
from population import AnyLens, Case, Floats, drive_of, load_case, off, rays_of
from result_tables import keep_table
from scipy.optimize import minimize_scalar
from wide import WideDrive

from dashcalib_ros import Config
from dashcalib_ros.arrays import Mask
from dashcalib_ros.demo import Drive
from dashcalib_ros.demo.drive import START_NS
from dashcalib_ros.demo.vehicle import MARGIN_S
from dashcalib_ros.problem.normal import common_drifts
from dashcalib_ros.reconstruct.scene import Scene, retriangulated
from dashcalib_ros.robust import mad_sigma
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution

# px; an observation that is farther from its exact place follows something else
ASTRAY_PX = 3.0
# m of a point from the camera
NEAR_M, FAR_M = 1.5, 150.0
# of the row in which a point is seen
ROW_STEPS = 8
# of the fit of drifts
ROBUST_STEPS = 15


def exact(scene: Scene, drive: Drive, lens: AnyLens) -> Scene:
    """Return a turn with the places in which its tracks would be without any error."""
    tracks, factor = scene.tracks, lens.width / scene.tracks.image_size[0]
    rows, columns = np.nonzero(tracks.seen)
    measured = (tracks.xy[rows, columns] + 0.5) * factor - 0.5
    readout_s = drive.spec.rolling_shutter_ms / 1000
    seconds = (tracks.stamps_ns[rows] - START_NS) / 1e9 + MARGIN_S

    def poses(pixels: Floats) -> tuple[Floats, Floats]:
        late = pixels[:, 1] / (lens.height - 1) - 0.5
        return drive.ride.camera_at(seconds + readout_s * late)

    rotations, positions = poses(measured)
    along = np.einsum('nij,nj->ni', rotations, rays_of(lens, measured))
    points = _crossings(positions, along, columns, tracks.xy.shape[1])[columns]
    pixels = measured
    for _ in range(ROW_STEPS if readout_s else 1):
        rotations, positions = poses(pixels)
        local = np.einsum('nji,nj->ni', rotations, points - positions)
        pixels = np.nan_to_num(lens.project(local), nan=-1e6)
    apart, distance = np.linalg.norm(pixels - measured, axis=1), np.linalg.norm(local, axis=1)
    kept = (apart < ASTRAY_PX * factor) & (distance > NEAR_M) & (distance < FAR_M)
    xy = np.full(tracks.xy.shape, np.nan)
    xy[rows[kept], columns[kept]] = (pixels[kept] + 0.5) / factor - 0.5
    return replace(scene, tracks=replace(tracks, xy=xy))


def _crossings(positions: Floats, along: Floats, tracks: Any, count: int) -> Floats:
    """Return (count, 3) where the rays of each track come closest to each other; NaN for none."""
    across = np.eye(3) - along[:, :, None] * along[:, None]
    inner, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(inner, tracks, across)
    np.add.at(right, tracks, np.einsum('nij,nj->ni', across, positions))
    seen_well: Mask = np.linalg.det(inner) > 1e-9
    found = np.full((count, 3), np.nan)
    found[seen_well] = np.linalg.solve(inner[seen_well], right[seen_well][:, :, None])[:, :, 0]
    return found


def with_noise(scene: Scene, noise_px: float, config: Config, seed: int) -> Scene:
    """Return a turn with noise, triangulated anew."""
    xy = scene.tracks.xy
    rng = np.random.default_rng([seed, int(scene.tracks.frames[0]), 53])
    scene = replace(scene, tracks=replace(
        scene.tracks, xy=xy + noise_px * rng.standard_normal(xy.shape)))
    limits = config.scene
    return retriangulated(scene, scene.camera, limits.error_px, limits.min_angle_deg)


def measured(path: Path, noise_px: float) -> dict[str, Any]:
    """Return what the solution of a case's exact tracks with some noise is off by."""
    cv2.setNumThreads(1)
    case, config = load_case(path), Config()
    drive = drive_of(case.seed)
    lens: AnyLens = drive.wide_lens if isinstance(drive, WideDrive) else drive.lens
    scenes = [with_noise(exact(scene, drive, lens), noise_px, config, case.seed)
              for scene in case.scenes]
    # those of glass are off by what the glass does
    alike = [] if noise_px or case.glass else [
        drifts(scene, truth) for scene, truth in zip(case.scenes, scenes, strict=True)]
    before = processor_s()
    found = solve(scenes, config)
    row = {'seed': case.seed, 'noise_px': noise_px, 'lens': case.lens['model'],
           'glass_px': case.glass.rms_px if case.glass else 0.0, 'readout_ms': case.readout_ms,
           'cpu_s': processor_s() - before, 'drifts': alike}
    return row if found is None else {**row, **_off(found, case)}


def drifts(scene: Scene, truth: Scene) -> list[tuple[list[float], list[list[float]]]]:
    """Return the common drifts of a turn's tracks by axis, px, each with its covariance.

    Robustly fitted to what they are off by, each track being one measurement.
    """
    both = replace(scene.structure, used=scene.structure.used & truth.tracks.seen)
    observed = replace(scene, structure=both).observed
    off = observed.xy - truth.tracks.xy[observed.rows, observed.columns]
    columns, found = common_drifts(observed).T, []
    for left in off.T:
        weight, values = np.ones(len(left)), np.zeros(columns.shape[1])
        for _ in range(ROBUST_STEPS):
            weighted = columns * weight[:, None]
            values = np.linalg.solve(weighted.T @ columns, weighted.T @ left)
            residual = left - columns @ values
            weight = 1 / (1 + (residual / (2 * mad_sigma(residual)))**2)
        by_track = np.zeros((len(observed.tracks), columns.shape[1]))
        np.add.at(by_track, observed.point, columns * (weight * residual)[:, None])
        inverse = np.linalg.inv((columns * weight[:, None]).T @ columns)
        spread = inverse @ (by_track.T @ by_track) @ inverse
        found.append((values.tolist(), spread.tolist()))
    return found


def size_of(all_drifts: Sequence[tuple[list[float], list[list[float]]]]) -> float:
    """Return the standard deviation of drifts that explains them best, px."""
    def cost(log_size: float) -> float:
        total = 0.0
        for values, spread in all_drifts:
            variance = np.asarray(spread) + np.exp(2 * log_size) * np.eye(len(values))
            total += np.linalg.slogdet(variance)[1] + values @ np.linalg.solve(variance, values)
        return float(total)

    return float(np.exp(minimize_scalar(cost, bounds=(-9.0, 0.0), method='bounded').x))


def _off(found: Solution, case: Case) -> dict[str, Any]:
    camera, field = found.camera, found.field
    factor = camera.image_size[0] / case.size[0]
    case = replace(case, pixels=(case.pixels + 0.5) * factor - 0.5)
    return {
        'model': camera.model, 'rays_sigma_px': found.rays_sigma_px,
        'rays_px': off(lambda rays: camera.project(rays) if field is None
                       else field.observed(camera.project(rays)), case, camera.model),
        'camera_px': off(camera.project, case, camera.model), 'camera_sigma_px': found.picture.rms,
        'fx_percent': 100 * (camera.fx / (factor * case.closest[camera.model]['fx']) - 1)
        if camera.model in case.closest else None,
        'shutter_ms': 1000 * found.readout_s, 'shutter_sigma_ms': 1000 * found.readout_sigma_s,
        'moves': bool(found.crops) or found.drift is not None}


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table: each noise with and without glass and shutter, then each camera."""
    lines = []
    for noise in sorted({row['noise_px'] for row in rows}):
        for name, glass, rolling in (('global shutter', False, False), ('rolling', False, True),
                                     ('glass', True, False), ('glass, rolling', True, True)):
            mine = [row for row in rows if row['noise_px'] == noise and 'model' in row
                    and bool(row['glass_px']) == glass and bool(row['readout_ms']) == rolling]
            if mine:
                lines.append([f'{noise:g}', name, str(len(mine)), *_of(mine)])
    each = [[f'{row["noise_px"]:g}', f'{row["seed"]}: {row["lens"]}, glass {row["glass_px"]:.1f} '
             f'px, {row["readout_ms"]:.1f} ms', row['model'], *_of([row])[:-1],
             f'{row["shutter_ms"]:.2f} ± {row["shutter_sigma_ms"]:.2f}'
             + (', moves' if row['moves'] else '')] if 'model' in row
            else [f'{row["noise_px"]:g}', str(row['seed']), 'no solution', *['']*4]
            for row in sorted(rows, key=lambda row: (row['noise_px'], row['seed']))]
    head = ['rays off, px', 'over sigma', 'camera alone off, px', 'wrong kind']
    drifting = [row for row in rows if row.get('drifts')]
    sizes = [size_of([turn[axis] for row in drifting for turn in row['drifts']])
             for axis in (0, 1)] if drifting else []
    return '\n\n'.join([
        *(f'Real tracks of {len(drifting)} cameras without glass drift alike by {along:.3f} px '
          f'along x and {down:.3f} px along y.' for along, down in ([sizes] if drifting else [])),
        table(['noise, px', 'cameras', 'of them', *head, 'readout off, ms'], lines),
        table(['noise, px', 'camera', 'found', *head[:-1], 'readout, ms'],
              [line[:6] + line[7:] if len(line) == 8 else line for line in each])])


def _of(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return medians and worst, how many have the wrong kind, and how far readouts are off."""
    return [*(_spread([row[key] / (row[over] if over else 1) for row in rows], digits)
              for key, over, digits in (('rays_px', '', 3), ('rays_px', 'rays_sigma_px', 2),
                                        ('camera_px', '', 3))),
            str(sum((row['lens'] == 'fisheye') != (row['model'] == 'fisheye') for row in rows)),
            _spread([abs(row['shutter_ms'] - row['readout_ms']) for row in rows], 3)]


def _spread(values: Iterable[float], digits: int) -> str:
    values = sorted(values)
    middle = f'{np.median(values):.{digits}f}' if values else str(math.nan)
    return middle if len(values) < 2 else f'{middle}; {values[-1]:.{digits}f}'


def main() -> None:
    """Measure."""
    parser = parser_with(__doc__, 'seeds', 'again', seeds=range(5000, 5017))
    parser.add_argument('--cases', type=Path, required=True)
    parser.add_argument('--noise', nargs='+', type=float, default=[0.0, 0.03, 0.1])
    parser.add_argument('--summary', action='store_true', help='of the results there are, and end')
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / 'exact.json'
    rows = load(path)
    for seed in [] if given.summary else given.seeds:
        for noise_px in given.noise:
            key = f'{seed}, {noise_px:g} px'
            if done(rows.get(key)) and not given.again:
                continue
            outcome = isolated(measured, given.cases / f'{seed}.scenes.pkl', noise_px)
            shown = {name: value for name, value in (outcome.value or {}).items()
                     if name != 'drifts'}
            complain(f'{key}: {outcome.failure or shown}')
            if outcome.value:
                rows[key] = {**outcome.value, 'commit': commit()}
                save(path, rows)
    keep_table('exact', summary(list(rows.values())), given,
               [row['commit'] for row in rows.values() if 'commit' in row])


if __name__ == '__main__':
    main()
