"""A fleet, from its manifest to its tables: the whole story on one screen.

Each clip is gathered, each camera solved as soon as its clips are, each make's prior made from its
cameras, and each camera published with it. Whatever is done has a file, and is not done again.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dashcalib_ros.config import Config
from dashcalib_ros.errors import ConfigError, one_line
from dashcalib_ros.fleet import lens_prior, overview, tables
from dashcalib_ros.fleet.engine import Died, Engine, Task
from dashcalib_ros.fleet.fuse import ClipShare
from dashcalib_ros.fleet.manifest import Row, by_camera
from dashcalib_ros.fleet.solved import Final, unit_of
from dashcalib_ros.fleet.storage import Folder
from dashcalib_ros.fleet.tasks import (
    ClipResult,
    Effort,
    gather_clip,
    publish_camera,
    set_aside,
    solve_camera,
)

Told = Callable[['Camera', ClipResult | None, Effort | None], None]


@dataclass
class Camera:
    """A camera on its way; one without a name has the rows that name no clip.

    rows, results: its clips, and what became of them, by row number.
    solved: the file of its own result; shares: of its clips; unit: what it tells of its make.
    failure: why there is no result. final: the published one.
    """

    name: str
    make: str
    rows: Sequence[Row]
    results: dict[int, ClipResult] = field(default_factory=dict)
    solved: str = ''
    shares: Mapping[str, ClipShare] = field(default_factory=dict)
    unit: lens_prior.Unit | None = None
    verdict: str = ''
    failure: str = ''
    final: Final | None = None

    @property
    def complete(self) -> bool:
        """Return whether all its clips were tried."""
        return len(self.results) == len(self.rows)


@dataclass(frozen=True)
class Fleet:
    """What a batch made: its cameras, and the files that tell of all; none of a shard."""

    cameras: Sequence[Camera]
    files: tuple[str, ...] = ()

    @property
    def all_well(self) -> bool:
        """Return whether every clip was read and no camera refused."""
        return all(each.verdict != 'refused' and all(
            result.file for result in each.results.values()) for each in self.cameras)


def batch(rows: Sequence[Row], out: str, config: Config, engine: Engine,
          shard: tuple[int, int] | None = None, tell: Told = lambda *news: None) -> Fleet:
    """Calibrate all cameras of a manifest; return them in the order of their names.

    out: the folder for everything. shard: (i, n) does the i-th of n parts, with all clips of its
    cameras, and makes no tables: a run without a shard does. tell: called for each clip, and for
    each camera that is solved. Raises OutputError where the tables cannot be written.
    """
    cameras = [_camera(name, of_camera) for name, of_camera in by_camera(rows).items()]
    if shard is not None:
        cameras = cameras[shard[0] - 1::shard[1]]
    _gather_and_solve(cameras, out, config, engine, tell)
    if shard is not None:
        return Fleet(cameras)
    found = lens_prior.priors([each.unit for each in cameras if each.unit], config.fleet)
    _publish(cameras, found, out, config, engine)
    return Fleet(cameras, _write_tables(cameras, Folder(out)))


def _camera(name: str, rows: Sequence[Row]) -> Camera:
    makes = {row.make for row in rows if row.make}
    # a camera of two makes has none that can be trusted
    camera = Camera(name, makes.pop() if len(makes) == 1 else '', rows)
    for row in rows:
        if row.problem:
            camera.results[row.number] = ClipResult(row.clip, problem=row.problem, kept=False)
    return camera


def _gather_and_solve(cameras: Sequence[Camera], out: str, config: Config, engine: Engine,
                      tell: Told) -> None:
    by_name = {each.name: each for each in cameras}
    by_row = {row.number: (each, row) for each in cameras for row in each.rows}
    for camera in cameras:
        for result in camera.results.values():
            tell(camera, result, None)
        for row in camera.rows:
            if not row.problem:
                engine.submit(Task(('clip', str(row.number)), gather_clip, (row, out, config)))
        if camera.complete and camera.name:
            engine.submit(_solving(camera, out, config))
    for (kind, key), outcome in engine.outcomes():
        if kind == 'clip':
            camera, row = by_row[int(key)]
            result, effort = _clip_result(row, outcome, out, config)
            camera.results[row.number] = result
            tell(camera, result, effort)
            if camera.complete:
                engine.submit(_solving(camera, out, config), first=True)
        else:
            camera = by_name[key]
            tell(camera, None, _note_solved(camera, outcome))


def _solving(camera: Camera, out: str, config: Config) -> Task:
    clips = tuple((row, camera.results[row.number]) for row in camera.rows)
    return Task(('camera', camera.name), solve_camera,
                (camera.name, camera.make, clips, out, config))


def _clip_result(row: Row, outcome: Any, out: str, config: Config
                 ) -> tuple[ClipResult, Effort | None]:
    if isinstance(outcome, Died):
        return set_aside(row, out, config, outcome.attempts), None
    if isinstance(outcome, Exception):
        return ClipResult(row.clip, problem=one_line(outcome, 300), kept=False), None
    result, effort = outcome
    return result, effort


def _note_solved(camera: Camera, outcome: Any) -> Effort | None:
    """Keep of a solved camera what its make and the tables need."""
    if isinstance(outcome, (Died, Exception)):
        camera.verdict = 'refused'
        camera.failure = (f'killed its worker {outcome.attempts} times: {outcome.reason}'
                          if isinstance(outcome, Died) else one_line(outcome, 300))
        return None
    name, solved, effort = outcome
    camera.solved, camera.shares, camera.unit = name, solved.shares, unit_of(solved)
    camera.verdict = solved.calibration.verdict.level
    return effort if isinstance(effort, Effort) else None


def _publish(cameras: Sequence[Camera], found: Mapping[str, lens_prior.Verdict], out: str,
             config: Config, engine: Engine) -> None:
    by_name = {each.name: each for each in cameras}
    for camera in cameras:
        if camera.solved:
            engine.submit(Task(('publish', camera.name), publish_camera, (
                camera.solved, found.get(camera.name), out, config)))
    for (_, name), outcome in engine.outcomes():
        if isinstance(outcome, Final):
            by_name[name].final = outcome
            by_name[name].verdict = outcome.calibration.verdict.level
        else:
            _note_solved(by_name[name], outcome)


def _write_tables(cameras: Sequence[Camera], folder: Folder) -> tuple[str, ...]:
    camera_rows, clip_rows = [], []
    for camera in cameras:
        shares = _shares(camera)
        own = [tables.clip_row(row, camera.name, camera.make, camera.results[row.number],
                               shares.get(row.number)) for row in camera.rows]
        clip_rows += own
        if camera.name:
            camera_rows.append(tables.camera_row(camera.name, camera.make, camera.final,
                                                 camera.failure, own))
    clip_rows.sort(key=lambda row: int(row['row']))
    files = [*tables.write_table(folder, tables.CAMERAS, camera_rows, tables.CAMERA_COLUMNS),
             *tables.write_table(folder, tables.CLIPS, clip_rows, tables.CLIP_COLUMNS)]
    folder.write(overview.NAME, overview.overview_html(camera_rows, clip_rows).encode(
        'utf-8', 'replace'))
    return (*files, overview.NAME)


def _shares(camera: Camera) -> dict[int, ClipShare]:
    """Return what each row's clip gave; a clip that is named twice counts once."""
    first: dict[str, int] = {}
    found = {}
    for row in camera.rows:
        before = first.setdefault(row.name, row.number)
        if before != row.number:
            found[row.number] = ClipShare(left_out=f'is the clip of row {before} again')
        elif row.name in camera.shares:
            found[row.number] = camera.shares[row.name]
    return found


def shard_of(text: str) -> tuple[int, int]:
    """Return i and n of 'i/n'; raises ConfigError."""
    i, _, n = text.partition('/')
    if not (i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
        raise ConfigError(f'--shard must be like 1/8, the first of eight parts, not {text[:40]!r}')
    return int(i), int(n)


def problems(fleet: Fleet) -> Iterator[tuple[Row, str]]:
    """Yield the clips that could not be read, and why."""
    for camera in fleet.cameras:
        for row in camera.rows:
            if not camera.results[row.number].file:
                yield row, camera.results[row.number].problem
