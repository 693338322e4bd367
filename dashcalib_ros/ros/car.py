# SPDX-License-Identifier: Apache-2.0
"""The car around the camera: its sensors come in; how the camera sits on it goes out.

That is a pose, and static transforms (REP-103, REP-105). What sensors measure is kept where they
are subscribed, and used at each calibration.
"""
from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.exceptions import NameValidationException
from std_msgs.msg import Header

from dashcalib_ros.camera.rotation import OPTICAL, quaternion
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.input.motion import values_in
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.report.wording import mount_text
from dashcalib_ros.ros.endpoints import Endpoints, message_class
from dashcalib_ros.ros.interface import PUBLISHED, SENSORS, TF_STATIC
from dashcalib_ros.ros.settings import NodeConfig

# s; within this time others publish that they have the frame
LISTEN_S = 2.0
# variances of an unknown angle and an unknown distance, rad^2 and m^2: message types
# have no other way to say so
UNKNOWN, UNKNOWN_PLACE = math.pi**2 / 3, 1e6
# sigma of what was measured by hand, m
BY_HAND_M = 0.02
# REP-105's and REP-120's: of the car, and on the road below it
LINK, ON_ROAD = 'base_link', 'base_footprint'
# as SensorBuffer.add(): with a kind, the stamp in s and the values
AddMeasurement = Callable[[str, float, Sequence[float]], None]


class Transforms:
    """Publishes static transforms, once others had the time to say what frames they have.

    send: publishes a message; None with ROS 2 from pip.
    """

    def __init__(self, endpoints: Endpoints) -> None:
        self._since = time.monotonic()
        # the parent of each frame, as others publish it
        self._parents: dict[str, str] = {}
        self.send: Callable[[Any], None] | None = None
        try:
            self.send = endpoints.latched(TF_STATIC)
            endpoints.subscription(TF_STATIC, self._listen)
        except ImportError:
            endpoints.complaints.once(
                'static transforms are not possible with ROS 2 from pip, which has no tf2_msgs: '
                'install ROS 2 from apt, or give the output of dashcalib export --to tf, or '
                'static_transforms.sh of dashcalib rig, to a computer that has it')

    @property
    def ready(self) -> bool:
        """Return whether it is time to publish."""
        return self.send is not None and time.monotonic() - self._since >= LISTEN_S

    def taken(self, *steps: tuple[str, str]) -> str:
        """Return why a step, parent and child, cannot be published; '' where all can be."""
        for parent, child in steps:
            if self._parents.get(child, parent) != parent:
                return (f'the frame {child} already has the parent {self._parents[child]}, and it '
                        f'can have only one')
        return ''

    def publish(self, transforms: Sequence[TransformStamped]) -> None:
        """Publish them in the place of those before."""
        assert self.send is not None
        self.send(message_class(PUBLISHED[TF_STATIC].type)(transforms=list(transforms)))

    def _listen(self, message: Any) -> None:
        self._parents.update({each.child_frame_id.lstrip('/'): each.header.frame_id.lstrip('/')
                              for each in message.transforms})


class Mounting:
    """Publishes the mounting on ~/mount, and with publish_tf once on /tf_static.

    frame: of the car. The estimated height is above the road: it is a z in a frame on the road
    only, which base_link is not.
    """

    def __init__(self, endpoints: Endpoints, own: NodeConfig) -> None:
        self._node, self._log, self._own = endpoints.node, endpoints.log, own
        self._warn = endpoints.complaints.once
        self.frame = own.base_frame or (ON_ROAD if math.isnan(own.mount_z) else LINK)
        # what was published last
        self.mount: Mount | None = None
        self._pose = endpoints.latched('~/mount')
        self._sent: Mount | None = None
        self._waiting: tuple[Mount, str] | None = None
        self._transforms = Transforms(endpoints) if own.publish_tf else None
        if self._transforms and self._transforms.send:
            endpoints.timer(LISTEN_S / 2, self.tick)

    def show(self, mount: Mount | None, frame_id: str) -> None:
        """Publish a mounting; None: there is none. frame_id: of the images."""
        self.mount = mount
        if mount is None:
            return
        self._pose(self._message(mount))
        if self._transforms and self._transforms.send and mount.verdict == 'accepted':
            self._waiting = mount, self._own.camera_frame or frame_id

    def tick(self) -> None:
        """Send the transforms that wait, once others had the time to publish theirs."""
        transforms = self._transforms
        if self._waiting is None or transforms is None or not transforms.ready:
            return
        (mount, frame), self._waiting = self._waiting, None
        if why := self._not_sent(mount, frame):
            self._warn(f'no static transform is published: {why}')
        elif self._sent is None or differs(mount, self._sent):
            self._sent = mount
            transforms.publish(self._tree(mount, frame))
            self._log.info(f'static transforms {self.frame} -> {link_of(frame)} -> {frame}: '
                           f'{mount_text(mount)}')

    def _not_sent(self, mount: Mount, frame: str) -> str:
        if not frame:
            return 'the images have no frame_id; set camera_frame'
        # a transform has no way to say that a number is not known
        missing = [f'mount_{axis}' for axis, (_, variance) in zip(
            'xyz', self._place(mount), strict=True) if variance == UNKNOWN_PLACE]
        if missing:
            return f'set {", ".join(missing)}, measured by hand' + (
                ', or give the speed, from which the height is estimated'
                if 'mount_z' in missing and self.frame != LINK else '')
        assert self._transforms is not None
        taken = self._transforms.taken((self.frame, link_of(frame)), (link_of(frame), frame))
        return taken and f'{taken}; set publish_tf to false, or camera_frame to another name'

    def _message(self, mount: Mount) -> PoseWithCovarianceStamped:
        message = PoseWithCovarianceStamped(header=self._header(self.frame))
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        (place.x, place.y, place.z), variances = map(
            list, zip(*self._place(mount), strict=True))
        turn.x, turn.y, turn.z, turn.w = mount.quaternion
        for name in ('roll_right_deg', 'pitch_up_deg', 'yaw_left_deg'):
            sigma = mount.sigma[name]
            variances.append(UNKNOWN if sigma is None else math.radians(sigma)**2)
        message.pose.covariance = np.diag(variances).ravel()
        return message

    def _tree(self, mount: Mount, frame: str) -> list[TransformStamped]:
        """Return base -> link -> optical frame: the link's axes are the car's, turned with it."""
        link = link_of(frame)
        outer = TransformStamped(header=self._header(self.frame), child_frame_id=link)
        inner = TransformStamped(header=self._header(link), child_frame_id=frame)
        place = outer.transform.translation
        place.x, place.y, place.z = (value for value, _ in self._place(mount))
        for message, rotation in ((outer, mount.rotation @ OPTICAL.T), (inner, OPTICAL)):
            turn = message.transform.rotation
            turn.x, turn.y, turn.z, turn.w = quaternion(rotation)
        return [outer, inner]

    def _header(self, frame: str) -> Header:
        return Header(stamp=self._node.get_clock().now().to_msg(), frame_id=frame)

    def _place(self, mount: Mount) -> list[tuple[float, float]]:
        """Return x, y and z in m, each with its variance; 0 with a large one: not known."""
        # a parameter of 1 is an integer
        found = [(float(value), BY_HAND_M**2)
                 for value in (self._own.mount_x, self._own.mount_y, self._own.mount_z)]
        height, sigma = mount.height_m, mount.sigma['height_m']
        estimated = math.isnan(self._own.mount_z) and self.frame != LINK
        if estimated and height is not None and sigma is not None:
            found[2] = height, sigma**2
        return [(0.0, UNKNOWN_PLACE) if math.isnan(value) else (value, variance)
                for value, variance in found]


def link_of(frame: str) -> str:
    """Return the frame of the camera's body: camera_link of camera_optical_frame (REP-103)."""
    return f'{re.sub("_optical(_frame)?$", "", frame)}_link'


def differs(mount: Mount, other: Mount) -> bool:
    """Return whether a mounting is another one than before, or knows its roll now."""
    return (mount.moved_from(other)
            or (mount.roll_right_deg is None) != (other.roll_right_deg is None))


def subscribe_sensors(endpoints: Endpoints, own: NodeConfig, add: AddMeasurement) -> None:
    """Subscribe to the sensors that are to be used, and pass on what they measure.

    Raises ConfigError for an invalid topic name.
    """
    for name, option in SENSORS.items():
        # as parameters named the topics up to version 0.2
        topic = getattr(own, f'{name}_topic', '')
        if not (topic or getattr(own, f'use_{name}')):
            continue
        try:
            endpoints.subscription(name, partial(_pass_on, add, option), topic)
        except NameValidationException as error:
            raise ConfigError('E-TOPIC-NAME-INVALID',
                              f'{name}_topic {topic!r} is not a valid topic name: use a name such '
                              f'as /car/{name}') from error
        if topic:
            endpoints.complaints.once(f'{name}_topic is deprecated: start the node with -p '
                                      f'use_{name}:=true -r {name}:={topic} instead')


def _pass_on(add: AddMeasurement, option: str, message: Any) -> None:
    stamp_s = float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
    for kind, values in values_in(message, option):
        # of odometry only the speed is used
        if kind != 'odom_rate':
            add(kind, stamp_s, values)
