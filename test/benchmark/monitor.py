#!/usr/bin/env python3
"""After how many turns the monitor notices a change of the camera, and how often for nothing.

    python test/benchmark/monitor.py --cache DIR [--drives N] [--out DIR]

Reads the solutions that check.py keeps in the cache. Each turn's tracks are mapped to what a
zoomed, cropped, exchanged or turned camera would have seen of them, and explained with the
calibration in use; these readings are kept in the cache, too. A simulated drive is a row of turns
of one lens, drawn at random, with a change after some of them. Its calibration in use is the
solution, moved by an error drawn from the solution's own covariance.
"""
from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from held_out import solved_drives
from measure import complain, parser_with, table
from scipy.spatial.transform import Rotation
from solutions import Solved

from dashcalib_ros import Config, stages
from dashcalib_ros.camera import Camera
from dashcalib_ros.checking import Monitor, Reading
from dashcalib_ros.reconstruction.scene import Scene
from dashcalib_ros.solve.opinions import covariance_of
from dashcalib_ros.turns.turn import TurnId

CONFIG = Config()
# turns after the change, and turns of a drive without one
AFTER, UNCHANGED = 5, 12
FEWEST_TURNS = 3
# times the limits of the config
FACTORS = (0.125, 0.25, 0.5, 1.0, 2.0)


def zoomed(camera: Camera, by: float, about: tuple[float, float] = (0.5, 0.5)) -> Camera:
    """Return the camera zoomed about a place of its picture, as a share of its sides."""
    x, y = (share * side - 0.5 for share, side in zip(about, camera.image_size, strict=True))
    return replace(camera, fx=camera.fx * by, fy=camera.fy * by, cx=x + by * (camera.cx - x),
                   cy=y + by * (camera.cy - y))


def exchanged(camera: Camera) -> Camera:
    """Return another device: 12 % longer, less distorted, another centre."""
    return replace(zoomed(camera, 1.12), k1=0.7 * camera.k1,
                   cx=camera.cx + 0.01 * camera.image_size[0])


@dataclass(frozen=True)
class Event:
    """A change: the camera that takes the pictures afterwards, and how it is turned, degrees."""

    camera: Callable[[Camera], Camera] = lambda camera: camera
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0

    @property
    def kind(self) -> str:
        """Return the kind of change that the monitor must tell."""
        return 'mount' if self.yaw_deg or self.pitch_deg else 'lens'


EVENTS: Mapping[str, Event] = {
    'none': Event(),
    'zoom +1 %': Event(lambda camera: zoomed(camera, 1.01)),
    'zoom +2 %': Event(lambda camera: zoomed(camera, 1.02)),
    'zoom -2 %': Event(lambda camera: zoomed(camera, 1 / 1.02)),
    'zoom +5 %': Event(lambda camera: zoomed(camera, 1.05)),
    'crop of 95 % at a corner': Event(lambda camera: zoomed(camera, 1 / 0.95, (0.0, 1.0))),
    'exchanged': Event(exchanged),
    'turned 1° to a side': Event(yaw_deg=1.0),
    'tilted by 1°': Event(pitch_deg=1.0),
    'turned 3° to a side': Event(yaw_deg=-3.0),
    'tilted by 3°': Event(pitch_deg=-3.0),
}


def seen_after(scene: Scene, camera: Camera, event: Event) -> Scene:
    """Return the scene as it would have been reconstructed after the event."""
    new = event.camera(camera)
    turn = Rotation.from_euler('yx', [event.yaw_deg, event.pitch_deg], degrees=True).as_matrix()
    xy = new.project(camera.rays(scene.tracks.xy) @ turn.T)
    width, height = new.image_size
    inside = (xy >= 0).all(axis=2) & (xy <= [width - 1, height - 1]).all(axis=2)
    structure = scene.structure
    return replace(
        scene, camera=new, tracks=replace(
            scene.tracks, xy=np.where(inside[:, :, None], xy, np.nan)),
        structure=replace(structure, rotations=turn @ structure.rotations,
                          translations=structure.translations @ turn.T,
                          used=structure.used & inside))


@dataclass(frozen=True)
class Library:
    """The readings of one lens, by event; covariance: (n, n) of its calibration."""

    name: str
    camera: Camera
    covariance: np.ndarray
    readings: Mapping[str, Sequence[Reading]]


def library_of(drive: Solved, cache: Path) -> Library:
    """Return a drive's readings from the cache, or make them."""
    assert drive.solution is not None
    path = cache / 'readings' / f'{drive.name}, seed {drive.seed}.pickle'.replace('/', ' ')
    if path.exists():
        found: Library = pickle.loads(path.read_bytes())
        return found
    camera = drive.solution.camera
    found = Library(
        f'{drive.name}, seed {drive.seed}', camera,
        covariance_of(drive.solution, CONFIG.intrinsics),
        {name: stages.read([seen_after(scene, camera, event) for scene in drive.solution.scenes],
                           camera, CONFIG) for name, event in EVENTS.items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix('.new')
    fresh.write_bytes(pickle.dumps(found))
    fresh.replace(path)
    return found


def noticed(library: Library, name: str, factor: float, seed: int) -> tuple[int | None, bool]:
    """Return after how many turns a change was told (None: not), and whether one was for nothing.

    factor: of the monitor's limits.
    """
    rng = np.random.default_rng([seed, 17])
    settings = CONFIG.monitor
    settings = replace(settings, limit=factor * settings.limit,
                       turn_limit=factor * settings.turn_limit,
                       heading_limit=np.sqrt(factor) * settings.heading_limit)
    # the calibration in use is off by this much
    off = rng.multivariate_normal(np.zeros(len(library.covariance)), library.covariance)
    monitor = Monitor(library.camera, library.covariance, settings)
    event = EVENTS[name]
    before = int(rng.integers(3, 7)) if name != 'none' else UNCHANGED
    for turn in range(before + (AFTER if name != 'none' else 0)):
        rows = library.readings['none' if turn < before else name]
        reading = rows[rng.integers(len(rows))]
        monitor = monitor.after(replace(reading, turn=TurnId.at(turn),
                                        score=reading.score - reading.hessian @ off))
        if turn < before and monitor.changes:
            return None, True
        if any(change.kind == event.kind for change in monitor.changes):
            return turn - before + 1, False
    return None, False


def events_table(libraries: Sequence[Library], drives: int) -> str:
    """Return a line for each event."""
    rows = []
    for name in EVENTS:
        found = [noticed(libraries[n % len(libraries)], name, 1.0, n) for n in range(drives)]
        turns = [after for after, _ in found if after is not None]
        within = [sum(each <= most for each in turns) for most in (2, 3, AFTER)]
        false = sum(each for _, each in found)
        rows.append((name, *('' if name == 'none' else f'{100 * count / drives:.1f} %'
                             for count in within), f'{false} of {drives}'))
    return table(('change', 'told within 2 turns', '3', f'{AFTER}', 'for nothing'), rows)


def trade_table(libraries: Sequence[Library], drives: int) -> str:
    """Return what other limits would tell: the curve of alarms that are true and false."""
    names = ('zoom +1 %', 'zoom +2 %', 'zoom -2 %', 'turned 1° to a side', 'tilted by 1°')
    rows = []
    for factor in FACTORS:
        shares = []
        for name in names:
            found = [noticed(libraries[n % len(libraries)], name, factor, n)[0]
                     for n in range(drives)]
            told = sum(each is not None and each <= 3 for each in found)
            shares.append(f'{100 * told / drives:.1f} %')
        false = sum(noticed(libraries[n % len(libraries)], 'none', factor, n)[1]
                    for n in range(drives))
        rows.append((f'{factor:g}', *shares, f'{false} of {drives}'))
    return table(('limits, times ours', *names, 'for nothing'), rows)


def main() -> None:
    """Parse the arguments, print the tables."""
    parser = parser_with(__doc__, 'cache', 'out')
    parser.add_argument('--drives', type=int, default=200, help='simulated, for each change')
    arguments = parser.parse_args()
    libraries = []
    for drive in solved_drives(arguments.cache):
        if (drive.solution is None or drive.calibration.verdict.level != 'accepted'
                or len(drive.solution.scenes) < FEWEST_TURNS):
            complain(f'{drive.name}, seed {drive.seed}: not accepted, or too few turns')
            continue
        libraries.append(library_of(drive, arguments.cache))
        complain(libraries[-1].name)
    turns = sum(len(each.readings['none']) for each in libraries)
    text = (f'{len(libraries)} lenses, {turns} turns\n\n'
            f'{events_table(libraries, arguments.drives)}\n\n'
            f'{trade_table(libraries, arguments.drives)}')
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / 'monitor.md').write_text(text + '\n')
    print(text)


if __name__ == '__main__':
    main()
