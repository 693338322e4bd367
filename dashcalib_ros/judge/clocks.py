# SPDX-License-Identifier: Apache-2.0
"""How late the stamps of positions and of speeds are, from the paths of the turns.

The camera's path over a turn is known but for its scale and heading. A receiver's fix, in the
plane, is

    fix(stamp) = place + exp(i heading) (scale path(t) + exp(i yaw(t)) lever),   t = stamp - offset

with path and yaw by the pictures, complex numbers in the plane. Each turn has its own place,
heading and scale; all share the lever arm from the camera to the aerial, the offset, and the pace
by which it changes. At one speed a lever arm forwards looks as an offset does: other speeds, and
turns to both sides, tell them apart. A speed adds up to the way, which has no heading.

The scale of a path by pictures wanders, which looks as an offset does where the car accelerates:
along the way errors have that covariance, across it that of a wandering heading.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera.rotation import centres_of
from dashcalib_ros.input.motion import Samples
from dashcalib_ros.judge.calibration import Witness
from dashcalib_ros.problem.observations import main_axis
from dashcalib_ros.reconstruct.scene import Scene

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Complex = npt.NDArray[np.complex128]

# s to either side: clocks of sensors in one car are not farther apart
LARGEST_OFFSET_S = 0.5
# of time, prior sigma of the pace of clocks: what a rate that was given with --fps may be off, as
# the frames of two real drives are
PACE = 0.005
# the same of two crystals: the scale of paths wanders too much to tell more
CRYSTALS = 1e-4
# m, prior sigma of the lever arm's components
LEVER_M = 2.5
# by how much the scale of a path by pictures, and its heading, wander within a turn, and how long
# they hold, s; paths of real drives are off by 1 to 4 % and 0.2 to 0.6 degrees
WANDER, HEADING_RAD, WANDER_S = 0.03, 0.01, 1.0
# s; what the offset by paths is not better than: KITTI's positions, whose clock a gyro knows, are
# -45, -24 and +13 ms off it
PATH_S = 0.02
# the same by rotations, of a sensor whose samples have been made of others: KITTI's poses, made of
# the nearest sample at 100 Hz, are -4 and +8 ms off
MADE_S = 0.004
# s; an offset that is known worse is not named, nor is a drift, of time
LARGEST_SIGMA_S, LARGEST_DRIFT_SIGMA = 0.05, 2e-4
# minimum number of fixes in a turn (with the five of 1 Hz, noise is taken for motion), and s
# between those that are used
LEAST_FIXES, APART_S = 8, 0.06
# sigmas between a path's offset and that of a gyro with the same stamps
ALIKE = 2.0
# steps of the fit, and those at which the noises are weighed anew
STEPS, WEIGHED = 30, (8, 18)
# m^2/s of a sensor's random walk, and the variance of one value over that of a second of it
NOISES, RATIOS = np.logspace(-6, 0, 13), np.logspace(-3, 2, 6)


@dataclass(frozen=True)
class Path:
    """A turn in the plane, by the pictures. yaw: rad to the left; each (k,)."""

    stamps_s: Floats
    places: Complex
    yaw: Floats


def paths_of(scenes: Sequence[Scene], start_s: float) -> list[Path]:
    """Return the turns' paths, in the plane in which most is turned. start_s: of the drive."""
    if not scenes:
        return []
    axis = main_axis(np.concatenate([np.diff(scene.turned, axis=0) for scene in scenes]))
    # y points down
    down, found = axis * np.sign(axis[1] or 1.0), []
    for scene in scenes:
        rows = scene.structure.registered
        rotations = scene.structure.rotations[rows]
        up = -np.sum(down @ rotations, axis=0)
        up /= np.linalg.norm(up)
        ahead = rotations[0][2] - up * (rotations[0][2] @ up)
        ahead /= np.linalg.norm(ahead)
        centres = centres_of(rotations, scene.structure.translations[rows])
        found.append(Path(scene.tracks.stamps_ns[rows] / 1e9 - start_s,
                          centres @ ahead + 1j * (centres @ np.cross(up, ahead)),
                          scene.turned @ down))
    return found


def offset_of(paths: Sequence[Path], samples: Samples, known: Witness | None = None
              ) -> Witness | None:
    """Return how late positions (n, 3), or speeds (n, 1), are; None where the turns do not tell.

    known: what a gyro with the same stamps says, which counts, too, where both agree.
    """
    found = _fitted(paths, samples)
    if found is None:
        return None
    offset_s, sigma_s = found.time_offset_s or 0.0, found.time_sigma_s or np.inf
    if not (sigma_s <= LARGEST_SIGMA_S and abs(offset_s) < LARGEST_OFFSET_S):
        return None
    if (known is None or known.time_offset_s is None
            or abs(known.time_offset_s - offset_s) >= ALIKE * sigma_s):
        return found
    return replace(found.timed(known),
                   time_sigma_s=float(np.hypot(known.time_sigma_s or 0.0, MADE_S)))


def of_steps(apart_s: Floats, ratio: float) -> Floats:
    """Return (k, k) the covariance of a sensor's steps, over times (k,), by its walk of a second.

    ratio: of the variance of each value at the ends of steps to that of the walk.
    """
    count = len(apart_s)
    return np.diag(apart_s + 2 * ratio) - ratio * (np.eye(count, k=1) + np.eye(count, k=-1))


def clock(offset_s: float, sigma_s: float, pace: float, pace_sigma: float) -> Witness:
    """Return what is known about a clock; its drift only where the drive is long enough."""
    long = pace_sigma <= LARGEST_DRIFT_SIGMA
    return Witness(offset_s, sigma_s, drift_ppm=1e6 * pace if long else None,
                   drift_sigma_ppm=1e6 * pace_sigma if long else None)


@dataclass(frozen=True)
class _Curve:
    """A path as a function of the time of the pictures; of a way, along the car's heading."""

    places: CubicSpline
    yaw: CubicSpline

    def inside(self, when: Floats) -> Mask:
        """Return which of the times (n,) are those of the path."""
        return np.asarray((when > self.yaw.x[0]) & (when < self.yaw.x[-1]))


def _curves(paths: Sequence[Path], plane: bool) -> list[_Curve]:
    """Return the paths; where not plane, the way forwards along each."""
    from scipy.interpolate import CubicSpline
    from scipy.linalg import block_diag
    ways = [np.diff(path.places) * np.exp(-0.5j * (path.yaw[1:] + path.yaw[:-1]))
            for path in paths]
    if not plane and ways:
        # a camera before the rear axle goes sideways where it turns; what is left of sideways
        # motion is that of a camera that does not look ahead
        each = np.concatenate([way / np.abs(way).sum() for way in ways])
        turned = block_diag(*(np.diff(path.yaw)[:, None] for path in paths))
        ahead = np.arctan(np.linalg.lstsq(np.c_[each.real, turned], each.imag, rcond=None)[0][0])
        ways = [(way * np.exp(-1j * ahead)).real for way in ways]
    return [_Curve(*(CubicSpline(path.stamps_s, values) for values in (
        path.places if plane else np.r_[0.0, np.cumsum(way)], path.yaw)))
        for path, way in zip(paths, ways, strict=True)]


@dataclass(frozen=True)
class _Rows:
    """What one turn's fixes leave in one direction: (m,), its derivatives (m, p) and noise.

    apart_s: (m,) between the fixes; wanders: (m, m) the covariance by what wanders.
    """

    left: Floats
    by_params: Floats
    apart_s: Floats
    wanders: Floats

    def whitened(self, noise: float, ratio: float) -> tuple[Floats, Floats, float]:
        """Return both in units of their noise, and the log of its size."""
        from scipy.linalg import solve_triangular
        root = np.linalg.cholesky(self.wanders + noise * of_steps(self.apart_s, ratio))
        white = solve_triangular(root, np.c_[self.left, self.by_params], lower=True)
        return white[:, 0], white[:, 1:], float(np.log(np.diag(root)).sum())


def _fitted(paths: Sequence[Path], samples: Samples) -> Witness | None:
    """Return what the turns say about the clock, at the middle of their times."""
    plane = samples.values.shape[1] > 1
    curves, middle_s = _curves(paths, plane), float(np.mean([
        path.stamps_s.mean() for path in paths])) if paths else 0.0
    samples = samples if plane else samples.integral
    kept = np.unique(np.floor((samples.stamps_s - samples.stamps_s[0]) / APART_S),
                     return_index=True)[1]
    stamps_s = samples.stamps_s[kept]
    values = samples.values[kept, 0] + 1j * (samples.values[kept, 1] if plane else 0.0)
    curves = [curve for curve in curves if curve.inside(stamps_s).sum() >= LEAST_FIXES]
    if not curves:
        return None
    # of each turn the log of its scale and its heading; the lever arm; the offset and the pace
    own, count = range(0, 2 * len(curves), 2), 2 * len(curves) + 4
    params = np.zeros(count)
    for place, curve in zip(own, curves, strict=True):
        some = curve.inside(stamps_s)
        path = curve.places(stamps_s[some])
        path, fixes = path - path.mean(), values[some] - values[some].mean()
        ratio = complex(np.vdot(path, fixes)) / float(np.vdot(path, path).real)
        if abs(ratio) == 0:
            return None
        params[place], params[place + 1] = np.log(abs(ratio)), np.angle(ratio) if plane else 0.0
    noises, prior = (1e-3, 1.0), np.r_[
        np.full(2 * len(curves), 1e-6), np.full(2, LEVER_M**-2), 1.0, CRYSTALS**-2]
    for number in range(STEPS):
        target = np.r_[params[:-4], np.zeros(4)]
        when = stamps_s - params[-2] - params[-1] * (stamps_s - middle_s)
        rows = [each for place, curve in zip(own, curves, strict=True)
                for each in _rows(curve, params, place, stamps_s, when, values, middle_s, plane)]
        if sum(len(each.left) for each in rows) <= count:
            return None
        if number in WEIGHED:
            noises = _likeliest(rows, prior)
        white = [each.whitened(*noises)[:2] for each in rows]
        jacobian = np.concatenate([by_params for _, by_params in white])
        hessian = jacobian.T @ jacobian + np.diag(prior)
        step = np.linalg.solve(hessian, jacobian.T @ np.concatenate([left for left, _ in white])
                               - prior * (params - target))
        step[-2] = np.clip(step[-2], -LARGEST_OFFSET_S / 2, LARGEST_OFFSET_S / 2)
        params = params + step
        if not np.isfinite(params).all() or abs(params[-2]) > 2 * LARGEST_OFFSET_S:
            return None
    sigmas = np.sqrt(np.diag(np.linalg.inv(hessian)))
    worse = max(_scatter(white), 1.0)
    return clock(float(params[-2]), float(np.hypot(worse * sigmas[-2], PATH_S)),
                 float(params[-1]), float(worse * sigmas[-1]) + PATH_S / float(
                     np.ptp(np.concatenate([curve.yaw.x for curve in curves]))))


def _rows(curve: _Curve, params: Floats, place: int, stamps_s: Floats, when: Floats,
          values: Complex, middle_s: float, plane: bool) -> list[_Rows]:
    """Return what a turn leaves along the way, and of places across it, from fix to fix."""
    some = curve.inside(when)
    if some.sum() < LEAST_FIXES:
        return []
    when, stamps_s = when[some], stamps_s[some]
    scale, turn = np.exp(params[place]), np.exp(1j * params[place + 1])
    path, yaw = curve.places(when), curve.yaw(when)
    arm = turn * np.exp(1j * yaw) if plane else np.zeros(len(yaw))
    aside = 1j * arm if plane else yaw
    seen = turn * scale * path + arm * params[-4] + aside * params[-3]
    moves = turn * scale * curve.places(when, 1) + curve.yaw(when, 1) * (
        1j * (arm * params[-4] + aside * params[-3]) if plane else params[-3])
    columns = np.zeros((len(when), len(params)), complex)
    columns[:, place] = turn * scale * path
    columns[:, place + 1] = 1j * seen if plane else 0.0
    columns[:, -4], columns[:, -3] = arm, aside
    columns[:, -2], columns[:, -1] = -moves, -moves * (stamps_s - middle_s)
    way = np.diff(seen)
    back = np.conj(way) / np.maximum(np.abs(way), 1e-9)
    left, by_params = back * np.diff(values[some] - seen), back[:, None] * np.diff(columns, axis=0)
    middle = (stamps_s[1:] + stamps_s[:-1]) / 2
    smooth = np.outer(np.abs(way), np.abs(way)) * np.exp(
        -0.5 * ((middle[:, None] - middle) / WANDER_S)**2)
    apart_s = np.diff(stamps_s)
    along = _Rows(left.real, by_params.real, apart_s, WANDER**2 * smooth)
    return [along, _Rows(left.imag, by_params.imag, apart_s, HEADING_RAD**2 * smooth)
            ] if plane else [along]


def _likeliest(rows: Sequence[_Rows], prior: Floats) -> tuple[float, float]:
    """Return the sensor's noises that explain the fixes best."""
    def badness(noises: tuple[float, float]) -> float:
        white = [each.whitened(*noises) for each in rows]
        jacobian = np.concatenate([by_params for _, by_params, _ in white])
        left = np.concatenate([each for each, _, _ in white])
        step = np.linalg.solve(jacobian.T @ jacobian + np.diag(prior), jacobian.T @ left)
        return 0.5 * float(np.sum((left - jacobian @ step)**2)) + sum(
            size for _, _, size in white)
    return min(product(NOISES.tolist(), RATIOS.tolist()), key=badness)


def _scatter(white: Sequence[tuple[Floats, Floats]]) -> float:
    """Return by how much the turns' own offsets differ, over what their noise explains."""
    off = []
    for left, by_params in white:
        own = by_params[:, np.flatnonzero(np.abs(by_params[:, :-4]).max(axis=0))]
        both = np.c_[own, by_params[:, -2]]
        covariance = np.linalg.pinv(both.T @ both)
        if covariance[-1, -1] > 0:
            off.append(float((covariance @ both.T @ left)[-1]) / np.sqrt(covariance[-1, -1]))
    return float(np.sqrt(np.mean(np.square(off)))) if off else 0.0
