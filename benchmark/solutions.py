# SPDX-License-Identifier: Apache-2.0
"""Solved drives on disk: what is measured of a solution needs no second rendering or solving."""
from __future__ import annotations

import argparse
import json
import pickle
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from drives import BY_NAME, drive_of, pictures_of
from measure import commit
from wide import WIDE, wide_drive_of

from dashcalib_ros import Calibration, Calibrator, Config, open_frames
from dashcalib_ros.input import Frame
from dashcalib_ros.solve.solution import Solution

RECORDED = {'kitti03': 'bag', 'carnd': 'drive.mp4', 'ntu_campus': 'images'}
FPS = {'ntu_campus': 3.0}


@dataclass(frozen=True)
class Solved:
    """A drive that was calibrated. solution: None where it gave none; commit: of the code."""

    name: str
    seed: int
    calibration: Calibration
    solution: Solution | None
    truth: Mapping[str, Any]
    commit: str = ''


def solved_drive(name: str, seed: int, cache: Path, data: Path | None = None) -> Solved:
    """Return a drive's solution from the cache, or calibrate the drive first."""
    path = solution_path(name, seed, cache)
    if path.exists():
        return Solved(**pickle.loads(path.read_bytes()))
    frames, truth = _frames_of(name, seed, cache, data)
    with Calibrator(Config(seed=seed)) as calibrator:
        for frame in frames:
            calibrator.push(frame)
        calibration = calibrator.calibrate()
        found = Solved(name, seed, calibration, calibrator.solution, truth, commit())
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix('.new')
    # as a plain dictionary, which any script can read
    fresh.write_bytes(pickle.dumps({each.name: getattr(found, each.name)
                                    for each in fields(found)}))
    fresh.replace(path)
    return found


def solution_path(name: str, seed: int, cache: Path) -> Path:
    """Return where a drive's solution by this commit is kept."""
    return cache / 'solutions' / commit() / f'{name}, seed {seed}.pickle'.replace('/', ' ')


def _frames_of(name: str, seed: int, cache: Path, data: Path | None
               ) -> tuple[Iterable[Frame], dict[str, Any]]:
    if name in RECORDED:
        assert data is not None
        truth = json.loads((data / name / 'truth.json').read_text())
        return open_frames(data / name / RECORDED[name], fps=FPS.get(name)), truth
    drive = wide_drive_of(name, seed) if name in WIDE else drive_of(BY_NAME[name], seed)
    size = {'width': drive.lens.width, 'height': drive.lens.height}
    return pictures_of(drive, cache), {**drive.truth, **size}


def main() -> None:
    """Fill the cache."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('names', nargs='+')
    parser.add_argument('--seeds', nargs='+', type=int, default=[0, 1, 2])
    parser.add_argument('--cache', type=Path, required=True)
    parser.add_argument('--data', type=Path)
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        for name in arguments.names:
            if name in RECORDED and seed:
                continue
            found = solved_drive(name, seed, arguments.cache, arguments.data)
            print(name, seed, found.calibration, file=sys.stderr, flush=True)


if __name__ == '__main__':
    main()
