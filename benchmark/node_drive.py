# SPDX-License-Identifier: Apache-2.0
"""A drive at its own rate through DDS into the node: how soon, how right, and nothing before.

    python benchmark/node_drive.py [--data DIR] [--repeat N] [--results]

The demo's drive, with exact truth; with --data also KITTI 03, against `dashcalib run`, and N more
times against its poses. Tells when camera_info began, counted from the end of the turn that
completes the evidence; how many images after that were without one; how many pairs a rectifier
gets that matches stamps exactly; what the node warned of; and the result beside the reference.
"""
from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rclpy
from measure import complain, keep_table, parser_with, table, unit_s
from ros_bench import Bench, NodeProcess, image_message, ros_environment
from sensor_msgs.msg import Image
from without_turns import DRIVES

from dashcalib_ros.config import Config
from dashcalib_ros.demo import demo_drive
from dashcalib_ros.formats.load import parse_camera
from dashcalib_ros.input import Frame
from dashcalib_ros.input.inputs import open_frames

# s; how long to wait for a calibration after the last image
PATIENCE_S = 180.0


class Rectifier(Bench):
    """Publishes the images, and rectifies each whose camera_info has the very same stamp."""

    def __init__(self, context: Any) -> None:
        super().__init__(context)
        self.sent: dict[int, float] = {}
        self.began: float | None = None
        self.rectified = 0
        self.node.create_subscription(Image, 'image_raw', self._on_image, 50)
        self._images: dict[int, Any] = {}
        self._infos: dict[int, Any] = {}

    def send(self, frame: Frame) -> None:
        """Publish a frame."""
        self.sent[frame.stamp_ns] = time.monotonic()
        self.images.publish(image_message(frame.image, frame.stamp_ns))

    def on_info(self, message: Any) -> None:
        """Note when the first one came."""
        super().on_info(message)
        self.began = self.began or time.monotonic()
        self._infos[stamp_of(message)] = message
        self._match(stamp_of(message))

    def _on_image(self, message: Any) -> None:
        self._images[stamp_of(message)] = message
        self._match(stamp_of(message))
        for old in sorted(self._images)[:-50]:
            del self._images[old]

    def _match(self, stamp: int) -> None:
        if stamp in self._images and stamp in self._infos:
            image, info = self._images.pop(stamp), self._infos.pop(stamp)
            picture = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)
            cv2.undistort(picture, info.k.reshape(3, 3), np.array(info.d))
            self.rectified += 1


def stamp_of(message: Any) -> int:
    """Return a message's stamp in ns."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def at_their_own_rate(frames: Iterator[Frame], bench: Rectifier) -> Iterator[Frame]:
    """Yield the frames when their stamps say so, spinning meanwhile."""
    first: int | None = None
    started = time.monotonic()
    for frame in frames:
        first = frame.stamp_ns if first is None else first
        bench.spin(max(0.0, started + (frame.stamp_ns - first) / 1e9 - time.monotonic()))
        yield frame


def drive(frames: Iterable[Frame], turns: list[int], half_width: float
          ) -> dict[str, Any]:
    """Play the frames; go on with the last one until the calibration is there."""
    home = Path(tempfile.mkdtemp(prefix='dashcalib-bench-'))
    os.environ.update(ros_environment(home))
    context = rclpy.Context()
    rclpy.init(context=context)
    bench = Rectifier(context)
    node = NodeProcess(home)
    last: Frame | None = None
    evidence: float | None = None
    try:
        bench.connect(node)
        for frame in at_their_own_rate(iter(frames), bench):
            bench.send(frame)
            last = frame
            if turns and evidence is None and frame.index >= turns[-1] + 10 * half_width:
                evidence = time.monotonic()
        assert last is not None
        ended = time.monotonic()
        count = 0
        while bench.began is None and time.monotonic() - ended < PATIENCE_S:
            # the car goes on; to the node it stands
            count += 1
            bench.send(Frame(last.index + count, last.stamp_ns + count * 10**8, last.image))
            bench.spin(0.1)
        for _ in range(20):
            count += 1
            bench.send(Frame(last.index + count, last.stamp_ns + count * 10**8, last.image))
            bench.spin(0.1)
        bench.spin(2.0)
        file = home / '.ros' / 'camera_info' / 'dashcam.yaml'
        stamps = {stamp_of(info) for info in bench.infos}
        after = [stamp for stamp in bench.sent if stamps and stamp > min(stamps)]
        return {
            'sent': len(bench.sent), 'received': bench.count('received'),
            'dropped': bench.count('dropped'), 'state': bench.values['state'],
            'verdict': bench.values['verdict'], 'reasons': bench.values['reasons'],
            'camera_info begins, s after the evidence':
                None if bench.began is None or evidence is None
                else round(bench.began - evidence, 1),
            'images after that without camera_info': len([s for s in after if s not in stamps]),
            'camera_info': len(stamps), 'rectified': bench.rectified,
            'change': bench.values['change'],
            'warned': [line for line in node.text.splitlines()
                       if line.startswith(('[WARN', '[ERROR'))],
            'calibration': file.read_text() if file.exists() else None}
    finally:
        print(f'exit code on SIGINT: {node.stop()}', file=sys.stderr)
        node.kill()
        # the next drive's node would see its publisher, too
        bench.close()
        rclpy.shutdown(context=context)


def against(text: str | None, reference: dict[str, float]) -> list[list[str]]:
    """Return a saved calibration beside a reference."""
    if text is None:
        return [['calibration', 'none']]
    camera = parse_camera(text, 'the node')
    rows = []
    for name, value in reference.items():
        mine = camera.camera.named[name]
        sigma = (camera.sigma or {})[name]
        rows.append([name, f'{mine:.4f} ± {sigma:.4f}, reference {value:.4f}, '
                     f'difference {100 * (mine / value - 1) if value else 0:+.2f} %'])
    return rows


def main() -> None:
    """Parse the arguments."""
    parser = parser_with(__doc__, 'data')
    parser.add_argument('--repeat', type=int, default=0, help='runs of KITTI 03')
    args = parser.parse_args()
    half_width = Config().turns.half_width
    rows = [['a fixed piece of work, SIFT of 40 pictures', f'{unit_s():.2f} CPU s']]
    demo = demo_drive(0)
    seen = drive(list(demo.frames(processes=2)), list(demo.turn_centers), half_width)
    text = seen.pop('calibration')
    rows += [['**the demo at 10 Hz**', ''], *lines_of(seen), *against(text, demo.truth)]
    if args.data is not None:
        bag = args.data / 'kitti03' / 'bag'
        seen = drive(iter(open_frames(bag)), [], half_width)
        text = seen.pop('calibration')
        with tempfile.TemporaryDirectory() as out:
            subprocess.run([sys.executable, '-m', 'dashcalib_ros', 'run', str(bag), '--out', out],
                           check=False, stdout=subprocess.DEVNULL)
            result = json.loads((Path(out) / 'result.json').read_text())
        rows += [['**KITTI 03 at its own rate**, reference: `dashcalib run`', result['verdict']],
                 *lines_of(seen), *against(text, result['intrinsics'] or {})]
    text = table(['', ''], rows)
    if args.data is not None and args.repeat:
        text += '\n\n' + repeated(bag, args.repeat, half_width)
    keep_table('node_drive', text, args)


def repeated(bag: Path, count: int, half_width: float) -> str:
    """Return a table of KITTI 03, played so many times, and a line about all."""
    rows, off = [], list[float]()
    *_, fx, fx_sigma = DRIVES['kitti03']
    for n in range(count):
        seen = drive(iter(open_frames(bag)), [], half_width)
        received = f'{seen["received"]} of {seen["sent"]}'
        row = [str(n + 1), received, seen['verdict'], 'none', '', '']
        if seen['calibration'] is not None:
            found = parse_camera(seen['calibration'], 'the node')
            sigma = (found.sigma or {})['fx']
            off.append((found.camera.fx - fx) / float(np.hypot(sigma, fx_sigma)))
            row[3:] = (f'{found.camera.fx:.1f} ± {sigma:.1f}', f'{off[-1]:+.1f}',
                       'none' if found.readout_ms is None else f'{found.readout_ms:.1f} ms')
        rows.append(row)
        complain(', '.join(row))
    head = ['run', 'images received', 'verdict', 'fx', 'off in sigmas', 'readout named']
    return (f'{table(head, rows)}\n\nOff from {fx} ± {fx_sigma} px: '
            f'{sum(abs(each) <= 2 for each in off)} of {count} are within 2 sigmas.')


def lines_of(seen: dict[str, Any]) -> list[list[str]]:
    """Return what was seen of a drive."""
    return [[name, '; '.join(value) if isinstance(value, list) else str(value)]
            for name, value in seen.items()]


if __name__ == '__main__':
    main()
