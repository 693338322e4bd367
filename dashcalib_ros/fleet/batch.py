# SPDX-License-Identifier: Apache-2.0
"""A fleet, from its manifest to its tables: the whole story.

Each clip is gathered, each camera solved as soon as its clips are, the prior of each model of
camera made from its units, and each camera published with it. Whatever is done has a file, and is
not done again.
"""
from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

from dashcalib_ros.config import Config
from dashcalib_ros.errors import ConfigError, InputError, Notice, coded
from dashcalib_ros.fleet import lens_prior, overview, solved, storage, tables
from dashcalib_ros.fleet.clips import (
    GONE,
    ClipResult,
    gather_clip,
    gathered,
    hash_of,
    looked_at,
    set_aside,
)
from dashcalib_ros.fleet.engine import DiedError, Engine, Task
from dashcalib_ros.fleet.fuse import fuse
from dashcalib_ros.fleet.manifest import Row
from dashcalib_ros.fleet.rigs import Member, place_rig
from dashcalib_ros.judge.calibration import Level
from dashcalib_ros.judge.conclude import versions
from dashcalib_ros.report import Written, write_results
from dashcalib_ros.report.files import REPORT
from dashcalib_ros.whole_files import temporary_folder


@dataclass(frozen=True)
class CameraResult:
    """What the fleet needs of a camera's own result. file: has the result.

    shares: by clip. unit: what the camera adds to the prior of its model. again: this was known
    before.
    """

    file: str
    verdict: str
    shares: Mapping[str, solved.ClipShare]
    unit: lens_prior.Unit | None
    again: bool


@dataclass
class Camera:
    """A camera on its way; one without a name has the rows that name no clip.

    results: what became of its clips, by the number of their row. own: its own result, None where
    there is none. clips: its rows of the table of clips, once it is solved. row: its own row.
    """

    name: str
    camera_model: str
    rows: Sequence[Row]
    results: dict[int, ClipResult] = field(default_factory=dict)
    own: CameraResult | None = None
    verdict: str = 'refused'
    clips: Sequence[Mapping[str, Any]] = ()
    row: Mapping[str, Any] = field(default_factory=dict)

    @property
    def known(self) -> dict[str, str]:
        """Return the settings known.* that its rows have; what two of them contradict is not."""
        found = {pair for row in self.rows for pair in row.known}
        names = Counter(name for name, _ in found)
        return {name: value for name, value in found if names[name] == 1}

    @property
    def rig(self) -> str:
        """Return the rig that its rows name; '' where they name none, or several."""
        found = {row.rig for row in self.rows}
        return found.pop() if len(found) == 1 else ''

    @property
    def gathered(self) -> list[tuple[Row, ClipResult]]:
        """Return its clips with what became of them."""
        return [(row, self.results[row.number]) for row in self.rows]


# called for each clip, and, without one, for each camera that is solved
OnProgress = Callable[[Camera, ClipResult | None], None]


def cameras_of(rows: Sequence[Row], shard: tuple[int, int] = (1, 1)) -> list[Camera]:
    """Return the cameras of a manifest, by name. shard: (i, n), the i-th of n parts.

    A clip whose camera is unknown is one of its own, and its name is the clip's. Rows that name
    neither are under ''.
    """
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row.camera or row.name, []).append(row)
    cameras = []
    for name in sorted(found)[shard[0] - 1::shard[1]]:
        models = {row.camera_model for row in found[name] if row.camera_model}
        # a camera of two models has none that can be trusted
        cameras.append(Camera(name, models.pop() if len(models) == 1 else '', found[name]))
    return cameras


def batch(cameras: Sequence[Camera], out: str, config: Config, engine: Engine,
          whole: bool = True, tell: OnProgress = lambda camera, clip: None
          ) -> tuple[tuple[str, ...], Mapping[str, Mapping[str, Level] | str]]:
    """Calibrate cameras; return the files about all of them, and the rigs.

    out: the folder for everything. whole: they are all of the manifest; of a part there is no
    prior, no table and no rig. Of a rig there is the verdict of each camera, or why there is none.
    Raises OutputError where the tables cannot be written.
    """
    _gather_and_solve(cameras, out, config, engine, tell)
    if not whole:
        return (), {}
    units = [each.own.unit for each in cameras if each.own and each.own.unit]
    _publish(cameras, lens_prior.priors(units, config.fleet), out, engine)
    rigs = _place(cameras, out, config, engine)
    return _write_tables(cameras, out), rigs


def _gather_and_solve(cameras: Sequence[Camera], out: str, config: Config, engine: Engine,
                      tell: OnProgress) -> None:
    known: list[tuple[tuple[Camera, Row], ClipResult]] = []
    for camera in cameras:
        for row in camera.rows:
            found = looked_at(row, out, config) if engine.here or row.problem else None
            if found is None:
                engine.submit(Task(gather_clip, (row, out, config), (camera, row)))
            else:
                known.append(((camera, row), found))
    for (camera, row), outcome in chain(known, engine.outcomes()):
        if row is None:
            if isinstance(outcome, Exception):
                _failed(camera, outcome)
            else:
                camera.own, camera.verdict = outcome, outcome.verdict
                camera.clips = tables.clip_rows(camera.name, camera.camera_model, camera.gathered,
                                                outcome.shares)
            tell(camera, None)
            continue
        if isinstance(outcome, DiedError):
            outcome = set_aside(row, out, config)
        elif isinstance(outcome, Exception):
            outcome = ClipResult.without(outcome)
        camera.results[row.number] = outcome
        tell(camera, outcome)
        if len(camera.results) == len(camera.rows):
            camera.clips = tables.clip_rows(camera.name, camera.camera_model, camera.gathered, {})
            # where it has files of earlier, they must not stay as they are
            if (all(result.code == GONE.code for _, result in camera.gathered)
                    and not storage.stamp(storage.joined(out, tables.camera_folder(camera.name)))):
                _failed(camera, InputError('E-CLIPS-MISSING',
                                           'none of its clips exists; check the paths'))
                tell(camera, None)
            elif camera.name:
                engine.submit(Task(solve_camera, (
                    camera.name, camera.camera_model, camera.gathered, out,
                    config.replace(camera.known)), (camera, None)), first=True)


def _failed(camera: Camera, error: Exception) -> None:
    camera.own, camera.verdict = None, 'refused'
    camera.row = tables.failed_row(camera.name, camera.camera_model, camera.clips, error)


def _publish(cameras: Sequence[Camera], found: Mapping[str, lens_prior.ModelPrior], out: str,
             engine: Engine) -> None:
    for camera in cameras:
        if camera.own is not None:
            engine.submit(Task(publish_camera, (camera.own.file, found.get(camera.name),
                                                camera.clips, out), camera))
    for camera, outcome in engine.outcomes():
        if isinstance(outcome, Exception):
            _failed(camera, outcome)
        else:
            camera.row, camera.verdict = outcome, outcome['verdict']


def _place(cameras: Sequence[Camera], out: str, config: Config, engine: Engine
           ) -> dict[str, Mapping[str, Level] | str]:
    members: dict[str, list[Member]] = {}
    # in the order of the manifest: the first one is the base
    for camera in sorted(cameras, key=lambda each: each.rows[0].number):
        if camera.own is not None and camera.rig:
            members.setdefault(camera.rig, []).append(
                Member(camera.name, camera.own.file, camera.gathered))
    found: dict[str, Mapping[str, Level] | str] = {}
    for name, those in members.items():
        if len(those) > 1:
            engine.submit(Task(place_rig, (name, those, out, config), name))
        else:
            found[name] = coded(Notice(
                'E-RIG-ONE-CAMERA', f'only {those[0].camera} is there: name the rig in the rows '
                f'of two cameras or more'))
    for name, outcome in engine.outcomes():
        found[name] = coded(outcome) if isinstance(outcome, Exception) else outcome
    return dict(sorted(found.items()))


def _write_tables(cameras: Sequence[Camera], out: str) -> tuple[str, ...]:
    camera_rows = [camera.row for camera in cameras if camera.name]
    clip_rows = sorted((row for camera in cameras for row in camera.clips),
                       key=lambda row: int(row['row']))
    files = [*tables.write_table(out, 'cameras', camera_rows, tables.CAMERA_COLUMNS),
             *tables.write_table(out, 'clips', clip_rows, tables.CLIP_COLUMNS)]
    page = overview.overview_html(camera_rows, clip_rows)
    storage.write(storage.joined(out, overview.NAME), page.encode('utf-8', 'replace'))
    return (*files, overview.NAME)


def shard_of(text: str) -> tuple[int, int]:
    """Return i and n of 'i/n'; raises ConfigError."""
    i, _, n = text.partition('/')
    if not (i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
        raise ConfigError('E-SHARD-INVALID', f'--shard must be like 1/8, the first of eight '
                                             f'parts, not {text[:40]!r}')
    return int(i), int(n)


def problems(cameras: Sequence[Camera]) -> Iterator[tuple[Row, str]]:
    """Yield the clips that could not be read, and why."""
    for camera in cameras:
        for row, result in camera.gathered:
            if not result.file:
                yield row, result.problem


def solve_camera(camera: str, camera_model: str, clips: Sequence[tuple[Row, ClipResult]], out: str,
                 config: Config) -> CameraResult:
    """Solve a camera from its gathered clips, unless that was done."""
    # a clip that the manifest names twice counts once
    used = {row.name: (result.file, f'{result.content}{row.topic or ""}')
            for row, result in reversed(clips) if result.file}
    name = solved_file(
        camera, camera_model, [(clip, *used[clip]) for clip in sorted(used)], config)
    data = storage.read(storage.joined(out, name))
    again = data is not None
    if data is None:
        loaded = {}
        for clip, (file, content) in used.items():
            found = gathered(out, file)
            if found is None:
                raise InputError('E-FLEET-FILE-CHANGED',
                                 f'{file} was removed or changed while the fleet was solved; '
                                 f'remove it and start the command again')
            # what was read has this content, whatever it says
            loaded[clip] = replace(found, content=content)
        data = solved.encoded(fuse(camera, camera_model, loaded, config))
        storage.write(storage.joined(out, name), data)
    result = solved.decoded(data, name)
    return CameraResult(name, result.calibration.verdict.level, result.shares,
                        solved.unit_of(result), again)


def solved_file(camera: str, camera_model: str, clips: Sequence[tuple[str, str, str]],
                config: Config) -> str:
    """Return the name of a camera's own result. clips: name, file and content of each.

    Other clips, other settings and another version of this package have another one.
    """
    settings = {key: value for key, value in config.flat().items() if key != 'workers'}
    version = versions(config.reconstruct)['dashcalib_ros']
    key = hash_of([solved.FORMAT, version, camera, camera_model, clips, settings])
    return f'solved/{key[:2]}/{key}.json'


def publish_camera(name: str, found: lens_prior.ModelPrior | None,
                   clips: Sequence[Mapping[str, Any]], out: str) -> dict[str, Any]:
    """Write calibration.yaml, result.json and report.html of a camera; return its row.

    name: the file of its own result. found: the prior of its model. clips: the rows of its clips.
    """
    data = storage.read(storage.joined(out, name))
    if data is None:
        raise InputError('E-FLEET-FILE-CHANGED', f'{name} was removed while the fleet was solved; '
                                                 f'start the command again')
    result = solved.decoded(data, name)
    final = solved.final_of(result, found)
    yaml_name = re.sub(r'[^A-Za-z0-9_]+', '_', result.camera).strip('_') or 'camera'
    yaml_name = 'camera_narrow_stereo' if yaml_name == 'narrow_stereo' else yaml_name
    place = storage.joined(out, tables.camera_folder(result.camera))
    if storage.is_url(place):
        with temporary_folder() as scratch:
            lost = _exchanged(place, scratch, lambda: write_results(
                final.calibration, scratch, yaml_name, place=storage.masked(place))).lost
    else:
        lost = write_results(final.calibration, place, yaml_name).lost
    row = tables.camera_row(result, final, clips)
    return {**row, 'warnings': [*row['warnings'], *lost]}


def _exchanged(place: str, scratch: Path, change: Callable[[], Written]) -> Written:
    """Change the calibrations of a store's folder in a folder of this machine."""
    there = storage.listed(place) if storage.is_folder(place) else []
    for name in (each.rpartition('/')[2] for each in there):
        if name.startswith(('calibration.', REPORT)):
            (scratch / name).write_bytes(storage.read(storage.joined(place, name)) or b'')
    before = {path.name for path in scratch.iterdir()}
    written = change()
    for path in sorted(scratch.iterdir(), key=lambda path: path.name == REPORT):
        storage.write(storage.joined(place, path.name), path.read_bytes())
    for name in sorted(before - {path.name for path in scratch.iterdir()}):
        storage.remove(storage.joined(place, name))
    return written
