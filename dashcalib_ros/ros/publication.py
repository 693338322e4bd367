"""The calibration that is published: beside each image, latched, and on disk."""
from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from dashcalib_ros.ros.messages import camera_info, uncalibrated
from dashcalib_ros.ros.store import Kept
from dashcalib_ros.ros.stream import Source

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# a reliable publisher reaches reliable and best-effort subscribers alike
BESIDE_IMAGES = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


class Publication:
    """Publishes a calibration from set() on until retract(); nothing before, nothing after.

    kept: the calibration. stale: it is contradicted, and published only because the user wants it.
    sent: how many were published beside images.
    """

    def __init__(self, node: Node) -> None:
        self.kept: Kept | None = None
        self.stale = False
        self.sent = 0
        self._node = node
        self._info = CameraInfo()
        self._beside = node.create_publisher(CameraInfo, 'camera_info', BESIDE_IMAGES)
        self._latched = node.create_publisher(CameraInfo, '~/calibration', LATCHED)

    @property
    def topic(self) -> str:
        """Return the full name of the topic beside the images."""
        return str(self._beside.topic_name)

    def set(self, kept: Kept) -> CameraInfo:
        """Publish this one from now on; return it as a message."""
        self.kept, self.stale = kept, False
        self._info = camera_info(kept.camera, self._now(kept.frame_id))
        self._latched.publish(self._info)
        return self._info

    def retract(self) -> None:
        """Fall silent; late subscribers of the latched topic get an uncalibrated one."""
        if self.kept is not None:
            self._latched.publish(uncalibrated(self._now(self.kept.frame_id)))
        self.kept, self.stale = None, False

    def accompany(self, header: Header, source: Source) -> None:
        """Publish for one image, with its header, if the calibration is for such images."""
        if self.kept is not None and self.kept.camera.image_size == source.size:
            self._info.header = header
            self._beside.publish(self._info)
            self.sent += 1

    def _now(self, frame_id: str) -> Header:
        return Header(stamp=self._node.get_clock().now().to_msg(), frame_id=frame_id)
