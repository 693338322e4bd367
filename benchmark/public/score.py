#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Score any calibrator by the camera files that it wrote for the drives of README.md.

    python benchmark/public/score.py FOLDER ... [--seeds 0 1 2] [--each]

A folder has the camera of each drive as DRIVE.EXTENSION or DRIVE/, in any format that `dashcalib
compare` reads. A drive without one was refused. A row for each folder; --each: for each drive.
"""
from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))
from result_tables import table

from dashcalib_ros.camera import Brown, Camera
from dashcalib_ros.camera.mapping import apart_at, grid_of, mapping_error
from dashcalib_ros.demo import Drive, demo_drive
from dashcalib_ros.errors import DashcalibError, InputError
from dashcalib_ros.formats import load_camera
from dashcalib_ros.judge.difference import NamedCamera

SOUND = 'radial', 'brown', 'fisheye', 'windscreen', 'shutter'
HOPELESS = 'straight', 'stabilised'
HEAD = ('calibrator', 'sound drives accepted', 'hopeless ones refused', 'fx off, %: median',
        'most', 'rays off, px: median', 'most', 'within 1 sigma, %', '2 sigma')
# K_00 and D_00 of KITTI raw, 2011-09-26, by chessboards
BOARD = Brown.of((1392, 512), [984.2439, 980.8141, 690.0, 233.1966, -0.3728755, 0.2037299,
                               0.002219027, 0.001383707, -0.07233722])
# of fx: pictures and true rotation together; two days' chessboards
KITTI = {'kitti03': (718.2, 1.8), 'kitti07': (701.9, 1.4), 'kitti_raw': (981.5, 3.0)}


@dataclass(frozen=True)
class Known:
    """A drive and its truth. fx, fx_sigma: px; drive: where it is rendered."""

    name: str
    fx: float
    fx_sigma: float = 0.0
    hopeless: bool = False
    drive: Drive | None = None


@dataclass(frozen=True)
class Score:
    """What a camera is worth; rays_px: None where no truth has them.

    off_percent: of fx. sigmas: the errors of fx and of what else is known, over their sigmas.
    """

    known: Known
    accepted: bool
    off_percent: float | None = None
    rays_px: float | None = None
    sigmas: tuple[float, ...] = ()


def drives(seeds: Sequence[int]) -> list[Known]:
    """Return all drives; nothing is rendered."""
    found = [Known(f'{lens}-{seed}', made.lens.fx, hopeless=lens in HOPELESS, drive=made)
             for lens in (*SOUND, *HOPELESS) for seed in seeds
             for made in [demo_drive(seed, lens)]]
    return [*found, *(Known(name, *fx) for name, fx in KITTI.items())]


def camera_in(folder: Path, name: str) -> NamedCamera | None:
    """Return the camera of a drive; None where there is none, or a refusal. Raises InputError."""
    paths = [path for path in sorted(folder.iterdir()) if name in (path.name, path.stem)]
    if len(paths) > 1:
        raise InputError('E-SCORE-SEVERAL', f'{folder} has several files of {name}: keep one')
    try:
        return load_camera(paths[0], nearest=True) if paths else None
    except InputError as error:
        if error.code != 'E-NO-INTRINSICS':
            raise
        return None


def score(known: Known, found: NamedCamera | None) -> Score:
    """Return what a calibrator's camera of a drive is worth."""
    if found is None:
        return Score(known, False)
    named, sigma = found.camera.named, found.sigma or {}
    accepted = found.verdict in (None, 'accepted')
    if known.hopeless:
        return Score(known, accepted)
    truth = {'fx': known.fx}
    # of a lens behind glass no camera model has the truth, nor has another model
    if known.drive is not None and known.drive.lens.glass is None and (
            found.camera.model == known.drive.lens.model):
        truth = dict(known.drive.truth)
    spread = {'fx': known.fx_sigma}
    return Score(
        known, accepted, 100 * (named['fx'] / known.fx - 1), rays_off(known, found),
        tuple((named[key] - value) / (sigma[key]**2 + spread.get(key, 0.0)**2)**0.5
              for key, value in truth.items() if key in named and sigma.get(key)))


def rays_off(known: Known, found: NamedCamera) -> float | None:
    """Return the RMS px over the picture, the best common rotation removed; with the field."""
    camera: Camera = found.camera
    if known.drive is not None:
        pixels = grid_of(camera)
        apart = apart_at(camera, known.drive.lens.rays(pixels),
                         pixels if found.field is None else found.field.ideal(pixels))
        return None if apart is None else apart.rms
    return mapping_error(camera, BOARD) if known.name == 'kitti_raw' else None


def cells(name: str, scores: Sequence[Score]) -> list[str]:
    """Return the row of a calibrator."""
    sound = [each for each in scores if not each.known.hopeless]
    hopeless = [each for each in scores if each.known.hopeless]
    good = [each for each in sound if each.accepted]
    off = [abs(each.off_percent) for each in good if each.off_percent is not None]
    rays = [each.rays_px for each in good if each.rays_px is not None]
    sigmas = [abs(z) for each in good for z in each.sigmas]
    within = [f'{100 * statistics.mean(z <= most for z in sigmas):.0f}' if sigmas
              else 'none said' for most in (1, 2)]
    return [name, f'{len(good)} of {len(sound)}',
            f'{sum(not each.accepted for each in hopeless)} of {len(hopeless)}',
            *(f'{of(values):.2f}' if values else '' for values in (off, rays)
              for of in (statistics.median, max)), *within]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n')[0])
    parser.add_argument('folders', nargs='+', type=Path, metavar='FOLDER')
    parser.add_argument('--seeds', nargs='+', type=int, default=[0, 1, 2])
    parser.add_argument('--each', action='store_true', help='a row for each drive')
    given = parser.parse_args()
    rows = []
    try:
        for folder in given.folders:
            scores = [score(known, camera_in(folder, known.name)) for known in drives(given.seeds)]
            rows += [cells(f'{folder.name}, {each.known.name}', [each]) for each in scores
                     if given.each]
            rows.append(cells(folder.name, scores))
    except (DashcalibError, OSError) as error:
        sys.exit(str(error))
    print(table(HEAD, rows))


if __name__ == '__main__':
    main()
