"""The node under load: image callback latency, losses, CPU and memory, while it calibrates.

    python test/benchmark/node_latency.py --minutes 10

A second process publishes 1280x720 bgr8 at 30 Hz (a rendered drive with two turns, enlarged, over
and over), with config/fastdds_large_images.xml, as a camera driver should. The node has a kept
calibration, so each image gets its camera_info at once: the time from publishing an image to
receiving its camera_info is the transport of both plus the wait for the node's callback. The
turns make it calibrate again and again; the latencies are told apart by that.
"""
from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import rclpy
from ros_bench import REPOSITORY, Bench, NodeProcess, image_message, ros_environment

from dashcalib_ros.demo import Drive, DriveSpec, Lens

SIZE = (1280, 720)
LENS = Lens.of(640, 360, 75.0, -0.30, 0.10, offset=(9.0, -6.0), aspect=1.003)
TICKS = os.sysconf('SC_CLK_TCK')


class Listener(Bench):
    """Takes the time at which each camera_info comes. latencies: ms, by whether it calibrates."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.latencies: dict[bool, list[float]] = {False: [], True: []}

    def on_info(self, message: Any) -> None:
        """Compare with the time at which its image was sent."""
        stamp = message.header.stamp
        age = time.time_ns() - (stamp.sec * 10**9 + stamp.nanosec)
        self.latencies[self.values.get('stage', '') != ''].append(age / 1e6)


def publish(seconds: float, rate: float) -> None:
    """Be the camera: pictures of a drive, stamped with the time at which they are sent."""
    import cv2
    pictures = [cv2.cvtColor(cv2.resize(frame.image, SIZE), cv2.COLOR_GRAY2BGR)
                for frame in Drive(LENS, DriveSpec(seed=0, turns=2)).frames(processes=2)]
    context = rclpy.Context()
    rclpy.init(context=context)
    bench = Bench(context, reliable=False, listen=False)
    bench.until(lambda: bench.images.get_subscription_count() > 0, 60.0)
    started = time.monotonic()
    for n in range(round(seconds * rate)):
        time.sleep(max(0.0, started + n / rate - time.monotonic()))
        # the drive has 10 Hz: at 30 Hz each picture is sent three times
        picture = pictures[int(n * 10 / rate) % len(pictures)]
        bench.images.publish(image_message(picture, time.time_ns()))
    bench.spin(1.0)


def keep_calibration(home: Path) -> None:
    """Leave the true calibration where the node looks for it."""
    fx, fy, cx, cy = (2 * LENS.fx, 2 * LENS.fy, 2 * LENS.cx + 0.5, 2 * LENS.cy + 0.5)
    path = home / '.ros' / 'camera_info' / 'dashcam.yaml'
    path.parent.mkdir(parents=True)
    path.write_text(f"""\
image_width: {SIZE[0]}
image_height: {SIZE[1]}
camera_name: dashcam
camera_matrix: {{rows: 3, cols: 3, data: [{fx}, 0, {cx}, 0, {fy}, {cy}, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [{LENS.k1}, {LENS.k2}, 0, 0, 0]}}
dashcalib:
  verdict: accepted
  sigma: {{fx: 2.0, fy: 2.0, cx: 2.0, cy: 2.0, k1: 0.01, k2: 0.01}}
""")


def cpu_s(pid: int) -> float:
    """Return the processor time of a process's own threads, s."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def resident_mb(pid: int) -> float:
    """Return a process's resident memory, MB."""
    pages = int(Path(f'/proc/{pid}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


def measure(minutes: float, rate: float) -> None:
    """Run everything and print a table."""
    home = Path(tempfile.mkdtemp(prefix='dashcalib-bench-'))
    os.environ.update(ros_environment(home))
    os.environ.pop('ROS_PYTHON_CHECK_FIELDS')  # not in the field either
    keep_calibration(home)
    context = rclpy.Context()
    rclpy.init(context=context)
    bench = Listener(context, topic='nothing')
    node = NodeProcess(home, contradictions=20, publish_stale=True)
    camera = subprocess.Popen(
        [sys.executable, __file__, '--publish', '--minutes', str(minutes), '--rate', str(rate)],
        env={**os.environ, 'FASTRTPS_DEFAULT_PROFILES_FILE':
             str(REPOSITORY / 'config' / 'fastdds_large_images.xml')})
    memory: list[float] = []
    try:
        bench.until(lambda: bench.count('received') > 0, 120.0, node=node)
        began, before = time.monotonic(), cpu_s(node.process.pid)
        while camera.poll() is None:
            bench.spin(1.0)
            memory.append(resident_mb(node.process.pid))
        share = (cpu_s(node.process.pid) - before) / (time.monotonic() - began)
        bench.spin(2.0)
        report(bench.values, round(minutes * 60 * rate), bench.latencies, share, memory)
    finally:
        camera.kill()
        print(f'| exit code on SIGINT | {node.stop()} |')
        node.kill()


def report(values: dict[str, str], sent: int, latencies: dict[bool, list[float]], share: float,
           memory: list[float]) -> None:
    """Print the table for the README."""
    print('| | |\n|---|---|')
    print(f'| images sent, received by the node | {sent}, {values["received"]} |')
    print(f'| camera_info published | {values["camera_info published"]} |')
    print(f'| dropped by the node | {values["dropped"]} |')
    for name, calibrating in (('idle', False), ('while it calibrates', True)):
        ages = latencies[calibrating]
        if ages:
            median, p99 = np.percentile(ages, [50, 99])
            print(f'| image to camera_info, {name}: median, p99 ({len(ages)} images) | '
                  f'{median:.1f}, {p99:.1f} ms |')
    print(f'| CPU of the node\'s process (transport and detection), of one core | '
          f'{100 * share:.0f} % |')
    minutes = [f'{np.mean(memory[n:n + 60]):.0f}' for n in range(0, len(memory), 60)]
    print(f'| resident memory, mean of each minute | {", ".join(minutes)} MB '
          f'(most {max(memory):.0f}) |')


def main() -> None:
    """Parse the arguments; --publish is for the second process."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--minutes', type=float, default=10.0)
    parser.add_argument('--rate', type=float, default=30.0)
    parser.add_argument('--publish', action='store_true', help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.publish:
        publish(60 * args.minutes, args.rate)
    else:
        measure(args.minutes, args.rate)


if __name__ == '__main__':
    main()
