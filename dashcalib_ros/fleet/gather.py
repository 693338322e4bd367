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
from dashcalib_ros.fleet.storage import clip_files
from dashcalib_ros.input import Frame, FrameSource
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.reconstruct.scene_file import FORMAT, Origin, SceneFile, StoredTurn

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
    detection = stages.detect(span, config)
    best = detection.turns()[:max(config.turns.wanted, config.turns.at_most)]
    valid = detection.valid()
    turns = []
    for turn in sorted(best, key=lambda turn: turn.center):
        scene = stages.reconstruct(turn, config, valid)
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
