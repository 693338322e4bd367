# SPDX-License-Identifier: Apache-2.0
"""The node between real processes: stopped in every state, fed bad input, asked for services."""
from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import yaml

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from ros_bench import (
    CAMERA_FILE,
    COMMAND,
    OURS,
    REPOSITORY,
    SECOND,
    SOON,
    START,
    Bench,
    NodeProcess,
    compressed_message,
    image_message,
    keep_file,
    noise,
    pairs,
    ros_environment,
    stream,
)
from sensor_msgs.msg import CameraInfo, CompressedImage

from dashcalib_ros.camera import Fisheye, ros_camera
from dashcalib_ros.formats import load_camera

# publishes images until it is killed; the first one's number comes as an argument
DRIVER = f"""
import sys
sys.path.insert(0, {str(REPOSITORY / 'testing')!r})
import rclpy
from ros_bench import Bench, SECOND, START, image_message, noise
rclpy.init()
bench = Bench(None, listen=False, name='driver')
bench.until(lambda: bench.images.get_subscription_count() > 0)
for n in range(int(sys.argv[1]), 10**9):
    bench.publish(image_message(noise(n % 20), START + n * SECOND // 10))
    bench.spin(0.1)
"""

# -- the end ----------------------------------------------------------------------------------

@pytest.mark.parametrize('signals', [
    (signal.SIGINT,), (signal.SIGTERM,), (signal.SIGHUP,), (signal.SIGTERM, signal.SIGINT)],
    ids=['SIGINT', 'SIGTERM', 'SIGHUP', 'both'])
def test_it_ends_cleanly_while_it_collects(start_node, make_bench, signals):
    node, camera = start_node(command=COMMAND), make_bench()
    camera.connect(node)
    stream(camera, 5)
    assert node.stop(*signals) == 0, node.text
    assert 'Traceback' not in node.text


def test_nohup_lets_it_outlive_its_terminal(start_node, make_bench):
    node, camera = start_node(command=['nohup', *COMMAND]), make_bench()
    camera.connect(node)
    node.process.send_signal(signal.SIGHUP)
    stream(camera, 5)
    camera.counted('received', 5, node)
    assert node.stop(signal.SIGTERM) == 0


# one handler has all three
@pytest.mark.parametrize(('delay', 'number'), [
    (0.0, signal.SIGINT), (0.2, signal.SIGTERM), (0.4, signal.SIGHUP)])
def test_it_ends_cleanly_while_it_starts(start_node, number, delay):
    """From the node's own first line on: before that it is Python that starts."""
    node = start_node(command=COMMAND)
    end = time.monotonic() + SOON
    while not node.catches(signal.SIGTERM):
        assert time.monotonic() < end and node.process.poll() is None, node.text
    time.sleep(delay)
    assert node.stop(number) == 0, node.text
    assert 'Traceback' not in node.text


# -- the file ---------------------------------------------------------------------------------

def test_a_kept_calibration_is_published_from_the_first_image_on(start_node, make_bench, tmp_path):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS)
    node, camera = start_node(), make_bench()
    camera.connect(node)
    camera.until(lambda: camera.latched, node=node)
    sent = [image_message(noise(n), START + n * SECOND) for n in range(3)]
    camera.publish(*sent)
    camera.until(lambda: len(camera.infos) == 3, node=node)
    assert [info.header for info in camera.infos] == [image.header for image in sent]
    assert camera.infos[0].k[0] == 200.0 and list(camera.infos[0].d) == [-0.1, 0.01, 0, 0, 0]
    assert camera.latched[0].header.frame_id == 'camera'


FISHEYE_FILE = CAMERA_FILE.format(width=320).replace('plumb_bob', 'equidistant').replace(
    'cols: 5, data: [-0.1, 0.01, 0.0, 0.0, 0.0]', 'cols: 4, data: [-0.02, 0.003, -0.001, 0.0002]')
OUR_FISHEYE = OURS.replace('k2: 0.01', 'k2: 0.01, k3: 0.001, k4: 0.001')


def test_a_kept_fisheye_is_published_with_the_view_that_is_wanted_now(start_node, make_bench,
                                                                      tmp_path):
    path = keep_file(tmp_path, FISHEYE_FILE + OUR_FISHEYE)
    node, camera = start_node(rectified='all', model='fisheye'), make_bench()
    camera.connect(node)
    camera.until(lambda: camera.latched, node=node)
    lens = Fisheye((320, 240), 200.0, 201.0, 160.0, 120.0, -0.02, 0.003, -0.001, 0.0002)
    for info in camera.latched:
        assert (info.distortion_model, list(info.d)) == ('equidistant', lens.ros_distortion())
        assert list(info.k) == ros_camera(lens).k and list(info.p) == ros_camera(lens, 'all').p
    camera.until(lambda: camera.values.get('camera model') == 'fisheye', node=node)
    assert 'k4 0.000200 ± 0.001000' in camera.values['published']
    # the file keeps its own until it is asked for
    node.wait_for('does not belong to rectified: all')
    assert path.read_text() == FISHEYE_FILE + OUR_FISHEYE
    assert camera.call('save', node).success
    saved = yaml.safe_load(path.read_text())
    assert saved['projection_matrix']['data'] == ros_camera(lens, 'all').p
    assert load_camera(path).camera == lens
    assert saved['dashcalib']['sigma'] == yaml.safe_load(OUR_FISHEYE)['dashcalib']['sigma']
    assert node.stop() == 0
    # it fits now: there is nothing to tell
    node, camera = start_node(rectified='all'), make_bench()
    node.wait_for('loaded ')
    assert 'projection_matrix' not in node.text


@pytest.mark.parametrize(('text', 'words'), [
    ('{{{ no yaml', 'dashcam.yaml is ignored'),
    ('', 'dashcam.yaml is ignored'),
    (CAMERA_FILE.format(width=320), '[E-KEPT-NOT-ACCEPTED]'),
    (CAMERA_FILE.format(width=640) + OURS, 'it is for 640x240'),
    ((CAMERA_FILE.format(width=320) + OURS).replace('frame_id: camera', 'frame_id: rear'),
     "in frame 'rear'"),
], ids=['corrupt', 'empty', 'foreign', 'other size', 'other frame'])
def test_a_file_that_does_not_fit_is_ignored_with_a_warning(start_node, make_bench, tmp_path,
                                                            text, words):
    path = keep_file(tmp_path, text)
    node, camera = start_node(), make_bench()
    camera.connect(node)
    stream(camera, 5)
    camera.counted('received', 5, node)
    node.wait_for(words)
    assert camera.infos == []
    assert path.read_text() == text
    assert not camera.latched or camera.latched[-1].k[0] == 0


def test_a_namespace_names_the_camera(start_node, make_bench, tmp_path):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS, 'front')
    node, camera = start_node('-r', '__ns:=/front'), make_bench(namespace='/front')
    camera.connect(node)
    stream(camera, 2)
    camera.until(lambda: len(camera.infos) == 2, node=node)
    assert camera.status.name == 'front/calibrator: camera calibration (front)'
    assert camera.status.hardware_id == 'front'


def test_another_cameras_calibration_is_not_published(start_node, make_bench, tmp_path):
    """Two cameras of one size and frame; the files of both would have one name."""
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS + '  topic: /a/image\n', 'a')
    node = start_node('-r', 'image_raw:=/a/image_raw', '-r', 'camera_info:=/a/camera_info')
    camera = make_bench(namespace='/a')
    camera.connect(node)
    stream(camera, 3)
    camera.counted('received', 3, node)
    node.wait_for('[E-KEPT-OF-OTHER-TOPIC]')
    assert 'on /a/image, and this node uses /a/image_raw' in node.text
    assert camera.infos == [] and camera.status.hardware_id == 'a'


# -- input ------------------------------------------------------------------------------------

def test_compressed_images_get_their_camera_info(start_node, make_bench, tmp_path):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS + '  topic: /dashcam/image\n')
    node = start_node('-r', 'image_raw:=dashcam/image', image_transport='compressed')
    camera = make_bench(image_type=CompressedImage, topic='dashcam/image/compressed')
    camera.connect(node)
    stream(camera, 4, make=compressed_message)
    stream(camera, 2, 4, make=compressed_message, suffix='.png')
    camera.until(lambda: len(camera.infos) == 6, node=node)
    camera.publish(compressed_message(noise(7, (640, 480)), START + 60 * SECOND))
    corrupt = compressed_message(noise(8), START + 61 * SECOND)
    del corrupt.data[2000:]
    camera.publish(corrupt)
    empty = compressed_message(noise(8), START + 62 * SECOND)
    del empty.data[:]
    camera.publish(empty)
    camera.counted('undecodable', 2, node)
    camera.counted('strays', 1, node)
    assert {(info.width, info.height) for info in camera.infos} == {(320, 240)}
    assert node.stop() == 0


def broken_images():
    """Return what no camera should send; each is later than the one before."""
    stamps = iter(range(START + 10 * SECOND, START + 100 * SECOND, SECOND))
    good = noise(0)
    unknown = image_message(good, next(stamps), encoding='32FC1')
    step = image_message(good, next(stamps))
    step.step = 17
    short = image_message(good, next(stamps))
    del short.data[1000:]
    empty = image_message(good, next(stamps))
    del empty.data[:]
    none = image_message(good, next(stamps))
    none.width = none.height = 0
    odd = image_message(good, next(stamps), encoding='\u00e9 \n' + 'x' * 300)
    return [unknown, step, short, empty, none, odd]


def test_bad_images_are_counted_and_the_node_lives(start_node, make_bench):
    node, camera = start_node(), make_bench()
    camera.connect(node)
    stream(camera, 3)
    bad = broken_images()
    camera.publish(*bad)
    camera.counted('undecodable', len(bad), node)
    stream(camera, 3, 500)
    camera.counted('received', 6 + len(bad), node)
    # one line for all of them within ten seconds, and it names a remedy
    said = [line for line in node.text.splitlines() if 'WARN' in line and 'lost' not in line]
    assert len(said) == 1, node.text
    # which comes first is not said: sizes are checked on arrival, pixels in a thread
    assert 'publish mono8' in said[0] or 'the camera driver' in said[0]
    assert node.stop() == 0 and 'Traceback' not in node.text


def test_odd_stamps_are_counted_and_the_node_lives(start_node, make_bench):
    node, camera = start_node(), make_bench()
    camera.connect(node)
    stream(camera, 20)
    times = [0, START + SECOND, START + SECOND, START + 4 * SECOND, START + 2 * SECOND,
             START - 3600 * SECOND, START + 86400 * SECOND]
    camera.publish(*(image_message(noise(n), stamp) for n, stamp in enumerate(times)))
    stream(camera, 20, 0)
    camera.counted('received', 47, node)
    camera.counted('unstamped', 1, node)
    camera.counted('repeated', 2, node)
    camera.counted('set_back', 2, node)
    camera.counted('lost', 1, node)
    assert len(camera.infos) == 0
    assert node.stop() == 0 and 'Traceback' not in node.text


@pytest.mark.parametrize(('reliable', 'compressed', 'options', 'remedies'), [
    (True, False, {}, ()),
    (True, False, {'reliability': 'best_effort'}, ('to auto', 'publish compressed', '.xml')),
    (False, False, {}, ('publish reliable', 'publish compressed', '.xml')),
    (False, True, {'image_transport': 'compressed'}, ('publish reliable',))])
def test_lost_images_name_only_cures_that_are_not_in_use(start_node, make_bench, reliable,
                                                         compressed, options, remedies):
    node = start_node(**options)
    kind = {'topic': 'image_raw/compressed', 'image_type': CompressedImage} if compressed else {}
    camera = make_bench(reliable=reliable, **kind)
    make = compressed_message if compressed else image_message
    camera.until(lambda: camera.images.get_subscription_count(), node=node)
    camera.spin(1.0)
    stream(camera, 20, make=make)
    camera.publish(make(noise(0), START + 5 * SECOND))
    node.wait_for('images are lost')
    line, = [line for line in node.text.splitlines() if 'images are lost' in line]
    found = [each for each in ('to auto', 'publish reliable', 'publish compressed', '.xml')
             if each in line]
    assert found == list(remedies), line
    # the driver itself may be the cause
    assert 'driver skips images' in line


def test_a_driver_that_never_stamps_is_learned_from_all_the_same(start_node, make_bench):
    node, camera = start_node(), make_bench()
    camera.connect(node)
    for n in range(10):
        camera.publish(image_message(noise(n), 0))
        camera.spin(0.15)
    camera.until(lambda: len(camera.magnitudes) >= 5, node=node)
    assert camera.count('unstamped') == 0
    # it is said once in the log, and as long as it is so in /diagnostics
    camera.until(lambda: '[E-STAMP-MISSING]' in camera.values['time stamps'], node=node)
    assert camera.status.level == DiagnosticStatus.WARN
    assert camera.values['warnings'] == camera.values['time stamps']
    line, = [line for line in node.text.splitlines() if 'E-STAMP-MISSING' in line]
    assert 'WARN' in line and 'rolling shutter' in line
    for n in range(10):
        camera.publish(image_message(noise(n), START + n * SECOND // 10))
    camera.until(lambda: camera.values['time stamps'] == 'of the images', node=node)
    assert not camera.values['warnings']


def test_two_publishers_of_different_sizes_do_not_reset_it(start_node, make_bench, tmp_path):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS)
    node, camera = start_node(), make_bench()
    camera.connect(node)
    for n in range(15):
        camera.publish(image_message(noise(n), START + n * SECOND),
                       image_message(noise(n, (640, 240)), START + n * SECOND + 5))
        # on a busy machine the queue of the subscription would overflow
        camera.until(lambda n=n: len(camera.infos) == n + 1, node=node)
    camera.counted('strays', 15, node)
    assert {info.width for info in camera.infos} == {320}
    node.wait_for('check for a second publisher')


def test_two_publishers_get_nothing_until_one_is_left(start_node, make_bench, tmp_path):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS)
    node, first = start_node(), make_bench()
    first.connect(node)
    stream(first, 3)
    first.until(lambda: len(first.infos) == 3, node=node)
    second = make_bench(listen=False, name='rear_driver')
    first.until(lambda: '(/bench, /rear_driver)' in first.values['warnings'], node=node)
    assert first.status.level == DiagnosticStatus.ERROR
    stream(second, 20, 3)
    first.counted('received', 23, node)
    answers = [first.call(name, node) for name in ('save', 'calibrate')]
    for answer in answers:
        assert not answer.success
        assert answer.message.startswith('2 publishers on /image_raw (/bench, /rear_driver): ')
    assert len(first.infos) == 3
    second.close()
    first.until(lambda: first.values['publishers'] == '/bench', node=node)
    stream(first, 3, 23)
    first.until(lambda: len(first.infos) == 6, node=node)
    assert first.call('save', node).success and not first.values['warnings']
    assert node.text.count('[ERROR]') == 1


def test_two_publishers_of_one_name_get_nothing_while_they_alternate(
        start_node, make_bench, tmp_path):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS)
    node, first = start_node(), make_bench()
    first.connect(node)
    second = make_bench(listen=False)
    first.until(lambda: first.values['publishers'] == '/bench, /bench', node=node)
    for n in range(10):
        first.publish(image_message(noise(n), START + 2 * n * SECOND))
        second.publish(image_message(noise(n), START + (2 * n + 1) * SECOND))
    first.until(lambda: '2 publishers' in first.values['warnings'], node=node)
    assert 0 < len(first.infos) < 20


def test_a_driver_that_was_killed_and_started_again_is_one_publisher(
        start_node, make_bench, tmp_path):
    """DDS lists the killed one for 20 s more."""
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS)
    node, camera = start_node(), make_bench(topic='elsewhere')
    for first, listed in ((0, '/driver'), (100, '/driver, /driver')):
        driver = subprocess.Popen([sys.executable, '-c', DRIVER, str(first)], env={
            **os.environ, **ros_environment(tmp_path)})
        try:
            camera.until(lambda count=first // 10 + 10: len(camera.infos) >= count, node=node)
            camera.until(lambda listed=listed: camera.values['publishers'] == listed, node=node)
        finally:
            driver.kill()
            driver.wait(SOON)
    assert not camera.values['warnings'] and '[ERROR]' not in node.text


@pytest.mark.parametrize('change', [{'size': (640, 240)}, {'frame_id': 'rear'}],
                         ids=['size', 'frame'])
def test_a_change_of_size_or_frame_resets_it_loudly(start_node, make_bench, tmp_path, change):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS)
    node, camera = start_node(), make_bench()
    camera.connect(node)
    stream(camera, 5)
    camera.until(lambda: len(camera.infos) == 5, node=node)
    stream(camera, 20, 5, **change)
    camera.counted('received', 25, node)
    camera.until(lambda: camera.values['state'] == 'collecting', node=node)
    assert '[ERROR]' in node.text and 'the camera changed from 320x240' in node.text
    assert all(info.width == 320 and info.header.frame_id == 'camera' for info in camera.infos)
    camera.until(lambda: camera.latched[-1].k[0] == 0, node=node)
    # back again: the file fits once more
    stream(camera, 20, 25)
    camera.until(lambda: camera.values['state'] == 'calibrated', node=node)


def test_auto_reliability_follows_the_publishers(start_node, make_bench):
    """Best effort hears both kinds; a reliable subscription would never hear the second."""
    first = make_bench(reliable=True)
    node = start_node()
    first.connect(node)
    node.wait_for('subscribing reliable')
    second = make_bench(reliable=False, listen=False, name='other')
    first.until(lambda: 'subscribing best_effort' in node.text, node=node)
    second.until(lambda: second.images.get_subscription_count() > 0, node=node)
    before = first.count('received')
    end = time.monotonic() + SOON
    while first.count('received') <= before:
        second.publish(image_message(noise(1), START))
        first.spin(0.1)
        assert time.monotonic() < end, node.text
    first.until(lambda: '2 publishers' in first.values['warnings'], node=node)


def test_another_publisher_of_camera_info_is_reported(plain):
    node, camera = plain
    assert camera.values['warnings'] == ''
    other = camera.node.create_publisher(CameraInfo, 'camera_info', 1)
    camera.until(lambda: '/plain/camera_info' in camera.values['warnings'], node=node)
    camera.node.destroy_publisher(other)
    camera.until(lambda: camera.values['warnings'] == '', node=node)


@pytest.fixture(scope='module')
def plain(ros_context, tmp_path_factory):
    """One node and its camera, for tests that leave it as it was."""
    camera = Bench(ros_context, namespace='/plain', topic='/plain_image')
    node = NodeProcess(tmp_path_factory.mktemp('plain'), '-r', '__ns:=/plain', '-r',
                       'image_raw:=/plain_image')
    camera.connect(node)
    yield node, camera
    node.kill()
    camera.close()


def test_silence_is_a_warning(plain):
    """STALE is for aggregators to say."""
    node, camera = plain
    camera.until(lambda: camera.status.level == b'\x01', node=node)
    assert camera.status.message == 'no image on /plain_image yet'


def test_a_paused_simulation_does_not_silence_the_diagnostics(start_node, make_bench):
    node, camera = start_node(use_sim_time=True), make_bench()
    camera.connect(node)
    stream(camera, 3)
    camera.counted('received', 3, node)
    assert node.stop() == 0


# -- services and parameters ------------------------------------------------------------------

def test_services_say_why_not(plain):
    node, camera = plain
    for name, why in (('calibrate', 'no turn'), ('save', 'no accepted calibration')):
        answer = camera.call(name, node)
        assert not answer.success and why in answer.message


# codes are of this room; those of the core are tested there
BAD = (
    ({'turns__half_width': 99.0}, 'between 0.5 and 10', ''),
    ({'turns__wanted': 2.5}, 'must be of type int', ''),
    ({'model': 'mirror'}, 'auto, radial, brown, fisheye', ''),
    ({'model': 3.5}, 'model must be of type str', ''),
    ({'rectified': 'whole'}, 'same, crop, all', ''),
    ({'reliability': 'perfect'}, 'auto, best_effort, reliable', ''),
    ({'camera_name': 'narrow_stereo'}, 'image_pipeline', ''),
    ({'imu_topic': "'a b'"}, "imu_topic 'a b'", 'E-TOPIC-NAME-INVALID'),
    ({'fix_topic': '/'}, "fix_topic '/'", 'E-TOPIC-NAME-INVALID'),
    ({'mask_file': 'missing.png'}, 'missing.png', ''),
    ({'mask_file': '~nobody-of-this-name/mask.png'}, 'mask.png', ''),
    ({'mask__segmentation': '~nobody-of-this-name/m.onnx'}, 'm.onnx', ''),
    ({'camera_info_url': '~nobody-of-this-name/camera.yaml'}, 'set camera_info_url',
     'E-HOME-UNKNOWN'),
    ({'camera_info_url': '/proc'}, '/proc: it is a folder', 'E-KEPT-NOT-WRITABLE'),
    ({'camera_info_url': 'file:///dev/null'}, 'a device', 'E-KEPT-NOT-WRITABLE'),
    # for root, too
    ({'camera_info_url': '/proc/camera.yaml'}, '/proc/camera.yaml', 'E-KEPT-NOT-WRITABLE'),
    ({'camera_info_url': '/dev/null/camera.yaml'}, 'Not a directory', 'E-KEPT-NOT-WRITABLE'),
    ({'camera_info_url': f'~/{"c" * 300}.yaml'}, 'too long', 'E-KEPT-NOT-WRITABLE'),
    # too long with what a file has before it is whole
    ({'camera_info_url': f'~/{"c" * 240}.yaml'}, 'too long', 'E-KEPT-NOT-WRITABLE'),
    ({'turns__half_widht': 3}, 'turns.half_width', 'E-PARAMETER-UNKNOWN'),
    ({'check_only': True}, 'start checker', 'E-CHECK-ONLY-REMOVED'),
    ({'of_another_node': 3}, 'of_another_node', 'E-PARAMETER-UNKNOWN'),
    (['-r', 'image_raw'], '-r image_raw', 'E-ROS-ARGUMENT-INVALID'),
)
# the program as often as there are arguments, one after the other; behind what each wrote to
# stderr its exit code
ONE_BY_ONE = """
import json, os, sys
from dashcalib_ros.ros import main
for arguments in json.loads(sys.argv[1]):
    os.write(2, f'\\0{main("calibrator", ["--ros-args", *arguments])}\\0'.encode())
"""


@pytest.fixture(scope='module')
def refusals(tmp_path_factory):
    """Return what one process says to each of the bad parameters, and its exit code."""
    home = tmp_path_factory.mktemp('refusals')
    done = subprocess.run(
        [sys.executable, '-c', ONE_BY_ONE, json.dumps(
            [given if isinstance(given, list) else pairs(given) for given, *_ in BAD])],
        capture_output=True, text=True, env={**os.environ, **ros_environment(home)},
        timeout=SOON + len(BAD))
    texts = done.stderr.split('\0')
    assert len(texts) == 2 * len(BAD) + 1, done.stderr
    return list(zip(texts[::2], texts[1::2], strict=False))


@pytest.mark.parametrize('number', range(len(BAD)))
def test_a_bad_parameter_ends_it_with_one_line(refusals, number):
    _, words, code = BAD[number]
    text, status = refusals[number]
    assert status == '2'
    # rcl has a line of its own about arguments
    assert words in text and len([each for each in text.splitlines() if '[rcl]' not in each]
                                 ) == 1, text
    assert code in text


def test_a_mask_of_another_size_ends_it_at_the_first_image(start_node, make_bench, tmp_path):
    cv2.imwrite(str(tmp_path / 'mask.png'), np.full((48, 64), 255, np.uint8))
    node, camera = start_node(mask_file=tmp_path / 'mask.png'), make_bench()
    camera.connect(node)
    camera.publish(image_message(noise(0), START))
    assert node.process.wait(SOON) == 2
    line = node.text.splitlines()[-1]
    assert line.startswith('calibrator: error: ') and '64x48' in line and '320x240' in line


def test_a_mask_that_fits_is_taken(start_node, make_bench, tmp_path):
    cv2.imwrite(str(tmp_path / 'mask.png'), np.full((240, 320), 255, np.uint8))
    node, camera = start_node(mask_file=tmp_path / 'mask.png'), make_bench()
    camera.connect(node)
    stream(camera, 15)
    camera.until(lambda: len(camera.magnitudes) >= 10, node=node)
    assert camera.count('undecodable') == camera.count('failed') == 0
    assert node.stop() == 0


def test_a_parameter_of_no_type_is_logged_once_and_the_node_goes_on(start_node, make_bench):
    """rclpy itself raises for it, before any callback of the node."""
    node, camera = start_node(), make_bench()
    camera.connect(node)
    client = camera.node.create_client(SetParameters, 'calibrator/set_parameters')
    camera.until(client.service_is_ready, node=node)
    odd = SetParameters.Request(parameters=[
        Parameter(name='commit', value=ParameterValue(type=99))])
    for count in (1, 2, 3):
        answer = client.call_async(odd)
        camera.until(answer.done, node=node)
        [result] = answer.result().results
        assert not result.successful and '99' in result.reason
        camera.counted('failed_callbacks', count, node)
    stream(camera, 3)
    camera.counted('received', 3, node)
    good = client.call_async(SetParameters.Request(parameters=[Parameter(
        name='commit', value=ParameterValue(type=ParameterType.PARAMETER_BOOL,
                                            bool_value=True))]))
    camera.until(good.done, node=node)
    assert good.result().results[0].successful
    assert node.text.count('Traceback') == 1 and node.stop() == 0


# callbacks that fail, and an rclpy that is left in the middle of one
FAILING = '''
import os
import signal
import sys
import time
from dashcalib_ros.ros import drive, main
kind = sys.argv.pop(1)
class Drive(drive.Drive):
    def _on_image(self, message):
        super()._on_image(message)
        if kind == 'callback' and self._intake.received % 2:
            raise ZeroDivisionError('odd image')
        if kind == 'stuck':
            self._endpoints.node.default_callback_group.ending_execution = lambda entity: None
            raise ZeroDivisionError('odd image')
        if kind == 'stopped':
            self._later(self.publish_while_stopped)
    def publish_while_stopped(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.1)
        self._magnitude.publish(drive.Float64())
    def _tick(self):
        if kind == 'timer' and self._intake.received == 2:
            raise ZeroDivisionError('odd tick')
        super()._tick()
from dashcalib_ros.ros import calibrate
calibrate.Drive = Drive
sys.exit(main('calibrator', sys.argv[1:]))
'''


@pytest.mark.parametrize('kind', ['callback', 'timer'])
def test_a_callback_that_fails_is_survived(ros_context, make_bench, tmp_path, kind):
    node = NodeProcess(tmp_path, command=[sys.executable, '-c', FAILING, kind])
    try:
        camera = make_bench()
        camera.connect(node)
        stream(camera, 2)
        node.wait_for('ZeroDivisionError: odd')
        stream(camera, 2, 2)
        camera.counted('received', 4, node)
        camera.counted('failed_callbacks', 1, node)
        assert node.text.count('Traceback') == 1 and node.stop() == 0
    finally:
        node.kill()


def test_a_callback_at_work_while_the_node_is_stopped_is_no_failure(
        ros_context, make_bench, tmp_path):
    node = NodeProcess(tmp_path, command=[sys.executable, '-c', FAILING, 'stopped'])
    try:
        camera = make_bench()
        camera.connect(node)
        stream(camera, 1)
        assert node.process.wait(SOON) == 0
        assert 'Traceback' not in node.text and 'the node continues' not in node.text
    finally:
        node.kill()


def test_an_rclpy_that_calls_nothing_any_more_ends_the_process(ros_context, make_bench, tmp_path):
    node = NodeProcess(tmp_path, command=[sys.executable, '-c', FAILING, 'stuck'])
    try:
        camera = make_bench()
        camera.connect(node)
        stream(camera, 1)
        assert node.process.wait(SOON) == 1
        assert 'ZeroDivisionError' in node.text
    finally:
        node.kill()


@pytest.mark.parametrize('redirection', ['>&-', '2>&-', '>&- 2>&-'])
def test_it_runs_and_ends_without_standard_streams(ros_context, make_bench, tmp_path,
                                                   redirection):
    node = NodeProcess(tmp_path, command=['sh', '-c', f'exec "$@" {redirection}', 'sh', *COMMAND])
    try:
        camera = make_bench()
        camera.connect(node)
        stream(camera, 3)
        camera.counted('received', 3, node)
        assert node.stop() == 0 and 'Traceback' not in node.text
    finally:
        node.kill()


def test_without_rclpy_one_line_says_how_to_install_it(tmp_path):
    code = ("import sys; sys.modules['rclpy'] = None\n"
            'from dashcalib_ros.ros import calibrator; sys.exit(calibrator())')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          timeout=SOON, env={**os.environ, **ros_environment(tmp_path)})
    assert done.returncode == 2
    assert 'pip install' in done.stderr and len(done.stderr.splitlines()) == 1
    assert done.stderr.endswith('[E-ROS-NOT-INSTALLED]\n')
