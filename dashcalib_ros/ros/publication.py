"""The topics of the calibration: beside each image, and latched."""
from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from dashcalib_ros.report import NamedCamera
from dashcalib_ros.ros.messages import camera_info, uncalibrated
from dashcalib_ros.ros.qos import make_publisher

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# a reliable publisher reaches reliable and best-effort subscribers alike
BESIDE_IMAGES = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


class Publication:
    """Publishes a camera between set() and retract(), and nothing before or after.

    info: what is published now. sent: how many were published beside images.
    """

    def __init__(self, node: Node, rectified: str) -> None:
        """rectified: what P shows, the setting of this name."""
        self.info: CameraInfo | None = None
        self.sent = 0
        self._rectified = rectified
        self._clock = node.get_clock()
        self._beside = make_publisher(node, CameraInfo, 'camera_info', BESIDE_IMAGES)
        self._latched = make_publisher(node, CameraInfo, '~/calibration', LATCHED)
        # the full name of the topic beside the images
        self.topic = str(self._beside.topic_name)

    def set(self, camera: NamedCamera, frame_id: str) -> None:
        """Publish this one from now on."""
        self.info = camera_info(camera.camera, self._now(frame_id), self._rectified)
        self._latched.publish(self.info)

    def retract(self) -> None:
        """Stop publishing; the latched topic gets an uncalibrated message."""
        if self.info is not None:
            self._latched.publish(uncalibrated(self._now(self.info.header.frame_id)))
        self.info = None

    def accompany(self, header: Header, size: tuple[int, int]) -> None:
        """Publish for one image, with its header, if the camera has such images."""
        if self.info is not None and (self.info.width, self.info.height) == size:
            self.info.header = header
            self._beside.publish(self.info)
            self.sent += 1

    def _now(self, frame_id: str) -> Header:
        return Header(stamp=self._clock.now().to_msg(), frame_id=frame_id)
