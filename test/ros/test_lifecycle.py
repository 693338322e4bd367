# SPDX-License-Identifier: Apache-2.0
"""The lifecycle in this process: nothing is left behind, whatever the order of transitions."""
from __future__ import annotations

import gc
import os
import random
import threading
from contextlib import suppress
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

import rclpy
from lifecycle_msgs.msg import State
from rclpy.lifecycle import TransitionCallbackReturn

from dashcalib_ros.errors import ConfigError
from dashcalib_ros.ros.node import CameraNode
from dashcalib_ros.ros.parameters import given_parameters
from dashcalib_ros.ros.store import CameraIdentity, Store

UNCONFIGURED, INACTIVE, ACTIVE = (
    State.PRIMARY_STATE_UNCONFIGURED, State.PRIMARY_STATE_INACTIVE, State.PRIMARY_STATE_ACTIVE)
# what each transition begins from, and where it ends
TRANSITIONS = {'configure': (UNCONFIGURED, INACTIVE), 'activate': (INACTIVE, ACTIVE),
               'deactivate': (ACTIVE, INACTIVE), 'cleanup': (INACTIVE, UNCONFIGURED)}


@pytest.fixture
def make_node(ros_context, tmp_path):
    """Make nodes that are not started, each in a run of rclpy of its own."""
    made = []

    def make(program='calibrator', **parameters):
        pairs = [part for name, value in parameters.items() for part in ('-p', f'{name}:={value}')]
        rclpy.init(args=[program, '--ros-args', '-p', f'camera_info_url:={tmp_path}/camera.yaml',
                         *pairs])
        made.append(CameraNode(program, given_parameters(program)))
        return made[-1]

    try:
        yield make
    finally:
        for each in made:
            each.close()
        each = None
        rclpy.try_shutdown()
        # rclpy keeps a lifecycle node in the graph until it is collected
        made.clear()
        gc.collect()


def children():
    """Return the ids of the processes that this one started, but not of those that ended."""
    found = []
    for status in Path('/proc').glob('[0-9]*/stat'):
        with suppress(OSError):
            state, parent = status.read_text().rpartition(')')[2].split()[:2]
            found += [status.parent.name] * (int(parent) == os.getpid() and state != 'Z')
    return found


def left(node, path):
    """Return the threads, children and endpoints of a node, and whether another gets its file."""
    other = Store(path, CameraIdentity('dashcam', '/image_raw'))
    free = other.claim()
    other.close()
    endpoints = {kind: len(list(getattr(node, kind))) for kind in (
        'publishers', 'subscriptions', 'services', 'timers', 'guards', 'clients')}
    return {each.name for each in threading.enumerate()}, children(), endpoints, free


@pytest.mark.thorough
@pytest.mark.parametrize('program', ['calibrator', 'checker'])
def test_random_transitions_leave_nothing(make_node, tmp_path, program):
    node, chance = make_node(program, image_transport='video'), random.Random(0)
    before, state = left(node, tmp_path / 'camera.yaml'), UNCONFIGURED
    assert before[3]
    started = failed = 0
    for _ in range(100):
        name = chance.choice([name for name, (begin, _) in TRANSITIONS.items() if begin == state])
        if name == 'configure' and chance.random() < 0.2:
            fail_once(node, chance.choice((ConfigError('E-TEST', 'odd'), ZeroDivisionError())))
            assert node.trigger_configure() != TransitionCallbackReturn.SUCCESS
            failed += 1
        else:
            assert getattr(node, f'trigger_{name}')() == TransitionCallbackReturn.SUCCESS
            state = TRANSITIONS[name][1]
            if name == 'configure' and started < 2:
                # a turn that is built starts a child
                started += 1
                start_child(node)
        if state == UNCONFIGURED:
            assert left(node, tmp_path / 'camera.yaml') == before
        elif program == 'calibrator':
            assert not left(node, tmp_path / 'camera.yaml')[3]
    assert failed and started == 2
    if state == UNCONFIGURED:
        node.trigger_configure()
    assert node.trigger_shutdown() == TransitionCallbackReturn.SUCCESS
    assert left(node, tmp_path / 'camera.yaml') == before


def fail_once(node, error):
    """Let the next configure fail after the threads were started."""
    def create_service(*arguments, **options):
        del node.create_service
        raise error
    node.create_service = create_service


def start_child(node):
    """Have the learner's thread run something in a child."""
    learner, done = node.role.drive.learner, threading.Event()

    def run():
        learner._now.calibrator.workers.run(os.getpid)
        done.set()
    learner.inbox.put(run)
    assert done.wait(60)
    assert children()


def test_it_can_be_configured_again_after_what_kept_it_from_that(make_node, tmp_path, capfd):
    mask = tmp_path / 'mask.png'
    node = make_node(mask_file=mask)
    assert node.trigger_configure() == TransitionCallbackReturn.FAILURE
    line, = [line for line in capfd.readouterr().err.splitlines() if '[ERROR]' in line]
    assert 'mask.png' in line
    import cv2
    import numpy as np
    cv2.imwrite(str(mask), np.full((48, 64), 255, np.uint8))
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    # what keeps it from starting by itself ends the program
    node.trigger_cleanup()
    mask.unlink()
    with pytest.raises(Exception, match=r'mask\.png'):
        node.start()


def test_a_kept_calibration_is_used_again_after_cleanup(make_desk):
    desk = make_desk()
    desk.give()
    assert desk.show() == 400.0
    assert desk.node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert desk.node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    assert desk.node.role is None
    desk.node.start()
    desk.until(lambda: desk.bench.values['calibration'] == 'unconfirmed')
    desk.until(lambda: desk.bench.values.get('reliability') == 'reliable')
    assert desk.show() == 400.0
