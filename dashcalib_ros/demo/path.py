# SPDX-License-Identifier: Apache-2.0
"""Where the rear axle goes: straights and turns joined by clothoids."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d

from dashcalib_ros.arrays import Floats
from dashcalib_ros.demo.spec import DriveSpec

STEP_M = 0.05
# steering takes time: the curvature ramps up over this length
RAMP_M = 5.0


@dataclass(frozen=True)
class Straight:
    """A street's axis as driven. start: (2,) m; heading rad; length m; first: its arc length."""

    start: Floats
    heading: float
    length: float
    first: float


@dataclass(frozen=True)
class Course:
    """The path by arc length s (n,) in metres: x, y in metres, heading in rad, curvature 1/m.

    turn_s: arc length of each turn's middle. straights: one more than there are turns.
    """

    s: Floats
    x: Floats
    y: Floats
    heading: Floats
    curvature: Floats
    turn_s: tuple[float, ...]
    straights: tuple[Straight, ...]

    @property
    def length(self) -> float:
        """Return the path's length in metres."""
        return float(self.s[-1])

    def at(self, s: npt.ArrayLike, left_m: float = 0.0) -> tuple[Floats, Floats, Floats]:
        """Return x, y, heading at arc lengths, left_m beside the path; straight beyond ends."""
        s = np.asarray(s, np.float64)
        heading = np.interp(s, self.s, self.heading)
        over = s - np.clip(s, 0.0, self.length)
        x = np.interp(s, self.s, self.x) + over * np.cos(heading) - left_m * np.sin(heading)
        y = np.interp(s, self.s, self.y) + over * np.sin(heading) + left_m * np.cos(heading)
        return x, y, heading


def course_of(spec: DriveSpec) -> Course:
    """Lay out the path of a drive, starting at the origin along x."""
    turns = spec.turn_list
    lengths = [spec.lead_m, *[spec.straight_m] * (len(turns) - 1), spec.lead_m]
    if not turns:
        lengths = [max(2.0 * spec.lead_m, 100.0)]
    if not turns and spec.kind == 'drive':
        lengths = [max(2.0 * spec.lead_m, spec.duration_s * spec.speed_mps)]
    pieces = []
    marks = []
    turn_s = []
    travelled = 0.0
    for i, length in enumerate(lengths):
        marks.append((travelled, length))
        pieces.append(np.zeros(round(length / STEP_M)))
        travelled += len(pieces[-1]) * STEP_M
        if i < len(turns):
            angle = math.radians(turns[i].angle_deg)
            count = max(1, round(abs(angle) * turns[i].radius_m / STEP_M))
            pieces.append(np.full(count, angle / (count * STEP_M)))
            turn_s.append(travelled + 0.5 * count * STEP_M)
            travelled += count * STEP_M
    curvature = np.concatenate(pieces)
    curvature = uniform_filter1d(curvature, round(RAMP_M / STEP_M) | 1, mode='constant')
    s: Floats = np.arange(curvature.size + 1) * STEP_M
    heading = np.concatenate([[0.0], np.cumsum(curvature) * STEP_M])
    middle = 0.5 * (heading[1:] + heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(np.cos(middle)) * STEP_M])
    y = np.concatenate([[0.0], np.cumsum(np.sin(middle)) * STEP_M])
    straights = []
    for first, length in marks:
        k = min(int((first + 0.5 * length) / STEP_M), x.size - 1)
        direction = np.array([math.cos(heading[k]), math.sin(heading[k])])
        start = np.array([x[k], y[k]]) - direction * (s[k] - first)
        straights.append(Straight(start, float(heading[k]), length, first))
    full = np.concatenate([curvature, curvature[-1:]])
    return Course(s, x, y, heading, full, tuple(turn_s), tuple(straights))
