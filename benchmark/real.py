#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Real drives: does the sigma hold for each choice of turns, and do rotations agree with fx?

    python benchmark/real.py --data DIR [--seeds N ...] [--out DIR] [--results]

Each drive is tracked anew with each seed. Its turns are then solved in every combination of two
and more (where one is sharp), and alone: as they are, and with the field of all turns taken out.
Where true poses are there, fx is also asked of them: the focal length with which the sharp turns'
angles are the true ones, in the sum of their signed errors (the lens otherwise as found). The
scale drift is that between a turn's first half and its second, against the poses. Each drive is
also calibrated by all of its stretches, as with `--thorough`.
"""
from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from measure import (
    commit,
    complain,
    done,
    isolated,
    keep_table,
    load,
    parser_with,
    reconstructed,
    save,
    table,
)

from dashcalib_ros import Config, calibrate, open_frames
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.detect.detection import detect
from dashcalib_ros.formats import load_camera
from dashcalib_ros.input.poses import Poses, read_poses
from dashcalib_ros.judge.conclude import conclude, evidence_of_detection
from dashcalib_ros.judge.odometry import Odometry, angle_deg, odometry
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution

# degrees between a turn's first and last keyframe
SHARP_DEG = 60.0
# of fx: where the angles are asked for
STEPS = (0.98, 0.99, 1.0, 1.01, 1.02)


@dataclass(frozen=True)
class Recorded:
    """A drive. fx: what it is judged by, and its sigma; from where: see data and docs."""

    name: str
    pictures: str
    fx: float
    fx_sigma: float
    fps: float | None = None
    poses: str | None = None


# pictures and true rotation together (two); a chessboard; the loop's own closure
DRIVES = (Recorded('kitti03', 'bag', 718.2, 1.8, poses='poses.txt'),
          Recorded('kitti07', 'images', 701.9, 1.4, fps=9.65, poses='poses.txt'),
          Recorded('kitti_raw', 'images', 984.2439, 2.0, fps=9.7),
          Recorded('ntu_campus', 'images', 505.0, 8.0, fps=3.0))


def measured(drive: Recorded, data: Path, seed: int) -> dict[str, Any]:
    """Return all that is measured of a drive with a seed."""
    config = Config(seed=seed)
    detection = detect(open_frames(data / drive.name / drive.pictures, fps=drive.fps),
                              config)
    px = detection.scale.px
    turns = detection.turns()[:config.turns.wanted]
    scenes = reconstructed(detection, turns, config)
    whole = solve(scenes, config)
    calibration = conclude(whole, evidence_of_detection(detection, scenes), config)
    row: dict[str, Any] = {'verdict': calibration.verdict.level, 'turns': len(scenes),
                           'reasons': [*map(str, calibration.verdict.reasons)]}
    if whole is None:
        return row
    sharp = {scene.turn for scene in whole.scenes if sharpness(scene) >= SHARP_DEG}
    row |= {'fx': px * whole.camera.fx, 'sigma': px * whole.sigma[0],
            'field_px': px * float(np.sqrt(np.mean(whole.field.over(whole.camera)**2)))
            if whole.field is not None else 0.0,
            'sharp': len(sharp), 'alone': alone(scenes, whole, config, px),
            'subsets': subsets(scenes, sharp, config, px)}
    if drive.poses is not None:
        poses = read_poses(data / drive.name / drive.poses)
        shipped = load_camera(data / drive.name / 'truth.json').camera
        row |= beside_poses(scenes, whole, shipped.resized(1 / px, whole.camera.image_size), poses,
                            config, px)
    return row


def without_field(scene: Scene, field: Field) -> Scene:
    """Return a turn as the lens alone would have seen it."""
    xy = scene.tracks.xy.copy()
    xy[scene.tracks.seen] = field.ideal(xy[scene.tracks.seen])
    return replace(scene, tracks=replace(scene.tracks, xy=xy))


def sharpness(scene: Scene) -> float:
    """Return the angle between a turn's first and last keyframe, degrees."""
    rotations = scene.structure.rotations[scene.structure.registered]
    return angle_deg(rotations.transpose(0, 2, 1))


def alone(scenes: Sequence[Scene], whole: Solution, config: Config, px: float
          ) -> list[dict[str, Any]]:
    """Return fx of each turn alone, as it is and without the field of all turns."""
    rows = []
    for scene in scenes:
        row: dict[str, Any] = {'turn': scene.turn.number}
        found = solve([scene], config)
        row |= {} if found is None else {'before': px * found.camera.fx}
        if whole.field is not None:
            found = solve([without_field(scene, whole.field)], config)
        row |= {} if found is None else {'after': px * found.camera.fx}
        rows.append(row)
    return rows


def subsets(scenes: Sequence[Scene], sharp: set[Any], config: Config, px: float
            ) -> list[dict[str, Any]]:
    """Return fx and its sigma of each combination of two and more turns with a sharp one."""
    rows = []
    for count in range(2, len(scenes) + 1):
        for some in itertools.combinations(scenes, count):
            found = solve(some, config)
            if found is not None and any(scene.turn in sharp for scene in found.scenes):
                rows.append({'turns': [scene.turn.number for scene in some], 'count': count,
                             'sharp': sum(scene.turn in sharp for scene in found.scenes),
                             'fx': px * found.camera.fx, 'sigma': px * found.sigma[0],
                             'field': found.field is not None,
                             'drift': found.drift is not None})
    return rows


def by_all_stretches(drive: Recorded, data: Path) -> dict[str, Any]:
    """Return what `dashcalib run --thorough` finds."""
    found = calibrate(data / drive.name / drive.pictures, fps=drive.fps,
                      config={'turns.thorough': True})
    row: dict[str, Any] = {'verdict': found.verdict.level,
                           'reasons': [*map(str, found.verdict.reasons)],
                           'stretches': sum(turn.used for turn in found.turns)}
    if found.camera is None or found.sigma is None:
        return row
    return {**row, 'fx': found.camera.fx, 'sigma': found.sigma['fx'],
            'drift': found.drift is not None}


def beside_poses(scenes: Sequence[Scene], whole: Solution, shipped: Camera, poses: Poses,
                 config: Config, px: float) -> dict[str, Any]:
    """Return fx by the true angles, and each turn's scale drift with each camera."""
    steps = {str(step): replace(whole.camera, fx=step * whole.camera.fx,
                                fy=step * whole.camera.fy) for step in STEPS}
    turned = odometry(whole.scenes, steps, poses, config)
    used = [scene for scene in scenes if scene.turn in {each.turn for each in whole.scenes}]
    plain = odometry(used, {'shipped': shipped, 'ours, no field': whole.camera}, poses, config)
    field = odometry(whole.scenes, {'ours': whole.camera}, poses, config)
    return {'fx_by_rotation': px * whole.camera.fx * best_step(turned),
            'scale_drift': {**drifts(plain), **drifts(field)},
            'angles_off': {name: signed(found, name) for found, name in (
                (plain, 'shipped'), (plain, 'ours, no field'), (field, 'ours'))}}


def sharp_of(found: Odometry) -> list[Any]:
    """Return the turns that are sharp by the poses."""
    return [turn for turn in found.turns if turn.angle_deg >= SHARP_DEG]


def signed(found: Odometry, name: str) -> list[float]:
    """Return by how much a camera's angle of each sharp turn is too large, degrees."""
    return [angle_deg(turn.paths[name].rotations) - turn.angle_deg for turn in sharp_of(found)]


def best_step(found: Odometry) -> float:
    """Return the factor of fx with which the sharp turns' errors sum up to nothing."""
    sums = [float(np.sum(signed(found, str(step)))) for step in STEPS]
    slope, offset = np.polyfit(np.array(STEPS) - 1.0, sums, 1)
    return 1.0 - float(offset / slope)


def drifts(found: Odometry) -> dict[str, list[float]]:
    """Return the scale drift within each sharp turn, percent, by the camera's name."""
    return {name: [100 * turn.scale_drift(name) for turn in sharp_of(found)]
            for name in found.names}


def summary(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table."""
    lines = []
    for drive in DRIVES:
        own = [row for row in rows.values()
               if row['drive'] == drive.name and 'subsets' in row]
        if not own:
            continue
        both = np.hypot([each['sigma'] for row in own for each in row['subsets']], drive.fx_sigma)
        off = np.array([each['fx'] - drive.fx for row in own for each in row['subsets']])
        sigmas = 100 * np.array([each['sigma'] / each['fx'] for row in own
                                 for each in row['subsets']])
        before, after = (
            np.mean([np.std([turn[key] for turn in row['alone'] if key in turn]) / row['fx']
                     for row in own]) * 100 for key in ('before', 'after'))
        rotation = [row['fx_by_rotation'] for row in own if 'fx_by_rotation' in row]
        lines.append([
            drive.name, ', '.join(row['verdict'] for row in own),
            ', '.join(f'{row["fx"]:.1f} ± {row["sigma"]:.1f}' for row in own),
            f'{drive.fx:.1f} ± {drive.fx_sigma:.1f}',
            f'{np.mean(rotation):.1f}' if rotation else '',
            f'{np.sum(np.abs(off) <= 2 * both)} of {len(off)}',
            f'{np.median(sigmas):.2f}; {sigmas.max():.2f}' if len(sigmas) else '',
            f'{sum(each["drift"] for row in own for each in row["subsets"])}',
            f'{before:.2f} → {after:.2f}',
            *('; '.join(f'{value:+.1f}' for value in np.mean(
                [row['scale_drift'][name] for row in own if 'scale_drift' in row], axis=0))
              if rotation else '' for name in ('shipped', 'ours, no field', 'ours'))])
    return table(['drive', 'verdict', 'fx, px', 'judged by', 'by true angles',
                  'combinations within 2σ', 'their σ %: median; largest', 'drift named in',
                  'turns alone, sd %', 'scale drift %: shipped K', 'ours, no field', 'ours'],
                 lines)


def compared(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of all stretches beside the best five turns of the first seed."""
    lines = []
    for drive in DRIVES:
        few, all_ = (next((row for row in rows.values() if row['drive'] == drive.name
                           and key in row and 'fx' in row), None)
                     for key in ('subsets', 'stretches'))
        if few is None or all_ is None:
            continue
        off = (all_['fx'] - drive.fx) / float(np.hypot(all_['sigma'], drive.fx_sigma))
        lines.append([
            drive.name, f'{few["fx"]:.1f} ± {few["sigma"]:.2f}', all_['verdict'],
            str(all_['stretches']), f'{all_["fx"]:.1f} ± {all_["sigma"]:.2f}',
            f'{all_["sigma"] / few["sigma"]:.2f}', f'{off:+.1f}',
            'yes' if all_['drift'] else 'no'])
    return table(['drive', 'five turns: fx, px', 'all stretches', 'how many', 'fx, px',
                  'sigma, of that of five turns', 'off in sigmas', 'drift named'], lines)


def main() -> None:
    """Measure."""
    arguments = parser_with(__doc__, 'data', 'seeds', 'drives', 'again',
                            drives=[drive.name for drive in DRIVES]).parse_args()
    path = arguments.out / 'real.json'
    rows = load(path)
    chosen = [drive for drive in DRIVES if drive.name in arguments.drives]

    def measure(name: str, function: Callable[..., dict[str, Any]], drive: Recorded, *more: int
                ) -> None:
        if done(rows.get(name)) and not arguments.again:
            return
        outcome = isolated(function, drive, arguments.data, *more)
        rows[name] = {'drive': drive.name, 'commit': commit(),
                      **(outcome.value or {'verdict': 'failed', 'reasons': [outcome.failure]})}
        save(path, rows)
        complain(f'{name}: {json.dumps(rows[name])[:300]}')

    for seed, drive in itertools.product(arguments.seeds, chosen):
        measure(f'{drive.name}, seed {seed}', measured, drive, seed)
    for drive in chosen:
        measure(f'{drive.name}, all stretches', by_all_stretches, drive)
    keep_table('real', f'{summary(rows)}\n\n{compared(rows)}', arguments,
               [row['commit'] for row in rows.values()])


if __name__ == '__main__':
    main()
