# SPDX-License-Identifier: Apache-2.0
"""A video file of a GoPro with nothing but its motion data: GPMF in a metadata track of an MP4."""
from __future__ import annotations

import struct

import numpy as np

PER_BLOCK, FIXES = 200, 18
MATRIX = struct.pack('>9I', 65536, 0, 0, 0, 65536, 0, 0, 0, 0x40000000)


def gopro(rates, latitude, speed):
    """Return the file. rates: (n, 3) rad/s at 200 Hz; a car that drives north, speed in m/s."""
    blocks = [_block(rates[n:n + PER_BLOCK], n, latitude, speed)
              for n in range(0, len(rates), PER_BLOCK)]
    head = _box(b'ftyp', b'mp41', bytes(4), b'mp41')
    places = np.cumsum([len(head) + 8, *map(len, blocks[:-1])])
    count, length = len(blocks), 1000 * len(blocks)
    table = _box(
        b'stbl', _full(b'stsd', struct.pack('>I', 1),
                       _box(b'gpmd', bytes(6), struct.pack('>H', 1), bytes(4))),
        _full(b'stts', struct.pack('>III', 1, count, 1000)),
        _full(b'stsc', struct.pack('>IIII', 1, 1, 1, 1)),
        _full(b'stsz', struct.pack('>II', 0, count), *(struct.pack('>I', len(b)) for b in blocks)),
        _full(b'stco', struct.pack('>I', count), *(struct.pack('>I', p) for p in places)))
    media = _box(
        b'mdia', _full(b'mdhd', struct.pack('>IIIIHH', 0, 0, 1000, length, 0, 0)),
        _full(b'hdlr', b'mhlrmeta', bytes(12), b'\x0bGoPro MET  '),
        _box(b'minf', _box(b'gmhd', _full(b'gmin', bytes(12))),
             _box(b'dinf', _full(b'dref', struct.pack('>I', 1), _box(b'url ', b'\0\0\0\1'))),
             table))
    track = _box(b'trak', _box(b'tkhd', b'\0\0\0\7', struct.pack('>IIIII', 0, 0, 1, 0, length),
                               bytes(16), MATRIX, bytes(8)), media)
    movie = _full(b'mvhd', struct.pack('>IIIIIH', 0, 0, 1000, length, 65536, 256), bytes(10),
                  MATRIX, bytes(24), struct.pack('>I', 2))
    return head + _box(b'mdat', *blocks) + _box(b'moov', movie, track)


def _block(rates, first, latitude, speed):
    """Return a second of GPMF."""
    start_us = first * 1_000_000 // PER_BLOCK
    fixes = b''.join(struct.pack(
        '>5i', round((latitude + speed * (start_us / 1e6 + n / FIXES) / 111_320) * 1e7),
        90_000_000, 100_000, round(1000 * speed), round(100 * speed)) for n in range(FIXES))
    gyro = np.round(1000 * rates).astype('>i2').tobytes()
    still = np.full(rates.shape, 3924, '>i2').tobytes()
    return _nest(
        b'DEVC', _item(b'DVID', b'L', 4, 1, struct.pack('>I', 1)),
        _item(b'DVNM', b'c', 12, 1, b'Hero8 Black\0'),
        _stream(start_us, first + len(rates), b'Accelerometer', struct.pack('>h', 400),
                _item(b'ACCL', b's', 6, len(rates), still)),
        _stream(start_us, first + len(rates), b'Gyroscope', struct.pack('>h', 1000),
                _item(b'GYRO', b's', 6, len(rates), gyro), unit=b'rad/s'),
        _stream(start_us, FIXES, b'GPS', struct.pack('>5i', 10**7, 10**7, 1000, 1000, 100),
                _item(b'GPS5', b'l', 20, FIXES, fixes), fix=3))


def _stream(start_us, total, name, scale, data, unit=None, fix=None):
    parts = [_item(b'STMP', b'J', 8, 1, struct.pack('>Q', start_us)),
             _item(b'TSMP', b'L', 4, 1, struct.pack('>I', total)),
             _item(b'STNM', b'c', len(name), 1, name)]
    if unit is not None:
        parts.append(_item(b'SIUN', b'c', len(unit), 1, unit))
    if fix is not None:
        parts.append(_item(b'GPSF', b'L', 4, 1, struct.pack('>I', fix)))
    long = len(scale) > 2
    parts.append(_item(b'SCAL', b'l' if long else b's', 4 if long else 2,
                       len(scale) // 4 if long else 1, scale))
    if fix is None:
        parts.append(_item(b'ORIN', b'c', 3, 1, b'XYZ'))
    return _nest(b'STRM', *parts, data)


def _box(name, *parts):
    data = b''.join(parts)
    return struct.pack('>I', 8 + len(data)) + name + data


def _full(name, *parts):
    return _box(name, bytes(4), *parts)


def _item(key, kind, size, count, data):
    return key + kind + struct.pack('>BH', size, count) + data + bytes(-len(data) % 4)


def _nest(key, *parts):
    data = b''.join(parts)
    return key + b'\0' + struct.pack('>BH', 1, len(data)) + data
