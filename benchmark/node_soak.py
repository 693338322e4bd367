# SPDX-License-Identifier: Apache-2.0
"""The node for an hour: restarts of the driver, lost images, a camera that is mounted anew.

    python benchmark/node_soak.py --minutes 60

A second process publishes 1280x720 bgr8 at 30 Hz: a rendered drive of five turns, over and over.
The node starts without a calibration, and a lifecycle manager's calls configure and activate it.
The driver ends every ten minutes, by SIGTERM and SIGKILL in turn, and comes back ten seconds
later; every second time the manager pauses the node meanwhile. From half of the time on the camera
points elsewhere. Now and then up to 30 images in a row are not sent. Prints how many of the images
sent after the first camera_info got theirs, what the node said, its memory, and what did not hold
of the limits: then the exit code is 1.
"""
from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from measure import keep_table, parser_with
from node_latency import LENS, SIZE, Listener, cpu_s, resident_mb
from ros_bench import LARGE_IMAGES, Bench, NodeProcess, image_message, ros_environment

from dashcalib_ros.demo import Drive, DriveSpec

RATE = 30.0
SPEC = DriveSpec(seed=0, rate=RATE)
# degrees at most in each of yaw, pitch and roll: of the camera, and after it was mounted anew
MOUNTS_DEG = {'as it was': 1.0, 'anew': 4.0}
RESTART_S, ABSENT_S = 600.0, 10.0
# how likely an image begins a gap, and how many images that takes
GAP, GAP_IMAGES = 0.002, (3, 30)
# of one core, MB, and the memory of the last quarter, of that of the second
MOST_CORE, MOST_MB, MOST_GROWTH = 0.15, 300.0, 1.1


class Recorder(Listener):
    """Also notes the stamps of camera_info, and each change of what diagnostics say.

    stamps: ns. said: level and state, with the changes and contradictions that stand beside them.
    changes: the changes alone, each with the time at which it was first said.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.stamps: set[int] = set()
        self.said: list[tuple[float, str]] = []
        self.changes: dict[str, float] = {}
        self.contradictions = 0

    def on_info(self, message: Any) -> None:
        """Note the stamp, too."""
        super().on_info(message)
        self.stamps.add(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)

    def _on_diagnostics(self, message: Any) -> None:
        super()._on_diagnostics(message)
        values = self.values
        text = (f'{ord(message.status[0].level)} {values["state"]}, change {values["change"]!r}, '
                f'contradictions {values["contradictions"]}')
        if not self.said or self.said[-1][1] != text:
            self.said.append((time.time(), text))
        if values['change']:
            self.changes.setdefault(values['change'], time.time())
        self.contradictions = max(self.contradictions, self.count('contradictions'))


def render(folder: Path) -> None:
    """Keep the pictures of the drive with each mounting."""
    for name, degrees in MOUNTS_DEG.items():
        frames = Drive(LENS, replace(SPEC, mount_deg=degrees)).frames(processes=2)
        np.save(folder / f'{name}.npy', np.stack([frame.image for frame in frames]))


def publish(folder: Path, mounting: str, seed: int) -> None:
    """Be the driver until a signal: a line with the stamp of each image goes to sent.txt."""
    pictures = np.load(folder / f'{mounting}.npy', mmap_mode='r')
    rng, silent_until = np.random.default_rng(seed), 0
    context = rclpy.Context()
    rclpy.init(context=context)
    bench = Bench(context, reliable=False, listen=False)
    bench.until(lambda: bench.images.get_subscription_count() > 0, 60.0)
    # the other side matches a moment later
    bench.spin(0.5)
    started = time.monotonic()
    with (folder / 'sent.txt').open('a', buffering=1) as sent:
        for n in range(10**9):
            time.sleep(max(0.0, started + n / RATE - time.monotonic()))
            if n > 100 and rng.random() < GAP:
                silent_until = n + int(rng.integers(*GAP_IMAGES))
            if n < silent_until:
                continue
            picture = cv2.cvtColor(cv2.resize(pictures[n % len(pictures)], SIZE),
                                   cv2.COLOR_GRAY2BGR)
            stamp = time.time_ns()
            bench.images.publish(image_message(picture, stamp))
            sent.write(f'{stamp}\n')


def driver(folder: Path, mounting: str, seed: int) -> subprocess.Popen[bytes]:
    """Start the driver."""
    return subprocess.Popen(
        [sys.executable, __file__, '--publish', str(folder), mounting, str(seed)],
        env={**os.environ, **LARGE_IMAGES})


def manage(bench: Recorder, node: NodeProcess, *transitions: int) -> None:
    """Do what nav2's lifecycle manager does: call for one transition after the other."""
    client = bench.node.create_client(ChangeState, 'calibrator/change_state')
    bench.until(client.service_is_ready, node=node)
    for transition in transitions:
        request = ChangeState.Request()
        request.transition.id = transition
        future = client.call_async(request)
        bench.until(future.done, node=node)
        assert future.result().success, transition
    bench.node.destroy_client(client)


def measure(minutes: float, restart_s: float, folder: Path) -> tuple[str, list[str]]:
    """Run everything; return a table, and what did not hold."""
    os.environ.update(ros_environment(folder))
    os.environ.pop('ROS_PYTHON_CHECK_FIELDS')  # not in the field either
    context = rclpy.Context()
    rclpy.init(context=context)
    bench = Recorder(context, topic='nothing')
    node = NodeProcess(folder, autostart=False)
    camera, restarts, memory = driver(folder, 'as it was', 0), 0, []
    anew = float('inf')
    try:
        manage(bench, node, Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
        bench.until(lambda: bench.count('received') > 0, 60.0, node=node)
        started, spent = time.monotonic(), cpu_s(node.process.pid)
        while (passed := time.monotonic() - started) < 60 * minutes:
            if passed > (restarts + 1) * restart_s:
                camera.send_signal((signal.SIGTERM, signal.SIGKILL)[restarts % 2])
                camera.wait(30.0)
                if restarts % 2:
                    manage(bench, node, Transition.TRANSITION_DEACTIVATE)
                bench.spin(ABSENT_S)
                if restarts % 2:
                    manage(bench, node, Transition.TRANSITION_ACTIVATE)
                restarts += 1
                if passed >= 30 * minutes:
                    anew = min(anew, time.time())
                camera = driver(folder, 'as it was' if anew > time.time() else 'anew', restarts)
            bench.spin(1.0)
            memory.append(resident_mb(node.process.pid))
        share = (cpu_s(node.process.pid) - spent) / (time.monotonic() - started)
        camera.send_signal(signal.SIGTERM)
        camera.wait(30.0)
        bench.spin(3.0)
        sent = [int(line) for line in (folder / 'sent.txt').read_text().split()]
        code = node.stop()
        text = report(bench, node.text, sent, restarts, memory, share)
        broken = broken_limits(bench, node.text, sent, memory, share, anew)
        return text, [*broken, *([f'exit code {code} on SIGINT'] if code else [])]
    finally:
        camera.kill()
        node.kill()


def broken_limits(bench: Recorder, log: str, sent: Sequence[int], memory: Sequence[float],
                  share: float, anew: float) -> list[str]:
    """Return what did not hold, one line each. anew: when the camera was mounted anew, s."""
    first = min(bench.stamps, default=None)
    unanswered = sum(stamp not in bench.stamps for stamp in sent if first and stamp >= first)
    # what a busy machine loses on the way cannot be answered; one more may come than a
    # killed driver has noted
    lost, quarter = max(len(sent) - bench.count('received'), 0), len(memory) // 4
    before, after = (float(np.median(memory[part])) for part in (
        slice(quarter, 2 * quarter), slice(-quarter, None)))
    early = [text for text, when in bench.changes.items() if when < anew]
    return [text for text, broken in (
        ('no camera_info at all', first is None),
        (f'{unanswered} images without camera_info, and {lost} lost on the way',
         unanswered > lost),
        (f'{100 * share:.1f} % of a core, not {100 * MOST_CORE:.0f} %', share > MOST_CORE),
        (f'{max(memory):.0f} MB, not {MOST_MB:.0f} MB', max(memory) > MOST_MB),
        (f'memory grew from {before:.0f} to {after:.0f} MB', after > MOST_GROWTH * before),
        (f'a change before there was one: {early}', bool(early)),
        (f'another lens: {list(bench.changes)}', any('does not' in each
                                                     for each in bench.changes)),
        (f'{bench.contradictions} contradictions', bench.contradictions > 0),
        ('a traceback in the log', 'Traceback' in log)) if broken]


def report(bench: Recorder, log: str, sent: list[int], restarts: int, memory: list[float],
           share: float) -> str:
    """Return the table, and what the node said, numbers aside."""
    first_answered = min(bench.stamps, default=float('inf'))
    due = [stamp for stamp in sent if stamp >= first_answered]
    values = bench.values
    lines = ['| | |', '|---|---|',
             f'| images sent, received by the node | {len(sent)}, {values["received"]} |',
             f'| sent after the first camera_info; of them without one | {len(due)}; '
             f'{sum(stamp not in bench.stamps for stamp in due)} |',
             f'| dropped by the node, counted as lost | {values["dropped"]}, {values["lost"]} |',
             f'| restarts of the driver | {restarts} |']
    for (calibrating, _), ages in sorted(bench.latencies.items()):
        median, p99 = np.percentile(ages, [50, 99])
        lines.append(f'| image to camera_info, {"while it calibrates" if calibrating else "idle"}'
                     f': median, p99 ({len(ages)} images) | {median:.1f}, {p99:.1f} ms |')
    tens = ', '.join(f'{np.mean(memory[n:n + 300]):.0f}' for n in range(0, len(memory), 300))
    lines += [f'| CPU of the node\'s process, of one core | {100 * share:.1f} % |',
              f'| resident memory, mean of each 5 minutes | {tens} MB (most {max(memory):.0f}) |']
    # the node's home is a folder of this run
    said = Counter(re.sub(r'\d+(\.\d+)?', '#', re.sub(r'^\[.*?\]: ', '', line))
                   for line in re.sub(r'/\S+/\.ros/', '~/.ros/', log).splitlines())
    first = bench.said[0][0] if bench.said else 0.0
    return '\n'.join([
        *lines, '', 'The log, numbers aside, and how often:', '',
        *(f'- {count} × {text}' for text, count in said.most_common()), '',
        'Diagnostics, as they change:', '',
        *(f'- {when - first:.0f} s: {text}' for when, text in bench.said)])


def main() -> None:
    """Parse the arguments; --publish is for the second process."""
    parser = parser_with(__doc__)
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--restart', type=float, default=RESTART_S, help='s between restarts')
    parser.add_argument('--publish', nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.publish:
        folder, mounting, seed = args.publish
        # not SIGINT, which a process in the background ignores
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with contextlib.suppress(KeyboardInterrupt):
            publish(Path(folder), mounting, int(seed))
        return
    with tempfile.TemporaryDirectory(prefix='dashcalib-soak-') as name:
        render(Path(name))
        text, broken = measure(args.minutes, args.restart, Path(name))
    text += '\n\n' + ('\n'.join(f'- Did not hold: {line}' for line in broken)
                      or 'All limits held.')
    keep_table('node_soak', text, args)
    sys.exit('\n'.join(broken) or None)


if __name__ == '__main__':
    main()
