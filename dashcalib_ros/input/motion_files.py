# SPDX-License-Identifier: Apache-2.0
"""Motion streams: from CSV, logs, GPX, KITTI's oxts folders, inside videos, and bags."""
from __future__ import annotations

import re
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.errors import InputError, Notice, one_line, shortened
from dashcalib_ros.input.inputs import is_video
from dashcalib_ros.input.motion import (
    DOUBT_S,
    EPOCH_S,
    SAMPLES,
    SensorBuffer,
    SensorStream,
    in_seconds,
    sensor_stream,
    values_in,
)
from dashcalib_ros.input.mp4_sensors import camm_streams, novatek_fixes
from dashcalib_ros.input.source import by_name, os_error
from dashcalib_ros.input.times import UNITS as TIME_UNITS
from dashcalib_ros.input.times import dated_ns, numbers_in, paired, unit_of
from dashcalib_ros.limits import (
    DIGITS,
    GPX_BYTES,
    GPX_DEPTH,
    GPX_NAMES,
    MOTION_BYTES,
    OXTS_BYTES,
    OXTS_FILES,
    check_file,
    read_lines,
    read_text,
)

if TYPE_CHECKING:
    from dashcalib_ros.input.bag_storage import Bag

# columns of a CSV by their stream
STAMP_COLUMN = 'stamp_s'
# of which one is used only where it is chosen: a car has many thermometers
TEMPERATURE = 'temperature'
COLUMNS = {'rate': ('gyro_x', 'gyro_y', 'gyro_z'), 'speed': ('speed',),
           'position': ('latitude', 'longitude', 'altitude'), TEMPERATURE: (TEMPERATURE,)}
# what --columns calls the stamp
STAMP_OPTION = 'time'
_PHYPHOX = {STAMP_COLUMN: 'Time (s)'}
# how the CSV files of loggers are called in the beginning, and their headings by our names
LOGS: tuple[tuple[str, Mapping[str, str]], ...] = (
    # Sensor Logger: its other sensors have the same headings
    ('gyroscope', {STAMP_COLUMN: 'time', 'gyro_x': 'x', 'gyro_y': 'y', 'gyro_z': 'z'}),
    ('location', {STAMP_COLUMN: 'time', 'latitude': 'latitude', 'longitude': 'longitude',
                  'altitude': 'altitude', 'speed': 'speed'}),
    # phyphox
    ('', {**_PHYPHOX, **{f'gyro_{axis}': f'Gyroscope {axis} (rad/s)' for axis in 'xyz'}}),
    ('', {**_PHYPHOX, 'latitude': 'Latitude (°)', 'longitude': 'Longitude (°)',
          'altitude': 'Height (m)', 'speed': 'Velocity (m/s)'}),
    # EuRoC's imu0/data.csv
    ('', {STAMP_COLUMN: 'timestamp [ns]',
          **{f'gyro_{axis}': f'w_RS_S_{axis} [rad s^-1]' for axis in 'xyz'}}),
    # MARS logger's gyro_accel.csv
    ('', {STAMP_COLUMN: 'Timestamp[nanosec]',
          **{f'gyro_{axis}': f'g{axis}[rad/s]' for axis in 'xyz'}}))
# Gyroflow's .gcsv: its first line, maximum number of lines of its head, columns, and s of a stamp
GCSV, GCSV_LINES, GCSV_TSCALE = 'GYROFLOW IMU LOG', 100, 1e-3
GCSV_COLUMNS = {STAMP_COLUMN: 't', **{f'gyro_{axis}': f'g{axis}' for axis in 'xyz'}}
# headings of angular rates in degrees per second, and of speeds in km/h
DEGREES, KMH = re.compile(r'deg|dps|°'), re.compile(r'km/?h|kph')
HEAD = f'stamp_s and any of {", ".join(chain(*COLUMNS.values()))}'.removesuffix(
    f', {TEMPERATURE}')
# places in a line of KITTI's oxts: latitude, longitude, altitude; forward speed; rates x, y, z
OXTS_POSITION, OXTS_SPEED, OXTS_RATE, OXTS_VALUES = slice(0, 3), 8, slice(17, 20), 30
# characters of a GPX that are parsed at once
GPX_PIECE = 2**22
# of a GoPro's blocks of GPS: the key of the kind of fix (2: without height, 3: with it), and s
GOPRO_FIX, GOPRO_BLOCK_S = '0x47505346', 1.0
# message types by the option that chooses one of their topics
TYPES = {'imu': ('sensor_msgs/msg/Imu',), 'gps': ('sensor_msgs/msg/NavSatFix',),
         'odom': ('nav_msgs/msg/Odometry', 'geometry_msgs/msg/TwistStamped'),
         TEMPERATURE: ('sensor_msgs/msg/Temperature',)}
# what a damaged message raises
NO_MESSAGE = (InputError, AttributeError, TypeError, ValueError)
# s between stamps and reception, beyond what a slow network makes; messages that tell it
ANOTHER_CLOCK_S, LATE_MESSAGES = 60.0, 9


def read_motion(path: Path, columns: Mapping[str, str] | None = None) -> SensorStream:
    """Read the motion sensors of a drive from a CSV, a GPX, a KITTI oxts folder or a video.

    A CSV may be that of a known logger (LOGS), and a folder may have several of these. columns: of
    another CSV, its headings by our names. Raises InputError for other files. Damaged samples are
    skipped, with a warning in the stream.
    """
    if path.is_dir():
        logs = [] if columns else [each for each in sorted(path.glob('*.csv')) if _log_of(each)]
        return _csvs(logs, path, None) if logs else _oxts(path)
    if is_video(path):
        return _inside_video(path)
    what = f'the motion file {path}'
    if _first_line(path, what).startswith('<'):
        return _gpx(read_text(path, GPX_BYTES, what), path)
    return _csvs([path], path, columns)


def read_temperature(path: Path) -> SensorStream:
    """Read the temperature of a camera from a CSV. Raises InputError where it has none."""
    found = _csvs([path], path, {STAMP_COLUMN: STAMP_COLUMN, TEMPERATURE: TEMPERATURE})
    if found.temperature is None:
        raise InputError('E-TEMPERATURE-UNUSABLE', f'{found.warnings[0]}; use lines of '
                         f'{STAMP_COLUMN},{TEMPERATURE} in rising order')
    return found


def is_motion(path: Path) -> bool:
    """Return whether read_motion() is for this, as its content tells, and not read_poses()."""
    if path.is_dir() or is_video(path):
        return True
    line = _first_line(path, str(path))
    return line.startswith('<') or STAMP_COLUMN in _names(line) or _log_of(path) is not None


def _first_line(path: Path, what: str) -> str:
    return next(read_lines(path, MOTION_BYTES, what), '').lstrip()


def _mark(line: str) -> str:
    return next((each for each in ';\t,' if each in line), ',')


def _names(line: str) -> list[str]:
    return [name.strip(' \r"') for name in line.removeprefix('#').split(_mark(line))]


def _log_of(path: Path) -> Mapping[str, str] | None:
    try:
        names = set(_names(_first_line(path, str(path))))
    except InputError:
        return None
    return next((columns for stem, columns in LOGS if names >= set(columns.values())
                 and path.stem.lower().startswith(stem)), None)


def _csvs(files: Sequence[Path], path: Path, columns: Mapping[str, str] | None) -> SensorStream:
    values: dict[str, tuple[Floats, Floats]] = {}
    warnings: list[Notice] = []
    for file in files:
        lines = read_lines(file, MOTION_BYTES, f'the motion file {file}')
        found, notices = _csv(lines, file, columns)
        values.update(found)
        warnings += notices
    stamps = np.concatenate([stamps for stamps, _ in values.values()])
    known = stamps[np.isfinite(stamps)]
    stream = sensor_stream(values, str(path), bool(len(known) and known[0] > EPOCH_S))
    return replace(stream, warnings=(*warnings, *stream.warnings))


def _csv(lines: Iterator[str], path: Path, columns: Mapping[str, str] | None
         ) -> tuple[dict[str, tuple[Floats, Floats]], tuple[Notice, ...]]:
    head, scales = next(lines, ''), dict[str, float]()
    if head.strip() == GCSV:
        # its orientation is Gyroflow's: the chip's own axes are those of a rotation
        for line in islice(lines, GCSV_LINES):
            key, _, value = line.partition(',')
            if key == 't':
                head, columns = line, GCSV_COLUMNS
                break
            scales[key] = _number(value)
    names, mark = _names(head), _mark(head)
    ours = columns or _log_of(path) or {name: name for name in names if name != TEMPERATURE}
    missing = [theirs for theirs in ours.values() if theirs not in names]
    if columns and missing:
        raise InputError('E-MOTION-COLUMNS', f'{path} has no column {missing[0]!r}: use those of '
                         f'its first line ({shortened(", ".join(names), 200)})')
    if STAMP_COLUMN not in ours or len(set(names)) < len(names):
        raise InputError('E-MOTION-HEADER', f'{path} is not a CSV of motion sensors: its first '
                         f'line must contain the column names {HEAD}; or say which columns they '
                         f'are with --columns {STAMP_OPTION}=t_ms,gyro_x=wx,gyro_y=wy,gyro_z=wz; '
                         f'for poses, use --poses')
    # only what is used: a file may have any number of columns
    used = [name for name in (STAMP_COLUMN, *chain(*COLUMNS.values())) if name in ours]
    table = _table(lines, len(names), [names.index(ours[name]) for name in used], mark)
    column = {name: values * _factor(name, ours[name], scales)
              for name, values in zip(used, table.T, strict=True)}
    stamps, warnings = column[STAMP_COLUMN], tuple[Notice, ...]()
    unit = '' if ours[STAMP_COLUMN] == STAMP_COLUMN else unit_of(ours[STAMP_COLUMN])
    if scales:
        stamps = stamps * scales.get('tscale', GCSV_TSCALE)
    elif unit:
        stamps = stamps * (TIME_UNITS[unit] / TIME_UNITS['seconds'])
    else:
        stamps, warnings = in_seconds(stamps, str(path))
    values: dict[str, tuple[Floats, Floats]] = {}
    for kind, wanted in COLUMNS.items():
        there = [name for name in wanted if name in column]
        if kind == 'position' and {'latitude', 'longitude'} <= set(there):
            column.setdefault('altitude', np.full(len(stamps), np.nan))
            rows = np.stack([column[name] for name in wanted], axis=1)
        elif len(there) == len(wanted):
            rows = np.stack([column[name] for name in wanted], axis=1)
        elif there:
            raise InputError('E-MOTION-COLUMNS', f'{path} has only {", ".join(there)} of '
                             f'{", ".join(wanted)}: write all of them')
        else:
            continue
        # sensors of different rates leave cells empty; a line without a stamp is damaged
        known = ~np.isnan(rows[:, :2]).all(axis=1) | ~np.isfinite(stamps)
        values[kind] = stamps[known], rows[known]
    if not values:
        raise InputError('E-MOTION-HEADER', f'{path} has no sensor column: its first line must '
                         f'contain the column names {HEAD}')
    return values, warnings


def _factor(ours: str, theirs: str, scales: Mapping[str, float]) -> float:
    if ours.startswith('gyro'):
        return (scales.get('gscale', 1.0) if scales else
                np.pi / 180 if DEGREES.search(theirs.lower()) else 1.0)
    return 1 / 3.6 if ours == 'speed' and KMH.search(theirs.lower()) else 1.0


def _table(lines: Iterable[str], width: int, places: Sequence[int], mark: str = ',') -> Floats:
    """Return numbers (n, k) of these places of at most SAMPLES + 1 lines.

    width: values of a line; mark: between them. NaN for what is not a number, and for a whole
    broken line.
    """
    found = array('d')
    for line in islice(filter(str.strip, lines), SAMPLES + 1):
        if line.count(mark) == width - 1:
            cells = line.split(mark)
            found.extend(_number(cells[place]) for place in places)
        else:
            found.extend([np.nan] * len(places))
    return np.array(found).reshape(-1, len(places))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        pass
    try:
        # quotes, and the comma of many countries
        return float(text.strip(' \r"').replace(',', '.'))
    except ValueError:
        return np.nan


class _TrackPoints:
    """Takes stamps and places of a GPX's track points from ElementTree's parser, as they come.

    rows: stamp, latitude, longitude and altitude of each point with a time, one after the other;
    NaN for what is missing. The tree of the file would take 50 times its size.
    """

    def __init__(self) -> None:
        self.rows = array('d')
        self._depth = 0
        self._names: set[str] = set()
        self._point: dict[str, str] | None = None
        self._text: str | None = None

    def doctype(self, name: str, *about: str | None) -> None:
        """Refuse entities, which could be made to grow."""
        raise ValueError('it defines entities')

    def start(self, tag: str, attributes: Mapping[str, str]) -> None:
        """Take the beginning of an element."""
        self._depth += 1
        self._names.update((tag, *attributes))
        # the parser remembers all of them
        if self._depth > GPX_DEPTH or len(self._names) > GPX_NAMES:
            raise ValueError(f'more than {GPX_DEPTH} levels or {GPX_NAMES} names')
        if _plain(tag) == 'trkpt':
            self._point = dict(attributes)
        self._text = '' if self._point is not None and _plain(tag) in ('ele', 'time') else None

    def data(self, text: str) -> None:
        if self._text is not None and len(self._text) < DIGITS:
            self._text += text

    def end(self, tag: str) -> None:
        self._depth -= 1
        if self._point is not None and self._text is not None:
            self._point[_plain(tag)] = self._text
        self._text = None
        if _plain(tag) == 'trkpt' and self._point is not None:
            point, self._point = self._point, None
            if 'time' in point:
                ns = dated_ns(point['time'])
                self.rows.append(np.nan if ns is None else ns / 10**9)
                self.rows.extend(_number(point.get(key, '')) for key in ('lat', 'lon', 'ele'))


def _plain(tag: str) -> str:
    return tag.rpartition('}')[2]


def _gpx(text: str, path: Path) -> SensorStream:
    points = _TrackPoints()
    try:
        parser = ElementTree.XMLParser(target=points)
        # it raises what its target raises at the end of a piece
        for start in range(0, len(text), GPX_PIECE):
            parser.feed(text[start:start + GPX_PIECE])
        parser.close()
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError('E-MOTION-GPX', f'{path} is not valid GPX ({shortened(str(error))}): '
                         f'export the track again') from error
    rows = np.array(points.rows).reshape(-1, 4)
    if len(rows) < 2:
        raise InputError('E-MOTION-NO-TIMES',
                         f'{path} has no track with time stamps: export it with time stamps')
    return sensor_stream({'position': (rows[:, 0], rows[:, 1:])}, str(path), absolute=True)


def _inside_video(path: Path) -> SensorStream:
    try:
        check_file(path, f'the video {path}')
        if inside := novatek_fixes(path):
            rows = np.array(inside)
            return replace(sensor_stream({'position': (rows[:, 0], rows[:, 1:4]),
                                          'speed': (rows[:, 0], rows[:, 4:])}, str(path)),
                           doubt_s=DOUBT_S)
        if streams := camm_streams(path):
            return sensor_stream(streams, str(path))
    except OSError as error:
        raise os_error(path, error) from error
    try:
        import telemetry_parser
    except ImportError as error:
        raise InputError('E-MOTION-PARSER',
                         f'{path} is a video, and telemetry-parser is needed to '
                         f"read its gyro and GPS: pip install '.[motion]' in the folder "
                         'of this package') from error
    values: dict[str, tuple[Floats, Floats]] = {}
    try:
        parser = telemetry_parser.Parser(str(path))
        seen = [sample for sample in parser.normalized_imu() if sample.get('gyro')]
        if seen:
            values['rate'] = (np.array([sample['timestamp_ms'] for sample in seen]) / 1e3,
                              np.radians([sample['gyro'] for sample in seen]))
        fixes = [fix for block in parser.telemetry() for fix in _gopro_fixes(block.get('GPS'))]
        if fixes:
            found = np.array(fixes)
            values['position'] = found[:, 0], found[:, 1:4]
            values['speed'] = found[:, 0], found[:, 4:]
    except (KeyboardInterrupt, SystemExit, MemoryError):
        raise
    except BaseException as error:  # the library's own panics are no Exception
        raise InputError('E-MOTION-VIDEO', f'{path} has no readable motion data '
                         f'({shortened(one_line(error))}): use a CSV or a GPX') from error
    return sensor_stream(values, str(path))


def _gopro_fixes(block: Mapping[str, Any] | None) -> Iterator[tuple[float, ...]]:
    """Yield stamp in s, latitude, longitude, altitude and speed of a block of GPS5 or GPS9."""
    if not block or block.get(GOPRO_FIX, 3) < 2:
        return
    rows, scale = block['Data'], np.array(block['Scale'], np.float64)[:4]
    for number, row in enumerate(rows):
        stamp_s = block['TimestampUs'] / 1e6 + number * GOPRO_BLOCK_S / len(rows)
        yield (stamp_s, *(np.array(row[:4], np.float64) / scale).tolist())


def _oxts(folder: Path) -> SensorStream:
    """Read oxts/ of a KITTI raw drive: timestamps.txt, and data/ with a file for each record."""
    inner = folder / 'oxts' if (folder / 'oxts').is_dir() else folder
    if not (inner / 'data').is_dir() or not (inner / 'timestamps.txt').exists():
        raise InputError('E-MOTION-FOLDER',
                         f'{folder} is not a folder of motion data: use a KITTI '
                         f'oxts folder (timestamps.txt and data/), a CSV or a GPX')
    lines = _kitti_stamps(inner / 'timestamps.txt')
    files = sorted((file for file in (inner / 'data').iterdir() if file.suffix == '.txt'),
                   key=lambda each: by_name(each.name))
    if len(files) > OXTS_FILES or len(files) < 2:
        raise InputError('E-MOTION-KITTI', f'{inner / "data"} has {len(files)} records: use a '
                         f'complete KITTI drive')
    found = paired(numbers_in([file.stem for file in files]), lines)
    if found is None:
        raise InputError('E-MOTION-UNPAIRED', f'{inner} has {len(files)} records and '
                         f'{len(lines) - lines.count(None)} time stamps in {len(lines)} lines of '
                         f'timestamps.txt, which cannot be assigned: use a complete KITTI drive')
    stamps = np.array([np.nan if ns is None else ns / 10**9 for ns in found])
    rows = np.full((len(files), OXTS_VALUES), np.nan)
    for row, file in zip(rows, files, strict=True):
        if not file.is_file():
            continue
        values = _table([read_text(file, OXTS_BYTES).strip().replace(' ', ',')], OXTS_VALUES,
                        range(OXTS_VALUES))
        row[:] = values[0] if len(values) else np.nan
    pictures = sorted(inner.parent.glob('image_0[0-3]/timestamps.txt'))
    first_ns = next((ns for place in (*pictures[:1], inner / 'timestamps.txt')
                     for ns in _kitti_stamps(place) if ns is not None), 0)
    return replace(sensor_stream({
        'rate': (stamps, rows[:, OXTS_RATE]),
        'speed': (stamps, rows[:, OXTS_SPEED:OXTS_SPEED + 1]),
        'position': (stamps, rows[:, OXTS_POSITION])}, str(folder), absolute=True),
        begin_s=first_ns / 10**9)


def _kitti_stamps(path: Path) -> list[int | None]:
    """Return ns from lines like 2011-09-26 13:02:25.964389445; None for other lines."""
    found = [dated_ns(line) for line in islice(read_lines(path, MOTION_BYTES), OXTS_FILES)]
    while found and found[-1] is None:
        found.pop()
    if not found:
        raise InputError('E-MOTION-KITTI',
                         f'{path} has no time stamps: use a complete KITTI drive')
    return found


def bag_motion(paths: Iterable[Path], chosen: Mapping[str, str | None],
               images: str | None = None) -> SensorStream | None:
    """Return the sensor data of a bag, on the clock of its images; None if it has none.

    chosen: topic by imu, gps, odom and temperature; None: the only one of its type, but no
    temperature. Of several without a choice none is used, and a warning lists them. images: their
    topic; None: the only one. Raises InputError for a chosen topic that does not exist.
    """
    from dashcalib_ros.input.bag_storage import open_bag
    samples = SensorBuffer(SAMPLES + 1)
    warnings: list[Notice] = []
    for path in paths:
        bag = open_bag(path)
        topics = {}
        for option, types in TYPES.items():
            found = [topic for topic in bag.topics if topic.msgtype in types and topic.count]
            name = chosen.get(option)
            if name is None and option == TEMPERATURE:
                continue
            if name is not None:
                found = [topic for topic in found if topic.name.strip('/') == name.strip('/')]
                if not found:
                    there = ', '.join(topic.name for topic in bag.topics
                                      if topic.msgtype in types) or 'none'
                    raise InputError('E-BAG-TOPIC-UNKNOWN',
                                     f'{path} has no {option} topic {name!r} '
                                     f'with messages of the type {" or ".join(types)}: choose one '
                                     f'of those that it has ({there})')
            if len(found) > 1:
                names = ', '.join(topic.name for topic in found)
                warnings.append(Notice(
                    'E-MOTION-TOPICS', f'none of the {len(found)} {option} topics is used '
                    f'({names}): choose one with --{option}'))
            elif found and found[0].count > SAMPLES:
                warnings.append(Notice(
                    'E-MOTION-TOO-LONG',
                    f'{found[0].name} is not used: it has more than {SAMPLES} messages'))
            elif found:
                topics[found[0].name] = option
        later = _aligned(bag, tuple(topics), images)
        warnings += [Notice(
            'E-MOTION-CLOCK', f'the clock of {name} is {abs(apart):.0f} s '
            f'{"behind" if apart > 0 else "ahead of"} the clock of the images: the times of '
            f'reception are used to align them') for name, apart in later.items()]
        for record in bag.records(tuple(topics), lambda _: None) if topics else ():
            try:
                message = record.message()
                values = list(values_in(message, topics[record.topic]))
                stamp_s = _stamp_s(message) or record.receive_ns / 1e9
            except NO_MESSAGE:
                continue  # a damaged message is as one that is missing
            for kind, value in values:
                samples.add(kind, stamp_s + later.get(record.topic, 0.0), value)
    stream = samples.stream('the bag')
    lines = (*warnings, *stream.warnings)
    return None if stream.empty and not lines else replace(stream, warnings=lines)


def _aligned(bag: Bag, topics: Sequence[str], images: str | None) -> dict[str, float]:
    """Return what to add to stamps, s, of topics of another clock than the images'."""
    shown = [topic.name for topic in bag.topics if topic.is_image and topic.count
             and (images is None or topic.name.strip('/') == images.strip('/'))]
    ours = _late_s(bag, shown[0]) if len(shown) == 1 and topics else None
    if ours is None:
        return {}
    apart = {topic: late - ours for topic in topics if (late := _late_s(bag, topic)) is not None}
    return {topic: later for topic, later in apart.items() if abs(later) > ANOTHER_CLOCK_S}


def _late_s(bag: Bag, topic: str) -> float | None:
    """Return by how many s a topic's messages come after their stamps, None where none is read."""
    late = []
    for record in islice(bag.records((topic,), lambda _: None), LATE_MESSAGES):
        with suppress(*NO_MESSAGE):
            came_s = record.receive_ns / 1e9
            late.append(came_s - (_stamp_s(record.message()) or came_s))
    return median(late) if late else None


def _stamp_s(message: Any) -> float:
    stamp = message.header.stamp
    return int(stamp.sec) + int(stamp.nanosec) / 1e9
