# SPDX-License-Identifier: Apache-2.0
"""The GPS that dashcams with a chip of Novatek (Viofo and many others) write into their MP4.

A box 'gps ' in 'moov' lists places of blocks 'free' 'GPS ', one for each second of the video. A
block has the time, whether there is a fix (A), N or S, E or W, and little-endian floats: degrees
and minutes as DDMM.mmmm, knots, and the course.
"""
from __future__ import annotations

import struct
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import BinaryIO

# hour, minute, second, year, month, day; fix, hemispheres; latitude, longitude, speed
BLOCK = struct.Struct('<6I4s3f')
# where it begins, by the firmware
PLACES = (48, 16)
HEAD, MPS = b'GPS ', 0.514444
# boxes of a file that are looked at, blocks of a drive, and bytes of one
BOXES, BLOCKS, BLOCK_BYTES = 10_000, 100_000, 128


def fixes(path: Path) -> list[tuple[float, ...]]:
    """Return s of the video, latitude, longitude, altitude (NaN) and speed of each fix, m/s.

    Empty where the file has no such GPS. Raises OSError.
    """
    with path.open('rb') as file:
        size = file.seek(0, 2)
        places = [(at, end) for name, first, last in boxes(file, 0, size) if name == b'moov'
                  for inner, at, end in boxes(file, first, last) if inner == b'gps ']
        blocks = [_block(file, *each) for at, end in places[:1]
                  for each in _listed(file, at, end)]
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


def _listed(file: BinaryIO, at: int, end: int) -> Iterator[tuple[int, int]]:
    """Yield place and size of each block that a box 'gps ' lists behind its two numbers."""
    file.seek(at + 8)
    data = file.read(min(end - at - 8, 8 * BLOCKS) // 8 * 8) if end > at + 8 else b''
    yield from struct.iter_unpack('>II', data)


def _block(file: BinaryIO, at: int, size: int) -> tuple[float, float, float, float, float] | None:
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
