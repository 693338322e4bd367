# SPDX-License-Identifier: Apache-2.0
"""The size of an encoded picture, read from its first bytes; what is too large stays packed."""
from __future__ import annotations

import os
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest
from fakes import compressed_message, image_message
from refused import refused

from dashcalib_ros.errors import InputError
from dashcalib_ros.input import decode as decoding
from dashcalib_ros.input.decode import decode, decode_file, encoded_size, message_size
from dashcalib_ros.limits import PIXELS

SUFFIXES = ['.jpg', '.png', '.webp', '.bmp', '.tif', '.pgm', '.ppm']


@pytest.mark.parametrize('suffix', SUFFIXES)
@pytest.mark.parametrize('size', [(1, 1), (641, 363), (1920, 1080)])
def test_encoded_sizes_are_read_without_decoding(suffix, size):
    for shape in ((*size[::-1],), (*size[::-1], 3)):
        if (suffix, len(shape)) in (('.pgm', 3), ('.ppm', 2)):
            continue
        data = cv2.imencode(suffix, np.zeros(shape, np.uint8))[1].tobytes()
        assert encoded_size(memoryview(data)) == size
        # wherever it is cut, it says the size or nothing
        for length in range(0, min(len(data), 700), 7):
            assert encoded_size(memoryview(data[:length])) in (None, size)


@pytest.mark.parametrize('options', [[cv2.IMWRITE_WEBP_QUALITY, 50],
                                     [cv2.IMWRITE_WEBP_QUALITY, 101]])
@pytest.mark.parametrize('channels', [3, 4])
def test_all_kinds_of_webp(options, channels):
    picture = np.random.default_rng(0).integers(0, 255, (48, 65, channels), np.uint8)
    data = cv2.imencode('.webp', picture, options)[1].tobytes()
    assert encoded_size(memoryview(data)) == (65, 48)


def test_progressive_and_optimised_jpeg():
    data = cv2.imencode('.jpg', np.zeros((48, 64), np.uint8),
                        [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_OPTIMIZE, 1])[1]
    assert encoded_size(memoryview(data.tobytes())) == (64, 48)


def test_a_jpeg_with_bytes_between_its_segments():
    data = cv2.imencode('.jpg', np.zeros((48, 64), np.uint8))[1].tobytes()
    for between in (b'abc', b'\xff\xff', b'\0' * 5000):
        odd = data[:20] + between + data[20:]
        assert decode_file(odd).shape == (48, 64)
        assert encoded_size(memoryview(odd)) == (64, 48)


def test_a_message_says_its_size():
    data = cv2.imencode('.bmp', np.zeros((48, 64), np.uint8))[1].tobytes()
    assert message_size(compressed_message(format='bmp', data=data)) == (64, 48)
    for name, content in (('jpeg', b'no image'), ('h264', data), ('16UC1; compressedDepth', data)):
        with pytest.raises(InputError):
            message_size(compressed_message(format=name, data=content))


@pytest.mark.parametrize(('width', 'height'), [(0, 5), (5, 0), (2**32 - 1, 2**32 - 1),
                                               (PIXELS, 2), (70_000, 10)])
def test_a_raw_message_of_an_absurd_size_has_none(width, height):
    code = 'E-IMAGE-TOO-LARGE' if width and height else 'E-IMAGE-SIZE'
    with refused(InputError, code, f'{width}x{height}'):
        message_size(image_message(
            encoding='mono8', width=width, height=height, step=width, is_bigendian=0, data=b''))


def png(width, height):
    """Return a PNG that claims a size and is small: all its pixels are black."""
    def chunk(kind, data):
        return struct.pack('>I', len(data)) + kind + data + struct.pack(
            '>I', zlib.crc32(kind + data))
    head = struct.pack('>IIBBBBB', width, height, 8, 0, 0, 0, 0)
    return (b'\x89PNG\r\n\x1a\n' + chunk(b'IHDR', head)
            + chunk(b'IDAT', zlib.compress(bytes(1000))) + chunk(b'IEND', b''))


def huge(suffix):
    """Return a picture of a kind, with the size in its header set beyond the budget."""
    if suffix == '.png':
        return png(30_000, 30_000)
    if suffix in ('.pgm', '.ppm'):
        return (b'P5' if suffix == '.pgm' else b'P6') + b'\n# a comment\n30000 30000\n255\n'
    data = bytearray(cv2.imencode(suffix, np.zeros((48, 64), np.uint8))[1].tobytes())
    if suffix == '.jpg':
        place = data.index(b'\xff\xc0') + 5
        data[place:place + 4] = struct.pack('>HH', 30_000, 30_000)
    elif suffix == '.webp':
        assert data[12:16] == b'VP8L'
        data[21:25] = struct.pack('<I', 16_382 | 16_382 << 14)
    elif suffix == '.bmp':
        data[18:26] = struct.pack('<ii', 30_000, -30_000)
    else:
        place, = struct.unpack_from('<I', data, 4)
        for entry in range(struct.unpack_from('<H', data, place)[0]):
            tag, = struct.unpack_from('<H', data, place + 2 + 12 * entry)
            if tag in (256, 257):
                struct.pack_into('<HIHH', data, place + 4 + 12 * entry, 3, 1, 30_000, 0)
    return bytes(data)


@pytest.mark.parametrize('suffix', SUFFIXES)
def test_what_would_take_too_much_memory_is_never_decoded(suffix, monkeypatch):
    def decoded(*_):
        raise AssertionError('it was decoded')

    monkeypatch.setattr(decoding.cv2, 'imdecode', decoded)
    data = huge(suffix)
    message = compressed_message(format='', data=data)
    for read in (decode, message_size, lambda each: decode_file(each.data)):
        with refused(InputError, 'E-IMAGE-TOO-LARGE', '50 million'):
            read(message)


def test_kinds_whose_size_is_not_known_beforehand_are_refused():
    data = cv2.imencode('.hdr', np.zeros((4, 4, 3), np.float32))[1].tobytes()
    with refused(InputError, 'E-IMAGE-DAMAGED'):
        decode_file(data)


def test_opencv_has_the_same_budget():
    """Were a header read wrongly, OpenCV would refuse the picture itself."""
    code = ('import sys\n'
            'from dashcalib_ros.workers.worker import prepare_process\n'
            'prepare_process()  # as our programs do\n'
            'import cv2, numpy as np\n'
            'data = np.frombuffer(sys.stdin.buffer.read(), np.uint8)\n'
            'print(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))')
    others = {name: text for name, text in os.environ.items() if 'OPENCV_IO' not in name}
    done = subprocess.run([sys.executable, '-c', code], input=png(30_000, 30_000), env=others,
                          capture_output=True)
    assert done.returncode == 1 or done.stdout == b'None\n', done
    assert b'CV_IO_MAX_IMAGE_PIXELS' in done.stderr
