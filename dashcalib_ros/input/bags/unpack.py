"""Compressed files, chunks and messages of a bag are unpacked within limits."""
from __future__ import annotations

import bz2
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import rosbags.rosbag1.reader
import rosbags.rosbag2.storage_mcap
import zstandard

from dashcalib_ros.limits import CHUNK_BYTES, UnpackedFile, join_within

# bytes; of one step
PIECE = 2**20


def unpack_zstd(data: bytes, limit: int = CHUNK_BYTES) -> bytes:
    """Return the unpacked data; raises InputError beyond the limit, ZstdError for damage."""
    return join_within(zstandard.ZstdDecompressor().read_to_iter(data), limit, 'a part of the bag')


def unpack_lz4(data: bytes, limit: int = CHUNK_BYTES) -> bytes:
    """Return the unpacked data; raises InputError beyond the limit, RuntimeError for damage."""
    return join_within(_pieces(lz4.frame.LZ4FrameDecompressor(), data), limit, 'a part of the bag')


def unpack_bz2(data: bytes, limit: int = CHUNK_BYTES) -> bytes:
    """Return the unpacked data; raises InputError beyond the limit, OSError for damage."""
    return join_within(_pieces(bz2.BZ2Decompressor(), data), limit, 'a part of the bag')


def unpack_file(packed: Path, write: Callable[[bytes], Any], folder: Path | None) -> None:
    """Unpack a .zstd file; folder: where it is written, None where it is not kept.

    Raises InputError beyond limits, ZstdError for damage, OSError.
    """
    target: Any = UnpackedFile(packed, write, folder)  # copy_stream() needs write() only
    with packed.open('rb') as source:
        zstandard.ZstdDecompressor().copy_stream(source, target)


def _pieces(unpacker: Any, data: bytes) -> Iterator[bytes]:
    while True:
        piece = unpacker.decompress(data, PIECE)
        yield piece
        data = b''
        if unpacker.eof:
            return
        if not piece and unpacker.needs_input:
            raise EOFError('a packed part is cut off')


# rosbags' own functions have no limit
rosbags.rosbag2.storage_mcap.DECOMPRESSORS.update(
    zstd=lambda data, _: unpack_zstd(data), lz4=lambda data, _: unpack_lz4(data))
rosbags.rosbag1.reader.decompressors.update(bz2=unpack_bz2, lz4=unpack_lz4)
