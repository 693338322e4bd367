#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What drives without a sharp turn know about the focal length: pieces of real and rendered ones.

    python benchmark/without_turns.py [--data DIR] [--seconds S] [--drives NAME ...]
                                      [--seeds 8000-8009] [--spoilt NAME ...] [--fleet]
                                      [--results]

Real drives are cut into pieces of so many seconds; a piece with a turn of 20 degrees or more is
left out. A seed draws a camera and a street as population.py does, and a drive of 10 to 40 s
with bumps: straight with lane keeping, or bends of 100 to 800 m radius. Each is calibrated
three times: without knowing anything, with known.stabiliser=no, and with nothing but the speed
of the car and known.height, to 2 cm. --spoilt: rendered drives whose pictures a stabiliser moved,
or that were zoomed or cropped; nothing is known about them, or speed and height. --fleet: pieces
without a sharp turn, as the clips of one camera of a fleet; there is no stabiliser.
Rows go to DIR/without_turns.json; what is there is not run again. --results writes the table into
benchmark/results/without_turns.md.
"""
from __future__ import annotations

import csv
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from attacks import Film, shifted, stepped, swings, warped, with_pictures, zoomed
from mapping import GRID
from measure import calibrate as calibrate_frames
from measure import commit, isolated, keep_table, load, parser_with, save, table
from motion import columns_of
from mount import NOMINAL_M, speed_of
from population import closest_cameras, rays_of
from population import drive_of as camera_and_street

from dashcalib_ros import Config, calibrate, open_frames
from dashcalib_ros.demo import Drive, Turn
from dashcalib_ros.demo.vehicle import MARGIN_S
from dashcalib_ros.formats.ours import load_calibration
from dashcalib_ros.input.motion import Samples, SensorStream
from dashcalib_ros.input.poses import read_poses
from dashcalib_ros.judge import CalibrationData

# what is known about the camera, as the table says it; 'height' is m above the road
KNOWN = {'not known': '', 'no': 'no', 'not known; speed and height are': 'height'}
# m, what a tape measure is worth
TAPE_M = 0.02
# input, images per second of folders, and the truth of fx with its sigma, px
DRIVES = {'kitti03': ('bag', None, 718.2, 1.8), 'kitti07': ('images', 9.65, 701.9, 1.4),
          'kitti_raw': ('images', 9.7, 981.5, 3.0), 'carnd': ('drive.mp4', None, 1161.0, 10.0)}
# s where the pieces begin that are a fleet's clips, and how many there are
FLEETS = {'kitti03': (10.5, 7), 'carnd': (0.0, 5)}
# degrees
SHARP = 20.0
DURATION_S = (10.0, 40.0)
LANE_DEG, LANE_RADIUS_M = (0.5, 3.0), (150.0, 400.0)
BEND_DEG, BEND_RADIUS_M = (6.0, 30.0), (100.0, 800.0)


def gentle_drive(seed: int) -> Drive:
    """Return the drive of a seed: odd ones have bends, even ones only keep their lane."""
    drawn = camera_and_street(seed)
    rng = np.random.default_rng([seed, 59])
    seconds, bends = rng.uniform(*DURATION_S), bool(seed % 2)
    angles, radii = (BEND_DEG, BEND_RADIUS_M) if bends else (LANE_DEG, LANE_RADIUS_M)
    spec = replace(drawn.spec, straight_m=float(rng.uniform(5.0, 30.0)), lead_m=10.0,
                   stops=(), turn_speed_mps=drawn.spec.speed_mps)
    left, turns, side = seconds * spec.speed_mps - 20.0, list[Turn](), rng.choice([-1.0, 1.0])
    while left > 0.0:
        turn = Turn(float(side * rng.uniform(*angles)), float(rng.uniform(*radii)))
        turns.append(turn)
        left -= np.radians(abs(turn.angle_deg)) * turn.radius_m + spec.straight_m
        side = -side if not bends or rng.random() < 0.5 else side
    return type(drawn)(drawn.lens, replace(spec, turns=tuple(turns)))


def film_of(drive: Drive) -> Film:
    """Return the pictures of a drive, with the true angles of its camera."""
    ahead = drive.poses[:, :3, 2]
    lens = drive.lens
    return Film([drive.frame(k) for k in range(len(drive))],
                {'fx': lens.fx, 'fy': lens.fy, 'cx': lens.cx, 'cy': lens.cy},
                -np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])),
                np.arctan2(-ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1])), ())


def steadied(across: bool, down: bool, lag_s: float = 0.5, gaussian: bool = True
             ) -> Callable[[Film, np.random.Generator], Film]:
    """Move the crop by at most 5 % of the width against what the camera turns; see swings()."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        height, width = film.frames[0].image.shape
        most = 0.05 * width
        right, below = (np.clip(-film.truth[f] * swings(
            angle, film.seconds, lag_s, gaussian), -most, most) * on
                        for f, angle, on in (('fx', film.yaw, across), ('fy', film.pitch, down)))
        return with_pictures(film, (
            warped(frame.image, np.array([[1.0, 0.0, x], [0.0, 1.0, y]]), (width, height))
            for frame, x, y in zip(film.frames, right, below, strict=True)))

    return change


SPOILT: dict[str, Callable[[Film, np.random.Generator], Film]] = {
    'stabilised across': steadied(True, False),
    'stabilised down': steadied(False, True),
    'stabilised': steadied(True, True),
    'stabilised, lag 0.3 s': steadied(True, True, 0.3, gaussian=False),
    'zoom 3 %, slowly': zoomed(lambda seconds, count: np.linspace(1.0, 1.03, count)),
    'zoom 3 % after half': stepped(1.03, 0.5),
    'shifted by 2 % after half': shifted(0.02)}


def row_of(found: CalibrationData, fx: float, fx_sigma: float) -> dict[str, Any]:
    """Return what is kept of a result; fx: the truth, NaN for a model that cannot have one."""
    yaws = [turn.yaw_deg for turn in found.turns if turn.yaw_deg is not None]
    sigma = float((found.sigma or {}).get('fx', np.nan))
    row = {'verdict': found.verdict.level, 'yaw': max(yaws, default=0.0), 'scenes': len(yaws),
           'fx': None, 'sigma': None, 'percent': None, 'sigmas': None}
    if found.camera is None or not np.isfinite([sigma, fx]).all():
        return row
    off = found.camera.fx - fx
    return {**row, 'fx': found.camera.fx, 'sigma': sigma, 'percent': 100 * off / fx,
            'sigmas': off / float(np.hypot(sigma, fx_sigma))}


def knowing(known: str, height_m: float) -> Config:
    """Return the settings where this is known, of KNOWN."""
    return Config.of({'known.height': f'{height_m}±{TAPE_M}'} if known == 'height' else
                     {'known.stabiliser': known})


def speed_from(folder: Path, place: str, fps: float | None, start_s: float) -> SensorStream:
    """Return the speed of a car of KITTI, from the first image behind start_s on."""
    stamps = np.array([frame.stamp_ns / 1e9 for frame in open_frames(folder / place, fps=fps)])
    first = stamps[stamps >= stamps[0] + start_s - 1e-6][0] - stamps[0]
    if (folder / 'oxts.csv').exists():
        own = columns_of(folder / 'oxts.csv')
        return SensorStream(speed=Samples(own['stamp_s'] - first,
                                          np.hypot(own['vf'], own['vl'])[:, None]))
    positions = read_poses(folder / 'poses.txt').positions
    count = min(len(positions), len(stamps))
    return speed_of(stamps[:count] - stamps[0] - first, positions[:count])


def piece(data: Path, name: str, start_s: float, seconds: float, known: str) -> dict[str, Any]:
    """Calibrate one piece (in a process of its own)."""
    place, fps, fx, fx_sigma = DRIVES[name]
    motion = speed_from(data / name, place, fps, start_s) if known == 'height' else None
    found = calibrate(data / name / place, fps=fps, start_s=start_s, duration_s=seconds,
                      motion=motion, config=knowing(known, NOMINAL_M))
    return row_of(found, fx, fx_sigma)


def fleet(data: Path, name: str, seconds: float) -> dict[str, Any]:
    """Calibrate a camera by its clips, folders of images (in a process of its own)."""
    place, fps, fx, fx_sigma = DRIVES[name]
    begin, count = FLEETS[name]
    with tempfile.TemporaryDirectory() as at:
        with open(f'{at}/clips.csv', 'w', encoding='utf-8') as stream:
            rows = csv.writer(stream)
            rows.writerow(['clip', 'camera', 'fps', 'known'])
            for k in range(count):
                folder = Path(at, f'{name}-{k}')
                folder.mkdir()
                stamps = []
                for frame in open_frames(data / name / place, fps=fps,
                                         start_s=begin + k * seconds, duration_s=seconds):
                    stamps.append(frame.stamp_ns)
                    cv2.imwrite(str(folder / f'{len(stamps):05d}.png'), frame.image)
                rate = 1e9 / float(np.median(np.diff(stamps)))
                rows.writerow([folder.name, name, f'{rate:.2f}', 'stabiliser=no'])
        subprocess.run([sys.executable, '-m', 'dashcalib_ros', 'batch', f'{at}/clips.csv', '--out',
                        f'{at}/out', '--workers', '1'], check=False, stdout=subprocess.DEVNULL)
        with open(f'{at}/out/cameras.csv', encoding='utf-8', newline='') as stream:
            turns = int(next(csv.DictReader(stream))['turns'])
        found = load_calibration(f'{at}/out/cameras/{name}/result.json')
        # whose turns are in the clips' files
        return {**row_of(found, fx, fx_sigma), 'yaw': None, 'scenes': turns}


def rendered(seed: int, spoilt: str, knowns: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Calibrate a rendered drive (in a process of its own); return a row for what is known."""
    cv2.setNumThreads(1)
    drive, rows = gentle_drive(seed), dict[str, dict[str, Any]]()
    film, lens = film_of(drive), drive.lens
    if spoilt:
        film = SPOILT[spoilt](film, np.random.default_rng(seed))
    x, y = np.meshgrid(np.linspace(0, lens.width - 1, GRID[0]),
                       np.linspace(0, lens.height - 1, GRID[1]))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    cameras = closest_cameras(lens, rays_of(lens, pixels), pixels)
    times = np.arange(0.0, drive.times[-1], 0.01)
    speed = speed_of(times, drive.ride.camera_at(times + MARGIN_S)[1])
    for known in knowns:
        found, _ = calibrate_frames(iter(film.frames), knowing(known, drive.spec.height_m),
                                    speed if known == 'height' else None)
        model = '' if found.camera is None else found.camera.model
        rows[known] = {**row_of(found, cameras.get(model, {}).get('fx', np.nan), 0.0),
                       'model': model, 'seconds': float(film.seconds[-1])}
    return rows


def honesty(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return one line about the numbers among some rows."""
    off = np.array([row['sigmas'] for row in rows if row['sigmas'] is not None])
    if not len(off):
        return f'{len(rows)} drives, no number.'
    sigma = np.median([100 * row['sigma'] / row['fx'] for row in rows if row['fx'] is not None])
    return (f'{len(rows)} drives, {len(off)} numbers, '
            f'{sum(row["verdict"] == "accepted" for row in rows)} accepted; '
            f'{np.sqrt(np.mean(off**2)):.2f} sigmas RMS, {np.sum(abs(off) > 2)} beyond 2, '
            f'{np.sum(abs(off) > 3)} beyond 3; sigma {sigma:.1f} % in the median.')


def main() -> None:
    """Calibrate all and print the tables."""
    parser = parser_with(__doc__, 'data', 'drives', 'seeds', drives=DRIVES,
                         seeds=range(8000, 8010))
    parser.set_defaults(data=Path('data'))
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--pieces', type=int, default=8, help='of each drive, at most')
    parser.add_argument('--spoilt', nargs='*', choices=SPOILT, default=[], metavar='NAME',
                        help='of ' + ', '.join(SPOILT).replace('%', '%%'))
    parser.add_argument('--fleet', action='store_true', help='also the clips of two cameras')
    args = parser.parse_args()
    path, at = args.out / 'without_turns.json', commit()
    rows = load(path)

    def keep(key: str, row: Mapping[str, Any] | None, failure: str) -> None:
        rows[key] = {'commit': at} | (
            {'verdict': 'failed', 'why': failure} if row is None else {**row})
        save(path, rows)
        print(key, rows[key], flush=True)

    for name in args.drives:
        for start in args.seconds * np.arange(args.pieces):
            for words, known in KNOWN.items():
                key = f'{name} | {start:.0f} | {args.seconds:.0f} s | {words}'
                # nobody knows the speed of the highway's car
                if key not in rows and (known != 'height' or name.startswith('kitti')):
                    done = isolated(piece, args.data, name, float(start), args.seconds, known)
                    keep(key, done.value, done.failure)
    for name in FLEETS if args.fleet else ():
        key = f'{name} | fleet of {FLEETS[name][1]} clips | {args.seconds:.0f} s | no'
        if key not in rows:
            done = isolated(fleet, args.data, name, args.seconds)
            keep(key, done.value, done.failure)
    for seed in args.seeds:
        for spoilt in ('', *args.spoilt):
            keys = {f'{seed} | {spoilt or "as it is"} | rendered | {words}': known
                    for words, known in KNOWN.items() if not spoilt or known != 'no'}
            if missing := {key: known for key, known in keys.items() if key not in rows}:
                done = isolated(rendered, seed, spoilt, [*missing.values()])
                for key, known in missing.items():
                    keep(key, (done.value or {}).get(known), done.failure)
    # a piece may be beyond the end of its drive, or have a turn
    kept = {key: row for key, row in rows.items() if row['verdict'] != 'failed' and row['scenes']
            and not ((row['yaw'] or 0.0) >= SHARP and key.startswith(tuple(DRIVES)))}
    text = table(
        ['drive', 'from s; or what was done', 'length', 'stabiliser', 'verdict', 'stretches',
         'largest yaw °', 'fx', 'off %', 'off in sigmas'],
        [[*key.replace('rendered', f'{row.get("seconds", 0):.0f} s').split(' | '), row['verdict'],
          f'{row["scenes"]}',
          '' if row['yaw'] is None else f'{row["yaw"]:.0f}',
          *(['none', '', ''] if row['fx'] is None else
            [f'{row["fx"]:.1f} ± {row["sigma"]:.1f}', f'{row["percent"]:+.1f}',
             f'{row["sigmas"]:+.1f}'])] for key, row in kept.items()])
    for words, belongs in (
            ('Real pieces', lambda key: key.startswith(tuple(DRIVES)) and 'fleet' not in key),
            ('Fleets', lambda key: 'fleet' in key),
            ('Rendered', lambda key: 'as it is' in key),
            ('Spoilt', lambda key: 'rendered' in key and 'as it is' not in key)):
        for known in KNOWN:
            chosen = [row for key, row in kept.items()
                      if belongs(key) and key.endswith(f'| {known}')]
            if chosen:
                text += f'\n\n{words}, stabiliser {known}: {honesty(chosen)}'
    keep_table('without_turns', text, args, [row['commit'] for row in kept.values()])


if __name__ == '__main__':
    main()
