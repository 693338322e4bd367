# SPDX-License-Identifier: Apache-2.0
"""Overlay and rectified picture: what they show, and that they cost nothing unless watched."""
from __future__ import annotations

import threading

import cv2
import numpy as np
import pytest

from dashcalib_ros.config import Config
from dashcalib_ros.detect.estimator import TrackedPoints
from dashcalib_ros.input import Frame

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

from ros_bench import image_message
from ros_desk import STAMPS
from sensor_msgs.msg import CompressedImage

from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.ros import preview as room
from dashcalib_ros.ros.preview import TRACK, Picture, overlay

EMPTY = TrackedPoints(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))


def texture(size=(320, 240)):
    noise = np.random.default_rng(3).integers(0, 256, (24, 32), np.uint8)
    return np.asarray(cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC))


# what they show ------------------------------------------------------------------------------

def test_tracks_are_drawn_from_where_they_were_to_where_they_are():
    points = TrackedPoints(np.array([[40.0, 50.0]], np.float32), np.array([[80.0, 50.0]],
                                                                          np.float32))
    drawn = overlay(Picture(None, np.zeros((240, 320), np.uint8), points, None), '')
    assert drawn.shape == (240, 320, 3)
    for x in (60, 80):
        assert np.abs(drawn[50, x].astype(int) - TRACK).max() < 30  # its border is smooth
    assert not drawn[40:45].any() and not drawn[50, 100:].any()


def test_the_ego_vehicle_is_tinted_also_where_its_mask_is_smaller():
    valid = np.ones((120, 160), bool)
    valid[100:] = False
    drawn = overlay(Picture(None, np.full((240, 320), 100, np.uint8), EMPTY, valid), '')
    assert drawn[150, 10].tolist() == [100, 100, 100]
    assert drawn[220, 10].tolist() == [20, 20, 160]


@pytest.mark.parametrize('size', [(320, 240), (1280, 720), (64, 48)])
def test_the_state_is_written_on_a_bar_and_fits(size):
    grey = np.full(size[::-1], 200, np.uint8)
    picture = Picture(None, grey, EMPTY, None)
    drawn = overlay(picture, 'not calibrated yet: 1 right turn, 1 left turn, 179° in all; '
                             '3 more turns needed')
    bar = np.flatnonzero(drawn[:, 0, 0] == 50)
    assert len(bar) and bar[-1] == size[1] - 1
    ink = drawn[bar].max(axis=(0, 2)) > 60
    assert ink.any() and not ink[-2:].any()


def test_points_are_told_in_pixels_of_the_input():
    """Of a picture that is enlarged for the search, and shrunk again for the tracking."""
    config = Config().replace({'min_width': 640, 'tracking.width': 320})
    with Calibrator(config) as calibrator:
        wide = texture((400, 240))
        for n in range(8):
            image = np.ascontiguousarray(wide[:, 3 * n:3 * n + 320])
            calibrator.push(Frame(n, n * 10**8, image))
        points = calibrator.detection.points()
    moved = points.now - points.before
    followed = np.linalg.norm(moved, axis=1) > 0
    assert followed.sum() > 50
    # three images of 3 px each
    assert np.median(moved[followed], axis=0) == pytest.approx([-9.0, 0.0], abs=0.3)
    assert points.now.min() >= 0 and (points.now.max(axis=0) < [320, 240]).all()


# what they cost ------------------------------------------------------------------------------

@pytest.fixture
def drawings(monkeypatch):
    """Count what is drawn; the drawing waits while `hold` is cleared."""
    made = type('Drawings', (), {'count': 0, 'views': 0, 'hold': threading.Event()})()
    made.hold.set()
    draw, points = room.overlay, Detection.points

    def counted(*arguments):
        made.count += 1
        assert made.hold.wait(60)
        return draw(*arguments)

    def viewed(self):
        made.views += 1
        return points(self)

    monkeypatch.setattr(room, 'overlay', counted)
    monkeypatch.setattr(Detection, 'points', viewed)
    return made


def publish(desk, count):
    """Publish images, each when the node has taken the one before."""
    for received in range(desk.drive._intake.received, desk.drive._intake.received + count):
        desk.bench.images.publish(image_message(texture(), next(STAMPS), 'camera'))
        desk.until(lambda received=received: desk.drive._intake.received > received)
        # as a camera does: time for the detection
        desk.bench.spin(0.02)


def subscribe(desk, name):
    heard = []
    topic = f'calibrator/{name}/compressed'
    made = desk.bench.node.create_subscription(CompressedImage, topic, heard.append, 10)
    desk.until(lambda: desk.bench.node.count_publishers(f'/{topic}') == 1)
    return heard, made


def test_they_are_published_only_while_someone_subscribes(make_desk, drawings):
    desk = make_desk(preview_rate=30.0)
    publish(desk, 10)
    assert (drawings.count, drawings.views, desk.drive._preview.published) == (0, 0, 0)
    overlays, subscription = subscribe(desk, 'overlay')
    desk.until(lambda: publish(desk, 1) or len(overlays) >= 3)
    assert drawings.count >= 3
    picture = cv2.imdecode(np.frombuffer(overlays[-1].data, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (240, 320, 3) and overlays[-1].format == 'jpeg'
    assert overlays[-1].header.frame_id == 'camera' and overlays[-1].header.stamp.sec > 0
    # there is no calibration: no rectified picture
    flat, _ = subscribe(desk, 'rectified')
    publish(desk, 3)
    assert flat == []
    desk.give()
    desk.until(lambda: publish(desk, 1) or flat)
    picture = cv2.imdecode(np.frombuffer(flat[-1].data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (240, 320)
    desk.bench.node.destroy_subscription(subscription)
    desk.until(lambda: desk.drive._preview._overlay.get_subscription_count() == 0)
    publish(desk, 1)
    before = drawings.count
    publish(desk, 5)
    assert drawings.count == before


def test_a_drawing_that_takes_long_holds_up_nothing(make_desk, drawings):
    desk = make_desk(preview_rate=30.0, queue_size=30)
    desk.give()
    overlays, _ = subscribe(desk, 'overlay')
    desk.until(lambda: publish(desk, 1) or overlays)
    drawings.hold.clear()
    before, infos = drawings.count, len(desk.bench.infos)
    searched = desk.drive.learner.activity.status.frames
    publish(desk, 20)
    desk.until(lambda: len(desk.bench.infos) == infos + 20)
    desk.until(lambda: desk.drive.learner.activity.status.frames >= searched + 20)
    assert desk.drive.learner.inbox.dropped == 0
    # one is being drawn all the time, and only the newest waits
    assert drawings.count <= before + 1
    drawings.hold.set()
    desk.until(lambda: drawings.count > before)


def test_a_drawing_that_fails_is_counted_and_the_node_goes_on(make_desk, monkeypatch, capfd):
    def fail(*arguments):
        raise ZeroDivisionError('odd drawing')
    monkeypatch.setattr(room, 'overlay', fail)
    desk = make_desk(preview_rate=30.0)
    subscribe(desk, 'overlay')
    desk.until(lambda: publish(desk, 1) or desk.bench.count('preview') >= 2)
    assert capfd.readouterr().err.count('Traceback') == 1
