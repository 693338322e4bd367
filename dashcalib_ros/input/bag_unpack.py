"""Compressed files, chunks and messages of a bag are unpacked within limits.

rosbags unpacks without one. Its readers are used through the two classes here.
"""
from __future__ import annotations

import bz2
import heapq
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import lz4.frame
import rosbags.rosbag1.reader
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.records import Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.interfaces import Connection
from rosbags.rosbag2.reader import DirectoryReader, Reader
from rosbags.rosbag2.storage_mcap import ChunkInfo, McapReader

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


UNPACK_MCAP: dict[str, Callable[[bytes], bytes]] = {'zstd': unpack_zstd, 'lz4': unpack_lz4}
UNPACK_BAG: dict[str, Callable[[bytes], bytes]] = {
    'none': bytes, 'bz2': unpack_bz2, 'lz4': unpack_lz4}


def chunk_records(chunk: Chunk) -> list[McapRecord]:
    """Return what is in a chunk of an MCAP file.

    Raises InputError beyond the limit; for damage what mcap, zstandard and lz4 raise.
    """
    unpack = UNPACK_MCAP.get(chunk.compression, bytes)
    plain = replace(chunk, compression='', data=unpack(chunk.data))
    return breakup_chunk(plain, validate_crc=True)


class Ros1Reader(rosbags.rosbag1.reader.Reader):
    """Reads a ROS 1 bag by its index."""

    def read_chunk(self) -> rosbags.rosbag1.reader.Chunk:
        """Return a chunk's place, and what unpacks it."""
        chunk = super().read_chunk()
        names = {function: name for name, function in rosbags.rosbag1.reader.decompressors.items()}
        return chunk._replace(decompressor=UNPACK_BAG[names[chunk.decompressor]])


class _McapFile(McapReader):

    def meta_scan(self) -> None:
        """Read a file without an index. Its chunks are tried first: rosbags unpacks them all."""
        assert self.bio
        self.bio.seek(0)
        size = Path(str(self.path)).stat().st_size
        for record in StreamReader(self.bio, emit_chunks=True, record_size_limit=size).records:
            if isinstance(record, Chunk):
                chunk_records(record)
        self.bio.seek(self.data_start)
        super().meta_scan()

    def messages(self, connections: Collection[Connection], start: int | None = None,
                 stop: int | None = None) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Yield topic, time of reception in ns and bytes of messages, by time.

        start, stop: as rosbags has them; nothing here gives them.
        """
        if not self.chunks or start is not None or stop is not None:
            yield from super().messages(connections, start, stop)
            return
        wanted = {each.id: each for each in connections}
        chunks = [self._chunk_messages(chunk, wanted) for chunk in self.chunks
                  if any(chunk.channel_count.get(each, 0) for each in wanted)]
        for time_ns, _, message in heapq.merge(*chunks, key=lambda each: each[:2]):
            if message is not None:
                yield wanted[message.channel_id], time_ns, message.data

    def _chunk_messages(self, info: ChunkInfo, wanted: Mapping[int, Connection]
                        ) -> Iterator[tuple[int, int, Message | None]]:
        """Yield a chunk's messages by time; first its start, so that it is not unpacked yet."""
        yield info.message_start_time, 0, None
        assert self.bio
        self.bio.seek(info.chunk_start_offset + 9)  # behind its kind and its length
        chunk = Chunk.read(ReadDataStream(self.bio))
        messages = [each for each in chunk_records(chunk)
                    if isinstance(each, Message) and each.channel_id in wanted
                    and info.message_start_time <= each.log_time <= info.message_end_time]
        for message in sorted(messages, key=lambda each: each.log_time):
            yield message.log_time, info.chunk_start_offset, message


class _Folder(DirectoryReader):
    STORAGE_PLUGINS: Mapping[str, Any] = {**DirectoryReader.STORAGE_PLUGINS, 'mcap': _McapFile}


class Ros2Reader(Reader):
    """Reads a ROS 2 bag, a folder or a file, by its index."""

    STORAGE_PLUGINS: Mapping[str, Any] = {
        **Reader.STORAGE_PLUGINS, 'dir': _Folder, '.mcap': _McapFile}
