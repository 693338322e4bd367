"""The node between real processes: driven to acceptance, stopped in every state, fed bad input."""
from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

from ros_bench import (
    SOON,
    Bench,
    NodeProcess,
    compressed_message,
    image_message,
    ros_environment,
)
from sensor_msgs.msg import CameraInfo, CompressedImage
from sensor_msgs.srv import SetCameraInfo

from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.report import load_calibration_yaml

LENS = Lens.of(640, 360, 75.0, -0.30, 0.10, offset=(9.0, -6.0), aspect=1.003)
# few points: what is tested is the node, the core has tests of its own
QUICK = {'turns__wanted': 2, 'scene__tracks': 200, 'scene__profile_tracks': 100,
         'tracks__points': 300, 'queue_size': 300}
SECOND = 10**9
START = 1_767_614_400 * SECOND


@pytest.fixture(scope='module')
def context(tmp_path_factory):
    """rclpy in this process, in this run's own domain."""
    before = dict(os.environ)
    os.environ.update(ros_environment(tmp_path_factory.mktemp('home')))
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.try_shutdown(context=context)
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture
def start(tmp_path, context):
    """Start nodes that are gone after the test, whatever happens."""
    nodes = []

    def start_node(*arguments, **parameters):
        nodes.append(NodeProcess(tmp_path, *arguments, **parameters))
        return nodes[-1]

    yield start_node
    for node in nodes:
        node.kill()


@pytest.fixture
def bench(context):
    """Make benches that are closed after the test."""
    made = []

    def make(**options):
        made.append(Bench(context, **options))
        return made[-1]

    yield make
    for each in made:
        each.close()


def noise(index, size=(320, 240)):
    """Return a picture without meaning."""
    return np.random.default_rng(index).integers(0, 256, size[::-1], np.uint8)


def stream(bench, count, first=0, make=image_message, size=(320, 240), **options):
    """Publish images without meaning at 10 Hz of their own time, faster than that."""
    for index in range(first, first + count):
        bench.publish(make(noise(index, size), START + index * SECOND // 10, **options))
        bench.spin(0.01)


CAMERA_FILE = """\
image_width: {width}
image_height: 240
camera_name: dashcam
camera_matrix: {{rows: 3, cols: 3, data: [200.0, 0.0, 160.0, 0.0, 201.0, 120.0, 0.0, 0.0, 1.0]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [-0.1, 0.01, 0.0, 0.0, 0.0]}}
"""
OURS = """\
dashcalib:
  verdict: accepted
  sigma: {fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0, k1: 0.01, k2: 0.01}
  frame_id: camera
"""


def keep_file(home, text, name='dashcam'):
    path = home / '.ros' / 'camera_info' / f'{name}.yaml'
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


# -- a drive to acceptance --------------------------------------------------------------------

@pytest.fixture(scope='module')
def rendered():
    """Return a drive with two turns, and all its frames."""
    drive = Drive(LENS, DriveSpec(seed=0, turns=2))
    return drive, list(drive.frames(processes=2))


class Driven:
    """What was seen while a rendered drive was published to a node until it was calibrated."""


@pytest.fixture(scope='module')
def driven(context, rendered, tmp_path_factory):
    home = tmp_path_factory.mktemp('driven')
    seen = Driven()
    seen.drive, seen.frames = rendered
    seen.node = NodeProcess(home, commit=True, commit_timeout=SOON, **QUICK)
    seen.bench = bench = Bench(context)
    seen.committed = []

    def set_camera_info(request, response):
        seen.committed.append(request.camera_info)
        response.success = True
        return response

    bench.node.create_service(SetCameraInfo, 'set_camera_info', set_camera_info)
    try:
        bench.connect(seen.node)
        drive(seen)
        yield seen
    finally:
        seen.node.kill()
        bench.close()


def drive(seen):
    """Publish the drive, kill the first child, wait for the calibration, publish some more."""
    bench, node = seen.bench, seen.node
    seen.killed = 0
    for frame in seen.frames:
        bench.publish(image_message(frame.image, frame.stamp_ns))
        bench.spin(0.02)
        if not seen.killed and (children := node.children()):
            os.kill(children[0], signal.SIGKILL)
            seen.killed = children[0]
    seen.before = len(bench.infos)
    bench.until(lambda: seen.committed, 120.0, 'an accepted calibration', node)
    seen.latched = list(bench.latched)
    seen.after = [image_message(frame.image, frame.stamp_ns + 100 * SECOND, 'camera')
                  for frame in seen.frames[:5]]
    bench.publish(*seen.after)
    bench.until(lambda: len(bench.infos) >= 5, what='camera_info for each image', node=node)
    bench.until(lambda: bench.values.get('state') == 'calibrated', node=node)


def test_nothing_is_published_before_acceptance_and_one_per_image_after(driven):
    assert driven.before == 0
    assert [info.header for info in driven.bench.infos] == [
        image.header for image in driven.after]


def test_camera_info_is_complete_and_close_to_the_truth(driven):
    info, truth = driven.bench.infos[0], driven.drive.truth
    assert (info.width, info.height, info.distortion_model) == (640, 360, 'plumb_bob')
    fx, fy, cx, cy = info.k[0], info.k[4], info.k[2], info.k[5]
    assert list(info.k) == [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    assert list(info.p) == [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]
    assert list(info.r) == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert len(info.d) == 5 and list(info.d[2:]) == [0, 0, 0]
    assert abs(fx / truth.fx - 1) < 0.015 and abs(fy / truth.fy - 1) < 0.015
    assert abs(info.d[0] - truth.k1) < 0.02


def test_a_killed_child_costs_no_turn(driven):
    assert driven.killed
    assert driven.killed not in driven.node.children()
    saved = load_calibration_yaml(driven.node.home / '.ros' / 'camera_info' / 'dashcam.yaml')
    assert saved.verdict == 'accepted'
    # both turns of the drive were needed, and the child that died had one of them
    assert 'turns_used: 2' in (
        driven.node.home / '.ros' / 'camera_info' / 'dashcam.yaml').read_text()


def test_the_latched_calibration_reaches_late_subscribers(driven, context):
    late = Bench(context)
    try:
        late.until(lambda: late.latched, node=driven.node)
        assert late.latched[-1].k.tolist() == driven.bench.infos[0].k.tolist()
    finally:
        late.close()


def test_the_driver_was_given_the_calibration(driven):
    assert len(driven.committed) == 1
    assert driven.committed[0].k.tolist() == driven.bench.infos[0].k.tolist()
    driven.node.wait_for('set_camera_info took the calibration')


def test_the_turning_magnitude_was_published(driven):
    values = [message.data for message in driven.bench.magnitudes]
    assert max(values) > 0.02 > min(values) >= 0


def test_the_calibration_is_saved_again_on_request(driven):
    path = driven.node.home / '.ros' / 'camera_info' / 'dashcam.yaml'
    path.unlink()
    answer = driven.bench.call('save', driven.node)
    assert answer.success and str(path) in answer.message
    assert load_calibration_yaml(path).intrinsics.fx == driven.bench.infos[0].k[0]


def test_diagnostics_tell_an_operator_everything(driven):
    bench = driven.bench
    # images, so that it is not stale
    bench.publish(*driven.after)
    bench.until(lambda: bench.status.level == b'\x00', node=driven.node)
    assert bench.status.name == 'calibrator: camera calibration'
    assert bench.status.hardware_id == 'dashcam'
    values = bench.values
    assert values['verdict'] == 'accepted' and values['turns wanted'] == '2'
    assert int(values['received']) >= len(driven.drive)
    assert values['dropped'] == '0'
    assert float(values['sigma fx (px)']) > 0
    assert values['published'].startswith('fx 4')


def test_reset_takes_everything_back(driven):
    """The last one with this node."""
    bench = driven.bench
    assert bench.call('reset', driven.node).success
    bench.until(lambda: bench.values.get('state') == 'collecting', node=driven.node)
    bench.until(lambda: bench.latched[-1].k[0] == 0, what='the latched one', node=driven.node)
    heard = len(bench.infos)
    received = bench.count('received')
    bench.publish(*driven.after)
    bench.counted('received', received + 5, driven.node)
    assert len(bench.infos) == heard
    folder = driven.node.home / '.ros' / 'camera_info'
    assert [path.name for path in folder.iterdir()] == ['dashcam.previous.yaml']
    assert not bench.call('save', driven.node).success
    assert driven.node.stop() == 0
    assert 'Traceback' not in driven.node.text


# -- the end ----------------------------------------------------------------------------------

@pytest.mark.parametrize('signals', [
    (signal.SIGINT,), (signal.SIGTERM,), (signal.SIGINT, signal.SIGINT),
    (signal.SIGTERM, signal.SIGINT)], ids=['SIGINT', 'SIGTERM', 'two SIGINT', 'both'])
def test_it_ends_cleanly_while_it_collects(start, bench, signals):
    node, camera = start(), bench()
    camera.connect(node)
    stream(camera, 5)
    assert node.stop(*signals) == 0, node.text
    assert 'Traceback' not in node.text


def test_it_ends_cleanly_while_children_work(start, bench, rendered):
    node, camera = start(**QUICK), bench()
    camera.connect(node)
    for frame in rendered[1]:
        camera.publish(image_message(frame.image, frame.stamp_ns))
        camera.spin(0.02)
        if node.children():
            break
    assert node.children()
    assert node.stop(signal.SIGINT, signal.SIGINT) == 0, node.text
    assert node.children() == [] and 'Traceback' not in node.text


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('delay', [0.3, 0.6, 0.9])
def test_it_ends_cleanly_while_it_starts(start, number, delay):
    node = start()
    time.sleep(delay)
    # before Python runs the node's own first line, the signal's default holds
    begun = bool(node.text) or delay > 0.5
    code = node.stop(number)
    assert code == 0 or (not begun and code == -number), node.text


# -- the file ---------------------------------------------------------------------------------

def test_a_kept_calibration_is_published_from_the_first_image_on(start, bench, tmp_path):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS)
    node, camera = start(), bench()
    camera.connect(node)
    camera.until(lambda: camera.latched, node=node)
    sent = [image_message(noise(n), START + n * SECOND) for n in range(3)]
    camera.publish(*sent)
    camera.until(lambda: len(camera.infos) == 3, node=node)
    assert [info.header for info in camera.infos] == [image.header for image in sent]
    assert camera.infos[0].k[0] == 200.0 and list(camera.infos[0].d) == [-0.1, 0.01, 0, 0, 0]
    assert camera.latched[0].header.frame_id == 'camera'


@pytest.mark.parametrize(('text', 'words'), [
    ('{{{ no yaml', 'is not valid YAML'),
    ('', 'is no camera calibration'),
    (CAMERA_FILE.format(width=320), 'no accepted calibration of this node'),
    (CAMERA_FILE.format(width=640) + OURS, 'it is for 640x240'),
    ((CAMERA_FILE.format(width=320) + OURS).replace('frame_id: camera', 'frame_id: rear'),
     "in frame 'rear'"),
], ids=['corrupt', 'empty', 'foreign', 'other size', 'other frame'])
def test_a_file_that_does_not_fit_is_ignored_with_a_warning(start, bench, tmp_path, text, words):
    path = keep_file(tmp_path, text)
    node, camera = start(), bench()
    camera.connect(node)
    stream(camera, 5)
    camera.counted('received', 5, node)
    node.wait_for(words)
    assert camera.infos == []
    assert path.read_text() == text
    assert not camera.latched or camera.latched[-1].k[0] == 0


def test_a_namespace_names_the_camera(start, bench, tmp_path):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS, 'front')
    node, camera = start('-r', '__ns:=/front'), bench(namespace='/front')
    camera.connect(node)
    stream(camera, 2)
    camera.until(lambda: len(camera.infos) == 2, node=node)
    assert camera.status.name == 'front/calibrator: camera calibration'
    assert camera.status.hardware_id == 'front'


# -- input ------------------------------------------------------------------------------------

def test_compressed_images_get_their_camera_info(start, bench, tmp_path):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS)
    node = start('-r', 'image_raw:=dashcam/image', image_transport='compressed')
    camera = bench(image_type=CompressedImage, topic='dashcam/image/compressed')
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


def test_bad_images_are_counted_and_the_node_lives(start, bench):
    node, camera = start(), bench()
    camera.connect(node)
    stream(camera, 3)
    bad = broken_images()
    camera.publish(*bad)
    camera.counted('undecodable', len(bad), node)
    stream(camera, 3, 500)
    camera.counted('received', 6 + len(bad), node)
    # one line for all of them within ten seconds, and it names a cure
    assert sum('[WARN]' in line for line in node.text.splitlines()) == 1, node.text
    assert 'publish mono8' in node.text
    assert node.stop() == 0 and 'Traceback' not in node.text


def test_odd_stamps_are_counted_and_the_node_lives(start, bench):
    node, camera = start(), bench()
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


def test_a_driver_that_never_stamps_is_learned_from_all_the_same(start, bench):
    node, camera = start(), bench()
    camera.connect(node)
    for n in range(10):
        camera.publish(image_message(noise(n), 0))
        camera.spin(0.15)
    camera.until(lambda: len(camera.magnitudes) >= 5, node=node)
    assert camera.count('unstamped') == 0


def test_two_publishers_of_different_sizes_do_not_reset_it(start, bench, tmp_path):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS)
    node, camera = start(), bench()
    camera.connect(node)
    for n in range(15):
        camera.publish(image_message(noise(n), START + n * SECOND),
                       image_message(noise(n, (640, 240)), START + n * SECOND + 5))
    camera.counted('strays', 15, node)
    camera.until(lambda: len(camera.infos) == 15, node=node)
    assert {info.width for info in camera.infos} == {320}
    node.wait_for('is there a second publisher?')


@pytest.mark.parametrize('change', [{'size': (640, 240)}, {'frame_id': 'rear'}],
                         ids=['size', 'frame'])
def test_a_change_of_size_or_frame_resets_it_loudly(start, bench, tmp_path, change):
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS)
    node, camera = start(), bench()
    camera.connect(node)
    stream(camera, 5)
    camera.until(lambda: len(camera.infos) == 5, node=node)
    stream(camera, 20, 5, **change)
    camera.counted('received', 25, node)
    camera.until(lambda: camera.values['state'] == 'collecting', node=node)
    assert '[ERROR]' in node.text and 'the camera changes from 320x240' in node.text
    assert all(info.width == 320 and info.header.frame_id == 'camera' for info in camera.infos)
    camera.until(lambda: camera.latched[-1].k[0] == 0, node=node)
    # back again: the file fits once more
    stream(camera, 20, 25)
    camera.until(lambda: camera.values['state'] == 'calibrated', node=node)


def test_auto_reliability_follows_the_publishers(start, bench):
    """Best effort hears both kinds; a reliable subscription would never hear the second."""
    first = bench(reliable=True)
    node = start()
    first.connect(node)
    node.wait_for('subscribing reliable')
    second = bench(reliable=False, listen=False)
    first.until(lambda: 'subscribing best_effort' in node.text, node=node)
    second.until(lambda: second.images.get_subscription_count() > 0, node=node)
    before = first.count('received')
    end = time.monotonic() + SOON
    while first.count('received') <= before:
        second.publish(image_message(noise(1), START))
        first.spin(0.1)
        assert time.monotonic() < end, node.text
    first.until(lambda: '2 publishers' in first.values['warnings'], node=node)


def test_another_publisher_of_camera_info_is_reported(start, bench):
    node, camera = start(), bench()
    camera.node.create_publisher(CameraInfo, 'camera_info', 1)
    camera.connect(node)
    stream(camera, 2)
    camera.until(lambda: 'another node publishes /camera_info' in camera.values['warnings'],
                 node=node)


def test_silence_is_stale(start, bench):
    node, camera = start(), bench()
    camera.connect(node)
    camera.until(lambda: camera.status.level == b'\x03', node=node)
    assert camera.status.message == 'no image on /image_raw yet'


# -- services and parameters ------------------------------------------------------------------

def test_services_say_why_not(start, bench):
    node, camera = start(), bench()
    camera.connect(node)
    for name, why in (('calibrate', 'no turn was found'), ('save', 'no accepted calibration')):
        answer = camera.call(name, node)
        assert not answer.success and why in answer.message


@pytest.mark.parametrize(('parameters', 'words'), [
    ({'turns__half_width': 99.0}, 'out of range'),
    ({'turns__wanted': 2.5}, 'must be int'),
    ({'reliability': 'perfect'}, 'must be one of'),
    ({'camera_name': 'narrow_stereo'}, 'belongs to image_pipeline'),
])
def test_a_bad_parameter_ends_it_with_one_line(start, parameters, words):
    node = start(**parameters)
    assert node.process.wait(SOON) == 2
    assert words in node.text and len(node.text.splitlines()) == 1, node.text


def test_a_misspelt_parameter_is_reported(start):
    start(turns__half_widht=3).wait_for('did you mean turns.half_width?')


def test_without_rclpy_one_line_says_how_to_install_it(tmp_path):
    code = ("import sys; sys.modules['rclpy'] = None\n"
            'from dashcalib_ros.ros import main; sys.exit(main([]))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          timeout=SOON, env={**os.environ, **ros_environment(tmp_path)})
    assert done.returncode == 2
    assert 'pip install' in done.stderr and len(done.stderr.splitlines()) == 1
