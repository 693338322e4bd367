# SPDX-License-Identifier: Apache-2.0
"""How the car, and the camera in it, move along the path: speed, pitch, roll and bounce."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from dashcalib_ros.arrays import Floats
from dashcalib_ros.demo.path import STEP_M, Course
from dashcalib_ros.demo.spec import DriveSpec

TICK_S = 0.002
# the camera sits at the windscreen, this far ahead of the rear axle, a little off the middle
AHEAD_M = 1.7
ASIDE_M = 0.1
# body motion of an ordinary car, degrees per m/s^2
DIVE_DEG = 0.25
LEAN_DEG = 0.5
# time before the first and after the last frame: rows of a rolling shutter reach into it
MARGIN_S = 0.1
# m; bumps with shorter waves are lower in proportion
SHORT_M = 2.5


@dataclass(frozen=True)
class Ride:
    """The car's motion on a fine time grid t (n,) s.

    s: arc length m; x, y, lift: rear axle m; yaw, pitch (nose down positive), roll: rad.
    lever: camera in the body frame (x forward, y left, z up) m. mount: (3, 3) body from camera.
    """

    t: Floats
    s: Floats
    x: Floats
    y: Floats
    lift: Floats
    yaw: Floats
    pitch: Floats
    roll: Floats
    lever: Floats
    mount: Floats

    @property
    def duration(self) -> float:
        """Return the length of the ride in seconds."""
        return float(self.t[-1])

    def time_at(self, s: float) -> float:
        """Return when the rear axle first passes arc length s, in seconds."""
        return float(self.t[min(int(np.searchsorted(self.s, s)), self.t.size - 1)])

    def arc_at(self, t: float) -> float:
        """Return the arc length at time t, going on at the last speed beyond the ends."""
        inside = min(max(t, 0.0), self.duration)
        k = min(max(int(inside / TICK_S), 1), self.t.size - 1)
        speed = (self.s[k] - self.s[k - 1]) / TICK_S
        return float(np.interp(t, self.t, self.s) + (t - inside) * speed)

    def yaw_at(self, times: npt.ArrayLike) -> Floats:
        """Return the car's heading in rad at times (n,) s."""
        return np.interp(np.asarray(times, np.float64), self.t, self.yaw)

    def camera_at(self, times: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Return world-from-camera rotations (n, 3, 3) and positions (n, 3) m at times (n,) s."""
        times = np.atleast_1d(np.asarray(times, np.float64))
        yaw, pitch, roll, x, y, lift = (
            np.interp(times, self.t, values)
            for values in (self.yaw, self.pitch, self.roll, self.x, self.y, self.lift))
        body = _rotation_z(yaw) @ _rotation_y(pitch) @ _rotation_x(roll)
        position = np.stack([x, y, lift], axis=1) + body @ self.lever
        return body @ self.mount, position


def ride_of(course: Course, spec: DriveSpec) -> Ride:
    """Drive the course as the spec says."""
    if spec.kind == 'drive':
        t, s = _timetable(course, spec)
    else:
        t = np.arange(0.0, spec.duration_s + 2.0 * MARGIN_S, TICK_S)
        s = np.full_like(t, 0.5 * course.length)
    x, y, yaw = course.at(s)
    speed = np.gradient(s, TICK_S)
    forward = gaussian_filter1d(np.gradient(speed, TICK_S), 0.3 / TICK_S, mode='nearest')
    lateral = speed ** 2 * np.interp(s, course.s, course.curvature)
    lateral = gaussian_filter1d(lateral, 0.3 / TICK_S, mode='nearest')
    rng = np.random.default_rng([spec.seed, 2])
    rough = math.radians(spec.vibration_deg)
    body = 1.0 if spec.vibration_deg > 0.0 else 0.0
    shortest = spec.shortest_bump_m
    pitch = _undulation(rng, s, rough, shortest) - body * math.radians(DIVE_DEG) * forward
    roll = _undulation(rng, s, 0.7 * rough, shortest) + body * math.radians(LEAN_DEG) * lateral
    lift = _undulation(rng, s, 2.0 * rough, shortest)
    if spec.kind == 'spin':
        yaw = yaw + math.radians(70.0) * np.sin(2.0 * math.pi * t / 7.0)
    lever = np.array([AHEAD_M, ASIDE_M, spec.height_m])
    if spec.kind == 'spin':
        lever[:2] = 0.0
    mount = _mount(rng, spec.mount_deg)
    if (own := spec.mounting) is not None:
        lever = np.array([own.ahead_m, own.left_m, own.height_m])
        mount = _mounted(*np.radians([own.yaw_left_deg, -own.pitch_up_deg, own.roll_right_deg]))
    return Ride(t, s, x, y, lift, yaw, pitch, roll, lever, mount)


def _timetable(course: Course, spec: DriveSpec) -> tuple[Floats, Floats]:
    """Return t (n,) every TICK_S and the arc length s (n,) then, with speed and stops obeyed."""
    turning = np.abs(course.curvature) > 0.3 * max(float(np.abs(course.curvature).max()), 1e-9)
    limit = np.where(turning, spec.turn_speed_mps, spec.speed_mps) ** 2
    dwell: dict[int, float] = {}
    for stop in spec.stops:
        straight = course.straights[stop.before_turn]
        k = round((straight.first + 0.7 * straight.length) / STEP_M)
        limit[k] = 0.0
        dwell[k] = dwell.get(k, 0.0) + stop.seconds
    # v^2 grows by at most 2 a ds, forwards when it accelerates and backwards when it brakes
    ramp = 2.0 * spec.accel_mps2 * course.s
    squared = np.minimum.accumulate(limit - ramp) + ramp
    squared = (np.minimum.accumulate((squared + ramp)[::-1]))[::-1] - ramp
    speed = np.sqrt(np.maximum(squared, 0.0))
    steps = 2.0 * STEP_M / (speed[1:] + speed[:-1])
    nodes_t = np.concatenate([[0.0], np.cumsum(steps)])
    nodes_s = course.s
    for k in sorted(dwell, reverse=True):
        nodes_t = np.concatenate([nodes_t[:k + 1], nodes_t[k:] + dwell[k]])
        nodes_s = np.concatenate([nodes_s[:k + 1], nodes_s[k:]])
    t = np.arange(0.0, nodes_t[-1], TICK_S)
    return t, np.interp(t, nodes_t, nodes_s)


def _undulation(rng: np.random.Generator, s: Floats, rms: float, shortest_m: float) -> Floats:
    """Return a road's unevenness along s (n,) with the given RMS: wavelengths up to 25 m."""
    waves = np.geomspace(shortest_m, 25.0, 7) * rng.uniform(0.9, 1.1, 7)
    phases = rng.uniform(0.0, 2.0 * math.pi, 7)
    heights = np.minimum(waves / SHORT_M, 1.0) if shortest_m < SHORT_M else np.ones(len(waves))
    total = np.sin(2.0 * math.pi * s[:, None] / waves + phases) @ heights
    return np.asarray(total * rms / math.sqrt(3.5))


def _mount(rng: np.random.Generator, most_deg: float) -> Floats:
    """Return (3, 3) body from camera: nearly straight ahead, as stuck on by hand."""
    return _mounted(*np.radians(most_deg * rng.uniform(-1.0, 1.0, 3)))


def _mounted(yaw: float, pitch: float, roll: float) -> Floats:
    """Return (3, 3) body from camera, turned to the left, downwards and clockwise, rad."""
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turned = _rotation_z(np.array([yaw])) @ _rotation_y(np.array([pitch]))
    return np.asarray((turned @ _rotation_x(np.array([roll])))[0] @ axes)


def _rotation_x(angle: Floats) -> Floats:
    return _rotation(angle, 1, 2)


def _rotation_y(angle: Floats) -> Floats:
    return _rotation(angle, 2, 0)


def _rotation_z(angle: Floats) -> Floats:
    return _rotation(angle, 0, 1)


def _rotation(angle: Floats, first: int, second: int) -> Floats:
    """Return (n, 3, 3) rotations that turn axis first towards axis second by angles (n,) rad."""
    matrix = np.tile(np.eye(3), (angle.size, 1, 1))
    matrix[:, first, first] = matrix[:, second, second] = np.cos(angle)
    matrix[:, second, first] = np.sin(angle)
    matrix[:, first, second] = -np.sin(angle)
    return matrix
