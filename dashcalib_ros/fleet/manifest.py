# SPDX-License-Identifier: Apache-2.0
"""Which clips there are: a table, a folder or a glob -> rows."""
from __future__ import annotations

import csv
import io
import json
import posixpath
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from itertools import islice
from typing import Any

from dashcalib_ros.config import Config, known_of
from dashcalib_ros.errors import ConfigError, InputError, one_line, shortened
from dashcalib_ros.fleet import storage
from dashcalib_ros.fleet.storage import needs
from dashcalib_ros.input.inputs import VIDEO_SUFFIXES
from dashcalib_ros.input.motion import HOTTEST_C
from dashcalib_ros.input.source import IMAGE_SUFFIXES, is_bag_file
from dashcalib_ros.limits import MANIFEST_BYTES, MANIFEST_ROWS
from dashcalib_ros.store.scene_file import LAST_S
from dashcalib_ros.store.scene_file import SUFFIX as GATHERED

# columns by their earlier names, which are read, too
RENAMED = {'make': 'camera_model'}
COLUMNS = ('clip', 'camera', 'camera_model', 'fps', 'topic', 'time', 'known', 'temperature', 'rig')


@dataclass(frozen=True, slots=True)
class Row:
    """A clip. number: of the manifest's row, from 1. place: its path or URL.

    clip: as written, without credentials; place, which may have some, is nowhere shown or kept.
    camera: '' where it is unknown, then the clip is a camera of its own. camera_model: '' where
    unknown. time_s: when it was recorded, s since 1970; None where unknown. known: settings
    known.* of its camera. temperature_c: mean of the clip, degrees Celsius; None where unknown.
    rig: of the car that its camera is on, '' where unknown. problem: why this row cannot be used,
    '' if it can.
    """

    number: int
    clip: str
    place: str
    camera: str = ''
    camera_model: str = ''
    fps: float | None = None
    topic: str | None = None
    time_s: float | None = None
    problem: str = ''
    known: tuple[tuple[str, str], ...] = ()
    temperature_c: float | None = None
    rig: str = ''

    @property
    def name(self) -> str:
        """Return a name that no other clip has: each topic of a bag is a clip of its own."""
        return f'{self.clip} (topic {self.topic})' if self.topic else self.clip


def read_manifest(place: str, group_by: str | None = None) -> list[Row]:
    """Return the rows of a manifest: .csv, .jsonl, .parquet, a folder or a glob.

    group_by: a regular expression that takes the camera from a clip's name: its group `camera`, or
    its first group, or all that it matches; its group `camera_model`, too. Raises InputError
    where the manifest cannot be read at all; what is wrong with a row stands in the row.
    """
    try:
        pattern = None if group_by is None else re.compile(group_by)
    except re.error as error:
        raise ConfigError('E-GROUP-BY-INVALID', f'--group-by {shortened(group_by or "")} is not '
                                                f'a regular expression ({error})') from error
    name, shown = storage.bare(place), storage.masked(place)
    reader = next((each for suffix, each in READERS.items() if name.lower().endswith(suffix)),
                  None)
    if reader is None or storage.is_folder(place):
        rows = [Row(number, storage.masked(found), found)
                for number, found in enumerate(_found(place), 1)]
    else:
        data = storage.read(place, MANIFEST_BYTES)
        if data is None:
            raise InputError('E-MANIFEST-MISSING', f'there is no manifest {shown}; check the path')
        folder = posixpath.dirname(name)
        rows = [_row(number, values, folder) for number, values in enumerate(
            islice(reader(shown, data), MANIFEST_ROWS + 1), 1)]
        if len(rows) > MANIFEST_ROWS:
            raise InputError('E-MANIFEST-TOO-LONG', f'{shown} has more than {MANIFEST_ROWS} rows: '
                                                    f'divide it into parts')
    if not rows:
        raise InputError('E-MANIFEST-EMPTY', f'{shown} names no clip; use a CSV with a column '
                                             f'clip, a folder of clips, or a glob in quotes')
    return rows if pattern is None else [_grouped(row, pattern) for row in rows]


def _found(place: str) -> list[str]:
    if storage.is_pattern(place):
        return storage.listed(place)
    if not storage.is_folder(place):
        shown = storage.masked(place)
        if storage.stamp(place) is None:
            raise InputError('E-MANIFEST-MISSING', f'there is no manifest {shown}; check the path')
        raise InputError('E-MANIFEST-UNKNOWN-TYPE',
                         f'{shown} is not a manifest: use a .csv, .jsonl or .parquet file, a '
                         f'folder of clips, or a glob in quotes')
    found = storage.listed(place)
    if found and all(name.lower().endswith(tuple(IMAGE_SUFFIXES)) for name in found):
        return [place]  # the images of one drive
    return [name for name in found if _may_be_a_clip(name)]


def _may_be_a_clip(name: str) -> bool:
    suffix = posixpath.splitext(name)[1].lower()
    return suffix in (*VIDEO_SUFFIXES, GATHERED) or is_bag_file(name) or storage.is_folder(name)


# of a row, or why there are none
Values = Mapping[str, Any] | str


def _csv(place: str, data: bytes) -> Iterator[Values]:
    text = _text_of(place, data).replace('\0', '')
    # a spreadsheet writes semicolons where the comma is in numbers
    mark = max(',;\t', key=text.partition('\n')[0].count)
    reader = csv.reader(io.StringIO(text, newline=''), delimiter=mark)
    try:
        head = [name.strip().lower() for name in next(reader, [])]
        if 'clip' not in head:
            raise InputError('E-MANIFEST-NO-CLIP-COLUMN',
                             f'{place} has no column clip; its first line must name the columns: '
                             f'{", ".join(COLUMNS)}')
        for values in reader:
            if any(map(str.strip, values)):
                yield (dict(zip(head, values, strict=False)) if len(values) <= len(head) else
                       f'has {len(values)} values for {len(head)} columns')
    except csv.Error as error:
        raise InputError('E-MANIFEST-DAMAGED', f'{place} is not a CSV file (line '
                                               f'{reader.line_num}: {error})') from error


def _json_lines(place: str, data: bytes) -> Iterator[Values]:
    for line in filter(str.strip, _text_of(place, data).split('\n')):
        try:
            values = json.loads(line)
            yield values if isinstance(values, dict) else 'is not a JSON object'
        except (ValueError, RecursionError) as error:
            yield f'is not valid JSON ({one_line(error, 80)})'


def _text_of(place: str, data: bytes) -> str:
    try:
        return data.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        line = data[:error.start].count(b'\n') + 1
        raise InputError('E-MANIFEST-NOT-UTF8',
                         f'{place} is not UTF-8 (line {line}); save it as UTF-8') from error


def _parquet(place: str, data: bytes) -> Iterator[Values]:
    needs('pyarrow', 'Parquet manifests')
    import pyarrow as arrow
    from pyarrow import parquet
    try:
        table = parquet.read_table(arrow.BufferReader(data))
    except (arrow.ArrowException, OSError) as error:
        raise InputError('E-MANIFEST-DAMAGED',
                         f'{place} is not a Parquet file ({one_line(error)})') from error
    if 'clip' not in table.column_names:
        raise InputError('E-MANIFEST-NO-CLIP-COLUMN', f'{place} has no column clip; the columns '
                                                      f'may be {", ".join(COLUMNS)}')
    yield from table.select([name for name in (*COLUMNS, *RENAMED)
                             if name in table.column_names]).to_pylist()


READERS: dict[str, Callable[[str, bytes], Iterator[Values]]] = {
    '.csv': _csv, '.jsonl': _json_lines, '.ndjson': _json_lines, '.parquet': _parquet}


def _row(number: int, values: Values, folder: str) -> Row:
    if isinstance(values, str):
        return Row(number, '', '', problem=values)
    values = _by_present_names(values)
    clip, camera, camera_model, fps, topic, time, known, temperature, rig = (
        '' if values.get(name) is None else str(values[name]).strip() for name in COLUMNS)
    if not clip:
        return Row(number, '', '', camera, camera_model, problem='names no clip')
    row = Row(number, storage.masked(clip), storage.joined(folder, clip), camera, camera_model,
              topic=topic or None, rig=rig)
    try:
        return replace(row, fps=_rate(fps) if fps else None, time_s=_time(time) if time else None,
                       known=_known(known),
                       temperature_c=_temperature(temperature) if temperature else None)
    except (ValueError, ConfigError) as error:
        return replace(row, problem=str(error))


def _by_present_names(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by name, with those of earlier names where the present one is not there."""
    return {**{RENAMED[name]: value for name, value in values.items() if name in RENAMED},
            **values}


def _known(text: str) -> tuple[tuple[str, str], ...]:
    """Return what is known, of 'stabiliser=no; fx=1160±20'; raises ConfigError."""
    found = known_of(part for part in re.split(r'[;,]\s*|\s+(?=\w+=)', text) if part)
    Config().replace(found)
    return tuple(sorted(found.items()))


def _rate(text: str) -> float:
    with suppress(ValueError):
        rate = float(text.replace(',', '.'))
        if 0 < rate <= 1000:
            return rate
    raise ValueError(f'fps must be above 0 and at most 1000, not {shortened(text, 40)}')


def _temperature(text: str) -> float:
    with suppress(ValueError):
        found = float(text.replace(',', '.'))
        if abs(found) <= HOTTEST_C:
            return found
    raise ValueError(f'temperature must be in degrees Celsius, not {shortened(text, 40)}')


def _time(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        try:
            date = datetime.fromisoformat(text.replace('Z', '+00:00'))
        except ValueError:
            raise ValueError(f'time must be a date such as 2026-01-31T12:00:00, or seconds since '
                             f'1970, not {shortened(text, 40)}') from None
        seconds = (date if date.tzinfo else date.replace(tzinfo=timezone.utc)).timestamp()
    if not abs(seconds) <= LAST_S:
        raise ValueError('time must be a date before the year 2261')
    return seconds


def _grouped(row: Row, pattern: re.Pattern[str]) -> Row:
    if not row.clip:
        return row
    found = pattern.search(row.clip)
    if found is None:
        return row if row.camera else replace(
            row, problem=row.problem or '--group-by matches no camera in the name of the clip')
    named = _by_present_names(found.groupdict())
    camera = named.get('camera') or (found.group(1) if pattern.groups else found.group(0))
    return replace(row, camera=row.camera or camera or '',
                   camera_model=row.camera_model or named.get('camera_model') or '')
