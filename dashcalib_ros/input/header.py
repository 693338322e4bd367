"""The size of an encoded picture from its first bytes, without decoding it."""
from __future__ import annotations

import re
import struct

Size = tuple[int, int]

# start-of-frame markers of a JPEG; C4, C8 and CC are tables
FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
BARE = frozenset((0x01, *range(0xD0, 0xD8)))
# markers before the size of a JPEG, at the most; cameras write 5 to 20
MARKERS = 1000
# width, height, tile width and tile height of a TIFF
TIFF_TAGS = (256, 257, 322, 323)
# entries of a TIFF's directory, at the most; cameras write 20
TIFF_ENTRIES = 1000
# P1 to P6, width and height, comments between them
PNM = re.compile(rb'P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s')


def encoded_size(data: memoryview) -> Size | None:
    """Return (width, height) of a JPEG, PNG, WebP, BMP, TIFF, PGM or PPM; None of anything else.

    Where a picture's tiles are larger than the picture, their size is returned: decoding uses it.
    """
    start = bytes(data[:64])
    try:
        if start[:2] == b'\xff\xd8':
            return _jpeg_size(bytes(data))
        if start[:8] == b'\x89PNG\r\n\x1a\n':
            return _pair('>II', start, 16)
        if start[:4] == b'RIFF' and start[8:12] == b'WEBP':
            return _webp_size(start)
        if start[:2] == b'BM':
            return _bmp_size(start)
        if start[:4] in (b'II*\0', b'MM\0*'):
            return _tiff_size(bytes(data))
    except struct.error:
        return None  # cut off before the size
    found = PNM.match(bytes(data[:4096]))
    return (int(found[1]), int(found[2])) if found else None


def _pair(layout: str, data: bytes, place: int) -> Size:
    first, second = struct.unpack_from(layout, data, place)
    return first, second


def _jpeg_size(data: bytes) -> Size | None:
    place = 2
    for _ in range(MARKERS):
        # decoders skip what is between the segments, and markers may be padded
        place = data.find(b'\xff', place)
        while place >= 0 and data[place + 1:place + 2] == b'\xff':
            place += 1
        if place < 0 or place + 9 > len(data):
            return None
        marker = data[place + 1]
        if marker in FRAMES:
            height, width = _pair('>HH', data, place + 5)
            return width, height
        if marker in BARE or marker == 0:
            place += 2
        else:
            place += 2 + int.from_bytes(data[place + 2:place + 4], 'big')
    return None


def _webp_size(data: bytes) -> Size | None:
    kind = data[12:16]
    if kind == b'VP8X':
        low_width, high_width, low_height, high_height = struct.unpack_from('<HBHB', data, 24)
        return (low_width | high_width << 16) + 1, (low_height | high_height << 16) + 1
    if kind == b'VP8L':
        bits, = struct.unpack_from('<I', data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b'VP8 ':
        width, height = _pair('<HH', data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


def _bmp_size(data: bytes) -> Size:
    if data[14:18] == b'\x0c\0\0\0':  # the oldest kind
        return _pair('<HH', data, 18)
    width, height = _pair('<ii', data, 18)
    return abs(width), abs(height)  # from the top down where the height is negative


def _tiff_size(data: bytes) -> Size | None:
    order = '<' if data[:2] == b'II' else '>'
    place, = struct.unpack_from(f'{order}I', data, 4)
    count, = struct.unpack_from(f'{order}H', data, place)
    sides = dict.fromkeys(TIFF_TAGS, 0)
    for entry in range(min(count, TIFF_ENTRIES)):
        tag, kind, _ = struct.unpack_from(f'{order}HHI', data, place + 2 + 12 * entry)
        if tag in sides:
            value, = struct.unpack_from(
                order + ('H' if kind == 3 else 'I'), data, place + 10 + 12 * entry)
            sides[tag] = max(sides[tag], value)
    width, height, tile_width, tile_height = sides.values()
    if not width or not height:
        return None
    return max(width, tile_width), max(height, tile_height)
