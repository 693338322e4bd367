"""The messages of a bag; damaged ones are read from the start, without index, as far as possible.

Each scanner yields messages in the order in which they were written, up to the end of the file.
It reports what it leaves out by calling `damage` with a short phrase.
"""
from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from dashcalib_ros.errors import InputError, one_line
from dashcalib_ros.input.bag_unpack import UNPACK_BAG, chunk_records, unpack_zstd
from dashcalib_ros.limits import MESSAGE_BYTES

Damage = Callable[[str], None]

_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


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
