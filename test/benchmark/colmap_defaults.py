#!/usr/bin/env python3
"""COLMAP with its defaults on the very frames of the turns that dashcalib uses: error and time.

    python test/benchmark/colmap_defaults.py [--input BAG --truth JSON] [--turns N] [--out DIR]

Without --input the demo drive is rendered. SIFT, sequential matching (overlap 10) and incremental
mapping of each turn, one shared RADIAL camera from COLMAP's default focal length. pycolmap runs in
this process: nothing else is measured here but dashcalib's own run before it.
"""
from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
import zlib  # noqa: F401  before pycolmap
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from dashcalib_ros import Calibrator, Config, open_frames
from dashcalib_ros.demo import demo_drive


def main() -> None:
    """Run dashcalib, then COLMAP on the same frames, and print both."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--input')
    parser.add_argument('--truth', type=Path)
    parser.add_argument('--turns', type=int, default=5)
    parser.add_argument('--out', type=Path, default=Path('benchmark'))
    arguments = parser.parse_args()
    if arguments.input:
        frames = list(open_frames(arguments.input))
        truth = json.loads(arguments.truth.read_text())
    else:
        drive = demo_drive()
        frames = list(drive.frames(processes=2))
        truth = asdict(drive.truth)
    config = Config().replace({'turns.wanted': arguments.turns})
    with Calibrator(config) as calibrator:
        for frame in frames:
            calibrator.push(frame)
        calibrator.finish()
        started = time.monotonic()
        ours = calibrator.calibrate()
        seconds = time.monotonic() - started
    assert ours.intrinsics is not None, ours.verdict
    turns = [turn for turn in ours.turns if turn.used]
    report = {'dashcalib': {'error_pct': errors(asdict(ours.intrinsics), truth),
                            'after_detection_s': seconds, 'timing': ours.timing},
              'cores': os.cpu_count(), 'turns': len(turns)}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for turn in turns:
            (root / 'images' / f'{turn.center:06}').mkdir(parents=True)
            for frame in frames[turn.first:turn.last + 1]:
                name = root / 'images' / f'{turn.center:06}' / f'{frame.index:06}.png'
                cv2.imwrite(str(name), frame.image)
        report['colmap'] = colmap(root, truth)
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / 'colmap_defaults.json').write_text(json.dumps(report, indent=1))
    print(json.dumps(report, indent=1))


def colmap(root: Path, truth: dict[str, float]) -> dict[str, object]:
    """Return what COLMAP's defaults make of the folder of images."""
    import pycolmap
    database = root / 'database.db'
    started = time.monotonic()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = 'RADIAL'
    pycolmap.extract_features(database, root / 'images',
                              camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader)
    extracted = time.monotonic()
    pycolmap.match_sequential(database)
    matched = time.monotonic()
    (root / 'sparse').mkdir()
    models = pycolmap.incremental_mapping(database, root / 'images', root / 'sparse')
    ended = time.monotonic()
    found = []
    for model in models.values():
        focal, cx, cy, k1, k2 = next(iter(model.cameras.values())).params
        estimate = {'fx': focal, 'fy': focal, 'cx': cx - 0.5, 'cy': cy - 0.5, 'k1': k1, 'k2': k2}
        found.append({'images': model.num_reg_images(), 'estimate': estimate,
                      'error_pct': errors(estimate, truth)})
    return {'seconds': {'extract': extracted - started, 'match': matched - extracted,
                        'map': ended - matched, 'total': ended - started},
            'models': sorted(found, key=lambda model: -model['images'])}


def errors(estimate: dict[str, float], truth: dict[str, float]) -> dict[str, float]:
    """Return absolute errors in percent; in units where the truth is 0."""
    return {key: float(100 * abs(estimate[key] / truth[key] - 1)) if abs(truth[key]) > 1e-9
            else float(np.abs(estimate[key]))
            for key in ('fx', 'fy', 'cx', 'cy', 'k1', 'k2')}


if __name__ == '__main__':
    main()
