"""A camera's gathered clips -> its own result; that and the prior of its make -> its files.

Each task is a function of its arguments and of files; it may run anywhere, and twice.
"""
from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from typing import Any

from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError
from dashcalib_ros.fleet import solved
from dashcalib_ros.fleet.clips import ClipResult, gathered, hash_of
from dashcalib_ros.fleet.fuse import fuse
from dashcalib_ros.fleet.lens_prior import OfMake, Unit
from dashcalib_ros.fleet.manifest import Row
from dashcalib_ros.fleet.storage import is_url, joined, read, remove, write
from dashcalib_ros.fleet.tables import camera_folder, camera_row
from dashcalib_ros.report import write_results
from dashcalib_ros.report.files import ACCEPTED, WEAK


@dataclass(frozen=True)
class Own:
    """What the fleet needs of a camera's own result. file: has the result.

    shares: by clip. unit: what the camera tells of its make. again: this was known before.
    """

    file: str
    verdict: str
    shares: Mapping[str, solved.ClipShare]
    unit: Unit | None
    again: bool


def solve_camera(camera: str, make: str, clips: Sequence[tuple[Row, ClipResult]], out: str,
                 config: Config) -> Own:
    """Solve a camera from its gathered clips, unless that was done."""
    # a clip that the manifest names twice counts once
    used = {row.name: (result.file, f'{result.content}{row.topic or ""}')
            for row, result in reversed(clips) if result.file}
    name = solved_file(camera, make, [(clip, *used[clip]) for clip in sorted(used)], config)
    data = read(joined(out, name))
    result = None if data is None else solved.decoded(data, name)
    if result is None:
        loaded = {}
        for clip, (file, content) in used.items():
            found = gathered(out, file)
            if found is None:
                raise InputError(f'{file} has gone or changed while the fleet was solved; remove '
                                 f'it and start again')
            # what was read has this content, whatever it says
            loaded[clip] = replace(found, content=content)
        text = solved.encoded(fuse(camera, make, loaded, config))
        result = solved.decoded(text, name)
        write(joined(out, name), text)
    return Own(name, result.calibration.verdict.level, result.shares, solved.unit_of(result),
               data is not None)


def solved_file(camera: str, make: str, clips: Sequence[tuple[str, str, str]], config: Config
                ) -> str:
    """Return the name of a camera's own result. clips: name, file and content of each.

    Other clips, other settings and another version of this package have another one.
    """
    settings = {key: value for key, value in config.flat().items() if key != 'threads'}
    try:
        version = metadata.version('dashcalib_ros')
    except metadata.PackageNotFoundError:
        version = ''
    key = hash_of([solved.FORMAT, version, camera, make, clips, settings])
    return f'solved/{key[:2]}/{key}.json'


def publish_camera(name: str, found: OfMake | None, clips: Sequence[Mapping[str, Any]], out: str
                   ) -> dict[str, Any]:
    """Write calibration.yaml, result.json and report.html of a camera; return its row.

    name: the file of its own result. found: what its make tells of it. clips: the rows of its
    clips.
    """
    data = read(joined(out, name))
    if data is None:
        raise InputError(f'{name} has gone while the fleet was solved; start again')
    result = solved.decoded(data, name)
    final = solved.final_of(result, found)
    yaml_name = re.sub(r'[^A-Za-z0-9_]+', '_', result.camera).strip('_') or 'camera'
    yaml_name = 'camera_narrow_stereo' if yaml_name == 'narrow_stereo' else yaml_name
    place = joined(out, camera_folder(result.camera))
    if is_url(place):
        with tempfile.TemporaryDirectory(prefix='dashcalib-') as scratch:
            files = write_results(final.calibration, scratch, yaml_name).files
            for path in files:
                write(joined(place, path.name), path.read_bytes())
        for file in {ACCEPTED, WEAK} - {path.name for path in files}:
            remove(joined(place, file))
    else:
        write_results(final.calibration, place, yaml_name)
    return camera_row(result, final, clips)
