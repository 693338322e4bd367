# SPDX-License-Identifier: Apache-2.0
"""Cars that move: oncoming, leading and crossing."""
from __future__ import annotations

import math

import numpy as np

from dashcalib_ros.demo.path import Course
from dashcalib_ros.demo.quads import QuadList
from dashcalib_ros.demo.spec import DriveSpec
from dashcalib_ros.demo.town import LANE_M, car_quads
from dashcalib_ros.demo.vehicle import Ride

# crossing cars pass this far ahead of one that stands, and come back after this time
CROSSING_M = 14.0
CROSSING_PERIOD_S = 9.0


class Traffic:
    """The car with number 1 leads; with stops, or standing, every third one crosses."""

    def __init__(self, course: Course, ride: Ride, spec: DriveSpec) -> None:
        self.course = course
        self.ride = ride
        self.count = spec.moving_cars
        self.standing = spec.kind != 'drive'
        rng = np.random.default_rng([spec.seed, 6])
        self.speeds = rng.uniform(6.0, 11.0, self.count)
        self.meetings = rng.uniform(0.05, 1.0, self.count) * ride.duration
        self.gap_s = float(rng.uniform(1.8, 2.6))
        self.kinds = rng.integers(0, 1000, self.count)
        # where and when the car stands at a light: (arc length, start, end)
        self.stands = [(0.5 * course.length, 0.0, ride.duration)] if self.standing else []
        for stop in spec.stops:
            straight = course.straights[stop.before_turn]
            s = straight.first + 0.7 * straight.length
            start = ride.time_at(s - 0.02)
            self.stands.append((s, start, start + stop.seconds + 2.0))

    def add_to(self, quads: QuadList, time: float, cars: tuple[tuple[int, ...], ...]) -> None:
        """Add the cars as they are at a time (s)."""
        for number in range(self.count):
            textures = cars[int(self.kinds[number]) % len(cars)]
            for x, y, heading in self._places(number, time):
                car_quads(quads, (x, y), heading, textures)

    def _places(self, number: int, time: float) -> list[tuple[float, float, float]]:
        if number % 3 == 2 and self.stands:
            return self._crossing(number, time)
        if number == 1 and not self.standing:
            s, left, turn = self.ride.arc_at(time + self.gap_s) + 8.0, 0.0, 0.0
        else:
            since = time - self.meetings[number]
            if self.standing:
                # comes by again and again
                since = (since + 8.0) % 16.0 - 8.0
            s = self.ride.arc_at(time - since) - self.speeds[number] * since
            left, turn = 2.0 * LANE_M, math.pi
        x, y, heading = self.course.at(s, left)
        return [(float(x), float(y), float(heading) + turn)]

    def _crossing(self, number: int, time: float) -> list[tuple[float, float, float]]:
        places = []
        for s, start, end in self.stands:
            if not start - 3.0 < time < end + 3.0:
                continue
            side = 1.0 if number % 2 else -1.0
            phase = (time + float(self.meetings[number])) % CROSSING_PERIOD_S
            lateral = side * (phase - 0.5 * CROSSING_PERIOD_S) * float(self.speeds[number])
            x, y, heading = self.course.at(s + CROSSING_M + 3.0 * (1.0 + side), lateral)
            places.append((float(x), float(y), float(heading) + side * 0.5 * math.pi))
        return places
