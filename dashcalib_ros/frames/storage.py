"""The files of a bag, as one sequence of messages.

A bag is an ordered list of storage files, each complete in itself: metadata.yaml only tells their
order and how many messages to expect. So a bag whose metadata.yaml is lost is still read, and so
is a split bag with one broken file. Every file is read by its index (rosbags); where that fails,
from its start to where it breaks (salvage).
"""
from __future__ import annotations

import errno
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath

import yaml
import zstandard
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from dashcalib_ros.errors import InputError
from dashcalib_ros.frames.record import Record
from dashcalib_ros.frames.salvage import Damage, scan
from dashcalib_ros.frames.source import by_name, is_bag_file

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CURE = ("repair it ('mcap recover', 'ros2 bag reindex', 'sqlite3 .recover', 'rosbag reindex'), "
        'copy it again or record it again')


@dataclass(frozen=True)
class Topic:
    """A topic of a bag; count is its number of messages."""

    name: str
    msgtype: str
    count: int

    @property
    def is_image(self) -> bool:
        """Tell whether these are a camera's pictures (not its depth)."""
        return (self.msgtype in (IMAGE, COMPRESSED_IMAGE)
                and not self.name.endswith('/compressedDepth'))


@dataclass(frozen=True)
class Bag:
    """A bag that can be read.

    files: in the order of time.
    topics: sorted by name.
    indexed: the counts are promised by an index, not found by reading: fewer mean a loss.
    warnings: what was odd about it.
    """

    files: tuple[Path, ...]
    topics: tuple[Topic, ...]
    indexed: bool
    warnings: tuple[str, ...]

    def records(self, topics: Collection[str], damage: Damage) -> Iterator[Record]:
        """Yield the messages of these topics, file by file; raises InputError, OSError."""
        for file in self.files:
            yield from _records(file, topics, damage)


def open_bag(path: Path) -> Bag:
    """Find a bag's files and topics; raises InputError when nothing in it can be read."""
    if not path.is_dir():
        topics, indexed = _topics_of((path,), path)
        return Bag((path,), topics, indexed, ())
    there = tuple(sorted((file for file in path.iterdir() if is_bag_file(file.name)),
                         key=lambda file: by_name(file.name)))
    listed, promised = _metadata(path / 'metadata.yaml')
    files = tuple(file for file in listed if file in there)
    warnings = [f'{file.name} is listed in metadata.yaml but missing: its images are lost'
                for file in listed if files and file not in there]
    if not files:
        files = there
        warnings = [f'{path} has no usable metadata.yaml: reading {_names(files)} in this order']
    if not files:
        raise InputError(f'{path} has a metadata.yaml but no .mcap, .db3 or .bag file: '
                         f'copy the whole folder')
    if any(topic.is_image and topic.count for topic in promised):
        return Bag(files, promised, True, tuple(warnings))
    topics, indexed = _topics_of(files, path)
    return Bag(files, topics, indexed, tuple(warnings))


def _metadata(path: Path) -> tuple[tuple[Path, ...], tuple[Topic, ...]]:
    """Return the files and topics that metadata.yaml lists, or nothing if it cannot be used."""
    try:
        content = yaml.safe_load(path.read_text('utf-8'))['rosbag2_bagfile_information']
        # older versions wrote the folder's name too, which may have changed since
        files = tuple(path.parent / PurePath(name).name for name in content['relative_file_paths'])
        counts = Counter[tuple[str, str]]()
        for item in content['topics_with_message_count']:
            about = item['topic_metadata']
            counts[str(about['name']), str(about['type'])] += int(item['message_count'])
    except (FileNotFoundError, yaml.YAMLError, KeyError, TypeError, ValueError):
        return (), ()
    return files, _sorted(counts)


def _topics_of(files: tuple[Path, ...], bag: Path) -> tuple[tuple[Topic, ...], bool]:
    """Return all topics, and whether every file had an index that told them."""
    counts = Counter[tuple[str, str]]()
    problems: list[str] = []
    indexed = True
    for file in files:
        with _unpacked(file, problems.append) as plain:
            found = _index_counts(plain)
            if found is None:
                indexed = False
                found = Counter((record.topic, record.msgtype)
                                for record in scan(plain, problems.append))
        counts.update(found)
    if problems and not counts:
        raise InputError(f'{bag} cannot be read ({problems[0]}): {CURE}')
    return _sorted(counts), indexed


def _sorted(counts: Counter[tuple[str, str]]) -> tuple[Topic, ...]:
    return tuple(Topic(name, kind, count) for (name, kind), count in sorted(counts.items()))


def _index_counts(path: Path) -> Counter[tuple[str, str]] | None:
    counts = Counter[tuple[str, str]]()
    try:
        with _reader(path) as reader:
            for connection in reader.connections:
                counts[connection.topic, connection.msgtype] += connection.msgcount
    except Exception:  # a damaged file makes rosbags raise nearly anything
        return None
    return counts


def _records(file: Path, topics: Collection[str], damage: Damage) -> Iterator[Record]:
    with _unpacked(file, damage) as path:
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
    with _reader(path) as reader:
        wanted = [each for each in reader.connections if each.topic in topics]
        missing = sum(connection.msgcount for connection in wanted)
        if not wanted:
            return
        ros1 = isinstance(reader, Reader1)
        for connection, receive_ns, raw in reader.messages(wanted):
            missing -= 1
            yield Record(connection.topic, connection.msgtype, receive_ns, bytes(raw), ros1)
        if missing > 0:
            raise ValueError('the index does not lead to all messages')


def _reader(path: Path) -> Reader1 | Reader2:
    with path.open('rb') as file:
        return Reader1(path) if file.read(7) == b'#ROSBAG' else Reader2(path)


@contextmanager
def _unpacked(file: Path, damage: Damage) -> Iterator[Path]:
    """Give the file, or what could be decompressed of it, in a place that is removed after use."""
    if file.suffix.lower() != '.zstd':
        yield file
        return
    with tempfile.TemporaryDirectory(prefix='dashcalib-') as folder:
        plain = Path(folder, file.stem)
        try:
            with file.open('rb') as packed, plain.open('wb') as output:
                zstandard.ZstdDecompressor().copy_stream(packed, output)
        except zstandard.ZstdError:
            damage(f'{file.name} is damaged')
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            raise InputError(f'no room to unpack {file} in {folder}: set TMPDIR to a bigger disk, '
                             f'or unpack it first (zstd -d)') from error
        yield plain


def _names(files: tuple[Path, ...]) -> str:
    names = [file.name for file in files]
    return ', '.join(names[:3]) + (' ...' if len(names) > 3 else '')
