# SPDX-License-Identifier: Apache-2.0
"""Gyro and GPS in a CAMM track of an MP4 (Google's Camera Motion Metadata).

A track whose samples have the sample entry 'camm'. A sample is little-endian: two bytes of 0, the
type, and numbers; its time is that of the track.
"""
from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.input.novatek import boxes

# types of samples: rad/s; latitude, longitude, altitude; the same with time, kind of fix and,
# after two accuracies, the velocity to the east, the north and up
GYRO, GPS_SHORT, GPS = 2, 5, 6
NUMBERS = {GYRO: struct.Struct('<3f'), GPS_SHORT: struct.Struct('<3d'),
           GPS: struct.Struct('<di2d7f')}
# samples of a track, and bytes of a table
SAMPLES, TABLE_BYTES = 10_000_000, 256 * 2**20
# boxes on the way from a track to its tables, in this order: nothing else is entered
WAY = (b'mdia', b'minf', b'stbl')
TABLES = {b'stsd', b'stts', b'stsz', b'stsc', b'stco', b'co64', b'mdhd'}


def streams(path: Path) -> Mapping[str, tuple[Floats, Floats]]:
    """Return rate, position and speed, each stamps (n,) in s of the video and values (n, c).

    Without those that the file does not have. Raises OSError.
    """
    rows: dict[str, list[tuple[float, ...]]] = {'rate': [], 'position': [], 'speed': []}
    with path.open('rb') as file:
        size = file.seek(0, 2)
        for stamp_s, data in _samples(file, size):
            kind = int.from_bytes(data[2:4], 'little')
            if kind not in NUMBERS or len(data) < 4 + NUMBERS[kind].size:
                continue
            values = NUMBERS[kind].unpack_from(data, 4)
            if kind == GYRO:
                rows['rate'].append((stamp_s, *values))
            elif kind == GPS_SHORT:
                rows['position'].append((stamp_s, *values))
            elif values[1]:
                # 0 is no fix
                rows['position'].append((stamp_s, *values[2:5]))
                rows['speed'].append((stamp_s, float(np.hypot(values[7], values[8]))))
    found = {kind: np.array(each, np.float64) for kind, each in rows.items() if each}
    return {kind: (each[:, 0], each[:, 1:]) for kind, each in found.items()}


def _samples(file: BinaryIO, size: int) -> Iterator[tuple[float, bytes]]:
    for name, first, last in boxes(file, 0, size):
        for inner, at, end in boxes(file, first, last) if name == b'moov' else ():
            tables = _tables(file, at, end) if inner == b'trak' else {}
            if tables.get(b'stsd', b'')[12:16] == b'camm':
                yield from _of_track(file, size, tables)
                return


def _tables(file: BinaryIO, at: int, end: int, way: tuple[bytes, ...] = WAY
            ) -> dict[bytes, bytes]:
    found: dict[bytes, bytes] = {}
    for name, first, last in boxes(file, at, end):
        if name in way[:1]:
            found |= _tables(file, first, last, way[1:])
        elif name in TABLES:
            file.seek(first)
            found[name] = file.read(min(last - first, TABLE_BYTES))
    return found


def _of_track(file: BinaryIO, length: int, tables: Mapping[bytes, bytes]
              ) -> Iterator[tuple[float, bytes]]:
    head = tables.get(b'mdhd', b'')
    if len(head) < 24 or b'stsz' not in tables:
        return
    scale = struct.unpack_from('>I', head, 20 if head[0] else 12)[0]
    one, count = struct.unpack_from('>2I', tables[b'stsz'].ljust(12, b'\0'), 4)
    # a count without a table may be any number: no more than fit into the file
    sizes = [one] * min(count, SAMPLES, length // one) if one else [
        each for each, in struct.iter_unpack(
            '>I', _whole(tables[b'stsz'][12:12 + 4 * SAMPLES], 4))]
    wide = b'co64' in tables
    chunks = [each for each, in struct.iter_unpack(
        '>Q' if wide else '>I',
        _whole(tables.get(b'co64' if wide else b'stco', b'')[8:], 8 if wide else 4))]
    runs = list(struct.iter_unpack('>3I', _whole(tables.get(b'stsc', b'')[8:], 12)))
    starts = [run[0] for run in runs]
    times, ticks = list[float](), 0
    for number, step in struct.iter_unpack('>2I', _whole(tables.get(b'stts', b'')[8:], 8)):
        for _ in range(min(number, len(sizes) - len(times))):
            times.append(ticks / max(scale, 1))
            ticks += step
    sample = 0
    for place, offset in enumerate(chunks, start=1):
        run = bisect_right(starts, place) - 1
        each = runs[run][1] if run >= 0 else 0
        for _ in range(each):
            if sample >= min(len(sizes), len(times)):
                return
            file.seek(offset)
            yield times[sample], file.read(min(sizes[sample], 1024))
            offset += sizes[sample]
            sample += 1


def _whole(data: bytes, size: int) -> bytes:
    return data[:len(data) // size * size]
