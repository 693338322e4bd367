# SPDX-License-Identifier: Apache-2.0
"""Gyro and GPS that cameras write into their MP4: Novatek's, and Google's Camera Motion Metadata.

Dashcams with a chip of Novatek (Viofo and many others) have a box 'gps ' in 'moov', which lists
places of blocks 'free' 'GPS ', one for each second of the video. A block has the time, whether
there is a fix (A), N or S, E or W, and little-endian floats: degrees and minutes as DDMM.mmmm,
knots, and the course.

CAMM is a track whose samples have the sample entry 'camm'. A sample is little-endian: two bytes of
0, the type, and numbers; its time is that of the track.
"""
from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dashcalib_ros.arrays import Floats

# of Novatek: hour, minute, second, year, month, day; fix, hemispheres; latitude, longitude, speed
BLOCK = struct.Struct('<6I4s3f')
# where it begins, by the firmware
PLACES = (48, 16)
HEAD, MPS = b'GPS ', 0.514444
# boxes of a file that are looked at, blocks of a drive, and bytes of one
BOXES, BLOCKS, BLOCK_BYTES = 10_000, 100_000, 128
# types of CAMM's samples: rad/s; latitude, longitude, altitude; the same with time, kind of fix
# and, after two accuracies, the velocity to the east, the north and up
GYRO, GPS_SHORT, GPS = 2, 5, 6
NUMBERS = {GYRO: struct.Struct('<3f'), GPS_SHORT: struct.Struct('<3d'),
           GPS: struct.Struct('<di2d7f')}
# samples of a track, and bytes of a table
SAMPLES, TABLE_BYTES = 10_000_000, 256 * 2**20
# boxes on the way from a track to its tables, in this order: nothing else is entered
WAY = (b'mdia', b'minf', b'stbl')
TABLES = {b'stsd', b'stts', b'stsz', b'stsc', b'stco', b'co64', b'mdhd'}


def novatek_fixes(path: Path) -> list[tuple[float, ...]]:
    """Return s of the video, latitude, longitude, altitude (NaN) and speed of each fix, m/s.

    Empty where the file has no such GPS. Raises OSError.
    """
    with path.open('rb') as file:
        size = file.seek(0, 2)
        places = [(at, end) for name, first, last in boxes(file, 0, size) if name == b'moov'
                  for inner, at, end in boxes(file, first, last) if inner == b'gps ']
        blocks = [_novatek_block(file, *each) for at, end in places[:1]
                  for each in _novatek_listed(file, at, end)]
    known = [(second, *block) for second, block in enumerate(blocks) if block is not None]
    # the first block is of the video's first second, and GPS counts the others
    return [(known[0][0] + stamp_s - known[0][1], *fix) for _, stamp_s, *fix in known
            ] if known else []


def boxes(file: BinaryIO, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield name, first and last byte of the content of each box between two places."""
    for _ in range(BOXES):
        file.seek(at)
        head = file.read(16)
        if at + 8 > end or len(head) < 8:
            return
        size, name = struct.unpack_from('>I4s', head)
        begin = 8
        if size == 1 and len(head) == 16:
            size, begin = struct.unpack_from('>Q', head, 8)[0], 16
        size = size or end - at
        if size < begin:
            return
        yield name, at + begin, min(at + size, end)
        at += size


def _novatek_listed(file: BinaryIO, at: int, end: int) -> Iterator[tuple[int, int]]:
    """Yield place and size of each block that a box 'gps ' lists behind its two numbers."""
    file.seek(at + 8)
    data = file.read(min(end - at - 8, 8 * BLOCKS) // 8 * 8) if end > at + 8 else b''
    yield from struct.iter_unpack('>II', data)


def _novatek_block(file: BinaryIO, at: int, size: int) -> tuple[float, ...] | None:
    """Return time, latitude, longitude, altitude and speed of a block; None without a fix."""
    file.seek(at)
    data = file.read(min(size, BLOCK_BYTES))
    for place in PLACES if data[8:12] == HEAD else ():
        if len(data) < place + BLOCK.size:
            continue
        hour, minute, second, year, month, day, signs, *values = BLOCK.unpack_from(data, place)
        if signs[:1] != b'A' or signs[1:2] not in (b'N', b'S') or signs[2:3] not in (b'E', b'W'):
            continue
        try:
            when = datetime(2000 + year % 100, month, day, hour, minute, second,
                            tzinfo=timezone.utc)
        except (ValueError, OverflowError):
            continue
        latitude, longitude = (value // 100 + value % 100 / 60 for value in values[:2])
        return (when.timestamp(), -latitude if signs[1:2] == b'S' else latitude,
                -longitude if signs[2:3] == b'W' else longitude, float('nan'), MPS * values[2])
    return None


def camm_streams(path: Path) -> Mapping[str, tuple[Floats, Floats]]:
    """Return rate, position and speed, each stamps (n,) in s of the video and values (n, c).

    Without those that the file does not have. Raises OSError.
    """
    rows: dict[str, list[tuple[float, ...]]] = {'rate': [], 'position': [], 'speed': []}
    with path.open('rb') as file:
        size = file.seek(0, 2)
        for stamp_s, data in _camm_samples(file, size):
            kind = int.from_bytes(data[2:4], 'little')
            if kind not in NUMBERS or len(data) < 4 + NUMBERS[kind].size:
                continue
            values = NUMBERS[kind].unpack_from(data, 4)
            if kind == GYRO:
                rows['rate'].append((stamp_s, *values))
            elif kind == GPS_SHORT:
                rows['position'].append((stamp_s, *values))
            elif values[1]:
                # 0 means no fix
                rows['position'].append((stamp_s, *values[2:5]))
                rows['speed'].append((stamp_s, float(np.hypot(values[7], values[8]))))
    found = {kind: np.array(each, np.float64) for kind, each in rows.items() if each}
    return {kind: (each[:, 0], each[:, 1:]) for kind, each in found.items()}


def _camm_samples(file: BinaryIO, size: int) -> Iterator[tuple[float, bytes]]:
    for name, first, last in boxes(file, 0, size):
        for inner, at, end in boxes(file, first, last) if name == b'moov' else ():
            tables = _camm_tables(file, at, end) if inner == b'trak' else {}
            if tables.get(b'stsd', b'')[12:16] == b'camm':
                yield from _of_track(file, size, tables)
                return


def _camm_tables(file: BinaryIO, at: int, end: int, way: tuple[bytes, ...] = WAY
            ) -> dict[bytes, bytes]:
    found: dict[bytes, bytes] = {}
    for name, first, last in boxes(file, at, end):
        if name in way[:1]:
            found |= _camm_tables(file, first, last, way[1:])
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
