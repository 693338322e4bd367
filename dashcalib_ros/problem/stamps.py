# SPDX-License-Identifier: Apache-2.0
"""When images were taken, by the path of the car, where their stamps do not say it.

Stamps of arrival are off by some milliseconds, and those of a constant rate hide images that are
missing. A rolling shutter feels that: how fast a camera turns is how far, over the time. But a
car's speed is smooth.
"""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.problem.observations import Stretch
from dashcalib_ros.problem.trajectory import Trajectory

# of missing images: the speed between two keyframes over that beside it, 1.04 at most in turns of
# 40 drives without a loss, 1.11 at 3 images a second; and over how accurate the stamps are
PEAK, CLEAR = 1.3, 6.0
# of a way; a parked car has no speed
TINY = 1e-12
# s; stamps that are less inaccurate stay: with exact ones, a drive's turns seem to have 1.6 ms at
# most in the median. 3 ms of jitter made a readout of 20 ms 4 % short
INACCURATE_S = 0.002
# s between keyframes; in longer times a car changes its speed
LONGEST_S = 0.3
# weights of the third derivative of the way, over that of its values
WEIGHTS = 10.0 ** np.arange(-6, 7, 0.5)
S = TypeVar('S', bound=Stretch)


@dataclass(frozen=True)
class Times:
    """What the stamps of images do not say.

    frames: those after which images are missing while stamps hide it; missing_s: all of that time.
    inaccurate_s: spread of the stamps that were replaced; 0 for none.
    """

    frames: tuple[int, ...] = ()
    missing_s: float = 0.0
    inaccurate_s: float = 0.0


def timed_by_path(stretches: Iterable[S]) -> tuple[list[S], Times]:
    """Return the stretches with the times that their paths say, where stamps do not."""
    found, frames, missing = list[S](), list[int](), 0.0
    for stretch in stretches:
        path = stretch.trajectory
        hidden = missing_s(path)
        found.append(_later(stretch, np.cumsum([0.0, *hidden])))
        frames += stretch.tracks.frames[path.rows[:-1][hidden > 0]].tolist()
        missing += float(hidden.sum())
    late = [inaccurate_s(stretch.trajectory) for stretch in found]
    spread = float(np.median([each for _, each in late])) if late else 0.0
    if spread < INACCURATE_S:
        return found, Times(tuple(frames), missing)
    return [_later(stretch, -late_s) for stretch, (late_s, _) in zip(found, late, strict=True)
            ], Times(tuple(frames), missing, spread)


def missing_s(path: Trajectory) -> Floats:
    """Return (k - 1,) s between knots that the stamps hide, as images are missing there.

    A car's speed has no peak as short as that. Where stamps are inaccurate, a peak has a trough
    beside it.
    """
    seconds, ways = np.diff(path.seconds), _ways(path)
    late = np.zeros((2, len(seconds)))
    if not path.moves or len(seconds) < 5:
        return np.zeros(len(seconds))
    for n in range(2, len(seconds) - 2):
        beside = [n - 2, n - 1, n + 1, n + 2]
        speed = max(float(np.median(ways[beside] / seconds[beside])), TINY)
        for row, some in enumerate((slice(n, n + 1), slice(n - 1, n + 2))):
            late[row, n] = ways[some].sum() / speed - seconds[some].sum()
    least = np.maximum((PEAK - 1) * seconds, CLEAR * np.median(np.abs(late[0, 2:-2])))
    return np.asarray(np.where((late > least).all(axis=0), late[1], 0.0))


def inaccurate_s(path: Trajectory) -> tuple[Floats, float]:
    """Return (k,) by how much knots are stamped late, s, if speed is smooth; and their spread.

    The way over the stamps is smoothed, with the likeliest weight of its third derivative.
    """
    count = len(path.seconds)
    if (not path.moves or count < 8 or not _ways(path).all()
            or np.median(np.diff(path.seconds)) > LONGEST_S):
        return np.zeros(count), 0.0
    way, bent = np.cumsum([0.0, *_ways(path)]), np.eye(count)
    for order in (1, 2, 3):
        apart = (path.seconds[order:] - path.seconds[:-order]) / order / np.mean(np.diff(
            path.seconds))
        bent = np.diff(bent, axis=0) / apart[:, None]
    rough, patterns = np.linalg.eigh(bent.T @ bent)
    parts = patterns.T @ way

    # three patterns are not bent, and as many parameters are free
    def cost(weight: float) -> float:
        share = weight * rough[3:] / (1 + weight * rough[3:])
        squares = parts[3:]**2 @ share + TINY * way[-1]**2
        return float((count - 3) * np.log(squares) - np.log(share).sum())

    weight = min(WEIGHTS, key=cost)
    bent_by = weight * np.maximum(rough, 0.0) / (1 + weight * np.maximum(rough, 0.0))
    off = patterns @ (bent_by * parts)
    speed = np.gradient(way - off, path.seconds)
    late = -off / np.maximum(speed, 0.2 * np.median(speed))
    return late, float(np.sqrt(late @ late / max(bent_by.sum(), 1.0)))


def _later(stretch: S, seconds: Floats) -> S:
    """Return the stretch with its known keyframes so much later (k,), and others like them."""
    if not seconds.any():
        return stretch
    path, tracks = stretch.trajectory, stretch.tracks
    later = np.interp(np.arange(path.count), path.rows, seconds)
    return replace(stretch, tracks=replace(
        tracks, stamps_ns=tracks.stamps_ns + np.round(1e9 * later).astype(np.int64)))


def _ways(path: Trajectory) -> Floats:
    return np.asarray(np.linalg.norm(np.diff(path.centres, axis=0), axis=1))
