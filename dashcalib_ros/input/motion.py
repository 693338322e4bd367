# SPDX-License-Identifier: Apache-2.0
"""What the car knows about its own motion: streams of a gyro, a speed and positions.

A stream's stamps are seconds since the drive's first image, on the sensor's own clock: how far
that is off is found later, from the turns (judge/witnesses.py). A stream that cannot be used is
None, and a warning states the reason: the calibration goes on without it.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import Any

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats
from dashcalib_ros.errors import InputError, Notice, counted
from dashcalib_ros.input.times import rising

# s; stamps beyond it are times of day, since 1970
EPOCH_S = 1e8
# s since 1970, and from the first image on: the year 2286
LATEST_S = 1e10
# what other units of stamps since 1970 are, in s
UNITS = {'milliseconds': 1e-3, 'microseconds': 1e-6, 'nanoseconds': 1e-9}
# s between two stamps of a sensor; by this, ns since a computer was started are not ms since 1970
LONGEST_STEP_S = 60.0
# metres of a degree of latitude
DEGREE_M = 111_320.0
# of the Earth's radius, by which positions of another drive would be off: not this car's
FARTHEST_M = 1e6
# degrees of latitude, and of longitude, which some count from 0 on
FARTHEST_DEG = (90.0, 360.0)
# maximum number of values of a stream: ten hours at 200 Hz
SAMPLES = 7_200_000
# minimum number of samples of a stream; fewer say nothing about a turn
LEAST_SAMPLES = 10
# share of samples that may be damaged before the stream is not used, or doubled without a word
DAMAGED = 0.2
# rad/s; no car turns faster: degrees were written for radians
FASTEST_TURN = 6.0
# the same for the whole drive, by the 99th percentile, where single peaks do not count
QUANTILE = 99.0
# degrees Celsius; kelvins were written for them
HOTTEST_C = 150.0
# m/s; a car that is slower stands; a sensor that never says more does not know about driving
STANDING_MPS, DRIVING_MPS = 0.3, 3.0
# s over which positions tell a speed
SPEED_OVER_S = 1.0
# of NavSatStatus; -2 is unknown
NO_FIX = -1
# of an Imu's covariance: there is no such value in the message; and what is taken of it
NO_DATA, NOTHING = -1, (np.nan, np.nan, np.nan)
# s; a time of recording has whole seconds, and the first picture comes after it
DOUBT_S = 1.5
# s; stamps from the first image on may begin before it, by no more than that
SECOND_S = 1.0
# hours by which a clock may be off as it is of another time zone
MOST_ZONES_H = 14
# s, and samples; so few at an end, and so far from the others, are of another clock
ANOTHER_CLOCK_S, STRAYS = 900.0, 2


@dataclass(frozen=True)
class Samples:
    """Values with their times. stamps_s: (n,) ascending; values: (n, d)."""

    stamps_s: Floats
    values: Floats

    def at(self, stamps_s: Floats) -> Floats:
        """Return (k, d) the values at stamps (k,), between samples on a straight line."""
        return np.stack([np.interp(stamps_s, self.stamps_s, column)
                         for column in self.values.T], axis=1)

    @property
    def integral(self) -> Samples:
        """Return the values added up over time since the first sample: angles, of rates."""
        steps = np.diff(self.stamps_s)[:, None] * (self.values[1:] + self.values[:-1]) / 2
        return Samples(self.stamps_s, np.cumsum(np.pad(steps, ((1, 0), (0, 0))), axis=0))


@dataclass(frozen=True)
class SensorStream:
    """Motion sensor data of a drive; each is None if there is no such sensor.

    rate: (n, 3) rad/s about the sensor's own three axes, in any mounting. speed: (n, 1) m/s.
    position: (n, 3) m, east, north and up from the first. temperature: (n, 1) of the camera,
    degrees Celsius. Stamps: s since the drive's first image; absolute: on the clock of the images,
    since 1970 as bags and GPX have them.
    warnings: what was skipped, one line each. begin_s: time of day of the drive's first image, for
    images without one; None: unknown. doubt_s: by how much that may be off.
    """

    rate: Samples | None = None
    speed: Samples | None = None
    position: Samples | None = None
    temperature: Samples | None = None
    warnings: tuple[Notice, ...] = ()
    absolute: bool = False
    begin_s: float | None = None
    doubt_s: float = 0.0

    @property
    def empty(self) -> bool:
        """Return whether there is nothing to use."""
        return not self.kinds

    @property
    def kinds(self) -> Mapping[str, Samples]:
        """Return the streams that there are, by their names."""
        found = {kind: getattr(self, kind) for kind in NAMES}
        return {kind: samples for kind, samples in found.items() if samples is not None}

    def stood(self, first_s: float, last_s: float) -> bool:
        """Return whether the measured speed says that the car stood all that time."""
        if self.speed is None or np.abs(self.speed.values).max() < DRIVING_MPS:
            return False
        stamps_s = self.speed.stamps_s
        then = np.abs(self.speed.values[(stamps_s >= first_s) & (stamps_s <= last_s)])
        return len(then) > 0 and bool(then.max() < STANDING_MPS)

    def shifted(self, later_s: float) -> SensorStream:
        """Return the same with later stamps."""
        moved: dict[str, Any] = {
            kind: Samples(samples.stamps_s + later_s, samples.values)
            for kind, samples in self.kinds.items()}
        return replace(self, **moved)

    @property
    def first_s(self) -> float:
        """Return the first stamp of all kinds."""
        return min(float(samples.stamps_s[0]) for samples in self.kinds.values())

    @property
    def last_s(self) -> float:
        """Return the last stamp of all kinds."""
        return max(float(samples.stamps_s[-1]) for samples in self.kinds.values())

    def on_clock_of(self, begin_ns: int | None, recorded: bool, length_ns: int | None
                    ) -> SensorStream:
        """Return the same with what a drive's images tell of their clock.

        begin_ns: when the first one was taken. recorded: their stamps are of that clock; else it
        is known to the second, and length_ns is how long they last.
        """
        if self.empty or begin_ns is None:
            return self
        begin_s = begin_ns / 1e9
        if recorded:
            # an uptime, of both: no time of the drive's begin is among the sensors' then
            own = not self.absolute and self.first_s <= begin_s <= self.last_s < EPOCH_S
            if own and self.first_s > SECOND_S:
                return replace(self, absolute=True)
            if not self.absolute or begin_s < self.last_s:
                return self
            return self._of_another_time(begin_s, begin_s)
        if not self.absolute or self.begin_s is not None:
            return self
        end_s = begin_s + (length_ns or 0) / 1e9
        if begin_s < self.last_s and end_s > self.first_s:
            return replace(self, begin_s=begin_s, doubt_s=DOUBT_S)
        return self._of_another_time(begin_s, end_s)

    def _of_another_time(self, begin_s: float, end_s: float) -> SensorStream:
        return replace(self, warnings=(*self.warnings, Notice(
            'E-MOTION-OTHER-DAY', f'the time of recording of the images, '
            f'{time_text(begin_s)}, is not among those of the motion sensors, which begin at '
            f'{time_text(self.first_s)}{zone_text(self.first_s, self.last_s, begin_s, end_s)}')))

    def since(self, start_s: float) -> SensorStream:
        """Return the same, with stamps from a drive's first image on. start_s: its stamp.

        Pictures without a time of day begin at begin_s, or where the stream does.
        """
        if not self.absolute or self.empty:
            return replace(self, absolute=False)
        first = self.first_s
        if self.begin_s is not None and not first <= start_s <= self.last_s:
            # of another clock than the sensors, or of none
            own_s = 0.0 if start_s > EPOCH_S else start_s
            return replace(self.shifted(-self.begin_s - own_s), absolute=False)
        if start_s > EPOCH_S or first <= EPOCH_S:
            return replace(self.shifted(-start_s), absolute=False)
        return replace(self.shifted(-first - start_s), absolute=False, doubt_s=DOUBT_S, warnings=(
            *self.warnings, Notice(
                'E-MOTION-NO-TIME-OF-DAY', 'the images have no time of day: the first sample of '
                'the motion sensors is assigned to the first image')))


def time_text(stamp_s: float) -> str:
    """Return a time of day, UTC, for messages."""
    return f'{datetime.fromtimestamp(stamp_s, timezone.utc):%Y-%m-%d %H:%M:%S}'


def zone_text(first_s: float, last_s: float, begin_s: float, end_s: float) -> str:
    """Return in words the time zone by which stamps are off; '' where that explains nothing.

    first_s, last_s: of the sensor; begin_s, end_s: of the images.
    """
    for hours in sorted((n / 2 for n in range(-2 * MOST_ZONES_H, 2 * MOST_ZONES_H + 1) if n),
                        key=lambda each: (each % 1, abs(each))):
        if first_s - 3600 * hours <= end_s and last_s - 3600 * hours >= begin_s:
            way = 'earlier' if hours > 0 else 'later'
            return (f': a time zone of {abs(hours):g} h? Their stamps would fit {abs(hours):g} h '
                    f'{way}; use --sensor-offset={-3600 * hours:.0f}s')
    return ''


def in_seconds(stamps: Floats, what: str) -> tuple[Floats, tuple[Notice, ...]]:
    """Return stamps (n,) in s, and a warning where those since 1970 are of another unit.

    what: where they are from, for messages. Raises InputError for those of no known unit.
    """
    known = stamps[np.isfinite(stamps)]
    if not len(known):
        return stamps, ()
    with np.errstate(over='ignore'):
        size = float(np.median(np.abs(known)))
        step = float(np.median(np.abs(np.diff(known)))) if len(known) > 1 else 0.0
    for name, unit in UNITS.items():
        if EPOCH_S < size * unit <= LATEST_S and step * unit <= LONGEST_STEP_S:
            return stamps * unit, (Notice(
                'E-STAMP-UNIT-ASSUMED',
                f'the time stamps of {what} are interpreted as {name} since 1970'),)
    if size > LATEST_S:
        raise InputError('E-STAMP-UNIT', f'{what} has time stamps such as {known[0]:.10g}, which '
                         f'are not seconds, milliseconds, microseconds or nanoseconds since 1970; '
                         f'write seconds')
    return stamps, ()


def sensor_stream(values: Mapping[str, tuple[Floats, Floats]], what: str,
                  absolute: bool = False) -> SensorStream:
    """Return a stream from raw values, with what is damaged left out.

    values: by kind, as SensorStream's, the stamps (n,) in s and the values (n, d); positions are
    latitude and longitude in degrees, and altitude in m. what: where they come from, for warnings.
    absolute: as SensorStream's.
    """
    found: dict[str, Any] = {}
    warnings: list[Notice] = []
    for kind, (stamps_s, rows) in values.items():
        stamps_s, rows = np.asarray(stamps_s, np.float64), np.asarray(rows, np.float64)
        said = ~np.isnan(rows).all(axis=1) | ~np.isfinite(stamps_s)
        stamps_s, rows = stamps_s[said], rows[said]
        if kind == 'position':
            nowhere = _nowhere(rows)
            stamps_s, rows = stamps_s[~nowhere], local_metres(*rows[~nowhere].T)
            if nowhere.any():
                warnings.append(Notice(
                    'E-GPS-NO-FIX', f'{counted(int(nowhere.sum()), "position")} of {what} '
                    f'skipped: 0, 0 or not on Earth, as a GPS sends them without a fix'))
        # whole seconds of a GPS at 10 Hz: the first one is at its time
        with np.errstate(invalid='ignore'):
            again = np.diff(stamps_s, prepend=np.nan) == 0
        thinned = again.sum() > DAMAGED * len(again)
        if thinned:
            stamps_s, rows = stamps_s[~again], rows[~again]
        samples, trouble = _cleaned(stamps_s, rows, kind)
        if thinned and samples is not None:
            warnings.append(Notice(
                'E-MOTION-STAMPS-EQUAL', f'several {NAMES[kind]} of {what} have the same time '
                f'stamp: the first one of each is used'))
        if samples is not None and (far := int(np.sum(
                (stamps_s < samples.stamps_s[0] - ANOTHER_CLOCK_S)
                | (stamps_s > samples.stamps_s[-1] + ANOTHER_CLOCK_S)))):
            warnings.append(Notice(
                'E-MOTION-OTHER-CLOCK', f'{far} of {len(stamps_s)} {NAMES[kind]} of {what} '
                f'skipped: their time stamps are of another clock than those of the others'))
        if trouble:
            warnings.append(Notice('E-MOTION-NOT-USED',
                                   f'the {NAMES[kind]} of {what} are not used: {trouble}'))
        if samples is not None:
            found[kind] = samples
    return SensorStream(**found, warnings=tuple(warnings), absolute=absolute)


def _nowhere(places: Floats) -> npt.NDArray[np.bool_]:
    nowhere = (places[:, :2] == 0).all(axis=1) | (np.abs(places[:, :2]) > FARTHEST_DEG).any(axis=1)
    return np.asarray(nowhere)


NAMES = {'rate': 'angular rates', 'speed': 'speeds', 'position': 'positions',
         'temperature': 'temperatures'}


def _cleaned(stamps_s: Floats, values: Floats, kind: str) -> tuple[Samples | None, str]:
    if not len(stamps_s):
        return None, 'the sensor sends none (a GPS without a fix, an IMU without a gyro)'
    if len(stamps_s) > SAMPLES:
        return None, f'there are more than {SAMPLES} of them'
    good = np.isfinite(stamps_s) & np.isfinite(values).all(axis=1)
    # a clock that was set back, or one stamp of another clock
    good[~_of_one_clock(np.where(good, stamps_s, np.nan))] = False
    count = int(good.sum())
    if count < max(LEAST_SAMPLES if kind == 'rate' else 2, (1 - DAMAGED) * len(good)):
        return None, f'{len(good) - count} of {len(good)} are damaged, repeated or out of order'
    samples = Samples(stamps_s[good], values[good])
    if kind == 'rate' and np.percentile(np.abs(samples.values), QUANTILE) > FASTEST_TURN:
        return None, (f'{np.percentile(np.abs(samples.values), QUANTILE):.0f} rad/s is too fast '
                      f'for a car; write rad/s, not degrees per second')
    if kind == 'temperature' and np.abs(samples.values).max() > HOTTEST_C:
        return None, 'no camera is so warm; write degrees Celsius'
    if kind == 'position' and not np.ptp(samples.values, axis=0).max() < FARTHEST_M:
        return None, 'they are too far apart for one drive'
    return samples, ''


def _of_one_clock(stamps_s: Floats) -> npt.NDArray[np.bool_]:
    """Return which of (n,) stamps are those of one clock, and rise; NaN is none."""
    kept = np.array(rising(stamps_s.tolist()), int)
    if len(kept) > 2 * STRAYS:
        far = np.diff(stamps_s[kept]) > ANOTHER_CLOCK_S
        first = int(np.flatnonzero(np.r_[True, far[:STRAYS]])[-1])
        past = len(kept) - int(np.flatnonzero(np.r_[True, far[::-1][:STRAYS]])[-1])
        kept = kept[first:past]
    of_one = np.zeros(len(stamps_s), bool)
    of_one[kept] = True
    return of_one


def local_metres(latitude: Floats, longitude: Floats, altitude: Floats) -> Floats:
    """Return positions (n, 3) in metres east, north and up from the first finite fix.

    latitude, longitude: (n,) degrees; altitude: (n,) m, where NaN counts as 0. A drive is small:
    the Earth is flat there.
    """
    known = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude))
    if not len(known):
        return np.full((len(latitude), 3), np.nan)
    first = known[0]
    east = np.mod(longitude - longitude[first] + 180.0, 360.0) - 180.0
    up = np.where(np.isfinite(latitude), np.nan_to_num(altitude, nan=0.0), np.nan)
    return np.stack([
        east * DEGREE_M * np.cos(np.radians(latitude[first])),
        (latitude - latitude[first]) * DEGREE_M, up - up[first]], axis=1)


def speeds_of(stream: SensorStream) -> Samples | None:
    """Return the car's speed (n, 1), m/s: as it was measured, else by its positions; or None."""
    if stream.speed is not None:
        return Samples(stream.speed.stamps_s, np.abs(stream.speed.values))
    if stream.position is None or len(stream.position.stamps_s) < 3:
        return None
    stamps_s, places = stream.position.stamps_s, stream.position.values
    # over a second or more: from fix to fix noise is speed, too
    later = np.minimum(np.searchsorted(stamps_s, stamps_s + SPEED_OVER_S), len(stamps_s) - 1)
    passed = stamps_s[later] - stamps_s
    known = passed >= SPEED_OVER_S
    if not known.any():
        return None
    way = np.linalg.norm(places[later, :2] - places[:, :2], axis=1)
    return Samples((stamps_s + passed / 2)[known], (way[known] / passed[known])[:, None])


# of all speeds, a fraction: wheels wear and expand; positions of a receiver
WHEELS_SIGMA, POSITIONS_SIGMA = 0.02, 0.01


def speed_sigma(stream: SensorStream) -> float:
    """Return the sigma of the scale of speeds_of, a fraction."""
    return POSITIONS_SIGMA if stream.speed is None else WHEELS_SIGMA


def temperature_of(streams: Iterable[SensorStream | None], start_s: float) -> Samples | None:
    """Return the temperature of the first stream that has one, on the images' clock, else None."""
    for stream in streams:
        found = None if stream is None else stream.since(start_s).temperature
        if found is not None:
            return Samples(found.stamps_s + start_s, found.values)
    return None


def values_in(message: Any, option: str) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield the kinds of values in a message of ROS 1 or 2, as SensorBuffer takes them.

    option: gps, imu, odom or temperature, by the message's type. NaN of a GPS without a fix, and
    of an IMU that says that it has no gyro.
    """
    if option == 'gps':
        place = (message.latitude, message.longitude, message.altitude)
        known = message.status.status != NO_FIX and np.isfinite(place[:2]).all()
        yield 'position', place if known else NOTHING
    elif option == 'imu':
        rate = message.angular_velocity
        known = message.angular_velocity_covariance[0] != NO_DATA
        yield 'rate', (rate.x, rate.y, rate.z) if known else NOTHING
    elif option == 'temperature':
        yield 'temperature', (message.temperature,)
    else:
        twist = message.twist
        twist = getattr(twist, 'twist', twist)
        yield 'odom_rate', (twist.angular.x, twist.angular.y, twist.angular.z)
        yield 'speed', (float(np.hypot(twist.linear.x, twist.linear.y)),)


NO_VALUES = np.empty(0), np.empty((0, 3))


class SensorBuffer:
    """The newest samples of a bag's or a node's sensors: add() them as they come, stream() to ask.

    stream() drops duplicate and late ones. Memory is bounded: of each kind the newest are kept.
    """

    def __init__(self, length: int = 200_000) -> None:
        """length: samples of each kind that are kept."""
        self._kept: dict[str, deque[tuple[float, tuple[float, ...]]]] = {}
        self._length = length

    def add(self, kind: str, stamp_s: float, values: Sequence[float]) -> None:
        """Take a sample. kind: as values_in() yields it; stamp_s: since 1970."""
        kept = self._kept.setdefault(kind, deque(maxlen=self._length))
        kept.append((stamp_s, tuple(values)))

    def newest(self, kind: str) -> tuple[float, tuple[float, ...]] | None:
        """Return the newest sample of a kind, its stamp first."""
        kept = self._kept.get(kind)
        return kept[-1] if kept else None

    def stream(self, what: str = 'the topic') -> SensorStream:
        """Return what there is; what: where it comes from, for warnings."""
        # a thread may add meanwhile
        kept = {kind: list(rows) for kind, rows in tuple(self._kept.items())}
        found = {kind: (np.array([stamp for stamp, _ in rows]), np.array([row for _, row in rows]))
                 for kind, rows in kept.items()}
        by_odometry = found.pop('odom_rate', None)
        # a gyro is better than what odometry makes of it
        if by_odometry is not None and not np.isfinite(found.get('rate', NO_VALUES)[1]).any():
            found['rate'] = by_odometry
        return sensor_stream(found, what, absolute=True)
