"""How large an image message's picture is, without decoding it where that can be avoided."""
from __future__ import annotations

from typing import Any

from dashcalib_ros.errors import InputError
from dashcalib_ros.frames.decode import decode_compressed

JPEG, PNG = b'\xff\xd8', b'\x89PNG\r\n\x1a\n'
# start-of-frame markers; C4, C8 and CC are tables
SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
BARE = frozenset((0x01, *range(0xD0, 0xD8)))


def encoded_size(data: memoryview) -> tuple[int, int] | None:
    """Return (width, height) as a JPEG's or PNG's header says; None if it says nothing."""
    if data[:2] == JPEG:
        return _jpeg_size(data)
    if data[:8] == PNG and len(data) >= 24:
        return int.from_bytes(data[16:20], 'big'), int.from_bytes(data[20:24], 'big')
    return None


def _jpeg_size(data: memoryview) -> tuple[int, int] | None:
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker in SIZES:
            return (int.from_bytes(data[place + 7:place + 9], 'big'),
                    int.from_bytes(data[place + 5:place + 7], 'big'))
        if marker == 0xFF:
            place += 1  # markers may be padded
        elif marker in BARE:
            place += 2
        else:
            place += 2 + int.from_bytes(data[place + 2:place + 4], 'big')
    return None


def image_size(message: Any) -> tuple[int, int]:
    """Return (width, height) of an Image or CompressedImage message.

    Raises InputError when it has none: neither a size in the header nor an image in the data.
    """
    if hasattr(message, 'encoding'):
        if message.width <= 0 or message.height <= 0:
            raise InputError(f'an image says it is {message.width}x{message.height}: the camera '
                             f'driver is broken')
        return message.width, message.height
    # formats other than JPEG and PNG are rare enough to be decoded for it
    size = encoded_size(memoryview(message.data))
    if size is None:
        height, width = decode_compressed(message).shape
        size = width, height
    return size
