"""What the image callback does without ROS: strays, the queue, complaints."""
from __future__ import annotations

import threading
from types import SimpleNamespace

from fakes import compressed_message

from dashcalib_ros.ros.backlog import Backlog
from dashcalib_ros.ros.complaints import Complaints
from dashcalib_ros.ros.intake import Intake
from dashcalib_ros.ros.stream import LASTING, Source, SourceWatch

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


def test_the_backlog_drops_its_oldest_and_counts():
    backlog = Backlog(3)
    for n in range(5):
        backlog.put(n)
    assert [backlog.get() for _ in range(3)] == [2, 3, 4] and backlog.dropped == 2


def test_closing_the_backlog_wakes_who_waits():
    backlog, got = Backlog(3), []
    waiting = threading.Thread(target=lambda: got.append(backlog.get()))
    waiting.start()
    backlog.close()
    waiting.join(timeout=10)
    assert got == [None]


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
