"""The first stage of a fleet: a clip -> its turns' scenes.

A pure function of the clip's content and the settings, in one thread; no pictures are kept.
"""
from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from dashcalib_ros import stages
from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError
from dashcalib_ros.fleet.gathered import FORMAT, Gathered, GatheredTurn
from dashcalib_ros.frames import Frame, FrameSource
from dashcalib_ros.inputs import open_frames

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
    """Return a hash of a file's bytes, or of all files in a folder with their names.

    Raises InputError.
    """
    found = hashlib.sha256()
    try:
        for file in _files(path):
            if path.is_dir():
                found.update(os.fsencode(file.relative_to(path)) + b'\0')
                found.update(file.stat().st_size.to_bytes(8, 'big'))
            with file.open('rb') as stream:
                while block := stream.read(BLOCK):
                    found.update(block)
    except OSError as error:
        raise InputError(f'cannot read {path} ({error.strerror or error})') from error
    return found.hexdigest()[:32]


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    return sorted(each for each in path.rglob('*') if each.is_file())


def gather(path: Path, content: str, fps: float | None, topic: str | None, config: Config
           ) -> Gathered:
    """Return a clip's turns and their scenes.

    content: the clip's content_hash(). Raises InputError for what cannot be read.
    """
    source = open_frames(path, topic, fps)
    span = _Span(source)
    detection = stages.detect(span, config)
    best = detection.turns()[:max(config.turns.wanted, config.turns.at_most)]
    valid = detection.valid()
    scenes = {}
    for turn in best:
        scene = stages.reconstruct(turn, config, valid)
        detection.release(turn.center)
        if scene is not None:
            scenes[turn.center] = scene
    assert detection.size is not None
    turns = tuple(
        GatheredTurn(turn.center, turn.stamp_s, turn.prominence, turn.center in scenes,
                     scenes[turn.center].yaw_deg if turn.center in scenes else None)
        for turn in sorted(best, key=lambda turn: turn.center))
    # the same content gives the same, wherever it lies
    warnings = tuple(line.replace(str(path), 'the clip')
                     for line in (*source.warnings, *detection.warnings()))
    return Gathered(content, settings_hash(config, fps, topic), detection.size, detection.scale,
                    detection.frames, span.seconds, turns, scenes, warnings)


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
