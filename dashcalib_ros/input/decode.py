# SPDX-License-Identifier: Apache-2.0
"""Image messages and image files -> images of 8 bits, grey or in colour; mask files -> masks.

Works on anything with the fields of sensor_msgs/Image or sensor_msgs/CompressedImage: messages of
rclpy and of rosbags alike. Needs neither ROS nor cv_bridge.
"""
from __future__ import annotations

import itertools
import os
import re
import struct
import sys
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import GreyImage, Mask, Pixels
from dashcalib_ros.errors import InputError
from dashcalib_ros.limits import (
    JPEG_SCANS,
    PICTURE_BYTES,
    PNG_PARTS,
    PNG_TEXTS,
    TIFF_ENTRIES,
    check_pixels,
    path_of,
    read_file,
)

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

_DEPTHS = (8, 10, 12, 14, 16)
_JPEG_START, _JPEG_END = b'\xff\xd8', b'\xff\xd9'
# bytes before the encoding in a message of zstd_image_transport
_PACKED_HEAD = struct.calcsize('<IIBII')
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
_JPEG_SCAN = b'\xff\xda'
_PNG_START = b'\x89PNG\r\n\x1a\n'
_TIFF_STARTS = (b'II*\0', b'MM\0*')
# parts of a PNG that are packed
_PACKED = (b'zTXt', b'iTXt', b'iCCP')
# how the EXIF data of a JPEG, a PNG and a WebP begin
_EXIF = (b'Exif\0\0', b'eXIf', b'EXIF')
_VIDEO_FORMATS = ('h264', 'h265', 'hevc', 'av1', 'vp9', 'theora')
# what is in the format of compressed images that are read
_FORMATS = ('jpeg', 'jpg', 'png', 'tif', 'webp', 'bmp', 'pgm', 'ppm', 'compressed')


# of a 16-bit image: pixels between those that are looked at, and the percentiles of their range
STEP, OF_PIXELS = 4, (1, 99)
# bits by which a range is far from 0, and smaller than the values that the depth has
FAR_FROM_0, FEW = 3, 2
# values of a range that is stretched, and of an image that tells it; in fewer there is noise only
LEAST_RANGE, FLAT = 64, 16


class BitDepth:
    """How many bits of a stream's 16-bit images are used: one object per stream.

    Cameras of 10, 12 or 14 bits fill only the lower bits of a 16-bit image, and nothing in the
    message says so. The depth is the smallest of 8, 10, 12, 14, 16 that holds every value seen so
    far. It never shrinks: the brightness changes at most four times in a drive, each time because
    a pixel did not fit the old depth.

    A thermal camera's values are temperatures: a few, far from 0. If the first image is such a
    one, of those that are not flat, the range of its values is stretched to 8 bits instead. It
    never shrinks either.
    """

    def __init__(self) -> None:
        self.bits = _DEPTHS[0]
        self._window: tuple[int, int] | None = None
        self._undecided = True

    def to_8_bits(self, pixels: npt.NDArray[np.uint16]) -> GreyImage:
        """Return the upper 8 bits in use, or the range that is, same shape."""
        needed = int(pixels.max()).bit_length()
        self.bits = max(self.bits, next(depth for depth in _DEPTHS if depth >= needed))
        if self._undecided or self._window:
            # dead pixels are not counted
            low, high = map(int, np.percentile(pixels[::STEP, ::STEP], OF_PIXELS))
            if self._window:
                self._window = _widened(self._window, low, high)
            elif high - low >= FLAT:
                self._undecided = False
                if low << FAR_FROM_0 >= 1 << self.bits and (high - low) << FEW <= 1 << self.bits:
                    self._window = _widened((low, low + 1), low, high)
        if self._window:
            start, end = self._window
            scaled = (pixels.astype(np.int32) - start) * 256 // (end - start)
            return np.clip(scaled, 0, 255).astype(np.uint8)
        return (pixels >> (self.bits - 8)).astype(np.uint8)


def _widened(window: tuple[int, int], low: int, high: int) -> tuple[int, int]:
    """Return a range [start, end) with this one, and with low and high, in it; itself if it has.

    Its length is a power of two, and a quarter of that divides its start: it rarely changes.
    """
    start, end = window
    if start <= low and high < end and end - start >= LEAST_RANGE:
        return window
    low, high = min(start, low), max(end - 1, high)
    size = max(LEAST_RANGE, 1 << (high - low).bit_length())
    while low // (size // 4) * (size // 4) + size <= high:
        size *= 2
    start = low // (size // 4) * (size // 4)
    return start, start + size


@dataclass(frozen=True)
class _Layout:
    """How an encoding stores a pixel.

    channels, bits: of one pixel in a row of the message.
    conversion: OpenCV's, with GRAY or BGR for its star; '': the first channel is the grey value.
    planar: all pixels' brightness comes first, then their colours.
    """

    channels: int
    bits: int = 8
    conversion: str = ''
    planar: bool = False


_LAYOUTS = {
    'mono8': _Layout(1), 'mono16': _Layout(1, 16),
    '8uc1': _Layout(1), '8uc3': _Layout(3, 8, 'BGR2*'), '8uc4': _Layout(4, 8, 'BGRA2*'),
    '16uc1': _Layout(1, 16), '16uc3': _Layout(3, 16, 'BGR2*'), '16uc4': _Layout(4, 16, 'BGRA2*'),
    **{f'{order}{bits}': _Layout(len(order), bits, f'{order.upper()}2*')
       for bits in (8, 16) for order in ('bgr', 'rgb', 'bgra', 'rgba')},
    # ROS: yuv422 is U Y V Y, yuv422_yuy2 is Y U Y V
    **{name: _Layout(2, 8, 'YUV2*_UYVY') for name in ('yuv422', 'uyvy')},
    **{name: _Layout(2, 8, 'YUV2*_YUY2') for name in ('yuv422_yuy2', 'yuyv', 'yuy2')},
    **{name: _Layout(1, 8, f'YUV2*_{name.upper()}', planar=True)
       for name in ('nv12', 'nv21', 'i420')},
    'nv24': _Layout(1, planar=True),  # OpenCV does not know its colours
    # ROS and OpenCV name the colours of the first two rows so, from the corner on (OpenCV's older
    # names, BayerBG for rggb, start one pixel further down the diagonal)
    **{f'bayer_{name}{bits}': _Layout(1, bits, f'Bayer{name.upper()}2*')
       for bits in (8, 16) for name in ('rggb', 'bggr', 'gbrg', 'grbg')},
}


def decode(message: Any, depth: BitDepth | None = None, colour: bool = False) -> Pixels:
    """Decode a sensor_msgs/Image or CompressedImage: (height, width) uint8, a copy.

    message: has encoding, height, width, step, is_bigendian and data; or format and data: a JPEG,
    PNG, TIFF, WebP, BMP, PGM or PPM, whose EXIF orientation is not applied: nothing in ROS does.
    depth: the stream's bit depth, for 16-bit encodings; without it, only this image counts.
    colour: (height, width, 3) BGR uint8, unless the image is grey.

    Raises InputError for an unknown encoding, a size that does not fit the data, depth images,
    video streams, data that is cut off or damaged, and for more pixels than limits allow.
    """
    if _is_packed(message):
        message = _unpacked(message)
    if not hasattr(message, 'encoding'):
        # what turns images with their EXIF data are programs for photographs, not those of ROS
        pixels = decode_pixels(memoryview(message.data), _name(message), colour, as_stored=True)
        return _to_8_bits(pixels, depth)
    layout = _LAYOUTS.get(str(message.encoding).lower())
    if layout is None:
        raise InputError('E-IMAGE-ENCODING',
                         f'the encoding {message.encoding!r} is not supported: '
                         f'publish mono8, bgr8, rgb8, yuv422 or a Bayer encoding')
    colour = colour and bool(layout.conversion)
    pixels = _pixels(message, layout, colour)
    if layout.conversion and (colour or not layout.planar):
        image = _convert(pixels, layout.conversion.replace('*', 'BGR' if colour else 'GRAY'))
    else:
        image = np.array(pixels[..., 0], order='C')
    return _to_8_bits(image, depth)


def message_size(message: Any) -> tuple[int, int]:
    """Return (width, height) of an Image or CompressedImage message, without decoding it.

    Raises InputError where there is no size in it, or one beyond the limits.
    """
    if _is_packed(message):
        message, _ = _packed_image(message)
    if hasattr(message, 'encoding'):
        width, height = int(message.width), int(message.height)
        check_pixels(width, height)
        return width, height
    return _encoded_size(memoryview(message.data), _name(message))


def _is_packed(message: Any) -> bool:
    """Tell whether this is a message of zstd_image_transport: a raw image that is packed."""
    return str(getattr(message, 'format', '')).strip().lower() == 'zstd'


def _packed_image(message: Any) -> tuple[Any, bytes]:
    data = bytes(message.data)
    try:
        height, width, big, step, length = struct.unpack_from('<IIBII', data)
        text = data[_PACKED_HEAD:_PACKED_HEAD + length]
        encoding = text.decode('ascii')
    except (struct.error, UnicodeDecodeError) as error:
        raise _damaged('zstd image', len(data)) from error
    return SimpleNamespace(height=height, width=width, is_bigendian=big, step=step,
                           encoding=encoding), data[_PACKED_HEAD + length:]


def _unpacked(message: Any) -> Any:
    """Return the unpacked image: that transport packs by gzip, whatever its name says."""
    image, packed = _packed_image(message)
    check_pixels(image.width, image.height)
    limit = min(image.height * image.step, PICTURE_BYTES) + 1
    try:
        image.data = (zstd.ZstdDecompressor().decompress(packed, limit)
                      if packed.startswith(ZSTD_MAGIC) else
                      zlib.decompressobj(zlib.MAX_WBITS | 32).decompress(packed, limit))
    except (zlib.error, zstd.ZstdError) as error:
        raise _damaged('zstd image', len(packed)) from error
    return image


def _name(message: Any) -> str:
    name = ' '.join(str(message.format).split())
    if 'compresseddepth' in name.lower():
        raise InputError('E-IMAGE-DEPTH',
                         f'{name!r} is a depth image: choose the topic of a camera image')
    if any(video in name.lower() for video in _VIDEO_FORMATS):
        raise InputError('E-IMAGE-VIDEO', f'{name!r} is a video, and one packet of it is not a '
                         f'complete image: set image_transport:=video, or republish it as JPEG '
                         f'(image_transport republish)')
    what = f'{name or "compressed"} image'
    if (not any(each in what.lower() for each in _FORMATS)
            and encoded_size(memoryview(message.data)) is None):
        raise InputError('E-IMAGE-FORMAT', f'the format of {what!r} is not supported: publish or '
                         f'record it as JPEG or PNG (ros2 run image_transport republish)')
    return what


def decode_file(data: bytes | memoryview, depth: BitDepth | None = None,
                what: str = 'image', colour: bool = False) -> Pixels:
    """Decode the bytes of an image file: (height, width) uint8; an EXIF orientation is applied.

    colour: as for decode. Raises InputError as decode_pixels does.
    """
    return _to_8_bits(decode_pixels(data, what, colour), depth)


def turned_text(data: bytes, what: str) -> str:
    """Return how decode_file() turns the picture by its EXIF orientation; '' for not at all."""
    if not any(mark in data for mark in _EXIF):
        return ''
    try:
        shown, stored = (decode_pixels(data, what, as_stored=stored) for stored in (False, True))
    except InputError:
        return ''
    turns = [90 * n for n in range(4) if np.array_equal(np.rot90(stored, -n), shown)]
    if not turns:
        return 'mirrored'
    return f'rotated by {turns[0]} degrees' if turns[0] else ''


def decode_pixels(data: bytes | memoryview, what: str = 'image', colour: bool = False,
                  as_stored: bool = False) -> Pixels:
    """Decode the bytes of an image file: (height, width) of 8 or 16 bits.

    colour: as for decode. what: the image's name in errors. as_stored: an EXIF orientation is not
    applied. Raises InputError when the bytes are cut off or no image, or have more pixels or parts
    than limits allow.
    """
    data = bytes(data)
    # before memory and time are used
    _encoded_size(memoryview(data), what)
    _check_parts(data, what)
    buffer = np.frombuffer(data, np.uint8)
    head, tail = buffer[:2].tobytes(), buffer[-4096:].tobytes()
    if head == _JPEG_START and _JPEG_END not in tail:
        # OpenCV would fill the rest with grey
        raise InputError('E-IMAGE-TRUNCATED', f'{what} is truncated: record or copy it again')
    try:
        image = cv2.imdecode(
            buffer, cv2.IMREAD_ANYDEPTH
            | (cv2.IMREAD_ANYCOLOR if colour else cv2.IMREAD_GRAYSCALE)
            | (cv2.IMREAD_IGNORE_ORIENTATION if as_stored else 0))
    except cv2.error:
        image = None
    if image is None:
        raise _damaged(what, buffer.size)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError('E-IMAGE-PIXELS',
                         f'{what} has {image.dtype} pixels: save it with 8 or 16 bits per channel')
    return np.asarray(image)


def _encoded_size(data: memoryview, what: str) -> tuple[int, int]:
    size = encoded_size(data)
    if size is None:
        raise _damaged(what, len(data))
    check_pixels(*size, what)
    return size


def _check_parts(data: bytes, what: str) -> None:
    """Raise InputError for a file of which decoding would take far longer than its size tells."""
    if data[:2] == _JPEG_START:
        # also those of a thumbnail in it
        _check_count(data.count(_JPEG_SCAN), JPEG_SCANS, 'scans', what)
    elif data[:8] == _PNG_START:
        texts = 0
        place = len(_PNG_START)
        for count in itertools.count(1):
            if place + 8 > len(data):
                return
            size, kind = struct.unpack_from('>I4s', data, place)
            texts += kind in _PACKED
            _check_count(count, PNG_PARTS, 'parts', what)
            _check_count(texts, PNG_TEXTS, 'packed texts', what)
            place += size + 12
    elif data[:4] in _TIFF_STARTS:
        entries = _tiff_entries(data)
        # each is read for itself, also where many name the same bytes
        if sum(count * TIFF_BYTES.get(kind, 1) for _, kind, count, _ in entries) > 2 * len(data):
            raise InputError('E-IMAGE-DAMAGED',
                             f'{what} is damaged: its directory lists more data '
                             f'than the file has; save it again')


def _check_count(count: int, limit: int, parts: str, what: str) -> None:
    if count > limit:
        raise InputError('E-IMAGE-COMPLEX', f'{what} has more than {limit} {parts} and takes too '
                         f'long to decode: save it again')


def _damaged(what: str, size: int) -> InputError:
    return InputError('E-IMAGE-DAMAGED', f'{what} is damaged or has an unknown format ({size} '
                      f'bytes): record it again as JPEG or PNG')


def _pixels(message: Any, layout: _Layout, colour: bool) -> Pixels:
    """Return (height, width, channels); colour: of planar ones all rows, the colours last."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    check_pixels(width, height)
    row = width * layout.channels * layout.bits // 8
    fits = data.size >= step * height if layout.planar else data.size == step * height
    if step < row or not fits:
        raise InputError(
            'E-IMAGE-LAYOUT', f'an image of {width}x{height} pixels, {message.encoding}, step '
            f'{step} cannot have {data.size} bytes: check the camera driver or the recording')
    height = min(height * 3 // 2, data.size // step) if layout.planar and colour else height
    rows = data[:step * height].reshape(height, step)[:, :row]
    if layout.bits == 16:
        kind = '>u2' if message.is_bigendian else '<u2'
        rows = np.ascontiguousarray(rows).view(kind).astype(np.uint16)
    return rows.reshape(height, width, layout.channels)


def _convert(pixels: Pixels, conversion: str) -> Pixels:
    plain = np.ascontiguousarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels)
    if conversion == 'BGR2BGR':
        return plain
    try:
        return np.asarray(cv2.cvtColor(plain, getattr(cv2, f'COLOR_{conversion}')))
    except cv2.error as error:
        raise InputError('E-IMAGE-CONVERSION', f'an image of {plain.shape[1]}x{plain.shape[0]} '
                         f'pixels cannot be converted ({error.err}): publish mono8 or bgr8'
                         ) from error


def _to_8_bits(image: Pixels, depth: BitDepth | None) -> Pixels:
    if image.dtype == np.uint16:
        return (depth or BitDepth()).to_8_bits(image)
    return image


def read_mask(path: Path) -> Mask:
    """Read a mask picture: (height, width), True where it is not black; ~ is expanded.

    Raises InputError.
    """
    with suppress(RuntimeError):  # ~user of an unknown user: the path stays as it is
        path = path.expanduser()
    what = f'the mask {path}'
    data = read_file(path, PICTURE_BYTES, what)
    try:
        mask: Mask = decode_pixels(data) > 0
    except InputError as error:
        raise InputError(error.code, f'{what} cannot be used ({error}); use a PNG that is black '
                         'where the images must be ignored') from error
    if not mask.any():
        raise InputError('E-MASK-BLACK',
                         f'{what} is entirely black, so that nothing of the images '
                         f'is left; make the part to use white')
    return mask


def mask_of(given: object) -> Mask | None:
    """Return the mask that a user gave: a picture's path, or an array (height, width); or None.

    Raises InputError.
    """
    if given is None:
        return None
    if isinstance(given, (str, os.PathLike)):
        return read_mask(path_of(given))
    mask = np.asarray(given)
    if mask.ndim != 2 or mask.dtype.kind not in 'biuf':
        raise InputError('E-MASK-SHAPE', f'the mask has the shape {mask.shape} of {mask.dtype}: '
                                         f'pass the path of a picture, or numbers of shape '
                                         f'(height, width)')
    return np.asarray(mask > 0)


def check_mask(mask: Mask | None, size: tuple[int, int]) -> None:
    """Raise InputError unless the mask is as large as images of this (width, height)."""
    if mask is not None and (own := mask.shape[::-1]) != size:
        raise InputError('E-MASK-SIZE', f'the mask has {own[0]}x{own[1]} pixels and the images '
                         f'have {size[0]}x{size[1]}; make the mask as large as the images')


Size = tuple[int, int]

# start-of-frame markers of a JPEG; C4, C8 and CC are tables
FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
MARKER = re.compile(rb'\xff[^\xff]')
BARE = frozenset((0x01, *range(0xD0, 0xD8)))
# maximum number of markers before the size of a JPEG; cameras write 5 to 20
MARKERS = 1000
# width, height, tile width and tile height of a TIFF
TIFF_TAGS = (256, 257, 322, 323)
# bytes of a value of each type; others have 1
TIFF_BYTES = {3: 2, 4: 4, 5: 8, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
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
        if start[:8] == _PNG_START:
            return _pair('>II', start, 16)
        if start[:4] == b'RIFF' and start[8:12] == b'WEBP':
            return _webp_size(start)
        if start[:2] == b'BM':
            return _bmp_size(start)
        if start[:4] in _TIFF_STARTS:
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
        found = MARKER.search(data, place)
        if found is None or (place := found.start()) + 9 > len(data):
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
    sides = dict.fromkeys(TIFF_TAGS, 0)
    for tag, _, _, value in _tiff_entries(data):
        if tag in sides:
            sides[tag] = max(sides[tag], value)
    width, height, tile_width, tile_height = sides.values()
    if not width or not height:
        return None
    return max(width, tile_width), max(height, tile_height)


def _tiff_entries(data: bytes) -> list[tuple[int, int, int, int]]:
    """Return tag, type, count and value of each entry of the first directory.

    Raises InputError for too many, struct.error where the file ends before the last.
    """
    order = '<' if data[:2] == b'II' else '>'
    place, = struct.unpack_from(f'{order}I', data, 4)
    count, = struct.unpack_from(f'{order}H', data, place)
    _check_count(count, TIFF_ENTRIES, 'entries', 'a TIFF')
    entries = []
    for start in range(place + 2, place + 2 + 12 * count, 12):
        tag, kind, values = struct.unpack_from(f'{order}HHI', data, start)
        value, = struct.unpack_from(order + ('H' if kind == 3 else 'I'), data, start + 8)
        entries.append((tag, kind, values, value))
    return entries
