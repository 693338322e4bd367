# SPDX-License-Identifier: Apache-2.0
"""dashcalib run --write-bag: the bag again, with camera_info beside each image."""
from __future__ import annotations

import subprocess
import sys

import made_drives
import numpy as np
import pytest
from made_drives import drive, picture, same
from refused import refused
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from dashcalib_ros.camera import Brown, Fisheye, Radial, ros_camera
from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.input.bag_write import camera_info_topic, check_bag, write_bag
from dashcalib_ros.input.inputs import open_frames

TYPES = get_typestore(Stores.ROS2_JAZZY)
CAMERA = Radial((64, 48), 400.0, 401.0, 31.0, 23.0, -0.3, 0.1)
START = 1_767_614_400 * 10**9


def header(n):
    time = TYPES.types['builtin_interfaces/msg/Time'](sec=START // 10**9 + n, nanosec=7 * n)
    return TYPES.types['std_msgs/msg/Header'](stamp=time, frame_id=f'camera {n}')


@pytest.fixture(params=[StoragePlugin.MCAP, StoragePlugin.SQLITE3], ids=['mcap', 'db3'])
def bag(request, tmp_path):
    """A bag of a camera, its old camera_info, and something else."""
    kinds = TYPES.types
    path = tmp_path / 'drive'
    with Writer(path, version=9, storage_plugin=request.param) as writer:
        images = writer.add_connection('/cam/image_raw', 'sensor_msgs/msg/Image', typestore=TYPES)
        old = writer.add_connection('/cam/camera_info', 'sensor_msgs/msg/CameraInfo',
                                    typestore=TYPES)
        words = writer.add_connection('/words', 'std_msgs/msg/String', typestore=TYPES)
        roi = kinds['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
        for n in range(5):
            image = kinds['sensor_msgs/msg/Image'](
                header(n), 48, 64, 'mono8', 0, 64, np.full(48 * 64, n, np.uint8))
            info = kinds['sensor_msgs/msg/CameraInfo'](
                header(n), 0, 0, '', np.zeros(0), np.zeros(9), np.zeros(9), np.zeros(12), 0, 0,
                roi)
            word = kinds['std_msgs/msg/String'](f'word {n}')
            for connection, message in ((images, image), (old, info), (words, word)):
                writer.write(connection, START + n * 10**8 + 3,
                             TYPES.serialize_cdr(message, connection.msgtype))
    return path


def messages(path, topic):
    with Reader(path) as reader:
        chosen = [each for each in reader.connections if each.topic == topic]
        return [(stamp, bytes(raw)) for _, stamp, raw in reader.messages(chosen)]


def test_each_image_gets_its_camera_info_and_all_else_stays(bag, tmp_path):
    out = tmp_path / 'out' / 'with_info'
    assert write_bag(bag, '/cam/image_raw', CAMERA, out) == 5
    for topic in ('/cam/image_raw', '/words'):
        assert messages(out, topic) == messages(bag, topic)
    infos = messages(out, '/cam/camera_info')
    assert [stamp for stamp, _ in infos] == [
        stamp for stamp, _ in messages(bag, '/cam/image_raw')]
    for n, (_, raw) in enumerate(infos):
        info = TYPES.deserialize_cdr(raw, 'sensor_msgs/msg/CameraInfo')
        assert info.header == header(n)
        assert (info.width, info.height, info.distortion_model) == (64, 48, 'plumb_bob')
        assert info.k.tolist() == [400, 0, 31, 0, 401, 23, 0, 0, 1]
        assert info.p.tolist() == [400, 0, 31, 0, 0, 401, 23, 0, 0, 0, 1, 0]
        assert info.d.tolist() == [-0.3, 0.1, 0, 0, 0]
    assert [path.name for path in out.parent.iterdir()] == ['with_info']


@pytest.mark.parametrize('lens', [
    Brown((64, 48), 40.0, 40.1, 31.0, 23.0, -0.3, 0.1, 0.001, -0.002, -0.01),
    Fisheye((64, 48), 30.0, 30.1, 31.0, 23.0, -0.02, 0.003, -0.001, 0.0002)],
    ids=['brown', 'fisheye'])
@pytest.mark.parametrize('rectified', ['same', 'crop', 'all'])
def test_other_models_and_their_rectified_view(bag, tmp_path, lens, rectified):
    out = tmp_path / 'with_info'
    assert write_bag(bag, '/cam/image_raw', lens, out, rectified) == 5
    ros = ros_camera(lens, rectified)
    for _, raw in messages(out, '/cam/camera_info'):
        info = TYPES.deserialize_cdr(raw, 'sensor_msgs/msg/CameraInfo')
        assert info.distortion_model == lens.ros_model and info.d.tolist() == ros.d
        assert info.k.tolist() == ros.k and info.p.tolist() == ros.p
        assert (info.p[0] == lens.fx) == (rectified == 'same')


def test_compressed_images_and_the_other_reader(tmp_path):
    frames = drive(3)
    source = made_drives.write_bag(tmp_path / 'drive', [
        ('/image_raw/compressed', frame.stamp_ns, picture(frame)) for frame in frames])
    out = tmp_path / 'out'
    assert write_bag(source, '/image_raw/compressed', CAMERA, out) == 3
    assert len(messages(out, '/camera_info')) == 3
    same(list(open_frames(out)), frames)


def test_what_cannot_be_written_is_one_line(bag, tmp_path):
    (tmp_path / 'file').touch()
    with refused(OutputError, 'E-OUTPUT-NOT-WRITABLE'):
        write_bag(bag, '/cam/image_raw', CAMERA, tmp_path / 'file' / 'bag')
    with refused(OutputError, 'E-OUTPUT-EXISTS', bag):
        write_bag(bag, '/cam/image_raw', CAMERA, bag)


@pytest.mark.parametrize(('topic', 'expected'), [
    ('/image_raw', '/camera_info'), ('/a/b/image', '/a/b/camera_info'),
    ('/a/image/compressed', '/a/camera_info')])
def test_camera_info_lies_beside_the_image(topic, expected):
    assert camera_info_topic(topic) == expected


def test_a_bag_cut_off_in_the_middle_gives_no_bag(bag, tmp_path):
    file = next(path for path in bag.iterdir() if path.suffix in ('.mcap', '.db3'))
    file.write_bytes(file.read_bytes()[:file.stat().st_size // 2])
    with refused(InputError, 'E-BAG-DAMAGED', 'mcap recover'):
        write_bag(bag, '/cam/image_raw', CAMERA, tmp_path / 'out')
    assert sorted(path.name for path in tmp_path.iterdir()) == ['drive']


def test_what_cannot_be_done_is_said_before_the_calibration(bag, tmp_path):
    check_bag(bag, '/cam/image_raw', tmp_path / 'out')
    with refused(InputError, 'E-BAG-REQUIRED', 'drive.mp4'):
        check_bag('drive.mp4', None, tmp_path / 'out')
    with refused(InputError, 'E-BAG-ROS1', 'rosbags-convert'):
        check_bag('drive.bag', '/image', tmp_path / 'out')
    with refused(OutputError, 'E-OUTPUT-EXISTS', bag):
        check_bag(bag, '/cam/image_raw', bag)
    check_bag(bag, '/cam/image_raw', tmp_path / 'a' / 'b' / 'out')
    assert sorted(path.name for path in tmp_path.iterdir()) == ['drive']


@pytest.fixture
def other_topics(tmp_path):
    """A bag whose camera_info is none, and one with a message type that it does not define."""
    for name, kind, options in (
            ('taken', 'std_msgs/msg/String', {'typestore': TYPES}),
            ('unknown', 'car_msgs/msg/Car', {'msgdef': '', 'rihs01': 'RIHS01_0'})):
        with Writer(tmp_path / name, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for topic, of, more in (
                    ('/cam/image_raw', 'sensor_msgs/msg/Image', {'typestore': TYPES}),
                    ('/cam/camera_info', kind, options)):
                writer.write(writer.add_connection(topic, of, **more), START, bytes(8))
    return tmp_path


def test_a_topic_that_camera_info_cannot_have_is_told_before_the_calibration(other_topics):
    with refused(InputError, 'E-BAG-TOPIC-TAKEN', 'std_msgs/msg/String', '/cam/camera_info'):
        check_bag(other_topics / 'taken', '/cam/image_raw', other_topics / 'out')


def test_a_message_type_that_nobody_knows_is_named(other_topics):
    with refused(InputError, 'E-BAG-TYPE-UNKNOWN', 'car_msgs/msg/Car', '/cam/camera_info'):
        write_bag(other_topics / 'unknown', '/other/image_raw', CAMERA, other_topics / 'out')


@pytest.mark.parametrize(('place', 'code'), [
    ('file/bag', 'E-OUTPUT-NOT-WRITABLE'), ('link', 'E-OUTPUT-EXISTS'),
    ('x' * 252, 'E-OUTPUT-NOT-WRITABLE'), ('/proc/bag', 'E-OUTPUT-NOT-WRITABLE')])
def test_a_bag_that_has_no_place_is_told_before_the_calibration(bag, tmp_path, place, code):
    (tmp_path / 'file').touch()
    (tmp_path / 'link').symlink_to(tmp_path / 'nowhere')
    before = {path.name for path in tmp_path.iterdir()}
    with refused(OutputError, code, tmp_path / place):
        check_bag(bag, '/cam/image_raw', tmp_path / place)
    assert {path.name for path in tmp_path.iterdir()} == before


def test_a_bag_that_a_killed_process_left_half_written_is_removed(bag, tmp_path):
    half = tmp_path / 'out' / '.dashcalib.0123abcd.tmp'
    (half / 'bag').mkdir(parents=True)
    (half / 'bag' / 'bag_0.mcap').write_bytes(bytes(100))
    write_bag(bag, '/cam/image_raw', CAMERA, tmp_path / 'out' / 'other')
    assert [path.name for path in (tmp_path / 'out').iterdir()] == ['other']


def test_the_command_says_why_there_is_no_bag(bag, tmp_path):
    """Five grey images make no calibration, so there must be no bag."""
    command = [sys.executable, '-m', 'dashcalib_ros', 'run', str(bag), '--out',
               str(tmp_path / 'result'), '--write-bag', str(tmp_path / 'new')]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 3 and '[E-BAG-NOT-WRITTEN]' in done.stderr, done.stderr
    assert not (tmp_path / 'new').exists()
