# SPDX-License-Identifier: Apache-2.0
"""Statistics that a few bad values do not spoil, and lists that stay short.

Least squares with Cauchy's weights: an error counts by 1 / (1 + (error / scale)^2), so that wrong
matches, other cars and bumps count little. The fit is repeated with the weights of the one before.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask

T = TypeVar('T')

# of a normal distribution: its standard deviation over its median absolute deviation
MAD = 1.4826


def mad_sigma(errors: Floats) -> float:
    """Return the standard deviation of errors (n,) about 0, by their median size."""
    return MAD * float(np.median(np.abs(errors)))


def cauchy_weights(errors: Floats, scale: float | Floats) -> Floats:
    """Return the weights of errors of any shape; one as large as the scale counts half."""
    return np.asarray(1 / (1 + (errors / scale)**2))


@dataclass(frozen=True)
class LinearFit:
    """A weighted linear fit of k parameters to n measurements.

    params: (k,). off: (n,) how far each measurement is off, 0 or more. weights: (n,) that led to
    params; normal: (k, k) the normal matrix with these.
    """

    params: Floats
    off: Floats
    weights: Floats
    normal: Floats


def cauchy_fit(design: Floats, wanted: Floats, scale: Callable[[Floats], float] | Floats,
               rounds: int, weights: Floats | None = None, start: Floats | None = None,
               prior: Callable[[Floats], Floats] | None = None, power: int = 1) -> LinearFit:
    """Return the parameters that explain most of the measurements.

    design: (n, k) or, for measurements with two components, (n, 2, k), for a unit of each
    parameter; wanted: (n,) or (n, 2). scale: of the errors that count half, from how far (n,) the
    measurements are off, or known for each, (n,). rounds: of new weights. weights: (n,) without
    errors; start: (k,) the first parameters, else those with these weights. prior: (k,) to add to
    the normal matrix's diagonal, from the weights (n,). power: 2 for weights that fall twice as
    fast (Geman and McClure). A parameter that nothing determines becomes as small as possible.
    """
    given = np.ones(len(wanted)) if weights is None else weights
    count = design.shape[-1]
    rows = design.reshape(-1, count)

    def solved(weights: Floats) -> tuple[Floats, Floats]:
        weighted = (design.T * weights).T.reshape(-1, count).T
        normal = weighted @ rows
        if prior is not None:
            normal += np.diag(prior(weights))
        moment = weighted @ wanted.reshape(-1)
        return np.asarray(np.linalg.lstsq(normal, moment, rcond=None)[0]), normal

    def off_by(params: Floats) -> Floats:
        left = wanted - design @ params
        return np.abs(left) if left.ndim == 1 else np.linalg.norm(left, axis=1)

    now = given
    params, normal = solved(now) if start is None else (start, np.zeros((len(start),) * 2))
    for _ in range(rounds):
        off = off_by(params)
        now = given * cauchy_weights(off, scale(off) if callable(scale) else scale)**power
        params, normal = solved(now)
    return LinearFit(params, off_by(params), now, normal)


def jackknife(estimate: Callable[[Mask], Floats], group: Ints, count: int) -> Floats:
    """Return the standard deviation of an estimate by leaving out each group in turn.

    estimate: from the measurements (n,) that count. group: (n,) from 0, of which there are count.
    """
    without = np.array([estimate(group != left) for left in range(count)])
    return np.asarray(np.sqrt((count - 1) * np.var(without, axis=0)))


@dataclass(frozen=True)
class Mean:
    """A weighted mean of n values. variance: by the values' own; squares: chi-squared, n - 1."""

    value: float
    variance: float
    squares: float
    count: int

    @property
    def widened(self) -> float:
        """Return the variance, larger where the values differ by more than theirs explain."""
        return self.variance * max(1.0, self.squares / max(self.count - 1, 1))


def weighted_mean(values: Floats, variances: Floats) -> Mean:
    """Return the mean of values (n,) with variances (n,)."""
    weights = 1 / variances
    mean = float(weights @ values / weights.sum())
    return Mean(mean, 1 / float(weights.sum()), float(weights @ (values - mean)**2), len(values))


def weighted_median(values: Floats, weights: Floats) -> float:
    """Return the value at which half of the weights is reached; values, weights: (n,)."""
    order = np.argsort(values, kind='stable')
    passed = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(passed, passed[-1] / 2)])


class EvenlySpaced(Generic[T]):
    """Items at stamps that are spread evenly over a drive; more only make them denser.

    When there are too many, every other one goes, and the next ones come half as often.
    """

    def __init__(self, period_s: float, capacity: int) -> None:
        """period_s: between two items, at first. capacity: items at most."""
        self.items: list[tuple[int, T]] = []
        self._period_ns = period_s * 1e9
        self._capacity = capacity

    def wants(self, stamp_ns: int) -> bool:
        """Return whether enough time has passed since the last item."""
        return not self.items or not 0 <= stamp_ns - self.items[-1][0] < self._period_ns

    def append(self, stamp_ns: int, item: T) -> None:
        """Take an item."""
        self.items.append((stamp_ns, item))
        if len(self.items) > self._capacity:
            self.items = self.items[::2]
            self._period_ns *= 2
