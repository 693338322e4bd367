"""What workers do: read a clip, solve a camera, publish its result. Done is what has a file.

Each task is a function of its arguments and of files; it may run anywhere, and twice.
"""
from __future__ import annotations

import hashlib
import json
import os
import re
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import TypeVar

from dashcalib_ros.config import Config
from dashcalib_ros.detect.detection import detect
from dashcalib_ros.errors import DashcalibError, InputError, one_line
from dashcalib_ros.fleet import solved
from dashcalib_ros.fleet.fuse import Clip, fuse
from dashcalib_ros.fleet.lens_prior import Verdict
from dashcalib_ros.fleet.manifest import Row
from dashcalib_ros.fleet.solved import Final, final_of
from dashcalib_ros.fleet.storage import Folder, clip_files, is_url, local_copy, stamp
from dashcalib_ros.input import Frame, FrameSource
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.limits import read_file
from dashcalib_ros.reconstruct import reconstruct
from dashcalib_ros.reconstruct.scene_file import (
    FORMAT,
    LARGEST,
    SUFFIX,
    Origin,
    SceneFile,
    StoredTurn,
    decoded,
    encoded,
)
from dashcalib_ros.report import write_results
from dashcalib_ros.report.files import ACCEPTED, NAMES, WEAK

T = TypeVar('T')
# names of gathered turns: nothing from inside a file becomes a path
GATHERED = re.compile(rf'gathered/[0-9a-f]{{2}}/[0-9a-f]+(-[0-9a-f]+)?\{SUFFIX}')
# the end of a camera's folder whose name is not the camera's
HASHED = re.compile(r'-[0-9a-f]{32}$')


@dataclass(frozen=True)
class ClipResult:
    """What became of a clip. file: its gathered turns, '' if there are none; problem: why.

    kept: a result that need not be tried again. stamp: as storage.stamp() before it was read.
    time_s: of its first turn, s; only a date if the clip has dates.
    """

    clip: str
    file: str = ''
    problem: str = ''
    stamp: str = ''
    kept: bool = True
    content: str = ''
    image_size: tuple[int, int] | None = None
    frames: int = 0
    seconds: float = 0.0
    turns: int = 0
    scenes: int = 0
    time_s: float | None = None
    warnings: tuple[str, ...] = ()


def gather_clip(row: Row, out: str, config: Config) -> tuple[ClipResult, Effort]:
    """Read a clip, unless that was done; never raises what a clip can cause."""
    folder, started = Folder(out), Clock()
    name = clip_file(row, config)
    now: str | None = None
    try:
        # before it is read: what changes later is read again
        now = stamp(row.place)
        before = _earlier(folder, name, row, now)
        if before is not None:
            return before, started.effort(again=True)
        result = _gathered(row, folder, config, now)
    except DashcalibError as error:
        # what is not the clip's own fault is tried again the next time
        result = ClipResult(row.clip, problem=one_line(error, 300), stamp=now or '',
                            kept=isinstance(error, InputError) and now is not None)
    except OSError as error:
        result = ClipResult(row.clip, problem=f'cannot be read here: {one_line(error)}',
                            kept=False)
    return _noted(folder, name, result), started.effort()


def set_aside(row: Row, out: str, config: Config, attempts: int) -> ClipResult:
    """Note that a clip is not tried again, as it killed its worker so many times."""
    result = ClipResult(row.clip, problem=f'killed its worker {attempts} times: it is set aside; '
                                          f'is it damaged, or is there too little memory?',
                        stamp=stamp(row.place) or '')
    return _noted(Folder(out), clip_file(row, config), result)


def clip_file(row: Row, config: Config) -> str:
    """Return the name of the file that tells what became of a clip."""
    key = _hash([row.place, settings_hash(config, row.fps, row.topic)])
    return f'clips/{key[:2]}/{key}.json'


def _earlier(folder: Folder, name: str, row: Row, now: str | None) -> ClipResult | None:
    """Return what became of the clip before, if that still holds.

    A clip that changed since is read again. One that is gone is not needed any more.
    """
    data = folder.read(name)
    if data is None:
        return None
    try:
        values = json.loads(data)
        size = values['image_size']
        result = ClipResult(**{**values, 'warnings': tuple(values['warnings']),
                               'image_size': None if size is None else tuple(size)})
    except (ValueError, KeyError, TypeError):
        return None
    if now is None and not result.file:
        return None
    if now not in (None, result.stamp) or (result.file and not (
            GATHERED.fullmatch(result.file) and folder.exists(result.file))):
        return None
    return replace(result, clip=row.clip)


def _gathered(row: Row, folder: Folder, config: Config, now: str | None) -> ClipResult:
    if now is None:
        return ClipResult(row.clip, problem='there is no such file; check the path', kept=False)
    with local_copy(row.place) as path:
        try:
            if path.suffix == SUFFIX:
                return _given(row, path, folder, now)
            content = content_hash(path)
            name = gathered_file(content, settings_hash(config, row.fps, row.topic))
            found = _kept(folder, name)
            if found is None:
                found = gather(path, content, row.fps, row.topic, config)
                folder.write(name, encoded(found))
        except InputError as error:
            # the tables must not depend on where the clip, or its copy, lies
            raise InputError(str(error).replace(str(path), row.clip)) from error
    return _result(row, name, found, content, now)


def _kept(folder: Folder, name: str) -> SceneFile | None:
    """Return turns that were gathered before; None where there are none, or they are damaged."""
    data = folder.read(name)
    try:
        return None if data is None else decoded(data)
    except ValueError:
        return None


def _given(row: Row, path: Path, folder: Folder, now: str) -> ClipResult:
    """Take turns that were gathered elsewhere, with whatever settings.

    Their identity is that of the file itself: what it says it was made from may be false.
    """
    data = read_file(path, LARGEST)
    try:
        found = decoded(data)
    except ValueError as error:
        raise InputError(f'{path.name} is no file of gathered turns ({one_line(error)}); gather '
                         f'its clip anew') from error
    content = hashlib.sha256(data).hexdigest()[:32]
    name = gathered_file(content)
    folder.write(name, data)
    return _result(row, name, found, content, now)


def gathered_file(*hashes: str) -> str:
    """Return the name of a clip's file of gathered turns; raises ValueError for other texts."""
    name = f'gathered/{hashes[0][:2]}/{"-".join(hashes)}{SUFFIX}'
    if not GATHERED.fullmatch(name):
        raise ValueError(f'{name!r} is not made of hashes')
    return name


def _result(row: Row, name: str, found: SceneFile, content: str, now: str) -> ClipResult:
    time_s = found.turns[0].stamp_s if found.turns else None
    return ClipResult(row.clip, name, '', now, True, content, found.origin.image_size,
                      found.frames, found.seconds, found.found, len(found.turns), time_s,
                      found.warnings)


def _noted(folder: Folder, name: str, result: ClipResult) -> ClipResult:
    if result.kept:
        try:
            folder.write(name, json.dumps(asdict(result), sort_keys=True).encode())
        except DashcalibError as error:
            return replace(result, problem=one_line(error, 300), file='', kept=False)
    return result


def solve_camera(camera: str, make: str, clips: Sequence[tuple[Row, ClipResult]], out: str,
                 config: Config) -> tuple[str, solved.Solved, Effort]:
    """Solve a camera from its gathered clips, unless that was done; return the result's file."""
    folder, started = Folder(out), Clock()
    # a clip that the manifest names twice counts once
    used = {row.name: (result.file, f'{result.content}{row.topic or ""}')
            for row, result in reversed(clips) if result.file}
    usable = [(clip, *used[clip]) for clip in sorted(used)]
    name = solved_file(camera, make, usable, config)
    data = folder.read(name)
    if data is not None:
        return name, solved.decoded(data, name), started.effort(again=True)
    loaded = []
    for clip, file, content in usable:
        found = _kept(folder, file)
        if found is None:
            raise InputError(f'{file} has gone or changed while the fleet was solved; remove it '
                             f'and start again')
        loaded.append(Clip(clip, replace(found, content=content)))
    text = solved.encoded(solved.solved_of(camera, make, fuse(loaded, config)))
    result = solved.decoded(text, name)
    publish(folder, result, None, config)
    folder.write(name, text)
    return name, result, started.effort()


def solved_file(camera: str, make: str, usable: Sequence[tuple[str, str, str]], config: Config
                ) -> str:
    """Return the name of a camera's own result.

    Other clips, other settings and another version of this package have another one.
    """
    settings = {key: value for key, value in config.flat().items() if key != 'threads'}
    try:
        version = metadata.version('dashcalib_ros')
    except metadata.PackageNotFoundError:
        version = ''
    key = _hash([solved.FORMAT, version, camera, make, list(usable), settings])
    return f'solved/{key[:2]}/{key}.json'


def publish_camera(name: str, prior: Verdict | None, out: str, config: Config) -> Final:
    """Write a camera's files with the prior of its make; return the final result."""
    folder = Folder(out)
    data = folder.read(name)
    if data is None:
        raise InputError(f'{name} has gone while the fleet was solved; start again')
    return publish(folder, solved.decoded(data, name), prior, config)


def publish(folder: Folder, result: solved.Solved, prior: Verdict | None, config: Config) -> Final:
    """Write calibration.yaml, result.json and report.html of a camera."""
    final = final_of(result, prior)
    place = camera_folder(result.camera)
    yaml_name = re.sub(r'[^A-Za-z0-9_]+', '_', result.camera).strip('_') or 'camera'
    yaml_name = 'camera_narrow_stereo' if yaml_name == 'narrow_stereo' else yaml_name
    if not is_url(folder.place):
        write_results(final.calibration, Path(folder.place) / place, yaml_name)
        return final
    with tempfile.TemporaryDirectory(prefix='dashcalib-') as scratch:
        written = write_results(final.calibration, scratch, yaml_name).files
        for path in written:
            folder.write(f'{place}/{path.name}', path.read_bytes())
    for name in {ACCEPTED, WEAK} & set(NAMES) - {path.name for path in written}:
        folder.remove(f'{place}/{name}')
    return final


def camera_folder(camera: str) -> str:
    """Return the folder of a camera's files; different names never share one."""
    plain = re.sub(r'[^A-Za-z0-9._-]+', '_', camera).strip('._')[:80]
    if plain == camera and not HASHED.search(camera):
        return f'cameras/{camera}'
    return f'cameras/{plain}-{_hash([camera])}'


def _hash(values: object) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:32]


def one_thread(function: Callable[..., T], *arguments: object) -> T:
    """Run a task in this process, which must have one thread for numpy; raises WorkerError."""
    import cv2

    from dashcalib_ros.workers.worker import InlineWorker
    cv2.setNumThreads(1)
    result: T = InlineWorker().call(function, *arguments)
    return result


@dataclass(frozen=True)
class Effort:
    """What a task took: s of processor and wall time, MB of memory of its process at the most.

    again: the result was there already.
    """

    cpu_s: float
    wall_s: float
    peak_mb: float
    again: bool = False


class Clock:
    """Measures what a task takes."""

    def __init__(self) -> None:
        self._cpu, self._wall = time.process_time(), time.monotonic()

    def effort(self, again: bool = False) -> Effort:
        """Return what was taken since this clock was made."""
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        return Effort(time.process_time() - self._cpu, time.monotonic() - self._wall, peak, again)


# settings by which a clip's scenes do not change
LATER = ('intrinsics.', 'verdict.', 'fleet.')
LATER_NAMES = ('threads', 'rectified', 'turns.store')
# bytes of a file that are hashed at a time
BLOCK = 2**20


@lru_cache(maxsize=64)
def settings_hash(config: Config, fps: float | None, topic: str | None) -> str:
    """Return a hash of all that a clip's scenes depend on beside its content."""
    used = {name: value for name, value in config.flat().items()
            if not name.startswith(LATER) and name not in LATER_NAMES}
    text = json.dumps([FORMAT, used, fps, topic], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def content_hash(path: Path) -> str:
    """Return a hash of a file's bytes, or of all files that a folder's clip may be made of.

    Raises InputError.
    """
    found = hashlib.sha256()
    try:
        for file, about in clip_files(path):
            found.update(os.fsencode(file.relative_to(path)) + b'\0' if file != path else b'')
            found.update(about.st_size.to_bytes(8, 'big') if file != path else b'')
            left = about.st_size  # files of /proc say 0, and reading some would wait for ever
            with file.open('rb') as stream:
                while left > 0 and (block := stream.read(min(BLOCK, left))):
                    found.update(block)
                    left -= len(block)
    except OSError as error:
        raise InputError(f'cannot read {path} ({error.strerror or error})') from error
    return found.hexdigest()[:32]


def gather(path: Path, content: str, fps: float | None, topic: str | None, config: Config
           ) -> SceneFile:
    """Return a clip's turns and their scenes.

    content: the clip's content_hash(). Raises InputError for what cannot be read, or changes
    meanwhile.
    """
    source = open_frames(path, topic, fps)
    span = _Span(source)
    detection = detect(span, config)
    best = detection.turns()[:max(config.turns.wanted, config.turns.at_most)]
    valid = detection.valid()
    turns = []
    for turn in sorted(best, key=lambda turn: turn.center):
        scene = reconstruct(turn, config, valid)
        detection.release(turn.center)
        if scene is not None:
            turns.append(StoredTurn(scene, turn.stamp_s, turn.prominence))
    if content_hash(path) != content:
        raise InputError(f'{path} changed while it was read: start again when it is complete')
    assert detection.size is not None
    # the same content gives the same, wherever it lies
    warnings = tuple(line.replace(str(path), 'the clip')
                     for line in (*source.warnings, *detection.warnings()))
    return SceneFile(Origin(detection.size, detection.scale), tuple(turns), len(best), content,
                     settings_hash(config, fps, topic), detection.frames, span.seconds, warnings)


class _Span:
    """Passes frames on and notes how long they last. seconds: from the first to the last."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self.seconds = 0.0

    def __iter__(self) -> Iterator[Frame]:
        first_ns: int | None = None
        for frame in self._source:
            first_ns = frame.stamp_ns if first_ns is None else first_ns
            self.seconds = (frame.stamp_ns - first_ns) / 1e9
            yield frame
