# SPDX-License-Identifier: Apache-2.0
"""How the camera sits on the car, from the node; and the sensors that it listens to."""
from __future__ import annotations

import math
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fake_endpoints import FakeEndpoints, transforms
from geometry_msgs.msg import TransformStamped
from made_calibration import make_calibration
from nav_msgs.msg import Odometry
from ros_bench import keep_file
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu, NavSatFix, Temperature
from std_msgs.msg import Header

from dashcalib_ros.input.motion import SensorBuffer
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.ros.car import BY_HAND_M, Mounting, differs, link_of, subscribe_sensors
from dashcalib_ros.ros.settings import NodeConfig
from dashcalib_ros.ros.store import CameraIdentity, StoredCalibration

SIGMA = {'yaw_left_deg': 0.1, 'pitch_up_deg': 0.15, 'roll_right_deg': None, 'height_m': None}
MOUNT = Mount('accepted', (), 2.0, -1.0, None, None, SIGMA, (600.0, 170.0), 0.5, 300.0)
HIGH = replace(MOUNT, height_m=1.4, sigma={**SIGMA, 'height_m': 0.03})
PLACE = {'mount_x': 1.5, 'mount_y': 0.0, 'mount_z': 1.2}
IDENTITY = CameraIdentity('dashcam', '/image_raw')


def made(publish_tf=True, **settings):
    endpoints = FakeEndpoints(None, None, None, {})
    return endpoints, Mounting(endpoints, NodeConfig(publish_tf=publish_tf, **settings))


def rotation(turn):
    return Rotation.from_quat((turn.x, turn.y, turn.z, turn.w)).as_matrix()


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
    # x was measured, y and z were not
    assert 0 < covariance[0] < 0.01 and covariance[7] == covariance[14] >= 1e6
    camera.until(lambda: 'accepted: yaw' in camera.values.get('mounting', ''), node=node)


def test_an_edited_mounting_is_not_believed(tmp_path):
    text = StoredCalibration.of(make_calibration(mount=MOUNT), IDENTITY, 'camera').text
    edited = text.replace('yaw_left_deg: 2.0', 'yaw_left_deg: 20.0')
    found = StoredCalibration.read(edited, tmp_path / 'dashcam.yaml', IDENTITY)
    assert edited != text and found.mount is None


def test_one_static_transform_and_again_only_when_it_moved(tf2):
    node, output = made(**PLACE)
    for angle in (2.0, 2.3, 4.0):
        output.show(Mount('accepted', (), angle, -1.0, None, None, SIGMA, (6.0, 7.0), 0.5, 300.0),
                    'camera')
        output.tick()
    (first, inner), (second, _) = transforms(node)
    # REP-105: the optical frame is a child of the camera's body
    assert (first.header.frame_id, first.child_frame_id) == ('base_link', 'camera_link')
    assert (inner.header.frame_id, inner.child_frame_id) == ('camera_link', 'camera')
    place = first.transform.translation
    assert (place.x, place.y, place.z) == tuple(PLACE.values())
    assert second.transform.rotation != first.transform.rotation
    np.testing.assert_allclose(
        rotation(first.transform.rotation) @ rotation(inner.transform.rotation), MOUNT.rotation,
        atol=1e-12)
    output.show(Mount('weak', ('thin',), 9.0, -1.0, None, None, SIGMA, (6.0, 7.0), 0.5, 30.0),
                'camera')
    output.tick()
    assert len(transforms(node)) == 2


def test_a_frame_never_gets_a_second_parent(tf2):
    for taken in ('camera', 'camera_link'):
        node, output = made(**PLACE)
        other = TransformStamped(child_frame_id=taken, header=Header(frame_id='rig'))
        node.heard['/tf_static'](SimpleNamespace(transforms=[other]))
        output.show(MOUNT, 'camera_optical_frame' if taken == 'camera_link' else 'camera')
        output.tick()
        output.show(MOUNT, 'camera_optical_frame' if taken == 'camera_link' else 'camera')
        output.tick()
        assert transforms(node) == []
        assert len(node.lines) == 1 and taken in node.lines[0] and 'rig' in node.lines[0]
        output.show(MOUNT, '')
        output.tick()
        assert 'set camera_frame' in node.lines[1]


@pytest.mark.parametrize(('settings', 'mount', 'frame', 'expected'), [
    # measured: 0, too, and in base_link; what is not known has no weight
    ({'mount_z': 0.0}, HIGH, 'base_link', [None, None, (0.0, BY_HAND_M)]),
    ({'mount_x': -1.5, 'mount_y': 0.0}, MOUNT, 'base_footprint',
     [(-1.5, BY_HAND_M), (0.0, BY_HAND_M), None]),
    # the height that is estimated is above the road, where base_link is not
    ({}, HIGH, 'base_footprint', [None, None, (1.4, 0.03)]),
    ({'base_frame': 'base_link'}, HIGH, 'base_link', [None, None, None]),
    ({'base_frame': 'road'}, HIGH, 'road', [None, None, (1.4, 0.03)]),
    ({'base_frame': 'road', 'mount_z': 2.0}, HIGH, 'road', [None, None, (2.0, BY_HAND_M)])])
def test_a_position_that_is_not_known_has_a_large_variance(tf2, settings, mount, frame, expected):
    node, output = made(publish_tf=True, **settings)
    output.show(mount, 'camera')
    output.tick()
    (_, message), = [each for each in node.published if each[0] == '~/mount']
    assert message.header.frame_id == frame
    place, variances = message.pose.pose.position, np.diag(
        np.reshape(message.pose.covariance, (6, 6)))[:3]
    for value, variance, known in zip((place.x, place.y, place.z), variances, expected,
                                      strict=True):
        if known is None:
            assert value == 0 and variance >= 1e6
        else:
            assert (value, variance) == (known[0], pytest.approx(known[1]**2))
    # a transform cannot say so: there is none, and a line says what is missing
    assert transforms(node) == [] and len(node.lines) == 1
    missing = {f'mount_{axis}' for axis, known in zip('xyz', expected, strict=True)
               if known is None}
    assert {name for name in ('mount_x', 'mount_y', 'mount_z') if name in node.lines[0]} == missing


@pytest.mark.parametrize(('frame', 'link'), [
    ('camera', 'camera_link'), ('front_optical_frame', 'front_link'),
    ('car/rear_optical', 'car/rear_link')])
def test_the_link_has_the_name_of_the_optical_frame(frame, link):
    assert link_of(frame) == link


def test_without_tf2_one_line_says_that_it_is_not_possible(monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_msgs', None)
    node, output = made()
    output.show(MOUNT, 'camera')
    output.tick()
    assert [topic for topic, _ in node.published] == ['~/mount']
    assert len(node.lines) == 1 and 'apt' in node.lines[0]


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


@pytest.mark.parametrize('names', [('imu', 'odom', 'fix'), ('/car/imu', '/car/odom', '/car/fix')])
def test_sensors_are_kept_as_streams(names):
    node, buffer = FakeEndpoints(None, None, None, {}), SensorBuffer()
    old = names[0] != 'imu'
    # parameters name the topics for one release more
    own = NodeConfig(**dict(zip(('imu_topic', 'odom_topic', 'fix_topic'), names, strict=True))
                     if old else {'use_imu': True, 'use_odom': True, 'use_fix': True})
    subscribe_sensors(node, own, buffer.add)
    assert len(node.lines) == (3 if old else 0)
    assert all('deprecated' in line and '-r' in line for line in node.lines)
    for second in range(100, 130):
        imu, odometry, fix = (stamped(kind, second) for kind in (Imu, Odometry, NavSatFix))
        imu.angular_velocity.y = 0.01 * second
        odometry.twist.twist.linear.x = -3.0
        fix.latitude, fix.longitude = 49.0 + 1e-5 * (second - 100), 8.4
        for topic, message in zip(names, (imu, odometry, fix), strict=True):
            node.heard[topic](message)
    # doubled, late, no fix, no numbers
    node.heard[names[0]](stamped(Imu, 110))
    lost = stamped(NavSatFix, 131)
    lost.status.status = -1
    node.heard[names[2]](lost)
    nowhere = stamped(NavSatFix, 132)
    nowhere.latitude = math.nan
    node.heard[names[2]](nowhere)
    found = buffer.stream()
    assert found.warnings == () and len(found.rate.stamps_s) == 30
    assert found.rate.values[-1, 1] == pytest.approx(1.29) and found.speed.values[0, 0] == 3.0
    assert found.position.values[-1, 1] == pytest.approx(29 * 1.1132, rel=1e-3)
    assert len(found.position.stamps_s) == 30


def test_a_temperature_is_kept_with_the_sensors():
    node, buffer = FakeEndpoints(None, None, None, {}), SensorBuffer()
    subscribe_sensors(node, NodeConfig(use_temperature=True), buffer.add)
    for second in range(100, 110):
        message = stamped(Temperature, second)
        message.temperature = 0.5 * second
        node.heard['temperature'](message)
    assert buffer.newest('temperature') == (109.0, (54.5,)) and buffer.newest('rate') is None
    found = buffer.stream().temperature
    assert found.values[0, 0] == 50.0 and len(found.values) == 10


def test_sensors_that_are_not_named_are_not_listened_to():
    node = FakeEndpoints(None, None, None, {})
    subscribe_sensors(node, NodeConfig(), print)
    assert node.heard == {}
