# SPDX-License-Identifier: Apache-2.0
"""Small picture files that take long to decode, where nobody counts what is in them."""
from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np


def picture(size=(640, 480), seed=0):
    """Return (height, width) uint8, smooth as a photograph."""
    small = np.random.default_rng(seed).integers(256, size=(12, 16), dtype=np.uint8)
    return cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)


def jpeg(progressive=False, size=(640, 480)):
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)]
    return cv2.imencode('.jpg', picture(size), flags)[1].tobytes()


def empty_scans(count, size=(640, 480)):
    """Return a progressive JPEG with so many scans more, each of all blocks, which change nothing.

    Their one code says that the next blocks, up to 2^15 - 1 of them, are empty.
    """
    whole = jpeg(progressive=True, size=size)
    end = whole.rindex(b'\xff\xd9')
    table = b'\xff\xc4' + struct.pack('>H', 20) + b'\x10' + bytes([1] + [0] * 15) + b'\xe0'
    # of the first component: coefficients 1 to 63, lowest bit once more
    head = b'\xff\xda' + struct.pack('>H', 8) + b'\x01\x01\x00\x01\x3f\x00'
    bits, left = '', -(-size[0] // 8) * -(-size[1] // 8)
    while left > 0:
        more = max(min(left, 2**15 - 1) - 2**14, 0)
        bits += f'0{more:014b}'
        left -= 2**14 + more
    bits += '1' * (-len(bits) % 8)
    data = int(bits, 2).to_bytes(len(bits) // 8, 'big').replace(b'\xff', b'\xff\0')
    return whole[:end] + table + (head + data) * count + whole[end:]


def many_tables(count):
    """Return a JPEG with so many Huffman tables before the picture."""
    whole = jpeg()
    place = whole.index(b'\xff\xc4')
    length = 2 + struct.unpack_from('>H', whole, place + 2)[0]
    return whole[:place] + whole[place:place + length] * count + whole[place:]


def padded(count):
    """Return a JPEG with so many fill bytes before a marker."""
    whole = jpeg()
    return whole[:2] + b'\xff' * count + whole[2:]


def chunk(kind, data):
    return (struct.pack('>I', len(data)) + kind + data
            + struct.pack('>I', zlib.crc32(kind + data)))


def png(extra=b'', size=(640, 480)):
    whole = cv2.imencode('.png', picture(size))[1].tobytes()
    return whole[:33] + extra + whole[33:]


def packed_texts(count, unpacked=2**23 - 100):
    """Return a PNG with so many packed texts, each of 8 MB when unpacked."""
    return png(chunk(b'zTXt', b'k\0\0' + zlib.compress(bytes(unpacked), 9)) * count)


def many_parts(count):
    """Return a PNG with so many empty parts."""
    return png(chunk(b'prVt', b'') * count)


def one_array(tags, values=10**6):
    """Return a TIFF in which so many entries name the same bytes, each to be read for itself."""
    pixels = picture((64, 48)).tobytes()
    plain = [(256, 3, 1, 64), (257, 3, 1, 48), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1),
             (273, 4, 1, 8), (277, 3, 1, 1), (278, 3, 1, 48), (279, 4, 1, len(pixels))]
    entries = plain + [(40_000 + n, 1, values, 8 + len(pixels)) for n in range(tags)]
    directory = b''.join(struct.pack('<HHII', *entry) for entry in entries)
    return (b'II*\0' + struct.pack('<I', 8 + len(pixels) + values) + pixels + bytes(values)
            + struct.pack('<H', len(entries)) + directory + bytes(4))


# each takes a second to a minute to decode, or a gigabyte
SLOW = {'scans of a JPEG': lambda: empty_scans(4000, (4000, 3000)),
        'packed texts': lambda: packed_texts(100),
        'parts of a PNG': lambda: many_parts(10**6), 'entries of a TIFF': lambda: one_array(3000),
        'bytes named twice': lambda: one_array(900)}
# as large, and quick
QUICK = {'a progressive JPEG': lambda: jpeg(progressive=True), 'scans': lambda: empty_scans(20),
         'tables': lambda: many_tables(20_000), 'fill bytes': lambda: padded(10**6),
         'texts': lambda: packed_texts(4), 'a PNG': png, 'a TIFF': lambda: one_array(1)}
