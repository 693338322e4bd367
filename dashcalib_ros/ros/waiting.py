"""Why no images come: which topic is awaited, and which ones there are."""
from __future__ import annotations

import time

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy

from dashcalib_ros.ros.images import ImageInput

# s without an image before it is told, and between two such lines
SILENT_S = 4.0
AGAIN_S = 60.0
IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
MOST_TOPICS = 8


class Waiting:
    """Says from time to time that images are missing, and what to do."""

    def __init__(self, node: Node, images: ImageInput) -> None:
        self._node = node
        self._images = images
        self._started = time.monotonic()
        self._said: float | None = None

    def look(self, silent_s: float | None) -> None:
        """Tell when there have been no images for some time; silent_s: since the last one."""
        now = time.monotonic()
        missing_s = now - self._started if silent_s is None else silent_s
        if missing_s < SILENT_S:
            self._said = None
        elif self._said is None or now - self._said >= AGAIN_S:
            self._said = now
            since = 'yet' if silent_s is None else f'for {silent_s:.0f} s'
            self._node.get_logger().info(f'no images on {self._images.topic} {since}; '
                                         f'{self._reason()}')

    def _reason(self) -> str:
        """Return why, as far as it is known, and the cure."""
        topic = self._images.topic
        if self._node.count_publishers(topic):
            return self._mismatch()
        wanted, other = ((COMPRESSED, IMAGE) if self._images.compressed else (IMAGE, COMPRESSED))
        found, others = self._published(wanted), self._published(other)
        if found:
            name = found[0].removesuffix('/compressed')
            return (f'publishers of {_short(wanted)}: {_listed(found)}; '
                    f'remap with -r image_raw:={name}')
        if others:
            transport, name = (('raw', others[0]) if self._images.compressed else
                               ('compressed', others[0].removesuffix('/compressed')))
            return (f'there are no publishers of {_short(wanted)}, but of {_short(other)}: '
                    f'{_listed(others)}; set -p image_transport:={transport} '
                    f'-r image_raw:={name}')
        return (f'there are no publishers of {_short(wanted)}: start the camera driver or play a '
                f'bag, with the same ROS_DOMAIN_ID as this node')

    def _mismatch(self) -> str:
        """Return what keeps the images of existing publishers away."""
        infos = self._node.get_publishers_info_by_topic(self._images.topic)
        kind = COMPRESSED if self._images.compressed else IMAGE
        types = sorted({info.topic_type for info in infos} - {kind})
        if types:
            return (f'its publisher sends {", ".join(map(_short, types))}, not {_short(kind)}: '
                    f'remap another topic with -r image_raw:=TOPIC')
        best_effort = any(info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
                          for info in infos)
        if best_effort and self._images.reliability == 'reliable':
            return ('its publisher is best effort, which a reliable subscription does not hear: '
                    'set -p reliability:=auto')
        return (f'it has {len(infos)} publisher{"" if len(infos) == 1 else "s"} that '
                f'send{"s" if len(infos) == 1 else ""} nothing: look at the camera driver')

    def _published(self, kind: str) -> list[str]:
        """Return the topics of a type that others publish."""
        own = {name for name, _ in self._node.get_publisher_names_and_types_by_node(
            self._node.get_name(), self._node.get_namespace())}
        # image_transport knows a compressed topic by its name only
        end = '/compressed' if kind == COMPRESSED else ''
        return sorted(name for name, types in self._node.get_topic_names_and_types()
                      if kind in types and name.endswith(end) and name not in own
                      and self._node.count_publishers(name))


def _short(kind: str) -> str:
    return kind.replace('/msg/', '/')


def _listed(names: list[str]) -> str:
    more = len(names) - MOST_TOPICS
    return ', '.join(names[:MOST_TOPICS]) + (f' and {more} more' if more > 0 else '')
