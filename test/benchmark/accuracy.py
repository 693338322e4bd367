#!/usr/bin/env python3
"""Accuracy, honesty and refusals, measured on rendered drives with exact truth and on real ones.

    python test/benchmark/accuracy.py [SETTING ...] [--seeds 0 1 2] [--data DIR] [--out DIR]

Runs every setting (or those named) with every seed, writes DIR/accuracy.json after each drive and
prints a table. --data: a folder with kitti03/ and carnd/ (bag or video beside a truth.json).
"""
from __future__ import annotations

import argparse
import json
import resource
import statistics
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from dashcalib_ros import Calibrator, Config, open_frames
from dashcalib_ros.demo import Drive, DriveSpec, Lens, Stop, Turn
from dashcalib_ros.frames import Frame
from dashcalib_ros.intrinsics import Calibration
from dashcalib_ros.report import camera_of, compare, load_camera

KITTI_RAW = Lens(1392, 512, 960.115, 954.891, 694.792, 240.355, -0.363, 0.151)
DEMO = Lens.of(960, 540, 75.0, -0.30, 0.10, offset=(14.0, -9.0), aspect=1.003)
WIDE = Lens.of(1280, 720, 115.0, -0.22, 0.04, offset=(-20.0, 12.0), aspect=0.998)
TELE = Lens.of(1280, 720, 48.0, 0.08, 0.05, offset=(10.0, 20.0))
VGA = Lens.of(640, 480, 65.0, -0.35, 0.12, offset=(6.0, 5.0), aspect=1.01)
FULL_HD = Lens.of(1920, 1080, 90.0, -0.28, 0.07, offset=(25.0, -15.0), aspect=1.001)

# what must be calibrated
DRIVES = {
    'kitti-raw lens': (KITTI_RAW, {}),
    'demo': (DEMO, {'bonnet': True, 'timestamp': True}),
    'wide 115 deg': (WIDE, {'bonnet': True}),
    'narrow 48 deg, pincushion': (TELE, {}),
    '640x480, fy/fx 1.01': (VGA, {'noise': 3.0}),
    '1920x1080, 30 fps': (FULL_HD, {'rate': 30.0, 'turns': 3}),
    '5 fps': (DEMO, {'rate': 5.0}),
    '3 fps': (DEMO, {'rate': 3.0}),
    'noise 6, blur 1': (DEMO, {'noise': 6.0, 'blur': 1.0}),
    'JPEG 50': (DEMO, {'jpeg_quality': 50}),
    'pillar, bonnet, text': (WIDE, {'bonnet': True, 'pillar': True, 'timestamp': True}),
    'moving cars': (DEMO, {'moving_cars': 8}),
    'rolling shutter 10 ms': (DEMO, {'rolling_shutter_ms': 10.0}),
    'rolling shutter 20 ms': (DEMO, {'rolling_shutter_ms': 20.0}),
    'wide turns': (DEMO, {'turns': tuple(Turn(side * 70.0, 18.0) for side in (1, -1, -1, 1, 1))}),
    'one sharp turn': (DEMO, {'turns': 1}),
    'two turns': (DEMO, {'turns': 2}),
}
# what must be refused
HOPELESS = {
    'straight': (DEMO, {'turns': 0, 'duration_s': 30.0}),
    'parked': (DEMO, {'kind': 'parked', 'duration_s': 20.0}),
    'at a light, others moving': (
        DEMO, {'turns': 0, 'duration_s': 30.0, 'moving_cars': 8, 'stops': (Stop(0, 20.0),)}),
    'parked at night': (DEMO, {'kind': 'parked', 'night': True, 'duration_s': 20.0}),
    'turning on the spot': (DEMO, {'kind': 'spin', 'duration_s': 20.0}),
}
KEYS = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2')


def calibrate(frames: Iterable[Frame], config: Config) -> tuple[Calibration, float]:
    """Return the calibration and the seconds it took, rendering and decoding not counted."""
    spent = 0.0
    with Calibrator(config) as calibrator:
        for frame in frames:
            started = time.monotonic()
            calibrator.push(frame)
            spent += time.monotonic() - started
        started = time.monotonic()
        result = calibrator.calibrate()
        return result, spent + time.monotonic() - started


def measured(result: Calibration, truth: dict[str, float], seconds: float) -> dict[str, object]:
    """Return errors, sigmas and what else the tables need; truth has fx..k2, width, height."""
    row: dict[str, object] = {
        'verdict': result.verdict.level, 'reasons': list(result.verdict.reasons),
        'frames': result.frames, 'seconds': round(seconds, 1), 'timing': result.timing,
        'turns': [[turn.center, turn.used] for turn in result.turns], 'truth': truth,
        'peak_mb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        'child_peak_mb': resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024}
    if result.intrinsics is None or result.sigma is None:
        return row
    estimate, sigma = asdict(result.intrinsics), asdict(result.sigma)
    row['estimate'], row['sigma'] = estimate, sigma
    row['error'] = {key: estimate[key] - truth[key] for key in KEYS}
    row['percent'] = {key: 100 * abs(estimate[key] / truth[key] - 1)
                      for key in KEYS if abs(truth[key]) > 1e-9}
    row['z'] = {key: (estimate[key] - truth[key]) / sigma[key] for key in KEYS}
    return row


def rendered(name: str, seed: int) -> dict[str, object]:
    """Render one drive and calibrate it."""
    lens, changes = {**DRIVES, **HOPELESS}[name]
    drive = Drive(lens, DriveSpec(seed=seed, **changes))
    truth = {**asdict(drive.truth), 'width': lens.width, 'height': lens.height}
    result, seconds = calibrate(drive.frames(processes=2), Config(seed=seed))
    row = measured(result, truth, seconds)
    row['true_turns'] = list(drive.turn_centers)
    return row


def recorded(name: str, data: Path) -> dict[str, object]:
    """Calibrate a real drive."""
    path = {'kitti03': data / 'kitti03/bag', 'carnd': data / 'carnd/drive.mp4'}[name]
    truth_path = data / name / 'truth.json'
    result, seconds = calibrate(open_frames(path), Config())
    row = measured(result, json.loads(truth_path.read_text()), seconds)
    if result.intrinsics is not None:
        row['mapping_px'] = compare(camera_of(result), load_camera(truth_path)).mapping_px
    return row


def table(rows: dict[str, dict[str, object]]) -> str:
    """Return the drives as a Markdown table, then the medians and what honesty came to."""
    lines = ['| drive | verdict | fx % | fy % | cx % | cy % | k1 % | k2 % | z of fx | s |',
             '|---|---|---|---|---|---|---|---|---|---|']
    for name, row in rows.items():
        percent = row.get('percent', {})
        cells = [f'{percent[key]:.3f}' if key in percent else '' for key in KEYS]
        z = f'{row["z"]["fx"]:+.1f}' if 'z' in row else ''
        lines.append(f'| {name} | {row["verdict"]} | {" | ".join(cells)} | {z} | '
                     f'{row["seconds"]} |')
    accepted = [row for row in rows.values() if row['verdict'] == 'accepted']
    if accepted:
        lines.append('')
        for key in KEYS:
            errors = [row['percent'][key] for row in accepted if key in row['percent']]
            z = [abs(row['z'][key]) for row in accepted]
            if errors:
                lines.append(
                    f'{key}: median {statistics.median(errors):.3f} %, worst {max(errors):.3f} %; '
                    f'within 1 sigma {sum(value <= 1 for value in z)} of {len(z)}, '
                    f'2 sigma {sum(value <= 2 for value in z)} of {len(z)}')
        false = sum(row['percent']['fx'] > 3 for row in accepted)
        lines.append(f'accepted with fx off by more than 3 %: {false} of {len(accepted)}')
    return '\n'.join(lines)


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('settings', nargs='*', help='default: all')
    parser.add_argument('--seeds', nargs='+', type=int, default=[0])
    parser.add_argument('--data', type=Path, default=Path('../shared/data'))
    parser.add_argument('--out', type=Path, default=Path('benchmark'))
    arguments = parser.parse_args()
    real = [name for name in ('kitti03', 'carnd') if (arguments.data / name).is_dir()]
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows: dict[str, dict[str, object]] = {}
    for name in arguments.settings or [*real, *HOPELESS, *DRIVES]:
        for seed in [0] if name in ('kitti03', 'carnd') else arguments.seeds:
            recording = name in ('kitti03', 'carnd')
            row = recorded(name, arguments.data) if recording else rendered(name, seed)
            rows[f'{name}, seed {seed}'] = row
            (arguments.out / 'accuracy.json').write_text(json.dumps(rows, indent=1))
            print(table({f'{name}, seed {seed}': row}).splitlines()[2], row['reasons'] or '',
                  flush=True)
    print(table(rows))


if __name__ == '__main__':
    main()
