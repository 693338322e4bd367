# SPDX-License-Identifier: Apache-2.0
"""A clip -> the scenes of its turns, and what became of it. Done is what has a file.

Each task is a function of its arguments and of files; it may run anywhere, and twice.
"""
from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from dashcalib_ros.config import Config
from dashcalib_ros.detect.detection import detect
from dashcalib_ros.detect.one_camera import APART
from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.errors import (
    DashcalibError,
    InputError,
    Notice,
    OutputError,
    WorkerError,
    code_of,
    coded,
    one_line,
)
from dashcalib_ros.fleet import storage
from dashcalib_ros.fleet.manifest import Row
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.limits import read_file
from dashcalib_ros.reconstruct import reconstruct
from dashcalib_ros.solve.evidence import SHARP_DEG
from dashcalib_ros.store import scene_file
from dashcalib_ros.store.scene_file import Origin, SceneFile, StoredTurn
from dashcalib_ros.whole_files import FULL
from dashcalib_ros.workers.memory import in_a_file

# settings by which a clip's scenes do not change
LATER = ('intrinsics.', 'verdict.', 'fleet.', 'known.')
LATER_NAMES = ('workers', 'rectified', 'turns.store')
GONE = InputError('E-CLIP-MISSING', 'there is no such file; check the path')
# what is gathered of a clip; 2: its upright lines, too; 3: other stretches than turns
GATHERED = 3
# characters of an error in a table, without its code
LONGEST = 300
# bytes of a file that are hashed at a time
BLOCK = 2**20


@dataclass(frozen=True)
class ClipResult:
    """What became of a clip, with columns of the table of clips.

    problem: why there are no gathered turns, '' if there are: in file. code: of that. stamp: as
    storage.stamp() before the clip was read; '' for what is tried again the next time. time: of
    the first turn, s; only a date if the clip has dates. again: this was known before.
    """

    problem: str = ''
    code: str = ''
    stamp: str = ''
    file: str | None = None
    content: str | None = None
    width: int | None = None
    height: int | None = None
    frames: int = 0
    seconds: float = 0.0
    turns: int = 0
    scenes: int = 0
    time: float | None = None
    warnings: tuple[str, ...] = ()
    again: bool = False

    @classmethod
    def without(cls, why: Exception | Notice, stamp: str = '') -> ClipResult:
        """Return the result of a clip that gives no turns."""
        return cls(coded(why, LONGEST), code_of(why), stamp)


def looked_at(row: Row, out: str, config: Config) -> ClipResult | None:
    """Return what became of a clip that no worker need read; None where one must.

    A file of this machine that has gone, or never was, costs two looks and no task.
    """
    if row.problem:
        return replace(ClipResult.without(Notice('E-MANIFEST-ROW', row.problem)), again=True)
    if (storage.is_url(row.place) or os.path.lexists(row.place)
            or storage.read(clip_file(row, out, config))):
        return None
    return ClipResult.without(GONE)


def gather_clip(row: Row, out: str, config: Config) -> ClipResult:
    """Read a clip, unless that was done; never raises what a clip can cause.

    Raises OutputError where there is no room, for the output or for the copy of a clip.
    """
    name, now = clip_file(row, out, config), ''
    try:
        # before it is read: what changes later is read again
        now = storage.stamp(row.place) or ''
        return _earlier(name, out, now) or _noted(name, _gathered(row, out, config, now))
    except InputError as error:
        return _noted(name, ClipResult.without(error, now))
    except OutputError:
        raise
    except DashcalibError as error:  # not the clip's own fault
        return ClipResult.without(error)
    except OSError as error:
        if error.errno in FULL:
            raise OutputError('E-SCRATCH-FULL',
                              f'no space is left for the copy of a clip ({one_line(error)}); free '
                              f'some, or set TMPDIR to another disk, and start the command again: '
                              f'it continues where it stopped') from error
        return ClipResult.without(
            Notice('E-FILE-ACCESS', f'this machine cannot read it: {one_line(error)}'))


def set_aside(row: Row, out: str, config: Config) -> ClipResult:
    """Note that a clip is not tried again, as its worker died each time."""
    error = WorkerError('E-CLIP-SET-ASIDE',
                        f'its worker process died {config.fleet.attempts} times, and it is set '
                        f'aside; check that the clip is sound and that there is enough memory')
    return _noted(clip_file(row, out, config),
                  ClipResult.without(error, storage.stamp(row.place) or ''))


def clip_file(row: Row, out: str, config: Config) -> str:
    """Return the place of the file about what became of a clip."""
    key = hash_of([storage.masked(row.place), settings_hash(config, row.fps, row.topic)])
    return storage.joined(out, f'clips/{key[:2]}/{key}.json')


def hash_of(values: object) -> str:
    """Return a hash of values that JSON has, 32 digits."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:32]


def _earlier(name: str, out: str, now: str) -> ClipResult | None:
    """Return what became of the clip before, if that still holds.

    A clip that changed since is read again. One that is gone is not needed any more.
    """
    try:
        values = json.loads(storage.read(name) or b'')
        result = ClipResult(**{**values, 'code': values['code'], 'again': True,
                               'warnings': tuple(values['warnings'])})
    except (ValueError, KeyError, TypeError):
        return None
    holds = now == result.stamp or (result.file and not now)
    there = not result.file or storage.stamp(storage.joined(out, result.file))
    return result if holds and there else None


def _noted(name: str, result: ClipResult) -> ClipResult:
    if result.stamp:
        storage.write(name, json.dumps(asdict(result), sort_keys=True).encode())
    return result


def _gathered(row: Row, out: str, config: Config, now: str) -> ClipResult:
    if not now:
        return ClipResult.without(GONE)
    with storage.local_copy(row.place) as path:
        try:
            content = content_hash(path)
            # turns that were gathered elsewhere have whatever settings
            given = path.suffix == scene_file.SUFFIX
            of = content if given else f'{content}-{settings_hash(config, row.fps, row.topic)}'
            name = f'gathered/{of[:2]}/{of}{scene_file.SUFFIX}'
            found = gathered(out, name)
            if found is None:
                found = _given(path) if given else gather(path, content, row.fps, row.topic,
                                                          config)
                if content_hash(path) != content:
                    raise InputError('E-CLIP-CHANGED',
                                     f'{path} changed while it was read: start the command again '
                                     f'when the clip is complete')
                storage.write(storage.joined(out, name), scene_file.encoded(found))
        except InputError as error:
            # the tables must not depend on where the clip, or its copy, lies
            raise InputError(error.code, str(error).replace(str(path), row.clip)) from error
    width, height = found.origin.image_size
    return ClipResult('', '', now, name, content, width, height, found.frames, found.seconds,
                      found.found, len(found.turns),
                      found.turns[0].stamp_s if found.turns else None, found.warnings)


def gathered(out: str, name: str) -> SceneFile | None:
    """Return turns that were gathered before; None where there are none, or they are damaged."""
    data = storage.read(storage.joined(out, name))
    try:
        return None if data is None else scene_file.decoded(data)
    except ValueError:
        return None


def _given(path: Path) -> SceneFile:
    try:
        return scene_file.decoded(read_file(path, scene_file.LARGEST))
    except ValueError as error:
        raise InputError('E-GATHERED-DAMAGED',
                         f'{path.name} is not a file of gathered turns ({one_line(error)}); '
                         f'gather its clip again') from error


def settings_hash(config: Config, fps: float | None, topic: str | None) -> str:
    """Return a hash of all that a clip's scenes depend on beside its content."""
    used = {name: value for name, value in config.flat().items()
            if not name.startswith(LATER) and name not in LATER_NAMES}
    return hash_of([scene_file.FORMAT, GATHERED, used, fps, topic])[:16]


def content_hash(path: Path) -> str:
    """Return a hash of a file's bytes, or of all files that a folder's clip may be made of.

    Raises InputError.
    """
    found = hashlib.sha256()
    try:
        for file, about in storage.clip_files(path):
            if file != path:
                found.update(os.fsencode(file.relative_to(path)) + b'\0')
                found.update(about.st_size.to_bytes(8, 'big'))
            left = about.st_size  # files of /proc say 0, and reading some would wait for ever
            with file.open('rb') as stream:
                while left > 0 and (block := stream.read(min(BLOCK, left))):
                    found.update(block)
                    left -= len(block)
    except OSError as error:
        raise InputError('E-FILE-UNREADABLE', f'cannot read {path} ({error.strerror or error}); '
                                                f'check its permissions') from error
    return found.hexdigest()[:32]


def gather(path: Path, content: str, fps: float | None, topic: str | None, config: Config
           ) -> SceneFile:
    """Return a clip's turns and their scenes.

    content: the clip's content_hash(). Raises InputError for what cannot be read, and for the
    images of two cameras.
    """
    source = open_frames(path, topic=topic, fps=fps)
    detection = detect(source, config, keep=in_a_file)
    if detection.other_camera is not None:
        raise InputError('E-TWO-CAMERAS', f'{detection.other_camera}: {APART}')
    best = detection.turns()[:max(config.turns.wanted, config.turns.at_most)]
    valid = detection.valid()

    def stored(those: Iterable[Turn]) -> Iterator[StoredTurn]:
        for turn in sorted(those, key=lambda turn: turn.center):
            scene = reconstruct(turn, config, valid)
            detection.release(turn.center)
            if scene is not None:
                yield StoredTurn(scene, turn.stamp_s, turn.prominence)

    turns, stretches = list(stored(best)), list[StoredTurn]()
    # a sharp turn says more than all of them
    if config.turns.thorough or all(turn.scene.yaw_deg < SHARP_DEG for turn in turns):
        stretches = list(stored(detection.stretches()))
    found = sorted([*turns, *stretches], key=lambda turn: turn.scene.turn.number)
    assert detection.size is not None
    # the same content gives the same, wherever it lies
    warnings = tuple(str(line).replace(str(path), 'the clip')
                     for line in (*source.warnings, *detection.warnings()))
    return SceneFile(Origin(detection.size, detection.scale), tuple(found),
                     len(best) + len(stretches), content,
                     settings_hash(config, fps, topic), detection.frames, detection.seconds,
                     warnings, detection.lines())
