# SPDX-License-Identifier: Apache-2.0
"""A bag as a drive: its files as one sequence of messages, and the images on one topic.

A bag is a list of storage files, each complete in itself: metadata.yaml has only their names, the
types of topics and the expected number of messages. So a bag without metadata.yaml can be read,
and a split bag with one broken file, too. Messages come by time, whatever the order of the files
and of what is in them. Where an index fails, a file is read from its start to where it breaks.
"""
from __future__ import annotations

import copy
import re
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import starmap
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from dashcalib_ros.arrays import Pixels
from dashcalib_ros.errors import InputError, Notice, counted
from dashcalib_ros.input.bag_read import (
    Damage,
    Record,
    begin_ns,
    by_time,
    message_counts,
    records,
)
from dashcalib_ros.input.decode import BitDepth, decode
from dashcalib_ros.input.encodings import ENCODINGS, PICTURES
from dashcalib_ros.input.packets import PacketDecoder, codec_of
from dashcalib_ros.input.source import (
    METADATA,
    FrameSource,
    Picture,
    Reading,
    by_name,
    cameras_named,
    first_of,
    is_bag_file,
)
from dashcalib_ros.input.stamps import StampGate
from dashcalib_ros.input.video import FramePicture
from dashcalib_ros.limits import YAML_BYTES, check_file, parse_yaml, read_text

REMEDY = ("repair it ('mcap recover', 'ros2 bag reindex', 'sqlite3 .recover', 'rosbag reindex'), "
        'copy it again, or record it again')
NO_CURE = 'check that it is a recording, then copy it again or record it again'
# of problems that no repair fixes
NO_RECORDING = {'E-BAG-NOT-A-RECORDING', 'E-BAG-TOO-LARGE'}
# types of image_transport's messages that are not read
VIDEO_TYPES = re.compile('image_transport|theora|h26[45]')
# problems of files in a message
LISTED = 12


@dataclass(frozen=True)
class Topic:
    """A topic of a bag; count is its number of messages."""

    name: str
    msgtype: str
    count: int

    @property
    def is_image(self) -> bool:
        """Tell whether these are a camera's pictures (not its depth)."""
        return (self.msgtype in PICTURES
                and not self.name.endswith('/compressedDepth'))


@dataclass(frozen=True)
class Bag:
    """A bag that can be read.

    files: in the order of metadata.yaml, else by name.
    topics: sorted by name; a type that is written nowhere is ''.
    indexed: the counts are from an index, not from reading all: fewer messages mean a loss.
    warnings: for the user, about the bag's files.
    begins_ns: first times of messages in packed files, as metadata.yaml has them.
    """

    files: tuple[Path, ...]
    topics: tuple[Topic, ...]
    indexed: bool
    warnings: tuple[Notice, ...]
    begins_ns: Mapping[Path, int] = field(default_factory=dict)

    def records(self, topics: Collection[str], damage: Damage) -> Iterator[Record]:
        """Yield the messages of these topics by time; raises InputError, OSError."""
        types = {topic.name: topic.msgtype for topic in self.topics}
        parts, start_ns = [], 0
        for file in self.files:
            if len(self.files) > 1 and (first_ns := self._begin_ns(file, topics)) is not None:
                start_ns = first_ns
            # a file of which nothing can be read says so in its place
            parts.append((start_ns, partial(records, file, topics, damage)))
        for record in by_time(parts, lambda each: each.receive_ns):
            yield record if record.msgtype else replace(
                record, msgtype=types.get(record.topic, ''))

    def _begin_ns(self, file: Path, topics: Collection[str]) -> int | None:
        # to unpack it once more would take as long as to read it
        return self.begins_ns[file] if file in self.begins_ns else begin_ns(file, topics)


def open_bag(path: Path) -> Bag:
    """Find a bag's files and topics; raises InputError when nothing in it can be read."""
    if not path.is_dir():
        check_file(path)
        topics, indexed = _topics_of((path,), path)
        if not all(topic.msgtype for topic in topics):
            beside = _metadata(path.parent / METADATA)
            topics = _typed(topics, beside.topics if path in beside.files else ())
        return Bag((path,), topics, indexed, ())
    names = sorted((file.name for file in path.iterdir() if is_bag_file(file.name)), key=by_name)
    skipped = [name for name in names if not (path / name).is_file()]
    present = tuple(path / name for name in names if name not in skipped)
    warnings = []
    if skipped:
        warnings = [Notice('E-BAG-FILES-SKIPPED', f'{counted(len(skipped), "file")} in {path} '
                           f'skipped, not regular files: {first_of(skipped)}')]
    metadata = _metadata(path / METADATA)
    files = tuple(file for file in metadata.files if file in present)
    if files:
        warnings += [Notice('E-BAG-FILE-MISSING', f'{file.name} is listed in metadata.yaml but '
                            f'does not exist: its images are lost')
                     for file in metadata.files
                     if file not in present and file.name not in skipped]
    elif present:
        files = present
        if (cameras := cameras_named([file.name for file in files])) > 1:
            raise InputError('E-INPUT-SEVERAL-CAMERAS', f'{path} has recordings of {cameras} '
                             f'cameras ({first_of([file.name for file in files])}): pass the '
                             f'files of one camera')
        warnings += [Notice(
            'E-BAG-NO-METADATA', f'{path} has no usable metadata.yaml: its files are read in the '
            f'order {first_of([file.name for file in files])}')]
    if not files:
        why = f' ({"; ".join(map(str, warnings))})' if warnings else ''
        raise InputError('E-BAG-NO-FILES',
                         f'{path} has no .mcap, .db3 or .bag file{why}: copy the '
                         f'whole folder')
    topics, indexed = metadata.topics, True
    if not any(topic.is_image and topic.count for topic in topics):
        topics, indexed = _topics_of(files, path)
        topics = _typed(topics, metadata.topics)
    return Bag(files, topics, indexed, tuple(warnings), metadata.begins_ns)


def _metadata(path: Path) -> Bag:
    """Return the bag that metadata.yaml lists, an empty one where it cannot be used."""
    try:
        text = read_text(path, YAML_BYTES)
        content = parse_yaml(text, str(path))['rosbag2_bagfile_information']
        # older versions wrote the folder's name too, which may have changed since; a file counts
        # once
        files = tuple(dict.fromkeys(
            path.parent / PurePath(name).name for name in content['relative_file_paths']))
        counts = Counter[tuple[str, str]]()
        for item in content['topics_with_message_count']:
            about = item['topic_metadata']
            counts[str(about['name']), str(about['type'])] += int(item['message_count'])
        begins = {path.parent / PurePath(each['path']).name:
                  int(each['starting_time']['nanoseconds_since_epoch'])
                  for each in content.get('files') or () if each['path'].endswith('.zstd')}
    except (InputError, KeyError, TypeError, ValueError, OverflowError, AttributeError):
        return Bag((), (), True, ())
    return Bag(files, _sorted(counts), True, (), begins)


def _typed(topics: tuple[Topic, ...], others: tuple[Topic, ...]) -> tuple[Topic, ...]:
    types = {topic.name: topic.msgtype for topic in (*others, *topics) if topic.msgtype}
    counts = Counter[tuple[str, str]]()
    for topic in topics:
        counts[topic.name, topic.msgtype or types.get(topic.name, '')] += topic.count
    return _sorted(counts)


def _topics_of(files: tuple[Path, ...], bag: Path) -> tuple[tuple[Topic, ...], bool]:
    """Return all topics, and whether they are from the indices of all files."""
    counts = Counter[tuple[str, str]]()
    problems: list[Notice] = []
    indexed = True
    for file in files:
        found, by_index = message_counts(file, problems.append)
        counts.update(found)
        indexed &= by_index
    if problems and not counts:
        why = first_of([*map(str, problems)], LISTED)
        if all(each.code in NO_RECORDING for each in problems):
            raise InputError('E-BAG-NOT-A-RECORDING', f'{bag} cannot be read ({why}): {NO_CURE}')
        raise InputError('E-BAG-DAMAGED', f'{bag} cannot be read ({why}): {REMEDY}')
    return _sorted(counts), indexed


def _sorted(counts: Mapping[tuple[str, str], int]) -> tuple[Topic, ...]:
    return tuple(Topic(name, kind, count) for (name, kind), count in sorted(counts.items()))


class _Shot(NamedTuple):
    """An image that was recorded. number: its place; decode: as Picture's."""

    number: int
    header_ns: int
    receive_ns: int
    frame_id: str
    decode: Callable[..., Pixels]


class BagSource(FrameSource):
    """The images on one topic of a ROS 2 or ROS 1 bag, in the order in which they were recorded.

    Raises InputError when the bag cannot be read, when it has no such topic, and when it has
    several image topics and none is chosen.
    """

    _remedy = REMEDY
    recorded = True

    def __init__(self, path: Path, topic: str | None = None, fps: float | None = None) -> None:
        self._bag = open_bag(path)
        chosen = _choose(path, self._bag, topic)
        warnings = list(self._bag.warnings)
        if fps is not None:
            warnings.append(Notice('E-FPS-IGNORED', f'{path} is a bag, and its images have time '
                                   f'stamps: fps is ignored'))
        super().__init__(str(path), chosen.count, chosen.name, tuple(warnings))

    def with_more(self, others: Sequence[BagSource]) -> BagSource:
        """Return this with the other files of the same recording: their images come by time."""
        found, bags = copy.copy(self), [self._bag, *(each._bag for each in others)]
        found._bag = Bag(
            tuple(file for bag in bags for file in bag.files), self._bag.topics,
            all(bag.indexed for bag in bags), (), {
                file: begin for bag in bags for file, begin in bag.begins_ns.items()})
        found.name = f'{self.name} and {len(others)} more'
        found.count = found._promised = sum(each.count or 0 for each in (self, *others))
        found._opening_warnings = tuple(dict.fromkeys(
            line for each in (self, *others) for line in each._opening_warnings))
        return found

    @property
    def begin_ns(self) -> int | None:
        """Return when the first image was recorded; None where that cannot be read."""
        try:
            first = next(self._bag.records([str(self.topic)], lambda _: None), None)
        except (InputError, OSError):
            return None
        return None if first is None else first.receive_ns

    def _pictures(self, reading: Reading, start_ns: int = 0) -> Generator[Picture, None, None]:
        gate = StampGate()
        damage: list[Notice] = []
        first_ns: int | None = None
        try:
            for shot in self._shots(reading, damage):
                stamp_ns = gate.take(shot.header_ns, shot.receive_ns)
                if stamp_ns is None:
                    continue
                first_ns = stamp_ns if first_ns is None else first_ns
                if stamp_ns - first_ns >= start_ns:
                    yield Picture(shot.number, stamp_ns, shot.decode, shot.frame_id)
            reading.warnings += self._losses(reading.images, damage)
        finally:
            reading.warnings += gate.warnings()

    def _shots(self, reading: Reading, damage: list[Notice]) -> Iterator[_Shot]:
        """Yield the images in the order in which they are shown; a video has packets for them."""
        depth, packets = BitDepth(), PacketDecoder()
        for record in self._bag.records([str(self.topic)], damage.append):
            index = reading.images
            reading.images += 1
            try:
                message = record.message()
                shot = _Shot(index, _header_ns(message), record.receive_ns,
                             str(message.header.frame_id), partial(decode, message, depth))
                codec = codec_of(message)
                shown = None if codec is None else packets.take(codec, message.data, shot)
            except InputError as error:
                reading.failed(index, error)
                continue
            yield from [shot] if shown is None else starmap(_of_video, shown)
        yield from starmap(_of_video, packets.rest())
        if packets.waited:
            reading.warnings.append(Notice(
                'E-VIDEO-BEGINS-LATE', f'the first {packets.waited} images of the video are '
                f'skipped: the key picture that they depend on is missing before them'))

    def _losses(self, read: int, damage: list[Notice]) -> list[Notice]:
        lost = (self._promised or 0) - read if self._bag.indexed else 0
        if not damage and lost <= 0:
            return []
        why = (f'damaged or was not closed ({"; ".join(map(str, damage[:2]))}'
               f'{" ..." if len(damage) > 2 else ""})' if damage else 'incomplete')
        return [Notice('E-BAG-IMAGES-LOST', f'the bag is {why}: {read}' + (
            ' images were read, the number of lost images is unknown' if not self._bag.indexed else
            f' of {self._promised} images were read, {lost} are lost' if lost > 0 else
            f' of {self._promised} images were read, none is lost'))]


def _of_video(shot: _Shot, frame: Any) -> _Shot:
    return shot._replace(decode=partial(FramePicture(), frame))


def _header_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _choose(path: Path, bag: Bag, name: str | None) -> Topic:
    images = [topic for topic in bag.topics if topic.is_image]
    if not images:
        _check_readable(path, bag)
        there = ', '.join(f'{topic.name} ({topic.msgtype})' for topic in bag.topics[:8])
        there = ' '.join(there.split())  # a damaged bag's names may hold anything
        raise InputError('E-BAG-NO-IMAGES', f'{path} has no image topic: it has '
                         f'{there or "no messages"}; record the camera (Image, CompressedImage or '
                         f'a video), encoded as {", ".join(ENCODINGS)}')
    if name is not None:
        found = [topic for topic in images if topic.name.strip('/') == name.strip('/')]
        if not found:
            raise InputError('E-BAG-TOPIC-UNKNOWN', f'{path} has no image topic {name!r}: choose '
                             f'one of {_listing(images)}')
        images = found
    filled = [topic for topic in images if topic.count]
    if not filled:
        raise InputError('E-BAG-TOPIC-EMPTY', f'{path} has no images on {images[0].name}: check '
                         f'that the camera runs, and record again')
    if len(filled) > 1:
        raise InputError('E-BAG-TOPIC-AMBIGUOUS', f'{path} has {len(filled)} image topics: choose '
                         f'one with --topic: {_listing(filled)}')
    return filled[0]


def _check_readable(path: Path, bag: Bag) -> None:
    filled = [topic for topic in bag.topics if topic.count]
    if untyped := [topic.name for topic in filled if not topic.msgtype]:
        raise InputError(
            'E-BAG-TYPE-MISSING', f'{path} lacks the message type of {first_of(untyped)}: put the '
            f'metadata.yaml of the recording, which names it, beside the file')
    for topic in filled:
        base, _, transport = topic.name.rpartition('/')
        if topic.msgtype in PICTURES:
            raise InputError('E-IMAGE-DEPTH', f'{path} has only depth images ({topic.name}): '
                             f'record the topic of a camera image')
        if VIDEO_TYPES.search(topic.msgtype):
            raise InputError(
                'E-BAG-TRANSPORT', f'{path} has images as {transport} ({topic.msgtype}) only, '
                f'which cannot be read: convert them while the bag is played (ros2 run '
                f'image_transport republish --ros-args -p in_transport:={transport} -p '
                f'out_transport:=compressed -r in/{transport}:={topic.name} -r '
                f'out/compressed:={base}/compressed) and record {base}/compressed')


def _listing(topics: list[Topic]) -> str:
    return '; '.join(f'{topic.name} ({topic.msgtype.rpartition("/")[2]}, {topic.count} images)'
                     for topic in topics)
