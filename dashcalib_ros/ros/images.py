"""The camera's images: subscribed, told apart from strays, and asked for when they are missing.

All of this runs in the executor's thread. It reads no pixels, but of images that tell of another
camera than before: damaged ones must not be believed.
"""
from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

from rclpy.clock import Clock
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, Image

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.decode import message_size
from dashcalib_ros.input.stamps import StampGate
from dashcalib_ros.ros.background import whole
from dashcalib_ros.ros.diagnostics import Complaints, since_text
from dashcalib_ros.ros.parameters import make_subscription, override_of
from dashcalib_ros.ros.settings import NodeConfig

# messages in a row of another size, frame or calibration that count as a change: those of a
# second publisher alternate with the first one's
LASTING = 10
T = TypeVar('T')

CURES = {
    'lost': 'images are lost between the camera and this node (gaps in the stamps): give the '
            "camera driver's process config/fastdds_large_images.xml, or publish reliable or "
            'compressed images',
    'dropped': 'images are dropped because detection does not keep up: set motion.rate, '
               'motion.width or motion.points lower',
    'repeated': 'images have stamps that are not later than those before: is there a second '
                'publisher on the topic?',
    'unstamped': 'images without a stamp among others that have one: repair the camera driver',
    'set_back': 'the stamps were set back (a bag that loops?): tracking begins anew, the turns '
                'are kept',
}
# images a subscription holds for a callback that is late
DEPTH = 5
# s between two checks of the publishers: images before the right subscription are lost
LOOK_S = 0.25
NAMED = {'best_effort': ReliabilityPolicy.BEST_EFFORT, 'reliable': ReliabilityPolicy.RELIABLE}
# s without an image before it is told, and between two such lines
SILENT_S, AGAIN_S = 4.0, 60.0
IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
MOST_TOPICS = 8


@dataclass(frozen=True)
class Source:
    """What all images of one camera share: size (width, height) in px, and frame_id."""

    size: tuple[int, int]
    frame_id: str

    def __str__(self) -> str:
        return f'{self.size[0]}x{self.size[1]} in frame {self.frame_id!r}'


class SourceWatch(Generic[T]):
    """Distinguishes a changed camera from single stray messages. previous: before the change.

    T: what the messages of one camera share.
    """

    def __init__(self) -> None:
        self.current: T | None = None
        self.previous: T | None = None
        self._other: T | None = None
        self._run = 0

    def take(self, source: T, check: Callable[[], object] = lambda: None
             ) -> Literal['first', 'same', 'stray', 'changed']:
        """Take the next message's source.

        check: raises InputError, which goes on to the caller, for a damaged message: such a one
        is no sign of a change. It is called for few messages: not for those of the present source,
        nor for strays between them.
        """
        if source == self.current:
            self._run = 0
            return 'same'
        if self.current is None:
            check()
            self.current = source
            return 'first'
        run = self._run + 1 if source == self._other else 1
        self._other, self._run = source, 0
        if run > 1:
            check()
        self._run = run
        if run < LASTING:
            return 'stray'
        self.previous, self.current, self._run = self.current, source, 0
        return 'changed'


class Intake:
    """Takes the messages of the camera's topic. received: how many there were.

    changed: called with the source before (None at first) and the present one, when images of
    another camera come. Before that, the image that shows the change is not accepted.
    """

    def __init__(self, rate: float, complaints: Complaints,
                 changed: Callable[[Source | None, Source], None]) -> None:
        """rate: Hz, of the images that are used."""
        self.received = 0
        self._complaints = complaints
        self._changed = changed
        self._watch: SourceWatch[Source] = SourceWatch()
        self._stamps = StampGate(rate)
        self._last: float | None = None

    @property
    def source(self) -> Source | None:
        """Return what the camera's images have in common, None before the first."""
        return self._watch.current

    @property
    def silent_s(self) -> float | None:
        """Return the time since the last image in s, None before the first."""
        return None if self._last is None else time.monotonic() - self._last

    def take(self, message: Any) -> tuple[int, Source] | None:
        """Take a message; return its number and source, None if it is not of the camera."""
        index, self.received = self.received, self.received + 1
        self._last = time.monotonic()
        try:
            source = Source(message_size(message), message.header.frame_id)
            what = self._watch.take(source, lambda: whole(message, source.size))
        except InputError as error:
            self._complaints.say('undecodable', str(error))
            return None
        if what == 'stray':
            self._complaints.say('strays', f'an image is {source}, the camera is '
                                           f'{self.source}: is there a second publisher?')
            return None
        if what != 'same':
            self._changed(self._watch.previous, source)
        return index, source

    def stamp_ns(self, message: Any) -> int | None:
        """Return the image's stamp, None for an image that is not needed or comes too late."""
        stamp = message.header.stamp
        return self._stamps.take(stamp.sec * 10**9 + stamp.nanosec, time.monotonic_ns())

    def forget(self) -> None:
        """Begin anew with the stamps: turns and tracks were dropped."""
        self._stamps.forget()

    def complain(self, dropped: int) -> None:
        """Tell what went wrong since the last call; dropped: images dropped by the detection."""
        stamps = self._stamps
        for kind, count in (('lost', stamps.lost), ('dropped', dropped),
                            ('repeated', stamps.repeated), ('unstamped', stamps.zero),
                            ('set_back', stamps.set_back)):
            self._complaints.total(kind, count, CURES[kind])


class ImageInput:
    """Subscribes to the image topic; with reliability 'auto' it follows the publishers.

    A reliable subscription does not match a best-effort camera. A best-effort one matches both,
    but loses large images that a reliable one would receive. So it is reliable if all publishers
    are. An override of its QoS comes first: then nothing is followed.

    topic: its full name. compressed: whether it has compressed images. publishers: how many there
    are. listening: from start() to stop(). reliability: of the present subscription.
    """

    def __init__(self, node: Node, config: NodeConfig, callback: Callable[[Any], None],
                 clock: Clock) -> None:
        self._node = node
        self._callback = callback
        self.compressed = config.image_transport == 'compressed'
        # as image_transport does: remap the base topic, then append the transport
        base = node.resolve_topic_name('image_raw')
        self.topic = f'{base}/compressed' if self.compressed else base
        self.publishers = 0
        overridden = override_of(node, self.topic, QoSPolicyKind.RELIABILITY)
        named = overridden if overridden in NAMED else config.reliability
        self._auto = overridden is None and config.reliability == 'auto'
        # a parameter would hold the first value for each later subscription
        self._fixed = (QoSPolicyKind.RELIABILITY,) if overridden is None else ()
        self._reliability = NAMED.get(named, ReliabilityPolicy.BEST_EFFORT)
        self._subscription: Subscription | None = None
        self._started = time.monotonic()
        self._said: float | None = None
        self._timer = node.create_timer(LOOK_S, self._look, clock=clock)

    @property
    def listening(self) -> bool:
        """Return whether the images are subscribed."""
        return self._subscription is not None

    def start(self) -> None:
        """Subscribe."""
        if self._subscription is None:
            self._subscription = self._subscribe()

    def stop(self) -> None:
        """End the subscription."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    @property
    def reliability(self) -> str:
        """Return the reliability of the present subscription."""
        return self._reliability.name.lower()

    def _subscribe(self) -> Subscription:
        profile = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH,
                             reliability=self._reliability, durability=DurabilityPolicy.VOLATILE)
        kind = CompressedImage if self.compressed else Image
        return make_subscription(self._node, kind, self.topic, self._callback, profile,
                                 self._fixed)

    def _look(self) -> None:
        offered = [info.qos_profile.reliability
                   for info in self._node.get_publishers_info_by_topic(self.topic)]
        self.publishers = len(offered)
        if not self._auto or not offered or not self.listening:
            return
        every = all(each == ReliabilityPolicy.RELIABLE for each in offered)
        fitting = ReliabilityPolicy.RELIABLE if every else ReliabilityPolicy.BEST_EFFORT
        if fitting != self._reliability:
            self._node.get_logger().info(
                f'{self.topic}: subscribing {fitting.name.lower()}, as its publishers do')
            self.stop()
            self._reliability = fitting
            self.start()

    def tell_silence(self, silent_s: float | None) -> None:
        """Tell from time to time that images are missing; silent_s: since the last one."""
        now = time.monotonic()
        missing_s = now - self._started if silent_s is None else silent_s
        if missing_s < SILENT_S:
            self._said = None
        elif self._said is None or now - self._said >= AGAIN_S:
            self._said = now
            self._node.get_logger().info(f'no images on {self.topic} {since_text(silent_s)}; '
                                         f'{self._reason()}')

    def _reason(self) -> str:
        """Return why, as far as it is known, and the cure."""
        topic = self.topic
        if self._node.count_publishers(topic):
            return self._mismatch()
        wanted, other = ((COMPRESSED, IMAGE) if self.compressed else (IMAGE, COMPRESSED))
        found, others = self._published(wanted), self._published(other)
        if found:
            name = found[0].removesuffix('/compressed')
            return (f'publishers of {_short(wanted)}: {_listed(found)}; '
                    f'remap with -r image_raw:={name}')
        if others:
            transport, name = (('raw', others[0]) if self.compressed else
                               ('compressed', others[0].removesuffix('/compressed')))
            return (f'there are no publishers of {_short(wanted)}, but of {_short(other)}: '
                    f'{_listed(others)}; set -p image_transport:={transport} '
                    f'-r image_raw:={name}')
        return (f'there are no publishers of {_short(wanted)}: start the camera driver or play a '
                f'bag, with the same ROS_DOMAIN_ID as this node')

    def _mismatch(self) -> str:
        """Return what keeps the images of existing publishers away."""
        infos = self._node.get_publishers_info_by_topic(self.topic)
        kind = COMPRESSED if self.compressed else IMAGE
        types = sorted({info.topic_type for info in infos} - {kind})
        if types:
            return (f'its publisher sends {", ".join(map(_short, types))}, not {_short(kind)}: '
                    f'remap another topic with -r image_raw:=TOPIC')
        best_effort = any(info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
                          for info in infos)
        if best_effort and self.reliability == 'reliable':
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
