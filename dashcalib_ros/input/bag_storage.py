"""The files of a bag, as one sequence of messages.

A bag is an ordered list of storage files, each complete in itself: metadata.yaml has only their
order and the expected number of messages. So a bag without metadata.yaml can be read, and a split
bag with one broken file, too. Every file is read by its index (rosbags); where that fails, from
its start to where it breaks (salvage).
"""
from __future__ import annotations

import errno
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath

import zstandard

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.bag_salvage import Damage, Record, scan
from dashcalib_ros.input.bag_unpack import Ros1Reader, Ros2Reader, unpack_file
from dashcalib_ros.input.source import METADATA, by_name, is_bag_file
from dashcalib_ros.limits import YAML_BYTES, check_file, irregular_entry, parse_yaml, read_text

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
    indexed: the counts are from an index, not from reading all: fewer messages mean a loss.
    warnings: for the user, about the bag's files.
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
        check_file(path)
        topics, indexed = _topics_of((path,), path)
        return Bag((path,), topics, indexed, ())
    names = sorted((file.name for file in path.iterdir() if is_bag_file(file.name)), key=by_name)
    skipped = {name: what for name in names if (what := irregular_entry(path / name))}
    present = tuple(path / name for name in names if name not in skipped)
    warnings = []
    if skipped:
        listing = ', '.join(f'{name} is {what}' for name, what in list(skipped.items())[:3])
        warnings = [f'{len(skipped)} entries of {path} were skipped: {listing}'
                    f'{" ..." if len(skipped) > 3 else ""}']
    listed, promised = _metadata(path / METADATA)
    files = tuple(file for file in listed if file in present)
    if files:
        warnings += [f'{file.name} is listed in metadata.yaml but missing: its images are lost'
                     for file in listed if file not in present and file.name not in skipped]
    elif present:
        files = present
        warnings += [f'{path} has no usable metadata.yaml: reading {_names(files)} in this order']
    if not files:
        why = f' ({"; ".join(warnings)})' if warnings else ''
        raise InputError(f'{path} has no .mcap, .db3 or .bag file{why}: '
                         f'copy the whole folder')
    if any(topic.is_image and topic.count for topic in promised):
        return Bag(files, promised, True, tuple(warnings))
    topics, indexed = _topics_of(files, path)
    return Bag(files, topics, indexed, tuple(warnings))


def check_unpacked(path: Path) -> None:
    """Raise InputError where rosbags would have to read or unpack more than limits allow."""
    files = [path]
    if path.is_dir():
        files = list(open_bag(path).files)
        parse_yaml(read_text(path / METADATA, YAML_BYTES), str(path / METADATA))
    for file in files:
        if file.suffix.lower() == '.zstd':
            unpack_file(file, lambda _: None, None)


def _metadata(path: Path) -> tuple[tuple[Path, ...], tuple[Topic, ...]]:
    """Return the files and topics that metadata.yaml lists, or nothing if it cannot be used."""
    try:
        text = read_text(path, YAML_BYTES)
        content = parse_yaml(text, str(path))['rosbag2_bagfile_information']
        # older versions wrote the folder's name too, which may have changed since
        files = tuple(path.parent / PurePath(name).name for name in content['relative_file_paths'])
        counts = Counter[tuple[str, str]]()
        for item in content['topics_with_message_count']:
            about = item['topic_metadata']
            counts[str(about['name']), str(about['type'])] += int(item['message_count'])
    except (InputError, KeyError, TypeError, ValueError, OverflowError):
        return (), ()
    return files, _sorted(counts)


def _topics_of(files: tuple[Path, ...], bag: Path) -> tuple[tuple[Topic, ...], bool]:
    """Return all topics, and whether they are from the indices of all files."""
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
        ros1 = isinstance(reader, Ros1Reader)
        for connection, receive_ns, raw in reader.messages(wanted):
            missing -= 1
            yield Record(connection.topic, connection.msgtype, receive_ns, bytes(raw), ros1)
        if missing > 0:
            raise ValueError('the index does not lead to all messages')


def _reader(path: Path) -> Ros1Reader | Ros2Reader:
    with path.open('rb') as file:
        return Ros1Reader(path) if file.read(7) == b'#ROSBAG' else Ros2Reader(path)


@contextmanager
def _unpacked(file: Path, damage: Damage) -> Iterator[Path]:
    """Give the file; of a .zstd file, a temporary copy of what could be decompressed."""
    if file.suffix.lower() != '.zstd':
        yield file
        return
    with tempfile.TemporaryDirectory(prefix='dashcalib-') as folder:
        plain = Path(folder, file.stem)
        try:
            with plain.open('wb') as output:
                unpack_file(file, output.write, Path(folder))
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
