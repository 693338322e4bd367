#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Where time goes, on this machine; in units of a fixed piece of work it compares with others.

    python benchmark/speed.py [command] [calibration] [length] [turns] [detection] [hour]
                              [--data DIR] [--minutes 60] [--cache DIR] [--out DIR]

command: `dashcalib run` on KITTI 03's bag, from the file to the result. calibration: five turns of
a rendered drive, stage by stage. length, turns: the command on rendered drives of 5 to 40 turns,
and with 2 to 8 turns wanted. All these in seconds, processor seconds, and units: the processor
time of COLMAP's SIFT of 40 pictures, measured before and after each.
detection: frames per second of a 30 fps camera on one core, by image size, thinning included and
decoding apart; what tracking, epipoles and the rest take of it; JPEG decoding of the same frames.
hour: cost per frame in the first and the last minute, and memory, of detection over an hour. Parts
take turns in a process each, not side by side. Writes DIR/speed.json and DIR/speed.md.
"""
from __future__ import annotations

import contextlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import cv2
from drives import DEMO, FULL_HD, NARROW, STREET, VGA, Pictures, Setting, drive_of, pictures_of
from measure import (
    SAMPLE_S,
    Outcome,
    Stopwatch,
    commit,
    complain,
    isolated,
    keep_table,
    load,
    memory_mb,
    parser_with,
    processor_s,
    reconstructed,
    save,
    solved,
    table,
    unit_s,
)

from dashcalib_ros import Config
from dashcalib_ros.detect import MotionEstimator, TurnDetector, estimator
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.input import Frame
from dashcalib_ros.input.scale import Scale

ONE_TURN = replace(STREET, turns=1)
SIZES = tuple(Setting(f'{lens.width}x{lens.height}', lens, ONE_TURN)
              for lens in (VGA, NARROW, FULL_HD))
EIGHT_TURNS = Setting('eight turns', DEMO, replace(STREET, turns=8))
RATE = 30.0
AT_10_FPS = ('--fps', '10')
# the estimator's methods, by what they do; one that is gone is not listed
METHODS = {'track': '_follow', 'epipoles': '_magnitude',
           'new points': '_replenish', 'ego vehicle': '_look_for_ego'}
PERIOD_S = 60.0
PARTS = ('command', 'calibration', 'length', 'turns', 'detection', 'hour')


def long_drive(turns: int) -> Setting:
    """Return a drive of so many turns."""
    return Setting(f'{turns} turns', DEMO,
                   replace(STREET, turns=turns, bonnet=True, timestamp=True))


def there_and_back(images: Sequence[Any], count: int, rate: float) -> Iterator[Frame]:
    """Yield so many frames: the images forwards, backwards, forwards ..., stamped at the rate.

    images: of a 10 fps drive, arrays or JPEG; at 30 fps each comes three times, as thinning
    would leave one of three.
    """
    last = len(images) - 1
    for index in range(count):
        step = int(index * 10.0 / rate) % (2 * last)
        image = images[min(step, 2 * last - step)]
        yield Frame(index, round(index * 1e9 / rate), image)


def detection(pictures: Pictures, seconds: float) -> dict[str, Any]:
    """Measure detection and decoding of a 30 fps camera on one core (in a process of its own)."""
    cv2.setNumThreads(1)
    images = [frame.image for frame in pictures]
    jpegs = [cv2.imencode('.jpg', image, (cv2.IMWRITE_JPEG_QUALITY, 90))[1] for image in images]
    started = time.perf_counter()
    for jpeg in jpegs:
        cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)
    decode_ms = 1000 * (time.perf_counter() - started) / len(jpegs)
    count = round(seconds * RATE)
    total = _detect_s(there_and_back(images, count, RATE))
    spent = _timed(lambda: _detect_s(there_and_back(images, count, RATE)))
    return {'frames': count, 'fps': count / total, 'ms': 1000 * total / count,
            'decode_ms': decode_ms, 'of_decode': 1000 * total / count / decode_ms,
            'parts_ms': {name: 1000 * value / count for name, value in spent.items()}}


def _detect_s(frames: Iterable[Frame]) -> float:
    """Return the seconds that detection takes, as Calibrator.push() does it."""
    config = Config()
    motion, detector = MotionEstimator(config.tracking, config.mask), TurnDetector(config.turns)
    spent = 0.0
    for frame in frames:
        started = time.perf_counter()
        resized = Scale.of(frame.size, config).frame(frame)
        found = motion.push(resized)
        if found is not None:
            detector.push(resized, found)
        spent += time.perf_counter() - started
    return spent


def _timed(work: Callable[[], Any]) -> dict[str, float]:
    """Return the seconds that each part of the estimator takes meanwhile; parts may nest."""
    spent: dict[str, float] = {}
    kept: dict[str, Any] = {}

    def clocked(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(method)
        def call(*arguments: Any) -> Any:
            started = time.perf_counter()
            try:
                return method(*arguments)
            finally:
                spent[name] = spent.get(name, 0.0) + time.perf_counter() - started
        return call

    owner = estimator.MotionEstimator
    for name, attribute in METHODS.items():
        if hasattr(owner, attribute):
            kept[attribute] = getattr(owner, attribute)
            setattr(owner, attribute, clocked(name, kept[attribute]))
    try:
        work()
    finally:
        for attribute, method in kept.items():
            setattr(owner, attribute, method)
    return spent


def hour(pictures: Pictures, minutes: float) -> dict[str, Any]:
    """Detect over a long drive at 10 fps: no frame of it may cost more than the first ones."""
    cv2.setNumThreads(1)
    images = [frame.image for frame in pictures]
    config = Config()
    motion, detector = MotionEstimator(config.tracking, config.mask), TurnDetector(config.turns)
    by_minute: list[float] = []
    memory: list[float] = []
    started = time.perf_counter()
    per_minute = round(PERIOD_S * 10.0)
    for frame in there_and_back(images, round(minutes * per_minute), 10.0):
        found = motion.push(frame)
        if found is not None:
            detector.push(frame, found)
        if (frame.index + 1) % per_minute == 0:
            now = time.perf_counter()
            by_minute.append(1000 * (now - started) / per_minute)
            memory.append(memory_mb(os.getpid()))
            started = time.perf_counter()
    return {'minutes': minutes, 'ms_by_minute': by_minute, 'mb_by_minute': memory,
            'turns': len(detector.bank.turns())}


def command(drive: Path, *options: str) -> dict[str, Any]:
    """Run the command on a drive twice: for its times, and for its memory.

    To ask for the memory four times a second takes half a second of processor time.
    """
    def spent_s() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    with tempfile.TemporaryDirectory() as folder:
        line = [sys.executable, '-m', 'dashcalib_ros', 'run', str(drive), '--out', folder,
                *options]
        began, before, peak = time.perf_counter(), spent_s(), 0.0
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        seconds, cpu_s = time.perf_counter() - began, spent_s() - before
        with subprocess.Popen(line, stdout=subprocess.DEVNULL,
                              stderr=subprocess.DEVNULL) as process:
            while process.poll() is None:
                peak = max(peak, memory_mb(process.pid))
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(SAMPLE_S)
    return {'seconds': seconds, 'cpu_s': cpu_s, 'peak_mb': peak,
            'verdict': done.stdout.partition('\n')[0].removeprefix('verdict: ')}


def calibration(pictures: Pictures) -> dict[str, Any]:
    """Reconstruct and solve five turns, stage by stage, all processes starting cold."""
    config = Config()
    images = list(pictures)
    watches = Stopwatch('detection'), Stopwatch('detection', processor_s)

    def enter(stage: str, share: float = 0.0) -> None:
        for watch in watches:
            watch.enter(stage)

    detection = Detection(config)
    for frame in images:
        detection.push(frame)
    detection.finish()
    enter('reconstructing turns')
    scenes = reconstructed(detection, detection.turns()[:config.turns.wanted], config)
    enter('starting a process')
    result = solved(detection, scenes, config, enter)
    enter('end')
    return {'stages': {stage: [watch.seconds[stage] for watch in watches]
                       for stage in watches[0].seconds},
            'seconds': sum(watches[0].seconds.values()), 'cpu_s': sum(watches[1].seconds.values()),
            'verdict': result.verdict.level, 'used': sum(turn.used for turn in result.turns)}


def as_images(pictures: Pictures, folder: Path) -> Path:
    """Write a drive as a folder of JPEG images."""
    folder.mkdir(exist_ok=True)
    for frame in pictures:
        cv2.imwrite(str(folder / f'{frame.index:06}.jpg'), frame.image)
    return folder


def measure(part: str, minutes: float, cache: Path, data: Path | None) -> dict[str, Any]:
    """Return what was measured, by row."""
    found: dict[str, Any] = {}

    def add(name: str, function: Callable[..., Any], *arguments: Any) -> None:
        complain(f'{part}: {name}')
        before = unit_s()
        # the command is a process of its own, whose memory is its own affair
        outcome = (Outcome(command(*arguments), '', 0.0, 0.0) if function is command
                   else isolated(function, *arguments))
        if outcome.failure:
            complain(outcome.failure)
        found[name] = {'failure': outcome.failure, 'peak_mb': outcome.peak_mb,
                       'unit_s': (before + unit_s()) / 2, **(outcome.value or {})}

    def pictures(setting: Setting) -> Pictures:
        return pictures_of(drive_of(setting, 0), cache)

    if part == 'command' and data is not None:
        add('`dashcalib run`, KITTI 03', command, data / 'kitti03' / 'bag')
    if part == 'calibration':
        add('five turns, 960x540', calibration, pictures(long_drive(5)))
    with tempfile.TemporaryDirectory() as folder:
        if part == 'length':
            for turns in (5, 10, 20, 40):
                drive = as_images(pictures(long_drive(turns)), Path(folder, str(turns)))
                add(f'a drive of {turns} turns', command, drive, *AT_10_FPS)
        if part == 'turns':
            drive = as_images(pictures(EIGHT_TURNS), Path(folder))
            for turns in (2, 5, 8):
                add(f'{turns} of eight turns', command, drive, *AT_10_FPS, '--set',
                    f'turns.wanted={turns}', '--set', f'turns.at_most={turns}')
    if part == 'detection':
        for size in SIZES:
            add(size.name, detection, pictures(size), 60.0)
    if part == 'hour':
        add('640x480', hour, pictures(SIZES[0]), minutes)
    return found


def report(found: dict[str, Any]) -> str:
    """Return what was measured as Markdown tables."""
    parts, lines = [], []
    rows = {part: {name: row for name, row in found.get(part, {}).items() if not row['failure']}
            for part in PARTS}
    for part in ('command', 'calibration', 'length', 'turns'):
        for name, row in rows[part].items():
            times = {f'{name}; {row["verdict"]}': (row['seconds'], row['cpu_s']),
                     **{f'of these: {stage}': each
                        for stage, each in row.get('stages', {}).items()}}
            for n, (text, (seconds, cpu_s)) in enumerate(times.items()):
                lines.append([text, f'{seconds:.1f}', f'{cpu_s:.1f}',
                              f'{cpu_s / row["unit_s"]:.2f}',
                              '' if n else f'{row["peak_mb"]:.0f}'])
    if lines:
        units = [row['unit_s'] for part in rows.values() for row in part.values()]
        parts.append(f'A unit, the SIFT of 40 pictures, took {min(units):.2f} to '
                     f'{max(units):.2f} CPU s.\n\n'
                     + table(['', 's', 'CPU s', 'units', 'MB'], lines))
    if detections := rows['detection']:
        names = list(dict.fromkeys(name for row in detections.values()
                                   for name in row['parts_ms']))
        parts.append('Detection of a 30 fps camera on one core, ms per camera frame.\n\n' + table(
            ['', 'frames/s', 'units per 1000 frames', 'ms', *names, 'JPEG decode, ms',
             'times JPEG decode'],
            [[size, f'{row["fps"]:.0f}', f'{row["ms"] / row["unit_s"]:.2f}', f'{row["ms"]:.2f}',
              *(f'{row["parts_ms"].get(name, 0.0):.2f}' for name in names),
              f'{row["decode_ms"]:.2f}', f'{row["of_decode"]:.2f}']
             for size, row in detections.items()]))
    for row in rows['hour'].values():
        ms, mb = row['ms_by_minute'], row['mb_by_minute']
        parts.append(table(
            [f'detection, {row["minutes"]:.0f} min at 10 fps, 640x480', 'first minute',
             'second', 'last', 'most'],
            [['ms per frame', f'{ms[0]:.2f}', f'{ms[min(1, len(ms) - 1)]:.2f}', f'{ms[-1]:.2f}',
              f'{max(ms):.2f}'],
             ['MB', f'{mb[0]:.0f}', f'{mb[min(1, len(mb) - 1)]:.0f}', f'{mb[-1]:.0f}',
              f'{max(mb):.0f}']]))
    return '\n\n'.join(parts)


def main() -> None:
    """Measure what is asked for."""
    parser = parser_with(__doc__, 'data', 'cache', 'again')
    parser.add_argument('parts', nargs='*', metavar='PART',
                        help=f'of {", ".join(PARTS)}; default: all')
    parser.add_argument('--minutes', type=float, default=60.0, help='of the long drive')
    arguments = parser.parse_args()
    if unknown := set(arguments.parts) - set(PARTS):
        parser.error(f'there is no part {", ".join(sorted(unknown))}; choose of {PARTS}')
    path = arguments.out / 'speed.json'
    found = load(path)
    with tempfile.TemporaryDirectory() as passing:
        for part in arguments.parts or PARTS:
            if part in found and not arguments.again:
                continue
            found |= {part: measure(part, arguments.minutes, arguments.cache or Path(passing),
                                    arguments.data),
                      'commits': {**found.get('commits', {}), part: commit()}}
            save(path, found)
    keep_table('speed', report(found), arguments, found['commits'].values())


if __name__ == '__main__':
    main()
