# SPDX-License-Identifier: Apache-2.0
"""The camera's images: subscribed, separated from strays, and reported when they are missing.

All of this runs in the executor's thread. It reads no pixels, but of images that seem to be of
another camera than before: damaged ones must not be believed.
"""
from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

from rclpy.qos import QoSPolicyKind, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.utilities import get_rmw_implementation_identifier

from dashcalib_ros.errors import InputError, coded, counted
from dashcalib_ros.input.bag_write import base_topic
from dashcalib_ros.input.decode import message_size
from dashcalib_ros.input.stamps import StampGate
from dashcalib_ros.ros.background import decode_checked
from dashcalib_ros.ros.diagnostics import Complaints
from dashcalib_ros.ros.endpoints import Endpoints, message_class, profile
from dashcalib_ros.ros.interface import SUBSCRIBED
from dashcalib_ros.ros.parameters import RELIABILITIES
from dashcalib_ros.ros.settings import NodeConfig

# messages in a row of another size, frame or calibration that count as a change: those of a
# second publisher alternate with the first one's
LASTING = 10
T = TypeVar('T')

CURES = {
    'lost': 'images are lost between the camera and this node (gaps in the stamps)',
    'dropped': 'images are dropped because detection does not keep up: lower tracking.rate, '
               'tracking.width or tracking.points',
    'repeated': 'images have stamps that are not later than those before: check for a second '
                'publisher on the topic',
    'unstamped': 'some images have no stamp, and others have one: fix the camera driver',
    'set_back': 'the stamps jumped back (as those of a bag that loops): tracking starts again, '
                'and the turns are kept',
}
# DDS lists a publisher for 20 s after it was killed: two of one node are two cameras only if their
# messages alternate, so that the sequence number falls twice within so many messages
ALTERNATING = 30
UNKNOWN = 'unknown node'
# packets that a subscription holds for a callback that is late; a lost one costs more images
VIDEO_DEPTH = 50
# s without an image before it is logged, and between two such lines
SILENT_S, AGAIN_S = 4.0, 60.0
# types of topics, and their transports
PACKET, VIDEO = ('ffmpeg_image_transport_msgs/msg/FFMPEGPacket',
                 'foxglove_msgs/msg/CompressedVideo')
IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
KINDS = {IMAGE: 'raw', COMPRESSED: 'compressed', PACKET: 'video', VIDEO: 'video'}
# where image_transport has videos: what is added to the name of a topic, and the type there
VIDEOS = (('/ffmpeg', PACKET), ('/foxglove', VIDEO), ('', VIDEO), ('', PACKET),
          ('/compressed', COMPRESSED), ('', COMPRESSED))
# that are listed in one line
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
        does not mean a change. It is called for few messages: not for those of the present source,
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
            what = self._watch.take(source, lambda: decode_checked(message, source.size))
        except InputError as error:
            self._complaints.say('undecodable', coded(error))
            return None
        if what == 'stray':
            self._complaints.say('strays', f'an image is {source}, the camera is '
                                           f'{self.source}: check for a second publisher')
            return None
        if what != 'same':
            self._changed(self._watch.previous, source)
        return index, source

    def stamp_ns(self, message: Any) -> int | None:
        """Return the image's stamp, None for an image that is not needed or comes too late."""
        stamp = message.header.stamp
        return self._stamps.take(stamp.sec * 10**9 + stamp.nanosec, time.monotonic_ns())

    @property
    def clock(self) -> list[str]:
        """Return why the stamps of the images are not used, in at most one line."""
        return [f'{text} [{text.code}]' for text in self._stamps.of_clock()]

    def forget(self) -> None:
        """Begin anew with the stamps: turns and tracks were dropped."""
        self._stamps.forget()

    def complain(self, dropped: int, why_lost: str) -> None:
        """Log what went wrong since the last call.

        dropped: images dropped by the detection. why_lost: the causes of lost ones, with remedies.
        """
        stamps = self._stamps
        for text in self.clock:
            self._complaints.once(text)
        self._complaints.total('lost', stamps.lost, f'{CURES["lost"]}: {why_lost}')
        for kind, count in (('dropped', dropped), ('repeated', stamps.repeated),
                            ('unstamped', stamps.zero), ('set_back', stamps.set_back)):
            if kind != 'repeated' or not stamps.fault:
                self._complaints.total(kind, count, CURES[kind])


class ImageInput:
    """Subscribes to the image topic; with reliability 'auto' it follows the publishers.

    A reliable subscription does not match a best-effort camera. A best-effort one matches both,
    but loses large images that a reliable one would receive. So it is reliable if all publishers
    are. An override of its QoS comes first: then nothing is followed.

    Of a video, the topic and its type are those of the first publisher that there is.

    topic: its full name; base: without the transport. publishers: the names of its nodes, twice
    after a restart until DDS has forgotten the first. reliability: of the present subscription.
    """

    def __init__(self, endpoints: Endpoints, config: NodeConfig,
                 callback: Callable[[Any], None]) -> None:
        self._node, self._log = endpoints.node, endpoints.log
        self._callback = callback
        self._kind: str | None = {'raw': IMAGE, 'compressed': COMPRESSED}.get(
            config.image_transport)
        # as image_transport does: remap the base topic, then append the transport
        self.base = base = self._node.resolve_topic_name('image_raw')
        self.topic = f'{base}/compressed' if self._kind == COMPRESSED else base
        self._is_video = self._kind is None
        self.publishers: tuple[str, ...] = ()
        # messages so far, the last one's sequence number, and when that fell
        self._count = 0
        self._number: int | None = 0
        self._falls: deque[int] = deque([-ALTERNATING] * 2, maxlen=2)
        override = endpoints.given.get(f'qos_overrides.{self.topic}.subscription.reliability')
        # without an override, rclpy's parameter would hold the first value for each later one
        self._overridable = None if self._kind is None else QoSOverridingOptions(
            (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH,
             *([QoSPolicyKind.RELIABILITY] if override else [])))
        self.reliability = override or config.reliability
        self._auto = self.reliability not in RELIABILITIES
        if self._auto:
            self.reliability = 'best_effort'
        self._subscription: Subscription | None = None
        self._active = False
        self._missing = ''
        self._started = time.monotonic()
        self._logged: float | None = None
        endpoints.at_end(self.stop)

    @property
    def override_names(self) -> frozenset[str]:
        """Return the parameters that override the QoS; they are declared with the subscription."""
        return frozenset() if self._is_video else frozenset(
            f'qos_overrides.{self.topic}.subscription.{policy}'
            for policy in ('history', 'depth', 'reliability'))

    @property
    def listening(self) -> bool:
        """Return whether the images are subscribed, or will be as soon as there are any."""
        return self._active

    @property
    def several(self) -> bool:
        """Return whether the images are of several publishers."""
        if len(self.publishers) < 2:
            return False
        alternating = self._number is None or self._count - self._falls[0] < ALTERNATING
        return alternating or len({*self.publishers} - {UNKNOWN}) > 1

    def start(self) -> None:
        """Subscribe."""
        self._active = True
        if self._subscription is None and self._kind is not None:
            self._subscription = self._subscribe(self._kind)

    def stop(self) -> None:
        """End the subscription."""
        self._active = False
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _subscribe(self, kind: str) -> Subscription:
        qos = profile(SUBSCRIBED['image_raw'])
        qos.reliability = ReliabilityPolicy[self.reliability.upper()]
        if self._is_video:
            qos.depth = VIDEO_DEPTH
        callback: Any = self._on_message  # rclpy's annotation knows callbacks of one argument only
        return self._node.create_subscription(message_class(kind), self.topic, callback, qos,
                                              qos_overriding_options=self._overridable)

    def _on_message(self, message: Any, about: Any) -> None:
        number = about['publication_sequence_number']  # None where the middleware has none
        self._count += 1
        if number is not None and self._number is not None and number <= self._number:
            self._falls.append(self._count)
        self._number = number
        self._callback(message)

    def _find_video(self) -> None:
        for transport, kind in VIDEOS:
            topic = f'{self.base}{transport}'
            if any(info.topic_type == kind
                   for info in self._node.get_publishers_info_by_topic(topic)):
                try:
                    message_class(kind)
                except ImportError:
                    self._log_missing(topic, kind)
                    continue
                self.topic, self._kind = topic, kind
                self._log.info(f'the video is {kind} on {topic}')
                if self._active:
                    self.start()
                return

    def _log_missing(self, topic: str, kind: str) -> None:
        if self._missing != kind:
            self._missing = kind
            package = kind.partition('/')[0].replace('_', '-')
            self._log.error(f'{topic} has {kind}, whose package is not installed: apt install '
                            f'ros-$ROS_DISTRO-{package}')

    def look(self) -> None:
        """Find out who publishes, and follow that: images before the right one are lost."""
        if self._kind is None:
            self._find_video()
        infos = self._node.get_publishers_info_by_topic(self.topic)
        self.publishers = tuple(sorted(map(_node_name, infos)))
        if not self._auto or not infos or not self.listening:
            return
        fitting = 'reliable' if all(map(_reliable, infos)) else 'best_effort'
        if fitting != self.reliability:
            self._log.info(f'{self.topic}: subscribing {fitting}, like its publishers')
            self.stop()
            self.reliability = fitting
            self.start()

    @property
    def why_lost(self) -> str:
        """Return what may lose images, with the remedies not in use, as far as seen here."""
        if self.reliability == 'reliable':
            return ('publisher and subscription are reliable, so the camera driver skips images, '
                    'or this computer is overloaded; check the rate of the driver and the load')
        infos = self._node.get_publishers_info_by_topic(self.topic)
        remedies = ['set reliability to auto' if infos and all(map(_reliable, infos)) else
                    'let the driver publish reliable images']
        if self._kind == IMAGE:
            remedies.append('publish compressed images')
            if get_rmw_implementation_identifier().startswith('rmw_fastrtps'):
                remedies.append("start the driver's process with config/fastdds_large_images.xml "
                                '(this node cannot see whether it already does)')
        return ('either the camera driver skips images: check its rate; or the best-effort '
                f'transport loses them: {", or ".join(remedies)}')

    def log_silence(self, silent_s: float | None) -> None:
        """Log from time to time that images are missing; silent_s: since the last one."""
        now = time.monotonic()
        missing_s = now - self._started if silent_s is None else silent_s
        if missing_s < SILENT_S:
            self._logged = None
        elif self._logged is None or now - self._logged >= AGAIN_S:
            self._logged = now
            self._log.info(f'no images on {self.topic} {since_text(silent_s)}; {self._reason()}')

    def _reason(self) -> str:
        infos = self._node.get_publishers_info_by_topic(self.topic)
        if not infos:
            found = self._published()
            return (f'publishers of images: {" or ".join(found)}' if found else
                    'there are no publishers of images: start the camera driver or play a bag, '
                    'with the same ROS_DOMAIN_ID as this node')
        others = {info.topic_type for info in infos} - {self._kind}
        if others:
            found = [_arguments(self.topic, kind) for kind in sorted(others)
                     if _has_a_name(self.topic, kind)]
            return (f'its publisher sends {", ".join(sorted(others))}: ' + (
                f'start the node with {" or ".join(found)}' if found else
                'remap another topic with -r image_raw:=TOPIC'))
        if self.reliability == 'reliable' and not all(map(_reliable, infos)):
            return ('its publisher is best effort, and a reliable subscription receives nothing '
                    'from it: set -p reliability:=auto')
        if self._is_video:
            return ('its publisher sent no key frame: configure the encoder to send one every few '
                    'seconds (gop_size), or check the camera driver')
        return f'its {counted(len(infos), "publisher")} sent nothing: check the camera driver'

    def _published(self) -> list[str]:
        node = self._node
        own = {name for name, _ in node.get_publisher_names_and_types_by_node(
            node.get_name(), node.get_namespace())}
        found = [(name, kind) for name, kinds in node.get_topic_names_and_types()
                 for kind in kinds if _has_a_name(name, kind) and name not in own
                 and not self._drawn(name)]
        return [_arguments(name, kind)
                for name, kind in sorted(found) if node.count_publishers(name)][:MOST_TOPICS]

    def _drawn(self, topic: str) -> bool:
        """Return whether another node like this one draws what is on a topic, for people."""
        place, _, _ = base_topic(topic).rpartition('/')
        return bool(self._node.count_publishers(f'{place}/turn_magnitude'))


def _has_a_name(topic: str, kind: str) -> bool:
    # image_transport knows a compressed topic by its name only
    return kind in KINDS and (kind != COMPRESSED or topic.endswith('/compressed'))


def _arguments(topic: str, kind: str) -> str:
    return f'-r image_raw:={base_topic(topic)} -p image_transport:={KINDS[kind]}'


def since_text(silent_s: float | None) -> str:
    """Return since when there are no images, None: none came."""
    return 'yet' if silent_s is None else f'for {silent_s:.0f} s'


def _node_name(info: TopicEndpointInfo) -> str:
    # for a moment, and of programs without ROS, the middleware does not know it
    if info.node_name.startswith('_NODE_NAME_UNKNOWN'):
        return UNKNOWN
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def _reliable(info: TopicEndpointInfo) -> bool:
    return bool(info.qos_profile.reliability == ReliabilityPolicy.RELIABLE)
