"""The messages of a bag's file: by its index, or from its start as far as it is whole.

A damaged file is scanned without its index: a scanner yields messages in the order in which they
were written, and reports what it leaves out by calling `damage` with a short phrase.
"""
from __future__ import annotations

import bz2
import errno
import os
import shutil
import struct
import sys
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from io import BufferedReader, BytesIO
from itertools import accumulate, chain, islice
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import apsw
import lz4.frame
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from rosbags import rosbag2
from rosbags.interfaces import Connection
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import storage_mcap, storage_sqlite3
from rosbags.typesys.msg import normalize_msgtype

from dashcalib_ros.errors import InputError, one_line
from dashcalib_ros.input.encodings import CDR, ENCODINGS, PROTOBUF, ROS1, message_of
from dashcalib_ros.input.source import first_of
from dashcalib_ros.limits import (
    CHUNK_BYTES,
    FREE_BYTES,
    INDEX_BYTES,
    MESSAGE_BYTES,
    OVERLAPPING_BYTES,
    RECORD_BYTES,
    SQLITE_STEPS,
    TOPICS,
    UNPACKED_LEAST,
    UNPACKED_RATIO,
)
from dashcalib_ros.whole_files import temporary_folder

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

Damage = Callable[[str], None]
# bytes of a file that are unpacked at once
PIECE = 2**20
# of the head of a record of a ROS 1 bag's index
INDEX_HEAD = 55
UNPACKERS: dict[str, Callable[[], Any]] = {
    'zstd': zstd.ZstdDecompressor, 'lz4': lz4.frame.LZ4FrameDecompressor,
    'bz2': bz2.BZ2Decompressor}
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


def unpack(kind: str, data: bytes, limit: int = CHUNK_BYTES) -> bytes:
    """Return unpacked data, `limit` bytes and those of a chunk at the most.

    kind: as bags name it; '' or none: it is not packed. Raises InputError beyond the limit; for
    damage what the libraries raise, and EOFError where it is cut off.
    """
    limit = min(limit, CHUNK_BYTES)
    unpacker = UNPACKERS[kind]() if kind not in ('', 'none') else None
    plain: bytes = data if unpacker is None else unpacker.decompress(data, limit + 1)
    if len(plain) > limit:
        raise InputError('E-BAG-TOO-LARGE', f'a part of the bag decompresses to more than '
                         f'{limit / 2**20:.0f} MB')
    if unpacker is not None and not unpacker.eof:
        raise EOFError('a compressed part is truncated')
    return plain


class _Unpacking:
    """Lets the chunks of a file unpack to no more, together, than a recording has."""

    def __init__(self, path: Path) -> None:
        self._limit = self._left = unpacked_limit(path)

    def check(self, size: int) -> None:
        """Raise InputError where so many bytes are too many."""
        if size > self._left:
            raise InputError('E-BAG-TOO-LARGE', f'its chunks decompress to more than '
                             f'{self._limit / 2**20:.0f} MB, too large for a recording')

    def through(self, unpacker: Callable[[bytes, int], bytes], data: bytes) -> bytes:
        """Return unpacked data, as unpack() does; raises InputError beyond the limit."""
        try:
            plain = unpacker(data, self._left)
        except InputError:
            self._left -= min(self._left, CHUNK_BYTES)
            raise
        self._left -= len(plain)
        return plain


def unpacked_limit(path: Path) -> int:
    """Return the bytes to which a file may be unpacked; raises OSError."""
    return max(UNPACKED_LEAST, UNPACKED_RATIO * path.stat().st_size)


class _WithinLimit:
    """Lets rosbags read within our limits, which it has not, while a reader of ours is open.

    It finds its unpackers in two tables, and SQLite its limits in a list of hooks. What else uses
    them in this process keeps its own as soon as the last reader is closed, in whatever order
    they are.
    """

    def __init__(self) -> None:
        self._readers = 0
        self._tables: tuple[tuple[dict[str, Any], dict[str, Any]], ...] = (
            (storage_mcap.DECOMPRESSORS, dict(storage_mcap.DECOMPRESSORS)),
            (rosbag1.decompressors, dict(rosbag1.decompressors)))

    def __enter__(self) -> None:
        self._readers += 1
        apsw.connection_hooks.append(_whole)
        for table, own in self._tables:
            table.update({kind: partial(unpack, kind) for kind in own})

    def __exit__(self, *error: object) -> None:
        self._readers -= 1
        apsw.connection_hooks.remove(_whole)
        if not self._readers:
            for table, own in self._tables:
                table.update(own)


WITHIN_LIMIT = _WithinLimit()


# views, virtual tables, generated columns and long defaults make contents that a file has not
_MADE = '''
    SELECT 1 FROM pragma_table_list AS t, pragma_table_xinfo(t.name) AS c WHERE t.schema = 'main'
    AND (t.type != 'table' OR c.hidden > 1 OR length(c.dflt_value) > 100) LIMIT 1'''
# several rows of a damaged file may have the same bytes
_SIZES = '''
    SELECT total(octet_length(data)), (SELECT count(*) FROM topics), (SELECT
    total(octet_length(name) + octet_length(type)) FROM topics) FROM messages'''


def _limited(database: apsw.Connection) -> None:
    """Let a database give what is stored in its tables, and its queries end.

    Raises apsw.Error where there is more, here and in its queries.
    """
    left = SQLITE_STEPS * max(Path(database.filename).stat().st_size, PIECE) // PIECE

    def endless() -> bool:
        nonlocal left
        left -= 1
        return left < 0
    database.limit(apsw.SQLITE_LIMIT_LENGTH, MESSAGE_BYTES)
    database.set_progress_handler(endless, PIECE)
    if list(database.execute(_MADE)):
        raise apsw.SQLError('it contains more than tables')


def _whole(database: apsw.Connection) -> None:
    """Limit a database that is to be read by its index; raises apsw.Error also for damage."""
    _limited(database)
    size = Path(database.filename).stat().st_size
    [(contents, topics, names)] = database.execute(_SIZES)
    if max(contents, names) > size or topics > TOPICS:
        raise apsw.SQLError('its rows contain more than the file')


class _McapReader(storage_mcap.McapReader):
    """rosbags' reader of an MCAP file that has an index of its chunks, within limits."""

    def read_index(self) -> None:
        """Read the index, and check it before anything is unpacked; raises InputError."""
        if Path(str(self.path)).stat().st_size - self.data_end > INDEX_BYTES:
            raise InputError('E-BAG-INDEX', 'the index is too large')
        super().read_index()
        sizes = [chunk.uncompressed_size for chunk in self.chunks]
        _Unpacking(Path(str(self.path))).check(sum(sizes))
        # the reader has all chunks of one time in memory
        ends = sorted((time, size) for chunk in self.chunks for time, size in (
            (chunk.message_start_time, chunk.uncompressed_size),
            (chunk.message_end_time + 1, -chunk.uncompressed_size)))
        if max(accumulate(size for _, size in ends), default=0) > max(
                OVERLAPPING_BYTES, max(sizes, default=0)):
            raise InputError('E-BAG-INDEX', 'too many chunks overlap')

    def messages_scan(self, *which: Any) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Read a file without an index of its chunks, once it is known what they unpack to."""
        _Unpacking(Path(str(self.path))).check(sum(self._chunk_sizes()))
        yield from super().messages_scan(*which)

    def _chunk_sizes(self) -> Iterator[int]:
        assert self.bio is not None
        place = self.data_start
        while place < self.data_end:
            self.bio.seek(place)
            head = self.bio.read(33)
            size = int.from_bytes(head[1:9], 'little')
            if size > RECORD_BYTES and head[0] in (Opcode.CHUNK, Opcode.MESSAGE):
                raise InputError('E-BAG-INDEX', 'a record is too large')
            if head[0] == Opcode.CHUNK:
                # behind the times of its first and last message
                yield int.from_bytes(head[25:33], 'little')
            place += 9 + size

    def meta_scan(self) -> None:
        """Leave a file without an index to scan_mcap()."""
        raise InputError('E-BAG-INDEX', 'the file has no index')


class _Ros1Reader(rosbag1.Reader):
    """rosbags' reader of a ROS 1 bag whose index names each part of the file once.

    _end: of the chunk before, with its index; _index_end: of what the counts of the head are of.
    """

    _end = _entries = _index_end = 0

    def read_connection(self) -> Connection:
        """Read a topic; raises InputError beyond limits."""
        assert self.bio is not None
        if Path(str(self.path)).stat().st_size - self.bio.tell() > INDEX_BYTES:
            raise InputError('E-BAG-INDEX', 'the index is too large')
        return super().read_connection()

    def read_chunk_info(self) -> rosbag1.ChunkInfo:
        """Read where a chunk is."""
        info = super().read_chunk_info()
        assert self.bio is not None
        self._index_end = self.bio.tell()
        return info

    def read_chunk(self) -> rosbag1.Chunk:
        """Read a chunk's head; raises InputError where it is a part of the one before."""
        assert self.bio is not None
        if self.bio.tell() < self._end:
            raise InputError('E-BAG-INDEX', 'chunks overlap')
        return super().read_chunk()

    def read_index_data(self, pos: int, indexes: dict[int, list[rosbag1.IndexData]]) -> None:
        """Read where a topic's messages are in a chunk; raises InputError beyond limits."""
        assert self.bio is not None
        head = self.bio.read(INDEX_HEAD)
        self._entries += int.from_bytes(head[-4:], 'little')
        if self._entries > INDEX_BYTES:
            raise InputError('E-BAG-INDEX', 'the index is too large')
        self.bio.seek(-len(head), os.SEEK_CUR)
        super().read_index_data(pos, indexes)
        self._end = self.bio.tell()

    def open(self) -> None:
        """Open the file; its chunks are unpacked within limits."""
        super().open()
        if self._index_end != Path(str(self.path)).stat().st_size:
            self.close()
            raise InputError('E-BAG-INDEX', 'the file is longer than its header indicates')
        unpacking = _Unpacking(Path(str(self.path)))
        for pos, chunk in self.chunks.items():
            # the one of the table, which takes a limit
            own: Any = chunk.decompressor
            self.chunks[pos] = chunk._replace(decompressor=partial(unpacking.through, own))


class _FolderReader(rosbag2.reader.DirectoryReader):
    """rosbags' reader of a folder with metadata.yaml, within limits."""

    STORAGE_PLUGINS: Mapping[str, Any] = {'mcap': _McapReader,
                                          'sqlite3': storage_sqlite3.Sqlite3Reader}


class Reader2(rosbag2.Reader):
    """rosbags' reader of a ROS 2 bag; within limits while WITHIN_LIMIT is entered."""

    STORAGE_PLUGINS: Mapping[str, Any] = {'dir': _FolderReader, '.mcap': _McapReader,
                                          '.db3': storage_sqlite3.Sqlite3Reader}


@contextmanager
def unpacked(file: Path, damage: Damage) -> Iterator[Path]:
    """Give the file; of a .zstd file, a temporary copy of what could be unpacked.

    Also of an SQLite file whose recorder was killed: its last messages are in a journal beside
    it. Raises InputError where a copy is too much for a recording or for the disk; OSError.
    """
    packed = file.suffix.lower() == '.zstd'
    journals = [] if packed else _journals(file)
    if not packed and not journals:
        yield file
        return
    with temporary_folder() as folder:
        plain = folder / (file.stem if packed else file.name)
        try:
            if packed:
                _unpack_file(file, plain)
            else:
                _complete(file, journals, plain)
                damage(f'{file.name} was not closed; its last messages are read from '
                       f'{first_of([each.name for each in journals])}')
        except (zstd.ZstdError, EOFError):
            damage(f'{file.name} is damaged')
        except apsw.Error as error:
            damage(f'{file.name} was not closed, and {journals[0].name} with its last messages '
                   f'cannot be used ({one_line(error)})')
            plain = file
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            raise InputError(
                'E-DISK-FULL',
                f'not enough disk space to decompress {file} in {folder}: set TMPDIR to a larger '
                f'disk, or decompress the file first (zstd -d)' if packed else
                f'{file} was not closed, and there is not enough disk space to copy it to '
                f'{folder}: set TMPDIR to a larger disk, or close the file first '
                f'(sqlite3 {file.name} .schema)') from error
        yield plain


def _unpack_file(packed: Path, plain: Path) -> None:
    limit = unpacked_limit(packed)
    with zstd.open(packed, 'rb') as source:
        for size in _copied(source.read1, plain):
            if size > limit:
                raise InputError(
                    'E-BAG-TOO-LARGE', f'{packed} decompresses to more than '
                    f'{limit / 2**20:.0f} MB, too large for a recording; if it is one, '
                    f'decompress it first (zstd -d)')


def _copied(read: Callable[[int], bytes], plain: Path) -> Iterator[int]:
    """Write what is read to a file; yield its size before each piece. Leaves FREE_BYTES free."""
    with plain.open('wb', PIECE) as output:
        while piece := read(PIECE):
            yield output.tell() + len(piece)
            if shutil.disk_usage(plain.parent).free < FREE_BYTES:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            output.write(piece)


def _journals(file: Path) -> list[Path]:
    """Return what SQLite has beside a file that was not closed: messages that are not in it yet.

    A rollback journal is one too: what is half-written in the file is in it as it was before.
    """
    beside = (file.with_name(f'{file.name}{end}') for end in ('-wal', '-journal'))
    return [each for each in beside if each.is_file() and each.stat().st_size]


def _complete(file: Path, journals: Sequence[Path], plain: Path) -> None:
    """Make a copy of a database with what its journals have; raises OSError, apsw.Error.

    Opening the file itself would write to it.
    """
    for source in (file, *journals):
        with source.open('rb') as stream:
            target = plain.with_name(f'{plain.name}{source.name.removeprefix(file.name)}')
            for _ in _copied(stream.read, target):
                pass
    with closing(apsw.Connection(str(plain))) as database:
        database.execute('PRAGMA schema_version').fetchone()  # takes a rollback journal
        _, frames, _ = database.execute('PRAGMA wal_checkpoint').fetchone() or (0, 0, 0)
        if not frames:
            raise apsw.Error('it has no complete message')
        database.execute('PRAGMA journal_mode = DELETE')


@dataclass(frozen=True)
class Record:
    """A stored message.

    msgtype: as ROS 2 writes it (sensor_msgs/msg/Image), also for ROS 1.
    receive_ns: when the recorder got it, in nanoseconds.
    raw: serialised; encoding tells how (input/encodings.py), and of protobuf schema. Bags that
    compress each message have it compressed here.
    """

    topic: str
    msgtype: str
    receive_ns: int
    raw: bytes
    encoding: str = CDR
    schema: bytes = b''

    def message(self) -> Any:
        """Return the message itself; raises InputError when its bytes make none."""
        try:
            raw = self.raw
            if self.encoding == CDR and raw[:4] == _ZSTD_MAGIC:  # a CDR message never starts so
                raw = unpack('zstd', raw, MESSAGE_BYTES)
            return message_of(self.msgtype, self.encoding, raw, self.schema)
        except InputError as error:
            raise InputError(error.code, f'a message on {self.topic}: {error}') from error
        except Exception as error:  # struct.error, AssertionError, DecodeError ...
            raise InputError('E-MESSAGE-DAMAGED',
                             f'a message on {self.topic} is damaged: record it again') from error


def message_counts(file: Path, damage: Damage) -> tuple[Counter[tuple[str, str]], bool]:
    """Return the numbers of messages by topic and type, and whether the file's index has them."""
    counts = Counter[tuple[str, str]]()
    with unpacked(file, damage) as path:
        try:
            with WITHIN_LIMIT, _reader(path) as reader:
                for connection in reader.connections:
                    counts[connection.topic, connection.msgtype] += connection.msgcount
            # what a journal has that cannot be used is not counted
            return counts, path != file or not _journals(file)
        except Exception:  # a damaged file makes rosbags raise nearly anything
            return Counter((record.topic, record.msgtype) for record in scan(path, damage)), False


def records(file: Path, topics: Collection[str], damage: Damage) -> Iterator[Record]:
    """Yield a file's messages of these topics, where they can be read.

    Raises InputError, OSError.
    """
    with unpacked(file, damage) as path:
        last_ns = -1
        try:
            for record in _indexed_records(path, topics):
                last_ns = record.receive_ns
                yield record
            return
        except Exception:  # a damaged file makes rosbags raise nearly anything
            pass
        for record in scan(path, damage):
            if record.topic in topics and record.receive_ns > last_ns:
                yield record


def _indexed_records(path: Path, topics: Collection[str]) -> Iterator[Record]:
    with WITHIN_LIMIT, _reader(path) as reader:
        wanted = [each for each in reader.connections if each.topic in topics]
        missing = sum(connection.msgcount for connection in wanted)
        if not wanted:
            return
        encoding = ROS1 if isinstance(reader, rosbag1.Reader) else CDR
        for connection, receive_ns, raw in reader.messages(wanted):
            missing -= 1
            yield Record(connection.topic, connection.msgtype, receive_ns, bytes(raw), encoding)
        if missing > 0:
            raise ValueError('the index does not list all messages')


def _reader(path: Path) -> rosbag1.Reader | rosbag2.Reader:
    with path.open('rb') as file:
        return _Ros1Reader(path) if file.read(7) == b'#ROSBAG' else Reader2(path)


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
        damage(f'{path.name} does not have the header of a bag')


def scan_mcap(path: Path, damage: Damage) -> Iterator[Record]:
    """Yield the messages of an MCAP file; a damaged chunk is left out, the next is tried."""
    for schema, channel, message in mcap_contents(path, damage):
        yield record_of(schema, channel, message)


def record_of(schema: Schema | None, channel: Channel, message: Message) -> Record:
    """Return what an MCAP file stores, as a record."""
    encoding = channel.message_encoding
    name = schema.name if schema else ''
    name = normalize_msgtype(name) if '/' in name else name
    # an unsupported one is shown with the type
    kind = name if encoding in ENCODINGS else f'{name} in {encoding or "no encoding"}'
    return Record(channel.topic, kind, message.log_time, message.data, encoding,
                  schema.data if schema and encoding == PROTOBUF else b'')


def mcap_contents(path: Path, damage: Damage) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """Yield the messages of an MCAP file with their topics and types, as scan_mcap() does."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with path.open('rb') as file:
        limit = min(path.stat().st_size, RECORD_BYTES)
        repeated = _repeated(file, limit)
        reader = StreamReader(file, emit_chunks=True, record_size_limit=limit)
        for record in chain(repeated, _mcap_records(reader, _Unpacking(path), path.name, damage)):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                yield schemas.get(channel.schema_id), channel, record


def has_other_encodings(path: Path) -> bool:
    """Return whether an MCAP file's index names messages that are no CDR."""
    with path.open('rb') as file:
        return any(isinstance(each, Channel) and each.message_encoding != CDR
                   for each in _repeated(file, min(path.stat().st_size, RECORD_BYTES)))


def _repeated(file: BinaryIO, limit: int) -> list[McapRecord]:
    """Return the topics and types that an MCAP file repeats at its end, nothing if it is cut off.

    Else the first chunk, which has them too, would cost all others when it is broken.
    """
    try:
        file.seek(-FOOTER_SIZE - MAGIC_SIZE, os.SEEK_END)
        footer: Any = next(StreamReader(file, skip_magic=True, record_size_limit=limit).records)
        if file.seek(0, os.SEEK_END) - footer.summary_start > INDEX_BYTES:
            return []
        file.seek(footer.summary_start)
        reader = StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=limit)
        return [record for record in reader.records if isinstance(record, (Schema, Channel))]
    except Exception:  # there are no limits to what a damaged file makes of these numbers
        return []
    finally:
        file.seek(0)


def _mcap_records(reader: StreamReader, unpacking: _Unpacking, name: str, damage: Damage
                  ) -> Iterator[McapRecord]:
    records = reader.records
    while True:
        # damaged lengths and texts come out as any of these: the library does not wrap them
        try:
            record = next(records, None)
        except (McapError, struct.error, ValueError, MemoryError, OverflowError):
            damage(f'{name} is truncated')
            return
        if record is None:
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            plain = unpacking.through(partial(unpack, record.compression), record.data)
            inner = breakup_chunk(replace(record, compression='', data=plain), validate_crc=True)
        except Exception as error:  # also the unpackers' own errors
            damage(f'{name} has a damaged chunk ({one_line(error)})')
            continue
        yield from inner


_ROWS = '''
    SELECT topic_id, timestamp, data FROM messages
    WHERE typeof(timestamp) = 'integer' AND typeof(data) = 'blob' AND octet_length(data) <= ?'''


def scan_db3(path: Path, damage: Damage) -> Iterator[Record]:
    """Yield the messages of an SQLite bag, by row."""
    uri = f'file:{quote(str(path.absolute()))}?mode=ro&immutable=1'
    database = apsw.Connection(uri, apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI)
    left = path.stat().st_size
    try:
        # else SQLite refuses a file that is shorter than its header says
        database.execute('PRAGMA writable_schema = ON')
        _limited(database)
        topics = {key: (name, kind) for key, name, kind in
                  islice(database.execute('SELECT id, name, type FROM topics'), TOPICS)}
        for topic, receive_ns, data in database.execute(_ROWS, (left,)):
            left -= len(data)
            if left < 0:
                raise apsw.SQLError('its rows contain more than the file')
            if topic in topics:
                yield Record(*topics[topic], receive_ns, data)
    except apsw.Error as error:
        damage(f'{path.name}: {one_line(error)}')
    finally:
        database.close()


def scan_bag(path: Path, damage: Damage) -> Iterator[Record]:
    """Yield the messages of a ROS 1 bag."""
    with path.open('rb') as file:
        file.readline()
        try:
            yield from _bag_messages(file, {}, _Unpacking(path))
        except Exception as error:  # rosbags' errors, and those of what unpacks
            damage(f'{path.name} is truncated ({one_line(error)})')


def _bag_messages(file: BufferedReader, connections: dict[int, tuple[str, str]],
                  unpacking: _Unpacking, inside: bool = False) -> Iterator[Record]:
    while file.peek(1):
        head = rosbag1.Header.read(file)
        kind = head.get_uint8('op')
        if kind == rosbag1.RecordType.CONNECTION:
            about = rosbag1.Header.read(file)
            connections[head.get_uint32('conn')] = (
                head.get_string('topic'), normalize_msgtype(about.get_string('type')))
            continue
        size = rosbag1.read_uint32(file)
        data = file.read(size)
        if kind == rosbag1.RecordType.CHUNK and not inside:
            # a chunk that is cut off may have complete messages at its start
            plain = unpacking.through(partial(unpack, head.get_string('compression')), data)
            yield from _bag_messages(BufferedReader(BytesIO(plain)), connections, unpacking, True)
        if len(data) < size:
            raise EOFError(f'{size - len(data)} bytes are missing')
        if kind == rosbag1.RecordType.MSGDATA:
            yield Record(*connections[head.get_uint32('conn')], head.get_time('time'), data,
                         ROS1)
