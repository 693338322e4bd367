#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""After how many turns the monitor notices a change of the camera, and how often for nothing.

    python benchmark/monitor.py --cache DIR [--simulated N] [--seed N] [--out DIR] [--results]

Reads the solutions that check.py keeps in the cache. Each turn's tracks are mapped to what a
zoomed, cropped, exchanged or turned camera would have seen of them, and explained with the
calibration in use; these readings are kept in the cache, too. A simulated drive is a row of turns
of one lens, drawn at random, with a change after some of them. Its calibration in use is the
solution, moved by an error drawn from the solution's own covariance. The monitor knows the sigmas
of its parameters, as in the node.
"""
from __future__ import annotations

import pickle
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from held_out import solved_drives
from lines import with_more_k1
from measure import commit, complain, keep_table, parser_with, table
from scipy.spatial.transform import Rotation
from solutions import Solved

from dashcalib_ros import Config
from dashcalib_ros.camera import Camera, Radial
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.judge import Change, Reading, watch
from dashcalib_ros.judge.monitor import readings_of
from dashcalib_ros.reconstruct.scene import Scene

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
    return with_more_k1(replace(zoomed(camera, 1.12), cx=camera.cx + 0.01 * camera.image_size[0]),
                        -0.3 * camera.named['k1'])


@dataclass(frozen=True)
class Event:
    """A change: the camera that takes the pictures afterwards, and how it is turned, degrees.

    parts: of the camera that are others then, as the monitor names them.
    """

    camera: Callable[[Camera], Camera] = lambda camera: camera
    parts: tuple[str, ...] = ()
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0

    @property
    def kind(self) -> str:
        """Return the kind of change that the monitor must tell."""
        return 'mount' if self.yaw_deg or self.pitch_deg else 'lens'


PARTS = ('focal length', 'centre', 'distortion')
EVENTS: Mapping[str, Event] = {
    'none': Event(),
    'zoom +1 %': Event(lambda camera: zoomed(camera, 1.01), PARTS[:1]),
    'zoom +2 %': Event(lambda camera: zoomed(camera, 1.02), PARTS[:1]),
    'zoom -2 %': Event(lambda camera: zoomed(camera, 1 / 1.02), PARTS[:1]),
    'zoom +5 %': Event(lambda camera: zoomed(camera, 1.05), PARTS[:1]),
    'crop of 95 % at a corner': Event(lambda camera: zoomed(camera, 1 / 0.95, (0.0, 1.0)),
                                      PARTS[:2]),
    'exchanged': Event(exchanged, PARTS),
    'k1 0.02 higher': Event(lambda camera: with_more_k1(camera, 0.02), PARTS[2:]),
    'turned 1° to a side': Event(yaw_deg=1.0),
    'tilted by 1°': Event(pitch_deg=1.0),
    'turned 3° to a side': Event(yaw_deg=-3.0),
    'tilted by 3°': Event(pitch_deg=-3.0),
}
OF_LENS = [name for name, event in EVENTS.items() if event.parts]


def seen_after(scene: Scene, camera: Camera, event: Event) -> Scene:
    """Return the scene as it would have been reconstructed after the event."""
    new = event.camera(camera)
    turn = Rotation.from_euler('yx', [event.yaw_deg, event.pitch_deg], degrees=True).as_matrix()
    xy = new.project(camera.rays(scene.tracks.xy) @ turn.T)
    width, height = new.image_size
    inside = np.all((xy >= 0) & (xy <= [width - 1, height - 1]), axis=2)
    structure = scene.structure
    return replace(
        scene, camera=new, tracks=replace(
            scene.tracks, xy=np.where(inside[:, :, None], xy, np.nan)),
        structure=replace(structure, rotations=turn @ structure.rotations,
                          translations=structure.translations @ turn.T,
                          used=structure.used & inside))


@dataclass(frozen=True)
class Library:
    """The readings of one lens, by event.

    covariance: (n, n) of its calibration; sigma: as it is stated, of the solution's pictures.
    """

    name: str
    camera: Camera
    covariance: np.ndarray
    sigma: Mapping[str, float]
    readings: Mapping[str, Sequence[Reading]]


def library_of(drive: Solved, cache: Path) -> Library:
    """Return a drive with its readings, which come from the cache or are made."""
    assert drive.solution is not None and drive.calibration.sigma is not None
    camera, name = drive.solution.camera, f'{drive.name}, seed {drive.seed}'
    path = cache / 'readings' / commit() / f'{name}.pickle'.replace('/', ' ')
    readings = pickle.loads(path.read_bytes()) if path.exists() else {}
    missing = [event for event in EVENTS if event not in readings]
    if missing:
        readings |= {event: readings_of([seen_after(scene, camera, EVENTS[event])
                                         for scene in drive.solution.scenes], camera, CONFIG)
                     for event in missing}
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = path.with_suffix('.new')
        fresh.write_bytes(pickle.dumps(readings))
        fresh.replace(path)
    px = drive.calibration.image_size[0] / camera.image_size[0]
    # fx, fy, cx and cy are pixels
    sigma = {key: value / px if key in camera.names()[:4] else value
             for key, value in drive.calibration.sigma.items()}
    return Library(name, camera, drive.solution.covariance, sigma, readings)


@dataclass(frozen=True)
class Row:
    """A row of simulated drives: turns of one event, then of another.

    proven: the calibration in use is known to have fitted before. factor: of the limits.
    """

    after: str
    before: str = 'none'
    proven: bool = True
    factor: float = 1.0


@dataclass(frozen=True)
class Told:
    """What was told of a drive: a change, after how many of its turns; one for nothing."""

    change: Change | None = None
    turns: int = 0
    for_nothing: Change | None = None


def told(library: Library, row: Row, seed: int) -> Told:
    """Simulate a drive until something is told."""
    rng = np.random.default_rng([seed, 17])
    settings = CONFIG.monitor
    settings = replace(settings, limit=row.factor * settings.limit,
                       turn_limit=row.factor * settings.turn_limit,
                       heading_limit=np.sqrt(row.factor) * settings.heading_limit)
    # the calibration in use is off by this much
    off = rng.multivariate_normal(np.zeros(len(library.covariance)), library.covariance)
    monitor = watch((), library.camera, library.sigma if row.proven else None, settings)
    event, changes = EVENTS[row.after], row.after != row.before
    before = int(rng.integers(3, 7)) if changes else UNCHANGED
    for turn in range(before + (AFTER if changes else 0)):
        rows = library.readings[row.before if turn < before else row.after]
        reading = rows[int(rng.integers(len(rows)))]
        monitor = monitor.after(replace(reading, turn=TurnId.at(turn),
                                        cost=reading.cost.moved(off)))
        if turn < before and monitor.changes:
            return Told(for_nothing=monitor.changes[0])
        found = [change for change in monitor.changes if change.kind == event.kind]
        if found:
            return Told(found[0], turn - before + 1)
    return Told()


class Simulation:
    """Simulated drives of all lenses in turn, numbered from seed on."""

    def __init__(self, libraries: Sequence[Library], drives: int, seed: int) -> None:
        self.libraries, self.drives, self.seed = libraries, drives, seed

    def of(self, row: Row, times: int = 1) -> list[Told]:
        """Return what was told of each drive."""
        return [told(self.libraries[n % len(self.libraries)], row, self.seed + n)
                for n in range(times * self.drives)]

    def within(self, row: Row) -> tuple[str, str, str, str]:
        """Return the shares that are told within 2, 3 and AFTER turns, and those for nothing."""
        found = self.of(row)
        counts = [sum(each.change is not None and each.turns <= most for each in found)
                  for most in (2, 3, AFTER)]
        two, three, all_turns = (f'{100 * count / self.drives:.1f} %' for count in counts)
        return two, three, all_turns, _for_nothing(found)


def _for_nothing(found: Sequence[Told]) -> str:
    return f'{sum(each.for_nothing is not None for each in found)} of {len(found)}'


def events_table(simulation: Simulation) -> str:
    """Return a line for each event; ten times as many drives without one."""
    rows = [(name, *simulation.within(Row(name))) for name in EVENTS if name != 'none']
    rows.insert(0, ('none', '', '', '', _for_nothing(simulation.of(Row('none'), 10))))
    return table(('change', 'told within 2 turns', '3', f'{AFTER}', 'for nothing'), rows)


def trade_table(simulation: Simulation) -> str:
    """Return what other limits would tell: the curve of alarms that are true and false."""
    names = ('zoom +1 %', 'zoom +2 %', 'zoom -2 %', 'turned 1° to a side', 'tilted by 1°')
    rows = []
    for factor in FACTORS:
        shares = [simulation.within(Row(name, factor=factor))[1] for name in names]
        rows.append((f'{factor:g}', *shares,
                     _for_nothing(simulation.of(Row('none', factor=factor)))))
    return table(('limits, times ours', *names, 'for nothing'), rows)


def lenses_table(simulation: Simulation) -> str:
    """Return the lenses on which a zoom of 2 % is not always told within three turns."""
    rows = []
    for library in simulation.libraries:
        own = Simulation([library], simulation.drives, simulation.seed)
        shares = [own.within(Row(name))[1] for name in ('zoom +2 %', 'zoom -2 %')]
        if set(shares) != {'100.0 %'}:
            rows.append((library.name, *shares, _for_nothing(own.of(Row('none')))))
    return table(('lens', 'zoom +2 %', 'zoom -2 %', 'for nothing'), rows)


def unproven_table(simulation: Simulation) -> str:
    """Return what is told of a calibration that is not known to have fitted before.

    One that never fits has not changed; one that fits at first has.
    """
    rows = [(name, _for_nothing(simulation.of(Row(name, name, proven=False))),
             simulation.within(Row(name, proven=False))[1]) for name in OF_LENS]
    return table(('the calibration is off by', 'told, though it never fitted',
                  'told, within 3 turns after it fitted'), rows)


def words_table(simulation: Simulation) -> str:
    """Return which parts of the camera a change is told to be of, and the size of a zoom."""
    rows = []
    for name in OF_LENS:
        kinds: Counter[str] = Counter()
        in_range = []
        for each in simulation.of(Row(name)):
            if each.change is not None:
                kinds[_kind_of(each.change, EVENTS[name].parts)] += 1
                in_range += _told_rightly(each.change, EVENTS[name])
        count = sum(kinds.values())
        rows.append((name, *(f'{100 * kinds[kind] / count:.1f} %' for kind in KINDS),
                     f'{100 * np.mean(in_range):.1f} %' if in_range else ''))
    return table(('change', *KINDS, 'true zoom is in the range told'), rows)


def _told_rightly(change: Change, event: Event) -> list[bool]:
    """Return for each text of a focal length alone whether its range holds a zoom's size."""
    true = 100 * (event.camera(Radial((2, 2), 1.0, 1.0, 0.5, 0.5, 0.0, 0.0)).fx - 1)
    if event.parts != PARTS[:1]:
        return []
    return [(side == 'short') == (true > 0) and float(low) <= abs(true) <= float(high)
            for text in change.looks_like
            for low, high, side in RANGE.findall(text)]


RANGE = re.compile(r'^its focal length were (\S+) to (\S+) % too (\w+)$')
KINDS = ('these parts', 'these or others', 'others', 'another camera')


def _kind_of(change: Change, parts: Sequence[str]) -> str:
    named = [{part for part in PARTS if part in text} for text in change.looks_like]
    if not named:
        return 'another camera'
    if set(parts) not in named:
        return 'others'
    return 'these parts' if len(named) == 1 else 'these or others'


def main() -> None:
    """Parse the arguments, print the tables."""
    parser = parser_with(__doc__, 'cache')
    parser.add_argument('--simulated', type=int, default=200, help='drives, for each change')
    parser.add_argument('--seed', type=int, default=0, help='number of the first drive')
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
    simulation = Simulation(libraries, arguments.simulated, arguments.seed)
    text = '\n\n'.join((f'{len(libraries)} lenses, {turns} turns', *(
        made(simulation) for made in (events_table, lenses_table, unproven_table, words_table,
                                      trade_table))))
    keep_table('monitor', text, arguments)


if __name__ == '__main__':
    main()
