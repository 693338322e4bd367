"""How large a compressed image is, without decoding it."""
from __future__ import annotations

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
