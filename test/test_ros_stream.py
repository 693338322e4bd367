"""What the image callback does without ROS: stamps, thinning, strays, sizes, the queue."""
from __future__ import annotations

import threading
import types

import cv2
import numpy as np
import pytest

from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError
from dashcalib_ros.frames import Frame
from dashcalib_ros.motion import MotionEstimator
from dashcalib_ros.ros.backlog import Backlog
from dashcalib_ros.ros.complaints import Complaints
from dashcalib_ros.ros.image_size import encoded_size, image_size
from dashcalib_ros.ros.stream import LASTING, Source, SourceWatch, StampWatch, Thinning

SECOND = 10**9
START = 1_767_614_400 * SECOND


def taken(*stamps):
    watch = StampWatch()
    return watch, [watch.take(stamp, 77 + n) for n, stamp in enumerate(stamps)]


def test_good_stamps_pass_and_gaps_are_counted():
    steps = [0, 1, 2, 3, 4, 5, 6, 9, 10, 11, 12, 15]
    watch, got = taken(*(START + step * SECOND // 10 for step in steps))
    assert got == [START + step * SECOND // 10 for step in steps]
    assert watch.lost == 4


def test_jitter_is_no_loss():
    rng = np.random.default_rng(0)
    watch, _ = taken(*(START + n * SECOND // 30 + int(rng.uniform(-6e6, 6e6)) for n in range(500)))
    assert watch.lost == 0


def test_a_pause_is_no_loss():
    watch, _ = taken(*(START + n * SECOND // 10 for n in range(20)), START + 60 * SECOND)
    assert watch.lost == 0


def test_late_and_repeated_images_are_not_learned_from():
    watch, got = taken(START, START, START - SECOND // 2, START + 1)
    assert got == [START, None, None, START + 1] and watch.repeated == 2


def test_a_clock_that_is_set_back_is_passed_on():
    watch, got = taken(START, START - 100 * SECOND, START - 99 * SECOND)
    assert got == [START, START - 100 * SECOND, START - 99 * SECOND]
    assert (watch.set_back, watch.repeated) == (1, 0)


def test_drivers_without_stamps_are_timed_by_arrival():
    watch, got = taken(0, 0, 0)
    assert got == [77, 78, 79] and watch.zero == 0
    assert watch.take(START, 80) == START


def test_one_zero_among_stamps_is_left_out():
    watch, got = taken(START, 0, START + 1)
    assert got == [START, None, START + 1] and watch.zero == 1


@pytest.mark.parametrize('rate', [5.0, 9.9, 13.0, 15.0, 25.0, 29.97, 60.0])
def test_thinning_takes_what_the_motion_estimator_takes(rate):
    rng = np.random.default_rng(int(rate))
    config = Config()
    thinning, estimator = Thinning(config.motion.rate), MotionEstimator(config.motion)
    image = np.zeros((48, 64), np.uint8)
    stamps = [START + round(n * SECOND / rate + rng.uniform(-5e6, 5e6)) for n in range(60)]
    stamps += [stamp - 3000 * SECOND for stamp in stamps]  # a bag that loops
    mine = [thinning.wants(stamp) for stamp in stamps]
    theirs = [estimator.push(Frame(n, stamp, image)) is not None
              for n, stamp in enumerate(stamps)]
    assert mine == theirs and any(mine)


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


@pytest.mark.parametrize('suffix', ['.jpg', '.png'])
@pytest.mark.parametrize('size', [(1, 1), (641, 363), (1920, 1080)])
def test_encoded_sizes_are_read_without_decoding(suffix, size):
    for shape in ((*size[::-1],), (*size[::-1], 3)):
        data = cv2.imencode(suffix, np.zeros(shape, np.uint8))[1].tobytes()
        assert encoded_size(memoryview(data)) == size
        # wherever it is cut, it says the size or nothing
        for length in range(0, min(len(data), 700), 7):
            assert encoded_size(memoryview(data[:length])) in (None, size)


def test_progressive_and_optimised_jpeg():
    data = cv2.imencode('.jpg', np.zeros((48, 64), np.uint8),
                        [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_OPTIMIZE, 1])[1]
    assert encoded_size(memoryview(data.tobytes())) == (64, 48)


def test_random_bytes_have_no_size_and_raise_nothing():
    rng = np.random.default_rng(0)
    for start in (b'', b'\xff\xd8', b'\xff\xd8\xff', b'\x89PNG\r\n\x1a\n'):
        for length in range(0, 16):
            encoded_size(memoryview(start + rng.bytes(length)))


def test_other_formats_are_decoded_for_their_size():
    data = cv2.imencode('.bmp', np.zeros((48, 64), np.uint8))[1].tobytes()
    assert image_size(types.SimpleNamespace(format='bmp', data=data)) == (64, 48)
    with pytest.raises(InputError):
        image_size(types.SimpleNamespace(format='jpeg', data=b'no image'))


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
