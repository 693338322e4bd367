#!/usr/bin/env python3
"""Where time goes, on this machine; ratios to JPEG decoding make it comparable with others.

    python test/benchmark/speed.py [detection] [calibration] [length] [turns] [hour]
                                   [--minutes 60] [--cache DIR] [--out DIR]

detection: frames per second of a 30 fps camera on one core, by image size, thinning included and
decoding apart; what tracking, epipoles and the rest take of it; JPEG decoding of the same frames.
hour: cost per frame in the first and the last minute, and memory, of detection over an hour.
calibration: turns, then scenes and each step of the adjustment. length, turns: the whole of
dashcalib, time and memory, on the same drive once, twice and four times over, and with 2 to 8
turns wanted. A long drive is a short one there and back again, so that no cut is in it. Parts
take turns in a process each, not side by side. Writes DIR/speed.json and DIR/speed.md.
"""
from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from documents import write_table
from drives import DEMO, FULL_HD, NARROW, STREET, VGA, Pictures, Setting, drive_of, pictures_of
from measure import (
    Stopwatch,
    calibrate,
    commit,
    complain,
    isolated,
    load,
    memory_mb,
    parser_with,
    reconstructed,
    save,
    solved,
    table,
)

from dashcalib_ros import Config
from dashcalib_ros.detect import MotionEstimator, TurnDetector, estimator
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.input import Frame
from dashcalib_ros.input.scale import Scale

ONE_TURN = replace(STREET, turns=1)
SIZES = tuple(Setting(f'{lens.width}x{lens.height}', lens, ONE_TURN)
              for lens in (VGA, NARROW, FULL_HD))
FIVE_TURNS = Setting('five turns', DEMO, replace(STREET, bonnet=True, timestamp=True))
EIGHT_TURNS = Setting('eight turns', DEMO, replace(STREET, turns=8))
RATE = 30.0
# the estimator's methods, by what they do; one that is gone is not listed
PARTS = {'track': '_follow', 'epipoles': '_magnitude',
         'new points': '_replenish', 'ego vehicle': '_look_for_ego'}
PERIOD_S = 60.0


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
    motion, detector = MotionEstimator(config.motion, config.mask), TurnDetector(config.turns)
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
    for name, attribute in PARTS.items():
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
    motion, detector = MotionEstimator(config.motion, config.mask), TurnDetector(config.turns)
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


def calibration(pictures: Pictures) -> dict[str, Any]:
    """Reconstruct and solve five turns, stage by stage, all processes starting cold."""
    config = Config()
    watch = Stopwatch('pictures')
    detection = Detection(config)
    for frame in pictures:
        watch.enter('detection')
        detection.push(frame)
        watch.enter('pictures')
    detection.finish()
    turns = detection.turns()[:config.turns.wanted]
    scenes, scenes_s = reconstructed(detection, turns, config)
    result, solving_s = solved(detection, scenes, config)
    stages_s = {'reconstructing turns': scenes_s, **solving_s}
    return {'detect_s': watch.seconds['detection'], 'stages_s': stages_s,
            'total_s': sum(stages_s.values()), 'verdict': result.verdict.level,
            'turns': sum(turn.used for turn in result.turns)}


def whole(pictures: Pictures, times: int, turns: int) -> dict[str, Any]:
    """Run all of dashcalib on the drive, so many times over (in a process of its own)."""
    images = [cv2.imencode('.jpg', frame.image, (cv2.IMWRITE_JPEG_QUALITY, 95))[1]
              for frame in pictures]
    frames = (replace(frame, image=np.asarray(cv2.imdecode(frame.image, 0), np.uint8))
              for frame in there_and_back(images, times * len(images), 10.0))
    config = Config().replace({'turns.wanted': turns, 'turns.at_most': turns})
    result, seconds = calibrate(frames, config)
    return {'times': times, 'wanted': turns, 'frames': result.frames, 'seconds': seconds,
            'used': sum(turn.used for turn in result.turns), 'verdict': result.verdict.level}


def measure(parts: Sequence[str], minutes: float, cache: Path) -> dict[str, Any]:
    """Return what was measured, by part."""
    found: dict[str, Any] = {}

    def row(function: Callable[..., Any], setting: Setting, *arguments: Any) -> dict[str, Any]:
        pictures = pictures_of(drive_of(setting, 0), cache)
        complain(f'{function.__name__} {setting.name} {" ".join(map(str, arguments))}')
        outcome = isolated(function, pictures, *arguments)
        if outcome.failure:
            complain(outcome.failure)
        return {'failure': outcome.failure, 'peak_mb': outcome.peak_mb, **(outcome.value or {})}

    if 'detection' in parts:
        found['detection'] = {size.name: row(detection, size, 60.0) for size in SIZES}
    if 'hour' in parts:
        found['hour'] = row(hour, replace(SIZES[0], name='640x480'), minutes)
    if 'calibration' in parts:
        found['calibration'] = row(calibration, FIVE_TURNS)
    if 'length' in parts:
        found['length'] = [row(whole, FIVE_TURNS, times, 5) for times in (1, 2, 4)]
    if 'turns' in parts:
        found['turns'] = [row(whole, EIGHT_TURNS, 1, turns) for turns in (2, 5, 8)]
    return found


def report(found: dict[str, Any]) -> str:
    """Return what was measured as Markdown tables."""
    parts = []
    if rows := found.get('detection'):
        names = list(dict.fromkeys(name for row in rows.values()
                                   for name in row.get('parts_ms', {})))
        parts.append('Detection of a 30 fps camera on one core, ms per camera frame.\n\n' + table(
            ['', 'frames/s', 'ms', *names, 'JPEG decode, ms', 'times JPEG decode'],
            [[size, f'{row["fps"]:.0f}', f'{row["ms"]:.2f}',
              *(f'{row["parts_ms"].get(name, 0.0):.2f}' for name in names),
              f'{row["decode_ms"]:.2f}', f'{row["of_decode"]:.2f}']
             for size, row in rows.items() if not row['failure']]))
    if (row := found.get('hour')) and not row['failure']:
        ms, mb = row['ms_by_minute'], row['mb_by_minute']
        parts.append(table(
            [f'detection, {row["minutes"]:.0f} min at 10 fps, 640x480', 'first minute',
             'second', 'last', 'most'],
            [['ms per frame', f'{ms[0]:.2f}', f'{ms[min(1, len(ms) - 1)]:.2f}', f'{ms[-1]:.2f}',
              f'{max(ms):.2f}'],
             ['MB', f'{mb[0]:.0f}', f'{mb[min(1, len(mb) - 1)]:.0f}', f'{mb[-1]:.0f}',
              f'{max(mb):.0f}']]))
    if (row := found.get('calibration')) and not row['failure']:
        stages = {'detection': row['detect_s'], **row['stages_s'],
                  'from turns to result': row['total_s']}
        parts.append(table([f'{row["turns"]} turns, 960x540, {row["verdict"]}', 's'],
                           [[name, f'{value:.1f}'] for name, value in stages.items()]))
    for name in ('length', 'turns'):
        if rows := [row for row in found.get(name, ()) if not row['failure']]:
            parts.append(table(
                ['drive', 'turns wanted', 'used', 'frames', 's', 'ms per frame', 'MB'],
                [[f'{row["times"]} times', str(row['wanted']), str(row['used']),
                  str(row['frames']), f'{row["seconds"]["total"]:.1f}',
                  f'{1000 * row["seconds"]["total"] / row["frames"]:.0f}',
                  f'{row["peak_mb"]:.0f}'] for row in rows]))
    return '\n\n'.join(parts)


def main() -> None:
    """Measure what is asked for."""
    every = ('detection', 'calibration', 'length', 'turns', 'hour')
    parser = parser_with(__doc__, 'cache', 'out', 'docs')
    parser.add_argument('parts', nargs='*', metavar='PART',
                        help=f'of {", ".join(every)}; default: all')
    parser.add_argument('--minutes', type=float, default=60.0, help='of the long drive')
    arguments = parser.parse_args()
    if unknown := set(arguments.parts) - set(every):
        parser.error(f'there is no part {", ".join(sorted(unknown))}; choose of {every}')
    path = arguments.out / 'speed.json'
    found = load(path)
    with tempfile.TemporaryDirectory() as passing:
        for part in arguments.parts or every:
            found |= measure([part], arguments.minutes, arguments.cache or Path(passing))
            found |= {'cores': os.cpu_count(), 'commit': commit()}
            save(path, found)
    text = report(found)
    (arguments.out / 'speed.md').write_text(f'{found["cores"]} cores.\n\n{text}\n')
    if arguments.docs:
        write_table('speed', text, [found['commit']])
    print(text)


if __name__ == '__main__':
    main()
