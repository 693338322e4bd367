# SPDX-License-Identifier: Apache-2.0
"""Rigs with known truth: how far each camera's place is off, in its unit and in sigmas.

    python benchmark/rig.py [--kinds KIND ...] [--seeds 0-9] [--turns N] [--cache DIR]
                            [--data DIR] [--drives DRIVE ...] [--results]

Rendered rigs have exact truth. The halves of a recorded drive's pictures are two cameras that look
to the left and to the right, without distortion; their rotation is known, but for what the lens
is off with which they were cut, and nothing is between them; their metres are by the height of
the camera. Of the real pair kitti_stereo the epipolar geometry of matches that nothing was fitted
to is the witness. The CPU time of each rig is beside that of calibrating its cameras alone. Rows
go to rig.json in --out; what is there is not run again.
"""
from __future__ import annotations

import resource
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from measure import commit, keep_table, load, parser_with, save
from mount import NOMINAL_M
from views import View, Viewed

from dashcalib_ros import open_frames
from dashcalib_ros.camera.rotation import rotation_matrices, rotation_vectors
from dashcalib_ros.demo import RIGS, Lens, render_to_bag, rig_drives, true_places
from dashcalib_ros.demo.rig import SPEC
from dashcalib_ros.input.motion import Samples, SensorStream
from dashcalib_ros.rig.placed import PlacedCamera, RigCalibration
from dashcalib_ros.rig_session import calibrate_rig
from dashcalib_ros.workers.worker import prepare_process

HEAD = """\
| rig | seed | turns | camera | verdict | rotation off, degrees | its sigma | worst, sigmas | \
lever off, cm (visible axes) | clock off, ms | CPU s | times the single runs |
|---|---|---|---|---|---|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Halved:
    """A recorded drive and what is cut from it.

    own: the drive's lens; lens: of both halves; yaw_deg: by which they look to the side.
    """

    pictures: str
    fps: float | None
    own: Lens
    lens: Lens
    yaw_deg: float


HALVES = {
    'kitti03': Halved('bag', None, Lens(1242, 375, 718.2, 718.2, 609.6, 172.9, 0.02),
                      Lens(540, 280, 680.0, 680.0, 269.5, 139.5), 15.0),
    'kitti07': Halved('images', 9.65, Lens(1226, 370, 701.9, 701.9, 601.9, 183.1, 0.022),
                      Lens(560, 300, 680.0, 680.0, 279.5, 149.5), 15.0),
    'kitti_raw': Halved('images', 9.7, Lens(
        1392, 512, 984.24, 980.81, 690.0, 233.2, -0.37288, 0.20373, 0.00222, 0.00138, -0.07234),
                        Lens(720, 400, 900.0, 900.0, 359.5, 199.5), 13.0)}
PAIR = 'kitti_stereo'
# degrees about x and z, of the left half and of the right one
TILTS_DEG = ((0.4, 0.3), (-0.5, -0.6))


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
    found, cost = measured(bags, motion=SensorStream(speed=Samples(times, moving[:, None])))
    truth, rows = true_places(drives, base), []
    for name, camera in found.cameras.items():
        if name == base:
            continue
        start = f'| {kind} | {seed} | {turns} | {name} |'
        if camera.rotation is None:
            rows.append(unplaced(start, camera, cost))
            continue
        lever = moved_by(camera, truth[name].translation_m)
        clock = 1e3 * ((camera.time_offset_s or 0.0) - truth[name].time_offset_s)
        rows.append(f'{rotated(start, camera, truth[name].rotation)} {lever} | {clock:.2f} | '
                    f'{cost}')
    return rows


def moved_by(camera: PlacedCamera, truth_m: np.ndarray) -> str:
    """Return how far a camera's translation is off along the axes that are visible, cm."""
    if camera.translation_m is None:
        return ''
    away = 100 * (np.array(camera.translation_m) - truth_m)
    return ', '.join(f'{value:.1f}' for value, sight in zip(
        away, camera.visible.translation, strict=True) if sight != 'not visible')


def spent() -> float:
    """Return the CPU seconds of this process and of its children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def measured(drives: dict[str, Any], **options: Any) -> tuple[RigCalibration, str]:
    """Return a rig, and its last cells: CPU seconds, and how many times the single runs'."""
    begin, alone = spent(), list[float]()

    def progress(stage: str, done: float) -> None:
        if stage.startswith('retracing') and not alone:
            alone.append(spent() - begin)

    found = calibrate_rig(drives, progress=progress, **options).rig
    seconds = spent() - begin
    return found, f'{seconds:.0f} | {seconds / alone[0]:.2f} |'


def unplaced(start: str, camera: PlacedCamera, cost: str) -> str:
    """Return the row of a camera without a place."""
    return f'{start} {camera.verdict} | {"; ".join(map(str, camera.reasons))} | | | | | {cost}'


def rotated(start: str, camera: PlacedCamera, truth: np.ndarray) -> str:
    """Return the beginning of a camera's row. truth: (3, 3) from the base's axes."""
    assert camera.rotation is not None
    off = np.degrees(rotation_vectors((camera.rotation @ truth.T)[None])[0])
    sigma = np.array(camera.rotation_sigma_deg)
    return (f'{start} {camera.verdict} | {_text(off)} | {_text(sigma)} | '
            f'{np.abs(off / sigma).max():.1f} |')


def halves(name: str, data: Path, cache: Path) -> list[str]:
    """Return the row of the halves of a recorded drive's pictures."""
    drive, folders, turned = HALVES[name], {}, {}
    for side, sign, (x, z) in zip(('left', 'right'), (1, -1), TILTS_DEG, strict=True):
        view = View(f'{name}, {side}', drive.lens, turned_deg=(x, sign * drive.yaw_deg, z))
        turned[side] = rotation_matrices(np.radians([view.turned_deg]))[0]
        frames = open_frames(data / name / drive.pictures, fps=drive.fps)
        folders[side] = cut(Viewed(view, frames, drive.own), cache / f'halves-{name}' / side)
    found, cost = measured(folders, fps=drive.fps or 10.0,
                           config={'known.height': f'{NOMINAL_M}±0.02'})
    rows = []
    for side, camera in found.cameras.items():
        if side != found.base:
            start = f'| halves of {name} | | | {side} |'
            truth = turned[side] @ turned[found.base].T
            rows.append(unplaced(start, camera, cost) if camera.rotation is None else
                        f'{rotated(start, camera, truth)} {moved_by(camera, np.zeros(3))} | | '
                        f'{cost}')
    return rows


def cut(pictures: Viewed, folder: Path) -> str:
    """Write pictures into a folder, unless it is there; return its path."""
    if not folder.exists():
        folder.mkdir(parents=True)
        for frame in pictures:
            cv2.imwrite(str(folder / f'{frame.index:06d}.png'), frame.image)
    return str(folder)


def real(folder: Path) -> list[str]:
    """Return the lines of the real pair."""
    found, cost = measured({name: str(folder / name) for name in ('left', 'right')}, fps=10)
    camera, witness = found.cameras['right'], found.witness[('left', 'right')]
    assert camera.rotation_deg is not None and camera.rotation_sigma_deg is not None
    return ['', f'The real pair {folder.name}, one turn: right against left '
            f'({_text(np.array(camera.rotation_deg))}) degrees, sigma '
            f'({_text(np.array(camera.rotation_sigma_deg))}), {camera.verdict}; epipolar residual '
            f'of {witness.matches} matches with that rotation held: median {witness.median:.2f} '
            f'px, over the picture {witness.cells_rms:.2f} px RMS; {cost.split()[0]} CPU s.']


def _text(values: np.ndarray) -> str:
    return ', '.join(f'{value:.3f}' for value in values)


def summary(rows: Sequence[str]) -> str:
    """Return one line about the cameras of rendered rigs."""
    cells = [[cell.strip() for cell in row.split('|')[1:-1]] for row in rows
             if row.startswith('|') and 'halves' not in row]
    placed = [row for row in cells if row[7]]
    sigmas = [max(map(float, row[6].split(','))) for row in placed]
    worst = [float(row[7]) for row in placed]
    return (f'Rendered: {len(cells)} cameras, {len(placed)} placed, '
            f'{sum(row[4] == "accepted" for row in placed)} accepted; the worst '
            f'{max(worst)} sigmas off; sigma about the worst axis {np.median(sigmas):.3f}° in the '
            f'median. {100 * np.mean(np.array(worst) <= 2):.0f} % of the placed within 2 sigma '
            f'about all axes; CPU {np.median([float(row[-1]) for row in cells]):.2f} times the '
            'single runs in the median.')


def main() -> None:
    """Measure, and write the table."""
    parser = parser_with(__doc__, 'data', 'drives', 'seeds', 'cache', drives=[*HALVES, PAIR],
                         seeds=range(2))
    parser.set_defaults(cache=Path(tempfile.gettempdir()) / 'rigs')
    parser.add_argument('--kinds', nargs='+', default=list(RIGS))
    parser.add_argument('--turns', type=int, default=3)
    args = parser.parse_args()
    path, at = args.out / 'rig.json', commit()
    done: dict[str, dict[str, Any]] = load(path)
    for seed in args.seeds:
        for kind in args.kinds:
            if (key := f'{kind}-{seed}-{args.turns}') not in done:
                rows = rendered(kind, seed, args.turns, args.cache)
                done[key] = {'commit': at, 'rows': rows}
                save(path, done)
                print('\n'.join(rows), flush=True)
    for name in args.drives if args.data else ():
        if name not in done:
            rows = (real(args.data / name) if name == PAIR else
                    halves(name, args.data, args.cache))
            done[name] = {'commit': at, 'rows': rows}
            save(path, done)
            print('\n'.join(rows), flush=True)
    # the table first, then what is said about the real pair
    lines = sorted((row for each in done.values() for row in each['rows']),
                   key=lambda row: not row.startswith('|'))
    keep_table('rig', '\n'.join([HEAD, *lines, '', summary(lines)]), args,
               [each['commit'] for each in done.values()])


if __name__ == '__main__':
    prepare_process()
    main()
