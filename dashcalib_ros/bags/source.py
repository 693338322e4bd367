"""A bag as a drive."""
from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from dashcalib_ros.arrays import GreyImage
from dashcalib_ros.bags.storage import CURE, Bag, Topic, open_bag
from dashcalib_ros.errors import InputError
from dashcalib_ros.frames.decode import BitDepth, decode
from dashcalib_ros.frames.source import FrameSource, Picture, Reading
from dashcalib_ros.frames.stamps import RECORDED, StampGate


class BagSource(FrameSource):
    """The images on one topic of a ROS 2 or ROS 1 bag, in the order in which they were recorded.

    Raises InputError when the bag cannot be read, when it has no such topic, and when it has
    several image topics and none is chosen.
    """

    _cure = CURE

    def __init__(self, path: Path, topic: str | None = None, fps: float | None = None) -> None:
        self._bag = open_bag(path)
        chosen = _choose(path, self._bag, topic)
        warnings = list(self._bag.warnings)
        if fps is not None:
            warnings.append(f'{path} is a bag, its images have stamps: fps is ignored')
        super().__init__(str(path), chosen.count, chosen.name, tuple(warnings))

    def _pictures(self, reading: Reading) -> Iterator[Picture]:
        gate, depth = StampGate(RECORDED), BitDepth()
        damage: list[str] = []
        count = 0
        try:
            for record in self._bag.records([str(self.topic)], damage.append):
                index, count = count, count + 1
                try:
                    message = record.message()
                except InputError as error:
                    yield index, record.receive_ns, error, ''
                    continue
                stamp_ns = gate.take(_header_ns(message), record.receive_ns)
                if stamp_ns is not None:
                    yield index, stamp_ns, _image(message, depth), str(message.header.frame_id)
            reading.warnings += self._losses(count, damage)
        finally:
            reading.warnings += gate.warnings()

    def _losses(self, read: int, damage: list[str]) -> list[str]:
        lost = (self.count or 0) - read if self._bag.indexed else 0
        if not damage and lost <= 0:
            return []
        why = f' ({"; ".join(damage[:2])}{" ..." if len(damage) > 2 else ""})' if damage else ''
        start = f'the bag is damaged{why}: read {read}'
        if lost > 0:
            return [f'{start} of {self.count} images; {lost} are lost']
        if self._bag.indexed:
            return [f'{start} of {self.count} images; none is lost']
        return [f'{start} images; how many are lost is not known']


def _image(message: Any, depth: BitDepth) -> GreyImage | InputError:
    try:
        return decode(message, depth)
    except InputError as error:
        return error


def _header_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _choose(path: Path, bag: Bag, name: str | None) -> Topic:
    images = [topic for topic in bag.topics if topic.is_image]
    if not images:
        there = ', '.join(f'{topic.name} ({topic.msgtype})' for topic in bag.topics[:8])
        there = ' '.join(there.split())  # a damaged bag's names may hold anything
        raise InputError(f'{path} has no image topic: it has {there or "no messages at all"}; '
                         f'record the camera (Image or CompressedImage) too')
    if name is not None:
        found = [topic for topic in images if topic.name.strip('/') == name.strip('/')]
        if not found:
            raise InputError(f'{path} has no image topic {name!r}: choose {_listing(bag, images)}')
        images = found
    filled = [topic for topic in images if topic.count]
    if not filled:
        raise InputError(f'{path} has no images on {images[0].name}: was the camera running? '
                         f'Record again')
    if len(filled) > 1:
        raise InputError(f'{path} has {len(filled)} image topics: choose one with --topic: '
                         f'{_listing(bag, filled)}')
    return filled[0]


def _listing(bag: Bag, topics: list[Topic]) -> str:
    sizes = _sizes(bag, topics)
    return '; '.join(
        f'{topic.name} ({topic.msgtype.rpartition("/")[2]}, {topic.count} images'
        f'{", " + sizes[topic.name] if topic.name in sizes else ""})' for topic in topics)


def _sizes(bag: Bag, topics: list[Topic]) -> dict[str, str]:
    """Return the size of each topic's first image, as far as they come early in the bag."""
    missing = {topic.name for topic in topics if topic.count}
    sizes: dict[str, str] = {}
    for record in islice(bag.records(tuple(missing), lambda _: None), 1000):
        if record.topic not in missing:
            continue
        missing.discard(record.topic)
        try:
            height, width = decode(record.message()).shape
            sizes[record.topic] = f'{width}x{height}'
        except InputError:
            pass  # it is listed without a size
        if not missing:
            break
    return sizes
