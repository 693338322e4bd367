"""Motion streams: from CSV, GPX, KITTI's oxts folders, inside videos, and a bag's own topics."""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.errors import InputError, one_line, shortened
from dashcalib_ros.input.inputs import is_video
from dashcalib_ros.input.motion import (
    EPOCH_S,
    SAMPLES,
    SensorBuffer,
    SensorStream,
    local_metres,
    sensor_stream,
    values_in,
)
from dashcalib_ros.input.source import os_error
from dashcalib_ros.limits import check_file, read_text

# of a CSV or GPX: ten hours of a gyro at 100 Hz
MOTION_BYTES = 2**29
# of one file of a KITTI oxts folder, and how many there may be
OXTS_BYTES, OXTS_FILES = 2**12, 1_000_000
# columns of a CSV by their stream
COLUMNS = {'rate': ('gyro_x', 'gyro_y', 'gyro_z'), 'speed': ('speed',),
           'position': ('latitude', 'longitude', 'altitude')}
HEAD = f'stamp_s and any of {", ".join(name for names in COLUMNS.values() for name in names)}'
# places in a line of KITTI's oxts: latitude, longitude, altitude; forward speed; rates x, y, z
OXTS_POSITION, OXTS_SPEED, OXTS_RATE, OXTS_VALUES = slice(0, 3), 8, slice(17, 20), 30
# of a GoPro's blocks of GPS: the key of the kind of fix (2: without height, 3: with it), and s
GOPRO_FIX, GOPRO_BLOCK_S = '0x47505346', 1.0
# message types by the option that chooses one of their topics
TYPES = {'imu': ('sensor_msgs/msg/Imu',), 'gps': ('sensor_msgs/msg/NavSatFix',),
         'odom': ('nav_msgs/msg/Odometry', 'geometry_msgs/msg/TwistStamped')}


def read_motion(path: Path) -> SensorStream:
    """Read what sensors say of a drive from a CSV, a GPX, a KITTI oxts folder, or a video.

    Raises InputError for what is none of these. What is damaged inside is left out, with a
    warning in the stream.
    """
    if path.is_dir():
        return _oxts(path)
    if is_video(path):
        return _inside_video(path)
    text = read_text(path, MOTION_BYTES, f'the motion file {path}')
    if path.suffix.lower() == '.gpx':
        return _gpx(text, path)
    return _csv(text, path)


def _csv(text: str, path: Path) -> SensorStream:
    head, _, rest = text.partition('\n')
    names = [name.strip() for name in head.split(',')]
    if 'stamp_s' not in names or len(set(names)) < len(names):
        raise InputError(f'{path} is no CSV of motion sensors: its first line must name its '
                         f'columns: {HEAD}')
    table = _table(rest.splitlines(), len(names))
    column = {name: table[:, place] for place, name in enumerate(names)}
    stamps = column['stamp_s']
    values: dict[str, tuple[Floats, Floats]] = {}
    for kind, wanted in COLUMNS.items():
        there = [name for name in wanted if name in column]
        if kind == 'position' and {'latitude', 'longitude'} <= set(there):
            rows = local_metres(column['latitude'], column['longitude'],
                                column.get('altitude', np.full(len(stamps), np.nan)))
        elif len(there) == len(wanted):
            rows = np.stack([column[name] for name in wanted], axis=1)
        elif there:
            raise InputError(f'{path} has only {", ".join(there)} of {", ".join(wanted)}: write '
                             f'all of them')
        else:
            continue
        # sensors of different rates leave cells empty; a line without a stamp is damaged
        known = ~np.isnan(rows).all(axis=1) | ~np.isfinite(stamps)
        values[kind] = stamps[known], rows[known]
    if not values:
        raise InputError(f'{path} has no column of a sensor: its first line must name {HEAD}')
    late = stamps[np.isfinite(stamps)]
    return sensor_stream(values, str(path), bool(len(late) and late[0] > EPOCH_S))


def _table(lines: Sequence[str], width: int) -> Floats:
    """Return (n, width) numbers; NaN for what is none, and for all of a broken line."""
    def number(cell: str) -> float:
        try:
            return float(cell)
        except ValueError:
            return np.nan
    rows = [[number(cell) for cell in line.split(',')] if line.count(',') == width - 1
            else [np.nan] * width for line in lines if line.strip()]
    return np.array(rows, np.float64).reshape(-1, width)


def _gpx(text: str, path: Path) -> SensorStream:
    try:
        import gpxpy
        import gpxpy.gpx
    except ImportError as error:
        raise InputError(f"{path} is a GPX file, which needs gpxpy: pip install "
                         f"'dashcalib_ros[motion]'") from error
    if '<!DOCTYPE' in text[:10_000].upper() or '<!ENTITY' in text.upper():
        raise InputError(f'{path} is no plain GPX: it defines entities; export the track anew')
    try:
        found = gpxpy.parse(text)
    except Exception as error:  # a damaged XML makes parsers raise nearly anything
        raise InputError(f'{path} is no valid GPX ({shortened(str(error))}): export the track '
                         f'anew') from error
    points = [point for track in found.tracks for segment in track.segments
              for point in segment.points if point.time is not None]
    if len(points) < 2:
        raise InputError(f'{path} has no track with times: export it with them')
    stamps = np.array([_epoch_s(point.time) for point in points])
    # None becomes NaN
    places = np.array([(point.latitude, point.longitude, point.elevation) for point in points],
                      np.float64)
    return sensor_stream({'position': (stamps, local_metres(*places.T))}, str(path), absolute=True)


def _inside_video(path: Path) -> SensorStream:
    """Read the gyro, and of a GoPro GPS, that a camera has written into its video."""
    try:
        check_file(path, f'the video {path}')
    except OSError as error:
        raise InputError(os_error(path, error)) from error
    try:
        import telemetry_parser
    except ImportError as error:
        raise InputError(f"{path} is a video, whose gyro and GPS telemetry-parser reads: pip "
                         f"install 'dashcalib_ros[motion]'") from error
    values: dict[str, tuple[Floats, Floats]] = {}
    try:
        parser = telemetry_parser.Parser(str(path))
        seen = [sample for sample in parser.normalized_imu() if sample.get('gyro')]
        if seen:
            values['rate'] = (np.array([sample['timestamp_ms'] for sample in seen]) / 1e3,
                              np.radians([sample['gyro'] for sample in seen]))
        fixes = [fix for block in parser.telemetry() for fix in _gopro_fixes(block.get('GPS'))]
        if fixes:
            stamps, latitude, longitude, altitude, speed = np.array(fixes).T
            values['position'] = stamps, local_metres(latitude, longitude, altitude)
            values['speed'] = stamps, speed[:, None]
    except (KeyboardInterrupt, SystemExit, MemoryError):
        raise
    except BaseException as error:  # the library's own panics are no Exception
        raise InputError(f'{path} has no motion data that can be read '
                         f'({shortened(one_line(error))}): give a CSV or a GPX') from error
    return sensor_stream(values, str(path))


def _gopro_fixes(block: Mapping[str, Any] | None) -> Iterator[tuple[float, ...]]:
    """Yield stamp in s, latitude, longitude, altitude and speed of a block of GPS5 or GPS9."""
    if not block or block.get(GOPRO_FIX, 3) < 2:
        return
    rows, scale = block['Data'], np.array(block['Scale'], np.float64)[:4]
    for number, row in enumerate(rows):
        stamp_s = block['TimestampUs'] / 1e6 + number * GOPRO_BLOCK_S / len(rows)
        yield (stamp_s, *(np.array(row[:4], np.float64) / scale).tolist())


def _epoch_s(time: Any) -> float:
    return float((time if time.tzinfo else time.replace(tzinfo=timezone.utc)).timestamp())


def _oxts(folder: Path) -> SensorStream:
    """Read oxts/ of a KITTI raw drive: timestamps.txt, and data/ with a file for each record."""
    inner = folder / 'oxts' if (folder / 'oxts').is_dir() else folder
    if not (inner / 'data').is_dir() or not (inner / 'timestamps.txt').exists():
        raise InputError(f'{folder} is no folder of motion data known here: give a KITTI oxts '
                         f'folder (timestamps.txt and data/), a CSV or a GPX')
    stamps = _kitti_stamps(inner / 'timestamps.txt')
    files = sorted(file for file in (inner / 'data').iterdir() if file.suffix == '.txt')
    if len(files) > OXTS_FILES or len(files) < 2:
        raise InputError(f'{inner / "data"} has {len(files)} records: give a whole KITTI drive')
    rows = np.full((len(files), OXTS_VALUES), np.nan)
    for row, file in zip(rows, files, strict=True):
        if not file.is_file():
            continue
        values = _table([read_text(file, OXTS_BYTES).strip().replace(' ', ',')], OXTS_VALUES)
        row[:] = values[0] if len(values) else np.nan
    count = min(len(rows), len(stamps))
    rows, stamps = rows[:count], stamps[:count]
    pictures = [file for file in sorted(inner.parent.glob('image_0[0-3]/timestamps.txt'))]
    first = _kitti_stamps(pictures[0])[0] if pictures else stamps[0]
    return sensor_stream({
        'rate': (stamps - first, rows[:, OXTS_RATE]),
        'speed': (stamps - first, rows[:, OXTS_SPEED:OXTS_SPEED + 1]),
        'position': (stamps - first, local_metres(*rows[:, OXTS_POSITION].T))}, str(folder))


def _kitti_stamps(path: Path) -> Floats:
    """Return seconds from lines like 2011-09-26 13:02:25.964389445; NaN for other lines."""
    found = []
    for line in read_text(path, MOTION_BYTES).splitlines():
        whole, _, part = line.strip().partition('.')
        try:
            start = datetime.strptime(whole, '%Y-%m-%d %H:%M:%S').replace(tzinfo=timezone.utc)
            found.append(start.timestamp() + float(f'0.{part or 0}'))
        except ValueError:
            found.append(np.nan)
    if not found:
        raise InputError(f'{path} has no stamps: give a whole KITTI drive')
    return np.array(found)


def bag_motion(paths: Iterable[Path], chosen: Mapping[str, str | None]) -> SensorStream | None:
    """Return what a bag's sensors say; None where it has none.

    chosen: topic by imu, gps and odom; None: the only one of its type. Of several without a choice
    none is used, and a warning lists them. Raises InputError for a chosen topic that there is not.
    """
    from dashcalib_ros.input.bag_storage import open_bag
    samples = SensorBuffer(SAMPLES + 1)
    warnings: list[str] = []
    for path in paths:
        bag = open_bag(path)
        topics = {}
        for option, types in TYPES.items():
            found = [topic for topic in bag.topics if topic.msgtype in types and topic.count]
            name = chosen.get(option)
            if name is not None:
                found = [topic for topic in found if topic.name.strip('/') == name.strip('/')]
                if not found:
                    there = ', '.join(topic.name for topic in bag.topics
                                      if topic.msgtype in types) or 'none'
                    raise InputError(f'{path} has no {option} topic {name!r} with messages of the '
                                     f'type {" or ".join(types)}: there is {there}')
            if len(found) > 1:
                names = ', '.join(topic.name for topic in found)
                warnings.append(f'none of the {len(found)} {option} topics is used ({names}): '
                                f'choose one with --{option}')
            elif found and found[0].count > SAMPLES:
                warnings.append(f'{found[0].name} is not used: it has more than {SAMPLES} '
                                f'messages')
            elif found:
                topics[found[0].name] = option
        for record in bag.records(tuple(topics), lambda _: None) if topics else ():
            try:
                message = record.message()
                values = list(values_in(message, topics[record.topic]))
                stamp = message.header.stamp
                stamp_s = int(stamp.sec) + int(stamp.nanosec) / 1e9 or record.receive_ns / 1e9
            except (InputError, AttributeError, TypeError, ValueError):
                continue  # a damaged message is as one that is missing
            for kind, value in values:
                samples.add(kind, stamp_s, value)
    stream = samples.stream('the bag')
    lines = (*warnings, *stream.warnings)
    return None if stream.empty and not lines else replace(stream, warnings=lines)
