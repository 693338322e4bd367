# SPDX-License-Identifier: Apache-2.0
"""What the image callback does: strays, the queue, complaints."""
from __future__ import annotations

from types import SimpleNamespace

import pytest
from fakes import compressed_message

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

from dashcalib_ros.ros.background import Inbox
from dashcalib_ros.ros.diagnostics import Complaints
from dashcalib_ros.ros.images import LASTING, Intake, Source, SourceWatch

SMALL, LARGE, REAR = (Source((320, 240), 'camera'), Source((640, 480), 'camera'),
                      Source((320, 240), 'rear'))


def test_strays_never_change_the_camera():
    watch = SourceWatch()
    assert watch.take(SMALL) == 'first'
    for _ in range(5 * LASTING):
        assert [watch.take(LARGE), watch.take(REAR), watch.take(SMALL)] == [
            'stray', 'stray', 'same']
    for _ in range(5 * LASTING):
        assert [watch.take(LARGE), watch.take(REAR)] == ['stray', 'stray']


def test_a_change_that_lasts_is_one():
    watch = SourceWatch()
    watch.take(SMALL)
    assert [watch.take(LARGE) for _ in range(LASTING)] == ['stray'] * (LASTING - 1) + ['changed']
    assert (watch.previous, watch.current) == (SMALL, LARGE)
    assert watch.take(LARGE) == 'same'


def test_the_inbox_drops_its_oldest_images_and_no_command():
    inbox, done = Inbox(3), []
    for n in range(5):
        inbox.put(lambda n=n: done.append(f'command {n}'))
        inbox.put_image(lambda n=n: done.append(n))
    for _ in range(8):
        inbox.get(0.0)()
    assert done == [*(f'command {n}' for n in range(5)), 2, 3, 4] and inbox.dropped == 2
    assert inbox.get(0.0) is None


def test_a_command_may_take_the_place_of_the_images_that_wait():
    inbox, done = Inbox(3), []
    for n in range(3):
        inbox.put_image(lambda n=n: done.append(n))
    inbox.put(lambda: done.append('new camera'), instead_of_images=True)
    inbox.put_image(lambda: done.append('its image'))
    while (action := inbox.get(0.0)) is not None:
        action()
    assert done == ['new camera', 'its image'] and inbox.dropped == 0


def test_complaints_are_counted_always_and_said_now_and_then():
    said = []
    complaints = Complaints(said.append, every_s=3600.0)
    for n in range(5):
        complaints.say('broken', f'image {n}')
        complaints.say('late', 'late')
    complaints.total('lost', 7, 'lost')
    complaints.total('lost', 7, 'lost')
    assert said == ['image 0', 'late', 'lost (6 more like it)']
    assert complaints.counts == {'broken': 5, 'late': 5, 'lost': 7}


def test_what_was_not_said_is_told_next_time():
    said = []
    complaints = Complaints(said.append, every_s=3600.0)
    complaints.say('broken', 'a')
    complaints.say('broken', 'b')
    complaints._every_s = 0.0
    complaints.say('broken', 'c')
    assert said == ['a', 'c (1 more like it)']


def test_what_lasts_is_said_once():
    said = []
    complaints = Complaints(said.append, every_s=3600.0)
    complaints.say('store', 'full')
    complaints.say('store', 'odd')
    for _ in range(3):
        for text in ('full', 'odd', 'no mask'):
            complaints.once(text)
    assert said == ['full', 'odd', 'no mask'] and complaints.counts == {'store': 2}


def test_damaged_images_are_no_sign_of_another_camera():
    """Of a PGM of ten bytes, the header says its size, and there are no pixels."""
    changes, complaints = [], Complaints(lambda text: None)
    intake = Intake(10.0, complaints, lambda before, source: changes.append(source))

    def sent(data, times=1):
        header = SimpleNamespace(frame_id='camera')
        message = compressed_message(format='pgm', data=data)
        message.header = header
        return [intake.take(message) for _ in range(times)]

    def whole(width):
        return b'P5 %d 8 255\n' % width + bytes(8 * width)

    cut = b'P5 64 8 9\n'
    assert sent(cut, 3) == [None] * 3 and intake.source is None
    sent(whole(32))
    assert sent(cut, 3 * LASTING) == [None] * 3 * LASTING
    sent(whole(64), LASTING - 1)
    sent(cut)
    sent(whole(64), LASTING - 1)
    assert [source.size for source in changes] == [(32, 8)] and complaints.counts['undecodable']
    sent(whole(64))
    assert [source.size for source in changes] == [(32, 8), (64, 8)]
