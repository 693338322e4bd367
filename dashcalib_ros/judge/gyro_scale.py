# SPDX-License-Identifier: Apache-2.0
"""The scale of a gyro, from the headings of GPS: no picture has a part in it.

Between two straights of a drive a car turned by the difference of their headings, whatever the
camera is, and the gyro by s times that, and by its bias times the time between. A line through
all such differences, by generalised least squares, has s as its slope: neighbours share a heading,
and a gyro's noise adds up with the time between.
"""
from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.input.motion import Samples


@dataclass(frozen=True)
class Straight:
    """Fixes of GPS along a line, in the order in which they were driven.

    stamps_s: (n,). direction: (2,) east and north, of unit length. along, left: (n,) m, where the
    fixes are from their mean, along the line and to its left.
    """

    stamps_s: Floats
    direction: Floats
    along: Floats
    left: Floats

    @property
    def heading(self) -> float:
        """Return the heading, rad, from east to the left."""
        return float(np.arctan2(self.direction[1], self.direction[0]))

    @property
    def spread_m2(self) -> float:
        """Return the sum of squares along the way."""
        return float(self.along @ self.along)

    @property
    def off_m2(self) -> float:
        """Return the sum of squares across the way."""
        return float(self.left @ self.left)

    @property
    def freedom(self) -> int:
        """Return how many fixes there are beyond those that a line needs."""
        return len(self.left) - 2


@dataclass(frozen=True)
class _Stretch:
    """A straight as the gyro has it. yaw: rad, in its middle; piece: between gaps of samples."""

    straight: Straight
    stamp_s: float
    yaw: float
    piece: int


# a scale farther off is one of units, or of another drive
SCALES = (0.7, 1.4)
# a scale with a larger sigma says less than that gyros are good to 3 %
LARGEST_SIGMA = 0.05


def scale_by_gps(rate: Samples, position: Samples) -> tuple[float, float] | None:
    """Return a gyro's angles over the true ones, and the sigma; None where too little tells.

    rate: rad/s about the sensor's axes, mounted in any way. position: m, east and north first.
    """
    _, axes = np.linalg.eigh(rate.values.T @ rate.values)
    about_upright = rate.values @ axes[:, -1]
    found = [each for sign in (1, -1)
             if (each := _fitted(_stretches(rate.stamps_s, sign * about_upright, position)))]
    # about the wrong way, the headings do not follow
    scale, sigma = max(found, default=(0.0, 0.0))
    return (scale, sigma) if SCALES[0] < scale < SCALES[1] and sigma < LARGEST_SIGMA else None


# degrees a second, and the seconds over which they are taken; a straight has less
STRAIGHT_DEG_S, RATE_OVER_S = 2.0, 1.0
# minimum duration and length of a straight, s and m; s that are left out at both ends, as clocks
# differ and receivers filter
STRAIGHT_S, STRAIGHT_M, ENDS_S = 2.0, 20.0, 0.7
# s between samples of a gyro; over more the angle between them is not known
LONGEST_GAP_S = 0.35


def _stretches(stamps_s: Floats, rate: Floats, position: Samples) -> list[_Stretch]:
    """Return where the car drove straight on. rate: (n,) rad/s to the left."""
    yaw = Samples(stamps_s, rate[:, None]).integral.values[:, 0]
    half = RATE_OVER_S / 2
    turning = np.interp(stamps_s + half, stamps_s, yaw) - np.interp(stamps_s - half, stamps_s, yaw)
    gap = np.r_[False, np.diff(stamps_s) > LONGEST_GAP_S]
    piece = np.cumsum(gap)
    straight = np.abs(turning) < np.radians(STRAIGHT_DEG_S) * RATE_OVER_S
    edges = np.flatnonzero(np.diff(np.r_[False, straight, False].astype(int)) | np.r_[gap, False])
    stretches = []
    for first, past in pairwise(edges):
        if not straight[first]:
            continue
        found = straight_between(stamps_s[first] + ENDS_S, stamps_s[past - 1] - ENDS_S, position,
                                 STRAIGHT_M, STRAIGHT_S, without_jumps=True)
        if found is not None:
            stamp_s = float(found.stamps_s.mean())
            stretches.append(_Stretch(found, stamp_s, float(np.interp(stamp_s, stamps_s, yaw)),
                                      int(piece[first])))
    return stretches


# minimum number of fixes of a straight: a line through two of them is always exact
FIXES = 3
# m; fixes of one receiver share errors of this size, which no residual shows
LEAST_NOISE_M = 0.05
# of the median distance from a straight; fixes beyond have jumped
JUMP = 4.0


def straight_between(begin_s: float, end_s: float, position: Samples, least_m: float,
                     least_s: float = 0.0, without_jumps: bool = False) -> Straight | None:
    """Return the line that was driven between two stamps; None where fixes tell none.

    least_m, least_s: its length, and the time. without_jumps: fixes far from the line do not
    count.
    """
    inside = (position.stamps_s >= begin_s) & (position.stamps_s <= end_s)
    when, where = position.stamps_s[inside], position.values[inside, :2]

    def too_few() -> bool:
        return len(where) < FIXES or bool(np.ptp(when) < least_s)

    for _ in range(2 if without_jumps else 0):
        if too_few():
            return None
        direction = _line_through(when, where).direction
        away = where - np.median(where, axis=0)
        off = np.abs(away @ np.array([-direction[1], direction[0]]))
        kept = off <= max(JUMP * float(np.median(off)), LEAST_NOISE_M)
        when, where = when[kept], where[kept]
    if too_few():
        return None
    found = _line_through(when, where)
    return None if np.ptp(found.along) < least_m else found


def _line_through(when: Floats, where: Floats) -> Straight:
    away = where - where.mean(axis=0)
    direction = np.linalg.svd(away, full_matrices=False)[2][0]
    direction = direction * np.sign(direction @ (where[-1] - where[0]))
    return Straight(when, direction, away @ direction,
                    away @ np.array([-direction[1], direction[0]]))


# degrees; what a heading is not better than: the aerial's place, and cambers
HEADING_FLOOR_DEG = 0.3
# degrees; a heading that is known worse says nothing
HEADING_SIGMA_DEG = 5.0
# degrees a root of a second: noise of cheap gyros
GYRO_NOISE_DEG = 0.1
# maximum time between straights, s; the bias drifts over more
APART_S = 60.0
# minimum number of straights, and of degrees between them in all
LEAST_STRAIGHTS, LEAST_TURNED_DEG = 6, 240.0


def _fitted(stretches: list[_Stretch]) -> tuple[float, float] | None:
    if len(stretches) < LEAST_STRAIGHTS:
        return None
    off_m2, spread_m2, freedom = (np.array([getattr(each.straight, name) for each in stretches])
                                  for name in ('off_m2', 'spread_m2', 'freedom'))
    own_m = np.sqrt(off_m2 / freedom)
    # three fixes may lie in a line by chance
    noise_m = np.maximum(own_m, max(float(np.median(own_m)), LEAST_NOISE_M))
    sigma = np.hypot(noise_m / np.sqrt(spread_m2), np.radians(HEADING_FLOOR_DEG))
    usable = sigma < np.radians(HEADING_SIGMA_DEG)
    stretches = [each for each, fits in zip(stretches, usable, strict=True) if fits]
    sigma = sigma[usable]
    pairs = [n for n, (a, b) in enumerate(pairwise(stretches))
             if a.piece == b.piece and b.stamp_s - a.stamp_s < APART_S]
    if len(pairs) < LEAST_STRAIGHTS - 1:
        return None
    heading, yaw, stamps_s = np.array([
        (each.straight.heading, each.yaw, each.stamp_s) for each in stretches]).T
    difference = np.zeros((len(pairs), len(stretches)))
    difference[np.arange(len(pairs)), pairs] = -1
    difference[np.arange(len(pairs)), np.array(pairs) + 1] = 1
    measured, apart_s = difference @ yaw, difference @ stamps_s
    # headings are known but for whole turns: the nearest to what the gyro says
    turned = difference @ heading
    turned = measured + np.angle(np.exp(1j * (turned - measured)))
    if np.degrees(np.abs(turned).sum()) < LEAST_TURNED_DEG:
        return None
    noise = np.diag(np.radians(GYRO_NOISE_DEG)**2 * apart_s)
    covariance = difference * sigma**2 @ difference.T + noise
    columns = np.stack([turned, apart_s], axis=1)
    information = np.linalg.inv(covariance)
    known = np.linalg.inv(columns.T @ information @ columns)
    found = known @ columns.T @ information @ measured
    left = measured - columns @ found
    # what differs by more than it should makes the sigma larger
    ratio = max(1.0, float(left @ information @ left) / max(len(pairs) - 2, 1))
    return float(found[0]), float(np.sqrt(ratio * known[0, 0]))
