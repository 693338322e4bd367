# SPDX-License-Identifier: Apache-2.0
"""The node under load: image callback latency, losses, CPU and memory, while it calibrates.

    python benchmark/node_latency.py --minutes 10 [--preview]

A second process publishes 1280x720 bgr8 at 30 Hz (a rendered drive with two turns, enlarged, over
and over), with config/fastdds_large_images.xml, as a camera driver should. The node has a kept
calibration, so each image gets its camera_info at once: the time from publishing an image to
receiving its camera_info is the transport of both plus the wait for the node's callback. The
turns make it calibrate again and again; the latencies are told apart by that. With --preview, the
overlay and the rectified picture are subscribed every other ten seconds, and told apart by that,
too: the machine's other work is then the same for both.
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

import numpy as np
import rclpy
from measure import keep_table, parser_with, unit_s
from ros_bench import LARGE_IMAGES, Bench, NodeProcess, image_message, ros_environment
from sensor_msgs.msg import CompressedImage

from dashcalib_ros.demo import Drive, DriveSpec, Lens

SIZE = (1280, 720)
LENS = Lens.of(640, 360, 75.0, -0.30, 0.10, offset=(9.0, -6.0), aspect=1.003)
TICKS = os.sysconf('SC_CLK_TCK')


class Listener(Bench):
    """Takes the time at which each camera_info comes.

    latencies: ms, by whether it calibrates and whether the pictures are subscribed. pictures: the
    size of each picture received, in bytes.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.latencies: dict[tuple[bool, bool], list[float]] = {}
        self.pictures: dict[str, list[int]] = {'overlay': [], 'rectified': []}
        self._watching: list[Any] = []

    def on_info(self, message: Any) -> None:
        """Compare with the time at which its image was sent."""
        stamp = message.header.stamp
        age = time.time_ns() - (stamp.sec * 10**9 + stamp.nanosec)
        key = self.values.get('stage', '') != '', bool(self._watching)
        self.latencies.setdefault(key, []).append(age / 1e6)

    def watch(self, on: bool) -> None:
        """Subscribe the overlay and the rectified picture, or end that."""
        if on and not self._watching:
            self._watching = [self._subscribed(*each) for each in self.pictures.items()]
        elif not on:
            while self._watching:
                self.node.destroy_subscription(self._watching.pop())

    def _subscribed(self, name: str, sizes: list[int]) -> Any:
        def note(message: Any) -> None:
            sizes.append(len(message.data))

        return self.node.create_subscription(
            CompressedImage, f'calibrator/{name}/compressed', note, 10)


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


def measure(minutes: float, rate: float, preview: bool) -> str:
    """Run everything and return a table."""
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
        env={**os.environ, **LARGE_IMAGES})
    memory: list[float] = []
    try:
        bench.until(lambda: bench.count('received') > 0, 300.0, node=node)
        # processor time and time, by whether the pictures are subscribed
        spent = {False: np.zeros(2), True: np.zeros(2)}
        while camera.poll() is None:
            on = preview and len(memory) // 10 % 2 == 1
            bench.watch(on)
            before = np.array([cpu_s(node.process.pid), time.monotonic()])
            bench.spin(1.0)
            spent[on] += [cpu_s(node.process.pid), time.monotonic()] - before
            memory.append(resident_mb(node.process.pid))
        bench.spin(2.0)
        return report(bench, round(minutes * 60 * rate), spent, memory)
    finally:
        camera.kill()
        print(f'exit code on SIGINT: {node.stop()}', file=sys.stderr)
        node.kill()


def report(bench: Listener, sent: int, spent: dict[bool, Any], memory: list[float]) -> str:
    """Return the table of benchmark/results/node_latency.md."""
    values = bench.values
    lines = ['| | |', '|---|---|',
             f'| images sent, received by the node | {sent}, {values["received"]} |',
             f'| camera_info published | {values["camera_info published"]} |',
             f'| dropped by the node | {values["dropped"]} |']
    for (calibrating, watched), ages in sorted(bench.latencies.items()):
        name = ('while it calibrates' if calibrating else 'idle') + (
            ', pictures subscribed' if watched else '')
        median, p99 = np.percentile(ages, [50, 99])
        lines.append(f'| image to camera_info, {name}: median, p99 ({len(ages)} images) | '
                     f'{median:.1f}, {p99:.1f} ms |')
    lines += [f'| CPU of the node\'s process (transport and detection), of one core'
              f'{", pictures subscribed" if watched else ""} | {100 * cpu / passed:.1f} % |'
              for watched, (cpu, passed) in spent.items() if passed]
    lines += [f'| {name}: pictures, kB each | {len(sizes)}, {np.mean(sizes) / 1e3:.0f} |'
              for name, sizes in bench.pictures.items() if sizes]
    minutes = [f'{np.mean(memory[n:n + 60]):.0f}' for n in range(0, len(memory), 60)]
    lines.append(f'| resident memory, mean of each minute | {", ".join(minutes)} MB '
                 f'(most {max(memory):.0f}) |')
    return '\n'.join(lines)


def main() -> None:
    """Parse the arguments; --publish is for the second process."""
    parser = parser_with(__doc__)
    parser.add_argument('--minutes', type=float, default=10.0)
    parser.add_argument('--rate', type=float, default=30.0)
    parser.add_argument('--preview', action='store_true', help='subscribe the pictures')
    parser.add_argument('--publish', action='store_true', help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.publish:
        publish(60 * args.minutes, args.rate)
        return
    unit = unit_s()
    text = measure(args.minutes, args.rate, args.preview)
    text += f'\n| a fixed piece of work: SIFT of 40 pictures | {unit:.2f} CPU s |'
    keep_table('node_latency', text, args)


if __name__ == '__main__':
    main()
