"""The messages of a bag's file: by its index, or from its start as far as it is whole.

rosbags and mcap unpack chunks without a limit. Here each is unpacked within one: the two readers
do so by the index. Damaged files are scanned without it: a scanner yields messages in the order in
which they were written, and reports what it leaves out by calling `damage` with a short phrase.
"""
from __future__ import annotations

import bz2
import heapq
import sqlite3
import struct
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import lz4.frame
import rosbags.rosbag1.reader
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.interfaces import Connection
from rosbags.rosbag2.reader import DirectoryReader, Reader
from rosbags.rosbag2.storage_mcap import ChunkInfo, McapReader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from dashcalib_ros.errors import InputError, one_line
from dashcalib_ros.limits import CHUNK_BYTES, MESSAGE_BYTES, UnpackedFile, join_within

Damage = Callable[[str], None]
# bytes; of one step
PIECE = 2**20
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


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


@dataclass(frozen=True)
class Record:
    """A stored message.

    msgtype: as ROS 2 writes it (sensor_msgs/msg/Image), also for ROS 1.
    receive_ns: when the recorder got it, in nanoseconds.
    raw: serialised; ros1 tells how. Bags that compress each message have it compressed here.
    """

    topic: str
    msgtype: str
    receive_ns: int
    raw: bytes
    ros1: bool = False

    def message(self) -> Any:
        """Return the message itself; raises InputError when its bytes make none.

        The types are ROS's own, not the bag's: sensor_msgs' images never changed, and a bag with
        an invalid definition of another type can still be read.
        """
        try:
            if self.ros1:
                return _types(Stores.ROS1_NOETIC).deserialize_ros1(self.raw, self.msgtype)
            raw = self.raw
            if raw[:4] == _ZSTD_MAGIC:  # a CDR message never starts so
                raw = unpack_zstd(raw, MESSAGE_BYTES)
            return _types(Stores.ROS2_JAZZY).deserialize_cdr(raw, self.msgtype)
        except InputError as error:
            raise InputError(f'a message on {self.topic}: {error}') from error
        except Exception as error:  # rosbags lets struct.error, AssertionError ... out
            raise InputError(f'a damaged message on {self.topic}: record it again') from error


def ros2_type(name: str) -> str:
    """Return a message type as ROS 2 writes it: sensor_msgs/Image -> sensor_msgs/msg/Image."""
    package, slash, kind = name.partition('/')
    return f'{package}/msg/{kind}' if slash and '/' not in kind else name


@lru_cache
def _types(store: Stores) -> Typestore:
    return get_typestore(store)


def scan(path: Path, damage: Damage) -> Iterator[Record]:
    """Yield all messages of a storage file; its first bytes tell its kind. Raises only OSError."""
    with path.open('rb') as file:
        magic = file.read(16)
    if magic.startswith(b'\x89MCAP0\r\n'):
        yield from scan_mcap(path, damage)
    elif magic.startswith(b'SQLite format 3\0'):
        yield from scan_db3(path, damage)
    elif magic.startswith(b'#ROSBAG V2.0\n'):
        yield from scan_bag(path, damage)
    else:
        damage(f'{path.name} does not start like a bag')


def scan_mcap(path: Path, damage: Damage) -> Iterator[Record]:
    """Yield the messages of an MCAP file; a damaged chunk is left out, the next is tried."""
    schemas: dict[int, str] = {}
    channels: dict[int, Channel] = {}
    with path.open('rb') as file:
        limit = path.stat().st_size
        reader = StreamReader(file, emit_chunks=True, record_size_limit=limit)
        for record in _mcap_records(reader, path.name, damage):
            if isinstance(record, Schema):
                schemas[record.id] = ros2_type(record.name)
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                yield Record(channel.topic, schemas.get(channel.schema_id, ''), record.log_time,
                             record.data, ros1=channel.message_encoding == 'ros1')


def _mcap_records(reader: StreamReader, name: str, damage: Damage) -> Iterator[McapRecord]:
    records = reader.records
    while True:
        # damaged lengths and texts come out as any of these: the library does not wrap them
        try:
            record = next(records, None)
        except (McapError, struct.error, ValueError, MemoryError, OverflowError):
            damage(f'{name} is cut off')
            return
        if record is None:
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            inner = chunk_records(record)
        except Exception as error:  # also zstandard's and lz4's own errors
            damage(f'{name} has a broken chunk ({one_line(error)})')
            continue
        yield from inner


_ROWS = '''
    SELECT topic_id, timestamp, data FROM messages
    WHERE typeof(timestamp) = 'integer' AND typeof(data) = 'blob' ORDER BY id'''


def scan_db3(path: Path, damage: Damage) -> Iterator[Record]:
    """Yield the messages of an SQLite bag, by row."""
    uri = f'file:{quote(str(path.absolute()))}?mode=ro&immutable=1'
    database = sqlite3.connect(uri, uri=True)
    try:
        # else SQLite refuses a file that is shorter than its header says
        database.execute('PRAGMA writable_schema = ON')
        topics = {key: (name, kind) for key, name, kind in
                  database.execute('SELECT id, name, type FROM topics')}
        for topic, receive_ns, data in database.execute(_ROWS):
            if topic in topics:
                yield Record(*topics[topic], receive_ns, data)
    except sqlite3.DatabaseError as error:
        damage(f'{path.name}: {one_line(error)}')
    finally:
        database.close()


def scan_bag(path: Path, damage: Damage) -> Iterator[Record]:
    """Yield the messages of a ROS 1 bag."""
    connections: dict[int, tuple[str, str]] = {}
    with path.open('rb') as file:
        file.readline()
        try:
            yield from _bag_messages(file, connections)
        except (InputError, EOFError, struct.error, KeyError, ValueError, OSError, RuntimeError,
                MemoryError) as error:
            damage(f'{path.name} is cut off ({one_line(error)})')


def _bag_messages(file: BinaryIO, connections: dict[int, tuple[str, str]]) -> Iterator[Record]:
    while head := file.read(4):
        fields = _bag_fields(_exactly(file, *struct.unpack('<I', head)))
        size, = struct.unpack('<I', _exactly(file, 4))
        kind = fields['op'][0]
        data = file.read(size)
        if kind == 5:
            # a chunk that is cut off may have complete messages at its start
            unpack = UNPACK_BAG[fields['compression'].decode()]
            yield from _bag_messages(BytesIO(unpack(data)), connections)
        if len(data) < size:
            raise EOFError(f'{size - len(data)} bytes are missing')
        if kind == 7:
            number, = struct.unpack('<I', fields['conn'])
            connections[number] = (fields['topic'].decode(),
                                   ros2_type(_bag_fields(data)['type'].decode()))
        elif kind == 2:
            number, seconds, nanoseconds = struct.unpack('<III', fields['conn'] + fields['time'])
            yield Record(*connections[number], seconds * 10**9 + nanoseconds, data, ros1=True)


def _bag_fields(data: bytes) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    position = 0
    while position < len(data):
        size, = struct.unpack_from('<I', data, position)
        name, _, value = data[position + 4:position + 4 + size].partition(b'=')
        fields[name.decode()] = value
        position += 4 + size
    return fields


def _exactly(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise EOFError(f'{size - len(data)} bytes are missing')
    return data
