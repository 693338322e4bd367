# SPDX-License-Identifier: Apache-2.0
"""A rendered drive, published to the node until it is calibrated: between real processes."""
from __future__ import annotations

import os
import signal

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

from ros_bench import (
    SECOND,
    SOON,
    Bench,
    NodeProcess,
    image_message,
)
from sensor_msgs.msg import Imu
from sensor_msgs.srv import SetCameraInfo
from shared_drive import ONE_TURN, OTHER_TURN
from synthetic import LENS as SYNTHETIC_LENS
from synthetic import synthetic_turn

from dashcalib_ros.formats import load_camera
from dashcalib_ros.store.turn_store import Origin, StoredTurn, TurnStore

# few points: what is tested is the node, the core has tests of its own
QUICK = {'turns__wanted': 2, 'scene__tracks': 200, 'scene__profile_tracks': 100,
         'tracks__points': 300, 'queue_size': 300}


@pytest.fixture(scope='module')
def rendered(shared_drive):
    """Return a drive with two turns, and all its frames."""
    return shared_drive, list(shared_drive.frames())


def test_it_ends_cleanly_while_children_work(start_node, make_bench, rendered):
    node, camera = start_node(**QUICK), make_bench()
    camera.connect(node)
    for frame in rendered[1]:
        camera.publish(image_message(frame.image, frame.stamp_ns))
        camera.spin(0.02)
        if node.children():
            break
    assert node.children()
    assert node.stop(signal.SIGINT, signal.SIGINT) == 0, node.text
    assert node.children() == [] and 'Traceback' not in node.text


class Driven:
    """What was seen while a rendered drive was published to a node until it was calibrated."""


@pytest.fixture(scope='module')
def driven(ros_context, rendered, tmp_path_factory):
    home = tmp_path_factory.mktemp('driven')
    seen = Driven()
    seen.drive, seen.frames = rendered
    # other tests keep the machine busy: a queue of 5 images would overrun
    seen.node = NodeProcess(home, '-p', 'qos_overrides./image_raw.subscription.depth:=50',
                            commit=True, commit_timeout=SOON, use_imu=True, **QUICK)
    seen.bench = bench = Bench(ros_context)
    seen.committed = []
    seen.gyro = bench.node.create_publisher(Imu, '/imu', 400)

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
    """Publish the drive, kill the first child, ask for a calibration after the first turn, wait
    for that of both turns, and publish some more.
    """
    bench, node = seen.bench, seen.node
    seen.killed, seen.asked = 0, None
    rates = gyro_messages(seen.drive, seen.frames)
    for frame in seen.frames:
        for message in next(rates):
            seen.gyro.publish(message)
        bench.publish(image_message(frame.image, frame.stamp_ns))
        bench.spin(0.02)
        if not seen.killed and (children := node.children()):
            os.kill(children[0], signal.SIGKILL)
            seen.killed = children[0]
        if seen.asked is None and bench.count('turns found') > 0:
            seen.asked = bench.call('calibrate', node, limit=90.0)
            # the second turn must not come to its help
            node.wait_for('a calibration of 1 turn', 90.0)
    seen.before = len(bench.infos)
    bench.until(lambda: seen.committed, 120.0, 'an accepted calibration', node)
    seen.latched = list(bench.latched)
    seen.after = [image_message(frame.image, frame.stamp_ns + 100 * SECOND, 'camera')
                  for frame in seen.frames[:5]]
    bench.publish(*seen.after)
    bench.until(lambda: len(bench.infos) >= 5, what='camera_info for each image', node=node)
    bench.until(lambda: bench.values.get('state') == 'calibrated', node=node)


def gyro_messages(drive, frames):
    """Yield for each image what a gyro that lies on its side, 40 ms late, sends until then.

    Each tenth message comes twice, some after a later one, and some without a stamp.
    """
    stamps_ns, late_ns = np.array([frame.stamp_ns for frame in frames]), 40_000_000
    rates = np.gradient(np.unwrap(drive.yaw), stamps_ns / 1e9)
    sent = stamps_ns[0]
    for now in stamps_ns:
        messages = []
        while sent <= now:
            message = Imu()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(sent), 10**9)
            message.angular_velocity.x = float(np.interp(sent - late_ns, stamps_ns, rates))
            messages.append(message)
            count = int(sent - stamps_ns[0]) // 10_000_000
            messages += [message] * (count % 10 == 0) + [Imu()] * (count % 100 == 50)
            if count % 15 == 0:
                messages[-2:] = messages[:-3:-1]
            sent += 10_000_000
        yield messages


def test_a_gyro_with_bad_messages_is_a_witness(driven):
    told = driven.bench.values['motion sensors']
    assert told.startswith('the gyro agrees: fx off by'), driven.node.text
    assert told in driven.node.text
    late_ms = float(told.partition('late by ')[2].split()[0])
    assert abs(late_ms - 40) < 15


def test_nothing_is_published_before_acceptance_and_one_per_image_after(driven):
    assert driven.before == 0
    assert [info.header for info in driven.bench.infos] == [
        image.header for image in driven.after]


def test_one_turn_is_calibrated_on_request_but_too_weak_to_publish(driven):
    # when it is done, with the verdict
    assert not driven.asked.success
    assert driven.asked.message.startswith(('weak: ', 'refused: '))
    assert 'a calibration of 1 turn is weak: only 1 of at least 2 turns' in driven.node.text


def test_camera_info_is_complete_and_close_to_the_truth(driven):
    info, truth = driven.bench.infos[0], driven.drive.truth
    assert (info.width, info.height, info.distortion_model) == (640, 360, 'plumb_bob')
    fx, fy, cx, cy = info.k[0], info.k[4], info.k[2], info.k[5]
    assert list(info.k) == [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    assert list(info.p) == [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]
    assert list(info.r) == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert len(info.d) == 5 and list(info.d[2:]) == [0, 0, 0]
    assert abs(fx / truth['fx'] - 1) < 0.015 and abs(fy / truth['fy'] - 1) < 0.015
    assert abs(info.d[0] - truth['k1']) < 0.02


def test_a_killed_child_costs_no_turn(driven):
    assert driven.killed
    assert driven.killed not in driven.node.children()
    saved = load_camera(driven.node.home / '.ros' / 'camera_info' / 'dashcam.yaml')
    assert saved.verdict == 'accepted'
    # both turns of the drive were needed, and the child that died had one of them
    assert 'turns_used: 2' in (
        driven.node.home / '.ros' / 'camera_info' / 'dashcam.yaml').read_text()


def test_the_latched_calibration_reaches_late_subscribers(driven, ros_context):
    late = Bench(ros_context)
    try:
        late.until(lambda: late.latched, node=driven.node)
        assert late.latched[-1].k.tolist() == driven.bench.infos[0].k.tolist()
    finally:
        late.close()


def test_the_driver_was_given_the_calibration(driven):
    assert len(driven.committed) == 1
    assert driven.committed[0].k.tolist() == driven.bench.infos[0].k.tolist()
    driven.node.wait_for('set_camera_info accepted the calibration')


def test_the_turning_magnitude_was_published(driven):
    values = [message.data for message in driven.bench.magnitudes]
    assert max(values) > 0.02 > min(values) >= 0


def test_the_calibration_is_saved_again_on_request(driven):
    path = driven.node.home / '.ros' / 'camera_info' / 'dashcam.yaml'
    path.unlink()
    answer = driven.bench.call('save', driven.node)
    assert answer.success and str(path) in answer.message
    assert load_camera(path).camera.fx == driven.bench.infos[0].k[0]


def test_diagnostics_tell_an_operator_everything(driven):
    bench = driven.bench
    # images, so that it is not stale
    bench.publish(*driven.after)
    bench.until(lambda: bench.status.level == b'\x00', node=driven.node)
    assert bench.status.name == 'calibrator: camera calibration (dashcam)'
    assert bench.status.hardware_id == 'dashcam'
    values = bench.values
    assert values['verdict'] == 'accepted' and values['turns wanted'] == '2'
    assert int(values['received']) >= len(driven.drive)
    assert values['dropped'] == '0'
    assert float(values['sigma fx (px)']) > 0
    assert values['published'].startswith('fx 38')


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
    assert [path.name for path in folder.glob('[!.]*')] == ['dashcam.previous.yaml']
    assert not bench.call('save', driven.node).success
    assert driven.node.stop() == 0
    assert 'Traceback' not in driven.node.text
    # the nodes of the tests after this hear no second publisher
    bench.close()


@pytest.mark.thorough
def test_turns_outlive_the_node_and_add_up(start_node, make_bench, rendered, tmp_path):
    """Two short trips of one turn each; the calibration comes of both."""
    drive, frames = rendered
    folder, camera = tmp_path / 'turns', make_bench()
    options = {**QUICK, 'turns__store': folder}

    def send(part):
        for frame in part:
            camera.publish(image_message(frame.image, frame.stamp_ns))
            camera.spin(0.02)

    node = start_node(**options)
    camera.connect(node)
    send(frames[:ONE_TURN])
    camera.until(lambda: list(folder.glob('*.npz')), 90.0, 'a stored turn', node)
    assert node.stop() == 0

    # another camera does not get it, and leaves it alone
    node = start_node(**options)
    camera.connect(node)
    camera.publish(image_message(frames[0].image, frames[0].stamp_ns, 'rear'))
    node.wait_for('skipped: the images were')
    camera.counted('store', 1, node)
    assert camera.count('turns found') == 0
    assert node.stop() == 0 and len(list(folder.glob('*.npz'))) == 1

    node = start_node(**options)
    camera.connect(node)
    send(frames[OTHER_TURN:OTHER_TURN + 1])
    camera.until(lambda: camera.count('turns stored') == 1, node=node)
    # it gives nothing before a turn of this drive agrees with it
    assert camera.count('turns found') == 1 and camera.count('turns built') == 0
    send(frames[OTHER_TURN + 1:])
    camera.until(lambda: camera.values['state'] == 'calibrated', 120.0, 'a calibration', node)
    assert abs(camera.latched[-1].k[0] / drive.truth['fx'] - 1) < 0.02
    # its turns are used up: the next opinion is one of its own
    camera.until(lambda: list(folder.iterdir()) == [], what='an empty folder', node=node)
    assert node.stop() == 0 and 'Traceback' not in node.text


def test_reset_forgets_the_stored_turns_even_before_the_first_image(start_node, make_bench,
                                                                    tmp_path):
    folder = tmp_path / 'turns'
    store = TurnStore(str(folder), 10, 3.0, pytest.fail)
    store.load(Origin((640, 360)))
    scene = synthetic_turn(keyframes=8, tracks=60).scene(SYNTHETIC_LENS)
    store.mirror({0: StoredTurn(scene, 5.0, 0.05)})
    assert len(list(folder.iterdir())) == 1
    node, camera = start_node(turns__store=folder), make_bench()
    assert camera.call('reset', node).success
    camera.until(lambda: list(folder.iterdir()) == [], what='an empty folder', node=node)
    assert node.stop() == 0
