# SPDX-License-Identifier: Apache-2.0
"""The steps that lower the cost of a problem over its free blocks, structures included.

A step is the optimum of the linearised problem, inside the bounds of the blocks. Where no part of
it lowers the cost, it is damped (Levenberg-Marquardt). The tracks stay as they were measured.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.problem.blocks import ImageBlock, Imaging, Seen
from dashcalib_ros.problem.normal import (
    Follow,
    Linear,
    Noise,
    damping,
    linearised,
    moved_by,
    noise_of,
    normal_equations,
)
from dashcalib_ros.problem.observations import Stretch
from dashcalib_ros.problem.quadratic import NONE, Quadratic

# shares of a step that are tried, the longest first: safe steps are a little short
PARTS = (1.3, 0.7, 0.3, 0.1, 0.02)
# the region in which the linearisation is trusted at first, where it is not trusted everywhere,
# and the greatest one
FIRST_RADIUS, LARGEST_RADIUS = 1e4, 1e16
# of the gain that was expected; a damped step that gains less is not taken
WORTH = 1e-3
# of poses and points, where a step does not lower the cost at once
SETTLING = 3
# steps in a row that lower nothing
FAILURES = 5
# of the cost, in units of the noise: by how much a step of what is shared lowers it at most
# where it is the last one, 0.2 of a sigma
SETTLED = 0.04
# eigenvalues below this share of the largest, each parameter in its own unit: of a direction that
# nothing determines
SINGULAR = 1e-15
# of such a direction: parameters with a smaller part are not named
NAMED_PART = 0.3


class Undetermined(np.linalg.LinAlgError):
    """Nothing determines a direction of the parameters. names: of those that it consists of."""

    def __init__(self, text: str, names: tuple[str, ...] = ()) -> None:
        super().__init__(text)
        self.names = names


S = TypeVar('S', bound='State')


@dataclass(frozen=True)
class State:
    """The present state of a problem.

    stretches: each with its tracks as measured. inflation: of the noise, by errors that the
    observations of a track share. last: (m,) the last step of what is shared; empty for none.
    """

    imaging: Imaging
    stretches: tuple[Stretch, ...]
    inflation: float = 1.0
    last: Floats = field(default_factory=lambda: NONE)

    @property
    def camera(self) -> Camera:
        """Return the lens."""
        return self.imaging.camera

    @cached_property
    def seen(self) -> list[Seen]:
        """Return where the used observations of each stretch are seen."""
        return [self.imaging.seen(stretch) for stretch in self.stretches]

    def noise(self, loss_px: float) -> Noise:
        """Return the noise of the residuals."""
        return noise_of(self.seen, len(self.camera.params), loss_px)

    def cost(self, loss_px: float, unit: float) -> float:
        """Return the robust cost of all residuals, in units (px^2) of the noise, and of priors."""
        total = sum(float(np.log1p(np.einsum('na,na->n', each.off, each.off) / loss_px**2).sum())
                    for each in self.seen)
        return loss_px**2 * total / unit + self.imaging.prior_cost(self.stretches)

    def linear(self, loss_px: float, safe: bool = False) -> list[Linear]:
        """Return the observations of each stretch, linearised."""
        return [linearised(each, loss_px, safe) for each in self.seen]

    def sized(self: S, imaging: Imaging, inflation: float) -> S:
        """Return it with other sizes of noise and priors: what is seen stays."""
        found = replace(self, imaging=imaging, inflation=inflation)
        found.__dict__['seen'] = self.seen
        return found


@dataclass(frozen=True)
class Stepping:
    """How to step, and when to end.

    steps: at most. unit: px^2 of the noise; None: of the residuals. settled: a step that is
    expected to lower the cost by less, by what is shared, is the last one; tolerance: one that
    changes it by a smaller share. radius: in which the linearisation is trusted at first.
    """

    loss_px: float
    steps: int
    unit: float | None = None
    settled: float = 0.0
    tolerance: float = 0.0
    radius: float = np.inf


def optimised(start: S, how: Stepping,
              chosen: Callable[[S, Sequence[Linear], int], S] = lambda now, linear, n: now) -> S:
    """Return the state after steps that lower its cost.

    chosen: the state before step n, linearised, with the sizes of its priors. Raises Undetermined.
    """
    now, trust = start, _Trust(how.radius)
    for n in range(how.steps):
        now = replace(now, imaging=now.imaging.anchored(), last=NONE)
        linear = now.linear(how.loss_px, safe=True)
        now = chosen(now, linear, n)
        unit = how.unit or now.noise(how.loss_px).variance * now.inflation
        before = now.cost(how.loss_px, unit)
        for _ in range(FAILURES + 1):
            tried = _tried(now, linear, how.loss_px, unit, before, trust)
            if tried.lowers or abs(tried.gain) <= how.tolerance * before:
                break
            trust = trust.less()
        else:
            # no step lowers the cost: this is as low as it gets
            return now
        if not tried.lowers:
            return now
        now = tried.after
        if ((tried.shared_gain < how.settled and trust.whole)
                or tried.gain <= how.tolerance * before):
            break
        trust = _Trust(how.radius) if how.radius == np.inf else trust.more(tried.worth)
    return now


@dataclass(frozen=True)
class _Trust:
    """The region in which the linearisation is trusted; shrink: what a failure divides it by."""

    radius: float
    shrink: float = 2.0

    @property
    def whole(self) -> bool:
        return self.radius == np.inf

    def less(self) -> _Trust:
        return _Trust(min(self.radius / self.shrink, FIRST_RADIUS), 2 * self.shrink)

    def more(self, worth: float) -> _Trust:
        """Return the region after a step that gained so much of what was expected."""
        return _Trust(min(self.radius / max(1 / 3, 1 - (2 * worth - 1)**3), LARGEST_RADIUS))


@dataclass(frozen=True)
class _Tried(Generic[S]):
    """The state after a step that was tried, and by how much it lowers the cost.

    worth: of what was expected; shared_gain: what the step of what is shared should gain.
    """

    after: S
    lowers: bool = False
    gain: float = -np.inf
    worth: float = 0.0
    shared_gain: float = 0.0


def _tried(now: S, linear: Sequence[Linear], loss_px: float, unit: float, before: float,
           trust: _Trust) -> _Tried[S]:
    """Return the longest part of a step that lowers the cost, or the last one that was tried."""
    try:
        step = _Step.of(now, linear, unit, trust.radius)
    except np.linalg.LinAlgError:
        if trust.whole:
            raise
        return _Tried(now)
    tried = _Tried(now)
    for part in PARTS if trust.whole else (1.0,):
        after = step.taken(now, part)
        for tries in range(SETTLING if trust.whole else 1):
            if tries:
                # far from the optimum poses and points follow in a curve
                after = _settled(after, loss_px, unit)
            gain = before - after.cost(loss_px, unit)
            tried = _Tried(after, gain > (0.0 if trust.whole else WORTH * step.expected), gain,
                           gain / max(step.expected, 1e-300), part * step.shared_gain)
            if tried.lowers:
                return tried
    return tried


def _settled(now: S, loss_px: float, unit: float) -> S:
    """Return the state with poses and points one step nearer to what all else asks of them."""
    linear = [linearised(each, loss_px, safe=True, alone=True) for each in now.seen]
    follows = [normal_equations(each, unit).follow(NONE) for each in linear]
    still = np.zeros(len(now.imaging.names))
    return replace(_Step(still, follows, 0.0, 0.0).taken(now, 1.0), last=now.last)


@dataclass(frozen=True)
class _Step:
    """A step of what is shared (m,), and how each stretch follows it.

    shared_gain: by how much what is shared should lower the cost; expected: all.
    """

    shared: Floats
    follows: list[Follow]
    shared_gain: float
    expected: float

    @classmethod
    def of(cls, now: State, linear: Sequence[Linear], unit: float, radius: float) -> _Step:
        normals = [normal_equations(each, unit, radius=radius) for each in linear]
        total = Quadratic.together([now.imaging.prior(), *(
            normal.cost.at_noise(unit) for normal in normals)])
        if radius < np.inf and len(total.score):
            own = np.sum([np.diag(each.shared[:, :-1]) for each in linear], axis=0)
            total = replace(total, hessian=total.hessian + np.diag(damping(own, radius)) / unit)
        step = bounded(total, now.imaging)
        gain = float(total.score @ step)
        return cls(step, [normal.follow(step) for normal in normals], gain,
                   gain + sum(normal.gain for normal in normals) / unit)

    def taken(self, now: S, part: float) -> S:
        imaging, stretches = now.imaging.moved(part * self.shared), []
        for follow, stretch in zip(self.follows, now.stretches, strict=True):
            stretches.append(moved_by(stretch, follow, part))
            for name, step in follow.images.items():
                block = imaging.blocks[name]
                assert isinstance(block, ImageBlock)
                imaging = imaging.having(block.moved_in(stretch, part * step))
        return replace(now, imaging=imaging, stretches=tuple(stretches),
                       last=part * self.shared)


def bounded(total: Quadratic, imaging: Imaging) -> Floats:
    """Return the step (m,) to the optimum inside the bounds of the blocks.

    What would go beyond its bound stays at it, and the others go to their optimum then. Raises
    Undetermined.
    """
    step, held = solution(total, imaging), np.zeros(len(total.score), bool)
    for _ in range(2):
        inside = imaging.clipped(step)
        held |= np.abs(inside - step) > 1e-9 * (np.abs(step) + 1e-9)
        if not held.any():
            break
        step, rest = inside, np.flatnonzero(~held)
        step[rest] = np.linalg.solve(
            total.hessian[np.ix_(rest, rest)],
            total.score[rest] - total.hessian[np.ix_(rest, held)] @ step[held])
    return step


def solution(total: Quadratic, imaging: Imaging) -> Floats:
    """Return the step (m,) to the least cost; raises Undetermined where nothing determines it."""
    scale = 1 / np.sqrt(np.maximum(np.diag(total.hessian), 1e-300))
    try:
        scaled = total.hessian * scale[:, None] * scale
        np.linalg.cholesky(scaled + SINGULAR * np.eye(len(scale)))
        return np.asarray(np.linalg.solve(total.hessian, total.score))
    except np.linalg.LinAlgError as error:
        if not np.isfinite(scaled).all():
            raise Undetermined('residuals are not numbers') from error
        direction = np.abs(np.linalg.eigh(scaled)[1][:, 0])
        names = tuple(name for name, part in zip(imaging.names, direction, strict=True)
                      if part > NAMED_PART * direction.max())
        raise Undetermined(f'nothing determines {", ".join(names)}', names) from error
