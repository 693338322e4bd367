"""The subscription to the camera: raw or compressed, with the reliability its publishers have."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

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

from dashcalib_ros.ros.qos import make_subscription, override_of
from dashcalib_ros.ros.settings import NodeConfig

# images a subscription holds for a callback that is late
DEPTH = 5
# s between two checks of the publishers: images before the right subscription are lost
LOOK_S = 0.25
NAMED = {'best_effort': ReliabilityPolicy.BEST_EFFORT, 'reliable': ReliabilityPolicy.RELIABLE}


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
