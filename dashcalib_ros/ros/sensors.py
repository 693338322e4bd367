"""The car's own sensors, where topics are named: they are kept, and asked at each calibration."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, NavSatFix

from dashcalib_ros.input.motion import local_metres
from dashcalib_ros.ros.settings import NodeConfig

# best effort also receives from reliable publishers; a second of a fast gyro
SENSOR = QoSProfile(depth=400, reliability=ReliabilityPolicy.BEST_EFFORT)
# of NavSatStatus; -2 is unknown
NO_FIX = -1
Take = Callable[[str, float, Sequence[float]], None]


class Sensors:
    """Subscribes the sensors that are named, and passes on what they say."""

    def __init__(self, node: Node, own: NodeConfig, take: Take) -> None:
        """take: called with a kind of SensorStream's, the stamp in s and the values."""
        self._take = take
        self._first: tuple[float, float, float] | None = None
        for topic, kind, callback in ((own.imu_topic, Imu, self._imu),
                                      (own.odom_topic, Odometry, self._odometry),
                                      (own.fix_topic, NavSatFix, self._fix)):
            if topic:
                node.create_subscription(kind, topic, callback, SENSOR)

    def _imu(self, message: Any) -> None:
        rate = message.angular_velocity
        self._take('rate', _stamp_s(message), (rate.x, rate.y, rate.z))

    def _odometry(self, message: Any) -> None:
        speed = message.twist.twist.linear
        self._take('speed', _stamp_s(message), (float(np.hypot(speed.x, speed.y)),))

    def _fix(self, message: Any) -> None:
        if message.status.status == NO_FIX:
            return
        now = (message.latitude, message.longitude, message.altitude)
        if not np.isfinite(now[:2]).all():
            return
        self._first = self._first or now
        place = local_metres(*np.array([self._first, now]).T)[1]
        self._take('position', _stamp_s(message), tuple(place.tolist()))


def _stamp_s(message: Any) -> float:
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
