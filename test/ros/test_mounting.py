"""How the camera sits on the car, from the node; and the sensors that it listens to."""
from __future__ import annotations

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from fakes import stands_in_for
from geometry_msgs.msg import TransformStamped
from made_calibration import make_calibration
from nav_msgs.msg import Odometry
from ros_bench import keep_file
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import Header

from dashcalib_ros.input.motion import SensorBuffer
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.ros import car
from dashcalib_ros.ros.car import Mounting, differs, subscribe_sensors
from dashcalib_ros.ros.diagnostics import Complaints
from dashcalib_ros.ros.endpoints import Endpoints
from dashcalib_ros.ros.settings import NodeConfig
from dashcalib_ros.ros.store import CameraIdentity, StoredCalibration

SIGMA = {'yaw_left_deg': 0.1, 'pitch_up_deg': 0.15, 'roll_right_deg': None, 'height_m': None}
MOUNT = Mount('accepted', (), 2.0, -1.0, None, None, SIGMA, (600.0, 170.0), 0.5, 300.0)
IDENTITY = CameraIdentity('dashcam', '/image_raw')


@stands_in_for(Endpoints)
class FakeEndpoints:
    """Keeps what is published, and the callbacks of subscriptions and timers."""

    def __init__(self, node, log, complaints, given):
        self.published, self.heard, self.lines, self.ends = [], {}, [], []
        self.complaints = Complaints(self.lines.append)
        self.log = SimpleNamespace(warning=self.lines.append, info=self.lines.append)
        self.node = SimpleNamespace(
            get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(to_msg=Time)),
            destroy_publisher=lambda publisher: True)

    def publisher(self, name):
        return SimpleNamespace(publish=lambda message: self.published.append((name, message)))

    def overridden(self, name):
        return f'QoS of {name}'

    def subscription(self, name, callback, topic=''):
        self.heard[topic or name] = callback

    def timer(self, period_s, callback):
        pass

    def at_end(self, function, *arguments):
        self.ends.append(function)


@pytest.fixture
def tf2(monkeypatch):
    """Stand in for tf2_ros, which is not on the package index, with the real messages."""
    class StaticTransformBroadcaster:
        def __init__(self, node, qos=None):
            assert qos == 'QoS of /tf_static'
            self.pub_tf = object()

        def sendTransform(self, transform):  # noqa: N802
            assert isinstance(transform, TransformStamped)
            FakeEndpoints.newest.published.append(('/tf_static', transform))

    monkeypatch.setitem(sys.modules, 'tf2_ros', SimpleNamespace(
        StaticTransformBroadcaster=StaticTransformBroadcaster))
    monkeypatch.setattr(car, 'LISTEN_S', 0.0)


def transforms(endpoints):
    return [message for topic, message in endpoints.published if topic == '/tf_static']


def made(**settings):
    endpoints = FakeEndpoints.newest = FakeEndpoints(None, None, None, {})
    return endpoints, Mounting(endpoints, NodeConfig(publish_tf=True, **settings))


def test_a_kept_mounting_is_published_and_kept(start_node, make_bench, tmp_path):
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from ros_bench import DurabilityPolicy, QoSProfile, ReliabilityPolicy
    kept = StoredCalibration.of(make_calibration(mount=MOUNT), IDENTITY, 'camera')
    assert StoredCalibration.read(kept.text, tmp_path / 'dashcam.yaml', IDENTITY).mount == MOUNT
    keep_file(tmp_path, kept.text)
    node, camera = start_node(mount_x=1.5, base_frame='car'), make_bench()
    poses = []
    camera.node.create_subscription(
        PoseWithCovarianceStamped, 'calibrator/mount', poses.append,
        QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                   durability=DurabilityPolicy.TRANSIENT_LOCAL))
    camera.until(lambda: poses, node=node)
    turn, covariance = poses[0].pose.pose.orientation, poses[0].pose.covariance
    assert poses[0].header.frame_id == 'car' and poses[0].pose.pose.position.x == 1.5
    np.testing.assert_allclose((turn.x, turn.y, turn.z, turn.w), MOUNT.quaternion)
    # roll is not known, yaw is
    assert covariance[21] > 1 and covariance[35] == pytest.approx(math.radians(0.1)**2)
    camera.until(lambda: 'accepted: yaw' in camera.values.get('mounting', ''), node=node)


def test_an_edited_mounting_is_not_believed(tmp_path):
    text = StoredCalibration.of(make_calibration(mount=MOUNT), IDENTITY, 'camera').text
    edited = text.replace('yaw_left_deg: 2.0', 'yaw_left_deg: 20.0')
    found = StoredCalibration.read(edited, tmp_path / 'dashcam.yaml', IDENTITY)
    assert edited != text and found.mount is None


def test_one_static_transform_and_again_only_when_it_moved(tf2):
    node, output = made(mount_z=1.2)
    for angle in (2.0, 2.3, 4.0):
        output.show(Mount('accepted', (), angle, -1.0, None, None, SIGMA, (6.0, 7.0), 0.5, 300.0),
                    'camera')
        output.tick()
    first, second = transforms(node)
    assert (first.header.frame_id, first.child_frame_id) == ('base_link', 'camera')
    assert first.transform.translation.z == 1.2 and second.transform.rotation != (
        first.transform.rotation)
    output.show(Mount('weak', ('thin',), 9.0, -1.0, None, None, SIGMA, (6.0, 7.0), 0.5, 30.0),
                'camera')
    output.tick()
    assert len(transforms(node)) == 2


def test_a_frame_never_gets_a_second_parent(tf2):
    node, output = made()
    other = TransformStamped(child_frame_id='camera', header=Header(frame_id='rig'))
    node.heard['/tf_static'](SimpleNamespace(transforms=[other]))
    output.show(MOUNT, 'camera')
    output.tick()
    output.show(MOUNT, 'camera')
    output.tick()
    assert transforms(node) == []
    assert len(node.lines) == 1 and 'camera' in node.lines[0] and 'rig' in node.lines[0]
    output.show(MOUNT, '')
    output.tick()
    assert 'set camera_frame' in node.lines[1]


def test_without_tf2_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_ros', None)
    node, output = made()
    output.show(MOUNT, 'camera')
    output.tick()
    assert [topic for topic, _ in node.published] == ['~/mount']
    assert len(node.lines) == 1 and 'apt install' in node.lines[0]


def test_small_differences_are_none():
    vague = Mount('accepted', (), 3.0, -1.0, None, None, {**SIGMA, 'yaw_left_deg': 1.0},
                  (6.0, 7.0), 0.5, 300.0)
    assert not differs(MOUNT, MOUNT) and not differs(MOUNT, vague)
    rolled = Mount('accepted', (), 2.0, -1.0, 1.0, None, {**SIGMA, 'roll_right_deg': 0.2},
                   (6.0, 7.0), 0.5, 300.0)
    assert differs(MOUNT, rolled) and differs(rolled, MOUNT)


def stamped(kind, second):
    message = kind()
    message.header.stamp.sec = second
    return message


def test_sensors_are_kept_as_streams():
    node, buffer = FakeEndpoints(None, None, None, {}), SensorBuffer()
    own = NodeConfig(imu_topic='/imu', odom_topic='/odom', fix_topic='/fix')
    subscribe_sensors(node, own, buffer.add)
    for second in range(100, 130):
        imu, odometry, fix = (stamped(kind, second) for kind in (Imu, Odometry, NavSatFix))
        imu.angular_velocity.y = 0.01 * second
        odometry.twist.twist.linear.x = -3.0
        fix.latitude, fix.longitude = 49.0 + 1e-5 * (second - 100), 8.4
        for topic, message in (('/imu', imu), ('/odom', odometry), ('/fix', fix)):
            node.heard[topic](message)
    # doubled, late, no fix, no numbers
    node.heard['/imu'](stamped(Imu, 110))
    lost = stamped(NavSatFix, 131)
    lost.status.status = -1
    node.heard['/fix'](lost)
    nowhere = stamped(NavSatFix, 132)
    nowhere.latitude = math.nan
    node.heard['/fix'](nowhere)
    found = buffer.stream()
    assert found.warnings == () and len(found.rate.stamps_s) == 30
    assert found.rate.values[-1, 1] == pytest.approx(1.29) and found.speed.values[0, 0] == 3.0
    assert found.position.values[-1, 1] == pytest.approx(29 * 1.1132, rel=1e-3)
    assert len(found.position.stamps_s) == 30


def test_sensors_that_are_not_named_are_not_listened_to():
    node = FakeEndpoints(None, None, None, {})
    subscribe_sensors(node, NodeConfig(), print)
    assert node.heard == {}
