# SPDX-License-Identifier: Apache-2.0
"""Plays a recorded drive to the node, as a camera driver does: ROS 2 from pip has no ros2 bag.

    python examples/play.py drive.mp4 --to /front/image_raw
    python examples/play.py drive.mcap --topic /camera/image_raw --speed 2

INPUT is what `dashcalib run` takes. The images are grey and reliable, stamped from now on. It
waits until a node subscribes, and ends with the drive or on Ctrl-C.
"""
from __future__ import annotations

import argparse
import array
import sys
import time
from contextlib import suppress

import rclpy
from rclpy.duration import Duration
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image

from dashcalib_ros import DashcalibError, open_frames

# s; for the subscription to be complete on both sides, and for the last images to arrive
MATCHED_S, ARRIVED_S = 1.0, 5.0


def play(options: argparse.Namespace) -> int:
    """Publish the drive's images at its own rate, times --speed; return how many."""
    frames = open_frames(options.input, topic=options.topic, fps=options.fps)
    node = rclpy.create_node('play')
    publisher = node.create_publisher(Image, options.to, 10)
    print(f'waiting for a node that subscribes {publisher.topic_name}')
    while not publisher.get_subscription_count():
        time.sleep(0.1)
    time.sleep(MATCHED_S)
    started, now_ns, first_ns, count = time.monotonic(), time.time_ns(), None, 0
    for frame in frames:
        first_ns = frame.stamp_ns if first_ns is None else first_ns
        passed_ns = frame.stamp_ns - first_ns
        time.sleep(max(0.0, started + passed_ns / 1e9 / options.speed - time.monotonic()))
        height, width = frame.image.shape
        message = Image(height=height, width=width, encoding='mono8', step=width,
                        data=array.array('B', frame.image.tobytes()))
        message.header.frame_id = frame.frame_id or 'camera'
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns + passed_ns, 10**9)
        publisher.publish(message)
        count += 1
    publisher.wait_for_all_acked(Duration(seconds=ARRIVED_S))
    return count


def main() -> int:
    """Parse the arguments, play, and return an exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n')[0])
    parser.add_argument('input', nargs='+', help='bags, videos or folders of images')
    parser.add_argument('--topic', help='image topic of a bag that has several')
    parser.add_argument('--fps', type=float, help='image rate of a folder, Hz')
    parser.add_argument('--to', default='image_raw', help='topic to publish (image_raw)')
    parser.add_argument('--speed', type=float, default=1.0, help='times the drive\'s own (1)')
    options = parser.parse_args()
    # without rclpy's own handlers Ctrl-C ends the loop, and not the publisher in the middle of it
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        with suppress(KeyboardInterrupt):
            print(f'{play(options)} images played')
    except DashcalibError as error:
        print(f'play: error: {error}', file=sys.stderr)
        return 2
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
