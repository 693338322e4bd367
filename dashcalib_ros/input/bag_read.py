# SPDX-License-Identifier: Apache-2.0
"""The messages of a bag's file: by its index, or from its start as far as it is whole.

A damaged file is scanned without its index: a scanner yields messages in the order in which they
were written, and reports what it leaves out by calling `damage` with a short phrase.
"""
from __future__ import annotations

import bz2
import errno
import heapq
import os
import shutil
import struct
import sys
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from io import BufferedReader, BytesIO
from itertools import accumulate, chain, islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar
from urllib.parse import quote

import apsw
import lz4.frame
import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from rosbags import rosbag2
from rosbags.interfaces import Connection
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import storage_mcap, storage_sqlite3
from rosbags.typesys.msg import normalize_msgtype

from dashcalib_ros.errors import InputError, Notice, one_line
from dashcalib_ros.input.decode import ZSTD_MAGIC
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

Damage = Callable[[Notice], None]
# bytes of a file that are unpacked at once
PIECE = 2**20
# of the head of a record of a ROS 1 bag's index
INDEX_HEAD = 55
# how an MCAP file and a ROS 1 bag begin
_MCAP, _ROS1 = b'\x89MCAP0\r\n', b'#ROSBAG V2.0\n'
# of a record of an MCAP file its kind and size; of a chunk its first and last time and its size
# unpacked; of a message its channel, number and time
_HEAD, _CHUNK, _MESSAGE = map(struct.Struct, ('<BQ', '<QQQ', '<HIQ'))
T = TypeVar('T')
UNPACKERS: dict[str, Callable[[], Any]] = {
    'zstd': zstd.ZstdDecompressor, 'lz4': lz4.frame.LZ4FrameDecompressor,
    'bz2': bz2.BZ2Decompressor}


class TooMuchError(apsw.SQLError):
    """A database has more than a recording has."""

    code = 'E-BAG-TOO-LARGE'


def unpack(kind: str, data: bytes, limit: int = CHUNK_BYTES) -> bytes:
    """Return unpacked data: at most `limit` bytes and those of a chunk.

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
        self._left = unpacked_limit(path)

    def through(self, unpacker: Callable[[bytes, int], bytes], data: bytes) -> bytes:
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


@contextmanager
def within_limit() -> Iterator[None]:
    """Let rosbags read a database within our limits, which SQLite finds in a list of hooks."""
    apsw.connection_hooks.append(_whole)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(_whole)


# views, virtual tables, generated columns and long defaults make contents that a file has not
_MADE = '''
    SELECT 1 FROM pragma_table_list AS t, pragma_table_xinfo(t.name) AS c WHERE t.schema = 'main'
    AND (t.type != 'table' OR c.hidden > 1 OR length(c.dflt_value) > 100) LIMIT 1'''
# several rows of a damaged file may have the same bytes
_SIZES = '''
    SELECT total(octet_length(data)), (SELECT count(*) FROM topics), (SELECT
    total(octet_length(name) + octet_length(type)) FROM topics) FROM messages'''


def limited(database: apsw.Connection) -> None:
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
        raise TooMuchError('it contains more than tables')


def _whole(database: apsw.Connection) -> None:
    """Limit a database that is to be read by its index; raises apsw.Error also for damage."""
    limited(database)
    size = Path(database.filename).stat().st_size
    [(contents, topics, names)] = database.execute(_SIZES)
    if max(contents, names) > size or topics > TOPICS:
        raise TooMuchError('its rows contain more than the file')


class _McapReader(storage_mcap.McapReader):
    """rosbags' reader of an MCAP file that has an index; its messages are those of McapFile."""

    def read_index(self) -> None:
        if Path(str(self.path)).stat().st_size - self.data_end > INDEX_BYTES:
            raise InputError('E-BAG-INDEX', 'the index is too large')
        super().read_index()
        if any(each.schema == '__schemaless__' for each in self.channels.values()):
            raise InputError('E-BAG-TYPE-MISSING', 'the type of a topic is missing in the file')

    def messages(self, connections: Collection[Connection], *limits: Any
                 ) -> Generator[tuple[Connection, int, bytes], None, None]:
        wanted = {each.id: each for each in connections}
        for _, channel, message in mcap_contents(
                Path(str(self.path)), refuse, {each.topic for each in connections}):
            if channel.id in wanted:
                yield wanted[channel.id], message.log_time, message.data

    def meta_scan(self) -> None:
        """Leave a file without an index to McapFile."""
        raise InputError('E-BAG-INDEX', 'the file has no index')


class _Ros1Reader(rosbag1.Reader):
    """rosbags' reader of a ROS 1 bag whose index names each part of the file once.

    _end: of the chunk before, with its index; _index_end: of what the counts of the head are of.
    """

    _end = _entries = _index_end = 0

    def read_connection(self) -> Connection:
        assert self.bio is not None
        if Path(str(self.path)).stat().st_size - self.bio.tell() > INDEX_BYTES:
            raise InputError('E-BAG-INDEX', 'the index is too large')
        return super().read_connection()

    def read_chunk_info(self) -> rosbag1.ChunkInfo:
        info = super().read_chunk_info()
        assert self.bio is not None
        self._index_end = self.bio.tell()
        return info

    def read_chunk(self) -> rosbag1.Chunk:
        assert self.bio is not None
        if self.bio.tell() < self._end:
            raise InputError('E-BAG-INDEX', 'chunks overlap')
        chunk = super().read_chunk()
        # ours take a limit
        kind = next(kind for kind, own in rosbag1.decompressors.items()
                    if own is chunk.decompressor)
        return chunk._replace(decompressor=partial(unpack, kind))

    def read_index_data(self, pos: int, indexes: dict[int, list[rosbag1.IndexData]]) -> None:
        assert self.bio is not None
        head = self.bio.read(INDEX_HEAD)
        self._entries += int.from_bytes(head[-4:], 'little')
        if self._entries > INDEX_BYTES:
            raise InputError('E-BAG-INDEX', 'the index is too large')
        self.bio.seek(-len(head), os.SEEK_CUR)
        super().read_index_data(pos, indexes)
        self._end = self.bio.tell()

    def open(self) -> None:
        super().open()
        if self._index_end != Path(str(self.path)).stat().st_size:
            self.close()
            raise InputError('E-BAG-INDEX', 'the file is longer than its header indicates')
        unpacking = _Unpacking(Path(str(self.path)))
        for pos, chunk in self.chunks.items():
            own: Any = chunk.decompressor
            self.chunks[pos] = chunk._replace(decompressor=partial(unpacking.through, own))


class _FolderReader(rosbag2.reader.DirectoryReader):
    STORAGE_PLUGINS: Mapping[str, Any] = {'mcap': _McapReader,
                                          'sqlite3': storage_sqlite3.Sqlite3Reader}


class Reader2(rosbag2.Reader):
    """rosbags' reader of a ROS 2 bag; databases within limits in within_limit()."""

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
                damage(_because(f'{file.name} was not closed; its last messages are read from '
                                f'{first_of([each.name for each in journals])}'))
        except (zstd.ZstdError, EOFError):
            damage(_because(f'{file.name} is damaged'))
        except apsw.Error as error:
            damage(_because(f'{file.name} was not closed, and {journals[0].name} with its last '
                            f'messages cannot be used ({one_line(error)})'))
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

    msgtype: as ROS 2 writes it (sensor_msgs/msg/Image), also for ROS 1; '' where it is missing.
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
            if self.encoding == CDR and raw[:4] == ZSTD_MAGIC:  # a CDR message never starts so
                raw = unpack('zstd', raw, MESSAGE_BYTES)
            return message_of(self.msgtype, self.encoding, raw, self.schema)
        except InputError as error:
            raise InputError(error.code, f'a message on {self.topic}: {error}') from error
        except Exception as error:  # struct.error, AssertionError, DecodeError ...
            raise InputError('E-MESSAGE-DAMAGED',
                             f'a message on {self.topic} is damaged: record it again') from error


def message_counts(file: Path, damage: Damage) -> tuple[Counter[tuple[str, str]], bool]:
    """Return the numbers of messages by topic and type, and whether the file's index has them."""
    with unpacked(file, damage) as path:
        try:
            # what a journal has that cannot be used is not counted
            return _counts_in_index(path), path != file or not _journals(file)
        except Exception:  # a damaged file makes rosbags raise nearly anything
            return Counter((record.topic, record.msgtype) for record in scan(path, damage)), False


def _counts_in_index(path: Path) -> Counter[tuple[str, str]]:
    if _magic(path).startswith(_MCAP):
        with McapFile(path, refuse) as contents:
            return contents.counts()
    counts = Counter[tuple[str, str]]()
    with within_limit(), _reader(path) as reader:
        for connection in reader.connections:
            counts[connection.topic, connection.msgtype] += connection.msgcount
    return counts


def records(file: Path, topics: Collection[str], damage: Damage) -> Iterator[Record]:
    """Yield a file's messages of these topics by time, where they can be read.

    Raises InputError, OSError.
    """
    with unpacked(file, damage) as path:
        # of the last time, by topic
        last_ns, given = -1, Counter[str]()
        if not _magic(path).startswith(_MCAP):
            try:
                for record in _indexed_records(path, topics):
                    if record.receive_ns > last_ns:
                        last_ns, given = record.receive_ns, Counter()
                    given[record.topic] += 1
                    yield record
                return
            except Exception:  # a damaged file makes rosbags raise nearly anything
                pass
        for record in scan(path, damage, topics):
            if record.receive_ns == last_ns and given[record.topic]:
                given[record.topic] -= 1
            elif record.receive_ns >= last_ns:
                yield record


def begin_ns(file: Path, topics: Collection[str]) -> int | None:
    """Return the first time of a message of these topics in a file, None where there is none."""
    return _begin_ns(file, frozenset(topics), file.stat().st_mtime_ns)


@lru_cache(maxsize=10_000)
def _begin_ns(file: Path, topics: Collection[str], _changed_ns: int) -> int | None:
    return next((each.receive_ns for each in records(file, topics, lambda _: None)), None)


def by_time(parts: Iterable[tuple[int, Callable[[], Iterable[T]]]], time_of: Callable[[T], int]
            ) -> Iterator[T]:
    """Yield what several parts have in the order of time; of the same time, in that of the parts.

    parts: the first time of each, when it is opened, and what opens it. Each is in order itself.
    """
    waiting = sorted(((start, n, opened) for n, (start, opened) in enumerate(parts)),
                     key=lambda part: part[:2], reverse=True)
    active: list[tuple[int, int, T, Iterator[T]]] = []
    while waiting or active:
        if waiting and (not active or waiting[-1][:2] < active[0][:2]):
            _, n, opened = waiting.pop()
            rest = iter(opened())
        else:
            _, n, item, rest = heapq.heappop(active)
            yield item
        for item in rest:
            heapq.heappush(active, (time_of(item), n, item, rest))
            break


def _indexed_records(path: Path, topics: Collection[str]) -> Iterator[Record]:
    with within_limit(), _reader(path) as reader:
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
    return _Ros1Reader(path) if _magic(path).startswith(_ROS1) else Reader2(path)


def _magic(path: Path) -> bytes:
    with path.open('rb') as file:
        return file.read(16)


def scan(path: Path, damage: Damage, topics: Collection[str] | None = None) -> Iterator[Record]:
    """Yield the messages of a storage file, whose first bytes tell its kind. Raises only OSError.

    topics: of these; None: all.
    """
    magic = _magic(path)
    if magic.startswith(_MCAP):
        for found in mcap_contents(path, damage, topics):
            yield record_of(*found)
        return
    if magic.startswith(b'SQLite format 3\0'):
        found_in = scan_db3(path, damage)
    elif magic.startswith(_ROS1):
        found_in = scan_bag(path, damage)
    else:
        damage(Notice('E-BAG-NOT-A-RECORDING',
                      f'{path.name} does not have the header of a bag'))
        return
    yield from (record for record in found_in if topics is None or record.topic in topics)


def record_of(schema: Schema | None, channel: Channel, message: Message) -> Record:
    """Return what an MCAP file stores, as a record."""
    encoding = channel.message_encoding
    return Record(channel.topic, _type_in_mcap(schema, encoding), message.log_time, message.data,
                  encoding, schema.data if schema and encoding == PROTOBUF else b'')


def _type_in_mcap(schema: Schema | None, encoding: str) -> str:
    name = schema.name if schema else ''
    if not name:
        return ''
    name = normalize_msgtype(name) if '/' in name else name
    # an unsupported one is shown with the type
    return name if encoding in ENCODINGS else f'{name} in {encoding or "no encoding"}'


def mcap_contents(path: Path, damage: Damage, topics: Collection[str] | None = None
                  ) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """Yield the messages of an MCAP file by time, with their topics and types.

    topics: of these; None: all.
    """
    with McapFile(path, damage, topics) as contents:
        yield from contents.messages()


def has_other_encodings(path: Path) -> bool:
    """Return whether an MCAP file's index names messages that are no CDR."""
    with path.open('rb') as file:
        return any(isinstance(each, Channel) and each.message_encoding != CDR
                   for each in _summary(file, min(path.stat().st_size, RECORD_BYTES)))


def _because(damage: str, error: Exception | None = None) -> Notice:
    if isinstance(error, InputError | TooMuchError):
        return Notice(error.code, damage)
    return Notice('E-BAG-DAMAGED', damage)


def refuse(damage: Notice) -> None:
    """Raise InputError for what is damaged."""
    raise InputError('E-BAG-DAMAGED', str(damage))


class _Place(NamedTuple):
    """Where a chunk of an MCAP file is: its record begins and ends; size: unpacked.

    counts: how many messages of each channel its index lists, which may be fewer than it has.
    """

    place: int
    end: int
    start_ns: int
    end_ns: int
    size: int
    counts: Mapping[int, int]


class McapFile:
    """The messages of an MCAP file, whether in chunks or not, in whatever order, indexed or not.

    Where the index ends or leaves a gap, the heads of the records tell what is there. A damaged
    chunk is left out and reported. topics: whose messages are wanted; None: all.
    """

    def __init__(self, path: Path, damage: Damage, topics: Collection[str] | None = None) -> None:
        self._path, self._damage, self._topics = path, damage, topics
        self._size = path.stat().st_size
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._statistics: Statistics | None = None
        self._chunks: list[_Place] = []
        # of messages that are in no chunk
        self._times, self._places = array('Q'), array('Q')
        self._unpacking = _Unpacking(path)

    def __enter__(self) -> McapFile:
        self._file = self._path.open('rb')
        try:
            self._find()
        except BaseException:
            self._file.close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def counts(self) -> Counter[tuple[str, str]]:
        """Return the numbers of messages by topic and type.

        Raises InputError where the index has them not.
        """
        about = self._statistics
        if about is None or sum(about.channel_message_counts.values()) != about.message_count:
            raise InputError('E-BAG-INDEX', 'the file has no index')
        counts = Counter[tuple[str, str]]()
        for channel in self._channels.values():
            kind = _type_in_mcap(self._schemas.get(channel.schema_id), channel.message_encoding)
            counts[channel.topic, kind] += about.channel_message_counts.get(channel.id, 0)
        return counts

    def messages(self) -> Iterator[tuple[Schema | None, Channel, Message]]:
        """Yield the messages by time; of the same time, in the order of the file."""
        wanted = {each.id: (self._schemas.get(each.schema_id), each)
                  for each in self._channels.values()
                  if self._topics is None or each.topic in self._topics}
        chunks = self._chunks
        listed = sum((Counter(chunk.counts) for chunk in chunks), Counter[int]())
        if self._statistics is not None and all(
                listed[each] == self._statistics.channel_message_counts.get(each, 0)
                for each in wanted):
            chunks = [chunk for chunk in chunks if not wanted.keys().isdisjoint(chunk.counts)]
        parts: list[tuple[int, Callable[[], Iterable[Message]]]]
        parts = [(chunk.start_ns, partial(self._inside, chunk)) for chunk in chunks]
        # all chunks of one time are in memory
        ends = sorted((time, size) for chunk in chunks for time, size in (
            (chunk.start_ns, chunk.size), (chunk.end_ns + 1, -chunk.size)))
        if max(accumulate(size for _, size in ends), default=0) > max(
                OVERLAPPING_BYTES, max((chunk.size for chunk in chunks), default=0)):
            parts = [(0, lambda: chain.from_iterable(map(self._inside, chunks)))]
        if self._times:
            parts.append((min(self._times), self._outside))
        for message in by_time(parts, lambda each: each.log_time):
            if message.channel_id in wanted:
                yield (*wanted[message.channel_id], message)

    def _find(self) -> None:
        indexed, end = [], self._size
        for record in _summary(self._file, min(self._size, RECORD_BYTES)):
            if isinstance(record, Schema | Channel):
                self._note(record)
            elif isinstance(record, Statistics):
                self._statistics = record
            elif isinstance(record, ChunkIndex):
                indexed.append(_indexed(record))
        place = self._follow(indexed, end)
        if place < end and indexed:
            # the index is wrong, or a part between the chunks is damaged
            place = self._follow([], end)
        if place < end:
            later = [chunk for chunk in sorted(indexed) if place < chunk.place < chunk.end <= end]
            self._chunks += later
            self._damage(_because(f'{self._path.name} is {"damaged" if later else "truncated"} at '
                                  f'byte {place}'))
        about = self._statistics
        if self._chunks and (about is None or len(self._channels) < about.channel_count or any(
                each.schema_id and each.schema_id not in self._schemas
                for each in self._channels.values())):
            # chunks name the topics of later ones, which may have earlier messages
            for chunk in self._chunks:
                with suppress(Exception):  # reported when its messages are read
                    for inner in self._records_in(chunk):
                        self._note(inner)
            self._unpacking = _Unpacking(self._path)

    def _follow(self, indexed: Iterable[_Place], end: int) -> int:
        """Find what is there up to the end, with the help of these chunks; return as _walk()."""
        self._chunks.clear()
        self._times, self._places = array('Q'), array('Q')
        place = MAGIC_SIZE
        for chunk in sorted(indexed):
            place = self._walk(place, chunk.place)
            if place != chunk.place:
                return min(place, end - 1)
            self._chunks.append(chunk)
            place = chunk.end
        return self._walk(place, end)

    def _note(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record

    def _walk(self, place: int, until: int) -> int:
        """Find what is from one place to another; return where what is whole ends.

        That is `until` where the data end. Raises InputError beyond limits.
        """
        while place < until:
            self._file.seek(place)
            head = self._file.read(_HEAD.size + _CHUNK.size)
            if len(head) < _HEAD.size:
                return place
            kind, size = _HEAD.unpack_from(head)
            if kind in (Opcode.DATA_END, Opcode.FOOTER):
                return until
            end = place + _HEAD.size + size
            if kind < Opcode.HEADER or end > until:
                return place
            if kind == Opcode.CHUNK and size > _CHUNK.size:
                first, last, unpacked_size = _CHUNK.unpack_from(head, _HEAD.size)
                self._chunks.append(_Place(place, end, first, last, unpacked_size, {}))
            elif kind == Opcode.MESSAGE and size >= _MESSAGE.size + 8:
                channel, _, time = _MESSAGE.unpack_from(head, _HEAD.size)
                if self._topics is None or channel not in self._channels or (
                        self._channels[channel].topic in self._topics):
                    self._times.append(time)
                    self._places.append(place)
            elif kind in (Opcode.SCHEMA, Opcode.CHANNEL) and size <= INDEX_BYTES:
                self._file.seek(place)
                self._note(next(self._records(size)))
            if len(self._times) + 32 * len(self._chunks) > INDEX_BYTES // 2:
                raise InputError('E-BAG-INDEX', 'the file has too many records')
            place = end
        return place

    def _records(self, limit: int) -> Iterator[McapRecord]:
        return StreamReader(self._file, skip_magic=True, emit_chunks=True,
                            record_size_limit=limit).records

    def _outside(self) -> Iterator[Message]:
        for n in np.argsort(self._times, kind='stable'):
            self._file.seek(self._places[n])
            try:
                message = next(self._records(RECORD_BYTES))
            except McapError as error:
                self._damage(Notice('E-BAG-TOO-LARGE', f'{self._path.name} has a message that is '
                                                       f'too large ({one_line(error)})'))
                continue
            assert isinstance(message, Message)
            yield message

    def _inside(self, chunk: _Place) -> list[Message]:
        try:
            found = [each for each in self._records_in(chunk) if isinstance(each, Message)]
        except Exception as error:  # also the unpackers' own errors
            self._damage(_because(
                f'{self._path.name} has a damaged chunk ({one_line(error)})', error))
            return []
        return sorted(found, key=lambda each: each.log_time)

    def _records_in(self, chunk: _Place) -> list[McapRecord]:
        self._file.seek(chunk.place)
        record = next(self._records(RECORD_BYTES))
        if not isinstance(record, Chunk):
            raise InputError('E-BAG-INDEX', 'the index is wrong')
        plain = self._unpacking.through(
            lambda data, left: unpack(record.compression, data, min(left, chunk.size)),
            record.data)
        return breakup_chunk(replace(record, compression='', data=plain), validate_crc=True)


def _indexed(chunk: ChunkIndex) -> _Place:
    end = chunk.chunk_start_offset + chunk.chunk_length
    offsets = sorted((place, channel) for channel, place in chunk.message_index_offsets.items())
    ends = [place for place, _ in offsets[1:]] + [end + chunk.message_index_length]
    # a record of the index has 15 bytes, and 16 for each message
    counts = {channel: (after - place - 15) // 16
              for (place, channel), after in zip(offsets, ends, strict=False)}
    return _Place(chunk.chunk_start_offset, end + chunk.message_index_length,
                  chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size,
                  counts)


def _summary(file: BinaryIO, limit: int) -> list[McapRecord]:
    """Return the topics, types and index at an MCAP file's end, nothing if it is cut off."""
    try:
        file.seek(-FOOTER_SIZE - MAGIC_SIZE, os.SEEK_END)
        footer: Any = next(StreamReader(file, skip_magic=True, record_size_limit=limit).records)
        if not footer.summary_start or (
                file.seek(0, os.SEEK_END) - footer.summary_start > INDEX_BYTES):
            return []
        file.seek(footer.summary_start)
        return list(StreamReader(file, skip_magic=True, emit_chunks=True,
                                 record_size_limit=limit).records)
    except Exception:  # there are no limits to what a damaged file makes of these numbers
        return []


_PLACES = '''
    SELECT rowid, timestamp FROM messages WHERE typeof(timestamp) = 'integer' AND timestamp >= 0'''
_ROW = '''
    SELECT topic_id, data FROM messages
    WHERE rowid = ? AND typeof(data) = 'blob' AND octet_length(data) <= ?'''


def scan_db3(path: Path, damage: Damage) -> Iterator[Record]:
    """Yield the messages of an SQLite bag by time, without its index of times."""
    uri = f'file:{quote(str(path.absolute()))}?mode=ro&immutable=1'
    database = apsw.Connection(uri, apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI)
    left = path.stat().st_size
    rows, times = array('q'), array('q')
    try:
        # else SQLite refuses a file that is shorter than its header says
        database.execute('PRAGMA writable_schema = ON')
        limited(database)
        topics = {key: (str(name), str(kind or '')) for key, name, kind in
                  islice(database.execute('SELECT id, name, type FROM topics'), TOPICS)}
        try:
            for row, receive_ns in islice(database.execute(_PLACES), left // 2):
                rows.append(row)
                times.append(receive_ns)
        except apsw.Error as error:
            damage(_because(f'{path.name}: {one_line(error)}'))
        for n in np.argsort(times, kind='stable'):
            for topic, data in database.execute(_ROW, (rows[n], left)):
                left -= len(data)
                if left < 0:
                    raise TooMuchError('its rows contain more than the file')
                if topic in topics:
                    yield Record(*topics[topic], times[n], data)
    except apsw.Error as error:
        damage(_because(f'{path.name}: {one_line(error)}', error))
    finally:
        database.close()


def scan_bag(path: Path, damage: Damage) -> Iterator[Record]:
    """Yield the messages of a ROS 1 bag."""
    with path.open('rb') as file:
        file.readline()
        try:
            yield from _bag_messages(file, {}, _Unpacking(path))
        except Exception as error:  # rosbags' errors, and those of what unpacks
            damage(_because(f'{path.name} is truncated ({one_line(error)})', error))


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
