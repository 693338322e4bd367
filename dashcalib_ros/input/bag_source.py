"""A bag as a drive."""
from __future__ import annotations

from collections.abc import Generator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.bag_storage import CURE, Bag, Topic, open_bag
from dashcalib_ros.input.decode import BitDepth, decode
from dashcalib_ros.input.source import FrameSource, Picture, Reading
from dashcalib_ros.input.stamps import StampGate


class BagSource(FrameSource):
    """The images on one topic of a ROS 2 or ROS 1 bag, in the order in which they were recorded.

    Raises InputError when the bag cannot be read, when it has no such topic, and when it has
    several image topics and none is chosen.
    """

    _cure = CURE
    recorded = True

    def __init__(self, path: Path, topic: str | None = None, fps: float | None = None) -> None:
        self._bag = open_bag(path)
        chosen = _choose(path, self._bag, topic)
        warnings = list(self._bag.warnings)
        if fps is not None:
            warnings.append(f'{path} is a bag, its images have stamps: fps is ignored')
        super().__init__(str(path), chosen.count, chosen.name, tuple(warnings))

    @property
    def begin_ns(self) -> int | None:
        """Return when the first image was recorded; None where that cannot be read."""
        try:
            first = next(self._bag.records([str(self.topic)], lambda _: None), None)
        except (InputError, OSError):
            return None
        return None if first is None else first.receive_ns

    def _pictures(self, reading: Reading, start_ns: int = 0) -> Generator[Picture, None, None]:
        gate, depth = StampGate(), BitDepth()
        damage: list[str] = []
        first_ns: int | None = None
        try:
            for record in self._bag.records([str(self.topic)], damage.append):
                index = reading.images
                reading.images += 1
                try:
                    message = record.message()
                except InputError as error:
                    reading.failed(index, error)
                    continue
                stamp_ns = gate.take(_header_ns(message), record.receive_ns)
                if stamp_ns is None:
                    continue
                first_ns = stamp_ns if first_ns is None else first_ns
                if stamp_ns - first_ns >= start_ns:
                    yield Picture(index, stamp_ns, partial(decode, message, depth),
                                  str(message.header.frame_id))
            reading.warnings += self._losses(reading.images, damage)
        finally:
            reading.warnings += gate.warnings()

    def _losses(self, read: int, damage: list[str]) -> list[str]:
        lost = (self._promised or 0) - read if self._bag.indexed else 0
        if not damage and lost <= 0:
            return []
        why = f' ({"; ".join(damage[:2])}{" ..." if len(damage) > 2 else ""})' if damage else ''
        start = f'the bag is damaged{why}: read {read}'
        if lost > 0:
            return [f'{start} of {self._promised} images; {lost} are lost']
        if self._bag.indexed:
            return [f'{start} of {self._promised} images; none is lost']
        return [f'{start} images; how many are lost is not known']


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
