"""The car around the camera: its sensors come in; how the camera sits on it goes out.

That is a pose, and a static transform (REP-103, REP-105). What sensors measure is kept where their
topics are set, and used at each calibration.
"""
from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.exceptions import NameValidationException
from std_msgs.msg import Header

from dashcalib_ros.errors import ConfigError
from dashcalib_ros.input.motion import values_in
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.report.wording import mount_text
from dashcalib_ros.ros.endpoints import Endpoints
from dashcalib_ros.ros.interface import TF_STATIC
from dashcalib_ros.ros.settings import NodeConfig
from dashcalib_ros.ros.transforms import static_broadcaster

# s; within this time others publish that they have the frame
LISTEN_S = 2.0
# variance of an angle of which nothing is known, rad^2
UNKNOWN = math.pi**2 / 3
# as SensorBuffer.add(): with a kind, the stamp in s and the values
AddMeasurement = Callable[[str, float, Sequence[float]], None]


class Mounting:
    """Publishes the mounting on ~/mount, and with publish_tf once on /tf_static."""

    def __init__(self, endpoints: Endpoints, own: NodeConfig) -> None:
        self._node, self._log, self._own = endpoints.node, endpoints.log, own
        self._warn = endpoints.complaints.once
        # what was published last
        self.mount: Mount | None = None
        self._pose = endpoints.publisher('~/mount')
        self._sent: Mount | None = None
        self._waiting: tuple[Mount, str] | None = None
        self._since = time.monotonic()
        # the parent of each frame, as others publish it
        self._parents: dict[str, str] = {}
        self._send = static_broadcaster(endpoints) if own.publish_tf else None
        if self._send is not None:
            endpoints.subscription(TF_STATIC, self._listen)
            endpoints.timer(LISTEN_S / 2, self.tick)

    def show(self, mount: Mount | None, frame_id: str) -> None:
        """Publish a mounting; None: there is none. frame_id: of the images."""
        self.mount = mount
        if mount is None:
            return
        self._pose.publish(self._message(mount))
        if self._send is not None and mount.verdict == 'accepted':
            self._waiting = mount, self._own.camera_frame or frame_id

    def tick(self) -> None:
        """Send the transform that waits, once others had the time to publish theirs."""
        if self._waiting is None or time.monotonic() - self._since < LISTEN_S:
            return
        (mount, frame), self._waiting = self._waiting, None
        if not frame:
            self._warn('no static transform is published: the images have no frame_id; set '
                       'camera_frame')
        elif self._parents.get(frame, self._own.base_frame) != self._own.base_frame:
            self._warn(f'no static transform is published: the frame {frame} already has the '
                       f'parent {self._parents[frame]}, and it can have only one; set publish_tf '
                       f'to false, or camera_frame to another name')
        elif self._sent is None or differs(mount, self._sent):
            self._sent = mount
            assert self._send is not None
            self._send(self._transform(mount, frame))
            self._log.info(f'static transform {self._own.base_frame} -> {frame}: '
                           f'{mount_text(mount)}')

    def _listen(self, message: Any) -> None:
        self._parents.update({each.child_frame_id.lstrip('/'): each.header.frame_id.lstrip('/')
                              for each in message.transforms})

    def _message(self, mount: Mount) -> PoseWithCovarianceStamped:
        message = PoseWithCovarianceStamped(header=self._header())
        pose = message.pose.pose
        self._place(mount, pose.position, pose.orientation)
        found = mount.sigma['height_m'] if not self._own.mount_z else None
        variances = [0.0, 0.0, (found or 0.0)**2]
        for name in ('roll_right_deg', 'pitch_up_deg', 'yaw_left_deg'):
            sigma = mount.sigma[name]
            variances.append(UNKNOWN if sigma is None else math.radians(sigma)**2)
        message.pose.covariance = np.diag(variances).ravel()
        return message

    def _transform(self, mount: Mount, frame: str) -> TransformStamped:
        message = TransformStamped(header=self._header(), child_frame_id=frame)
        self._place(mount, message.transform.translation, message.transform.rotation)
        return message

    def _header(self) -> Header:
        return Header(stamp=self._node.get_clock().now().to_msg(), frame_id=self._own.base_frame)

    def _place(self, mount: Mount, place: Any, turn: Any) -> None:
        """Fill in a position and an orientation."""
        own = self._own
        # a parameter of 1 is an integer
        place.x, place.y, place.z = map(
            float, (own.mount_x, own.mount_y, own.mount_z or mount.height_m or 0.0))
        turn.x, turn.y, turn.z, turn.w = mount.quaternion


def differs(mount: Mount, other: Mount) -> bool:
    """Return whether a mounting is another one than before, or knows its roll now."""
    return (mount.moved_from(other)
            or (mount.roll_right_deg is None) != (other.roll_right_deg is None))


def subscribe_sensors(endpoints: Endpoints, own: NodeConfig, add: AddMeasurement) -> None:
    """Subscribe to the sensors whose topics are set, and pass on what they measure.

    Raises ConfigError for an invalid topic name.
    """
    for name, option in (('imu_topic', 'imu'), ('odom_topic', 'odom'), ('fix_topic', 'gps')):
        topic = getattr(own, name)
        if not topic:
            continue
        try:
            endpoints.subscription(name, partial(_pass_on, add, option), topic)
        except NameValidationException as error:
            raise ConfigError('E-TOPIC-NAME-INVALID',
                              f'{name} {topic!r} is not a valid topic name: use a name such '
                              f'as /car/{option}') from error


def _pass_on(add: AddMeasurement, option: str, message: Any) -> None:
    stamp_s = float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
    for kind, values in values_in(message, option):
        # of odometry only the speed is used
        if kind != 'odom_rate':
            add(kind, stamp_s, values)
