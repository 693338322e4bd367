# SPDX-License-Identifier: Apache-2.0
"""The node hears a video: packets of H.264 in messages."""
from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy')

from made_packets import SIZE, encoded, levels
from ros_bench import START
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header
from waiting import wait_for

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.decode import decode, message_size
from dashcalib_ros.ros import video
from dashcalib_ros.ros.background import decode_checked
from dashcalib_ros.ros.video import VideoDecoding

STEP = 10**8


def packet(number, data, name='h264'):
    """Return a sensor_msgs/CompressedImage with a packet in it."""
    stamp = START + number * STEP
    message = CompressedImage(format=name, data=np.frombuffer(data, np.uint8))
    message.header.frame_id = 'camera'
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    return message


@pytest.fixture
def heard():
    """Give what hears packets, and what came of them."""
    images, failures = [], []
    decoding = VideoDecoding(images.append, failures.append)
    yield decoding, images, failures
    decoding.close()


def levels_of(images):
    return [round((float(decode(image).mean()) - 40) / 8) for image in images]


@pytest.mark.parametrize('codec', ['libx264', 'libx265'])
def test_who_joins_late_waits_for_a_key_picture(heard, codec):
    decoding, images, failures = heard
    for number, data in encoded(levels(), codec)[3:]:
        decoding.put(packet(number, data, codec))
    wait_for(lambda: len(images) == 12)
    assert levels_of(images) == list(range(8, 20)) and not failures
    assert decoding.waited == 5 and decoding.dropped == 0
    assert [image.header.stamp.nanosec // STEP for image in images[:3]] == [8, 9, 0]
    assert isinstance(images[0].header, Header) and message_size(images[0]) == SIZE


def test_foxglove_s_messages_have_no_header_of_ros(heard):
    decoding, images, _ = heard
    for number, data in encoded(levels(3)):
        stamp = packet(number, data).header.stamp
        decoding.put(SimpleNamespace(timestamp=stamp, frame_id='front', format='h264', data=data))
    wait_for(lambda: len(images) == 3)
    assert {image.header.frame_id for image in images} == {'front'}
    assert images[2].header.stamp.nanosec == 2 * STEP


def test_what_comes_too_fast_is_dropped_until_a_key_picture(heard, monkeypatch):
    decoding, images, _ = heard
    monkeypatch.setattr(video, 'WAITING', 5)
    packets = encoded(levels())
    with decoding._filled:  # the decoder does not get at them meanwhile
        for number, data in packets[:10]:
            decoding.put(packet(number, data))
    wait_for(lambda: not decoding._packets)
    for number, data in packets[10:]:
        decoding.put(packet(number, data))
        wait_for(lambda: not decoding._packets)
    wait_for(lambda: images and levels_of(images)[-1] == 19)
    # 0 to 4 are dropped; the next key picture is 8
    assert decoding.dropped == 5 and levels_of(images) == list(range(8, 20))


def test_what_is_no_video_is_said(heard):
    decoding, images, failures = heard
    decoding.put(packet(0, b'x', 'jpeg'))
    for number, data in encoded(levels(3)):
        decoding.put(packet(number, data))
    wait_for(lambda: len(images) == 3)
    assert len(failures) == 1 and failures[0].endswith('[E-NOT-A-VIDEO-PACKET]')


def test_the_node_finds_the_video_and_counts_its_pictures(start_node, make_bench):
    camera = make_bench(topic='front/image_raw/compressed', image_type=CompressedImage)
    node = start_node('-r', 'image_raw:=/front/image_raw', image_transport='video')
    node.wait_for('the video is sensor_msgs/msg/CompressedImage on /front/image_raw/compressed')
    camera.connect(node)
    camera.publish(*(packet(number, data) for number, data in encoded(levels())[3:]))
    camera.counted('received', 12, node)
    assert 'are 64x48 in frame' in node.text and camera.count('undecodable') == 0
    assert camera.count('received') == 12


def test_without_a_key_picture_the_cure_is_of_the_encoder(start_node, make_bench):
    camera = make_bench(topic='front/image_raw/compressed', image_type=CompressedImage)
    node = start_node('-r', 'image_raw:=/front/image_raw', image_transport='video')
    camera.connect(node)
    camera.publish(*(packet(number, data) for number, data in encoded(levels())[1:7]))
    node.wait_for('its publisher sent no key frame')


def test_an_image_of_another_size_than_its_header_is_refused():
    found = cv2.imencode('.png', np.zeros((48, 64), np.uint8))[1].tobytes()
    assert decode_checked(packet(0, found, 'png'), (64, 48)).shape == (48, 64)
    with pytest.raises(InputError) as raised:
        decode_checked(packet(0, found, 'png'), (64, 40))
    assert raised.value.code == 'E-IMAGE-SIZE-NOT-AS-HEADER'
