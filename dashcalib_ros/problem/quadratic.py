# SPDX-License-Identifier: Apache-2.0
"""What a turn knows about the camera: its cost near the solution, as a quadratic function.

Around the solution a turn's cost changes with a step d of the parameters by

    d' H d - 2 g' d

where H, the hessian, is the turn's information about the parameters, and g, the score, says where
the turn alone would rather go. All that is said about a camera's uncertainty comes from a few
operations on such functions: those of several turns are added up, and a prior is one more of
them; parameters are fixed at the solution, or left free and eliminated; the sum has an optimum and
a covariance. So nothing has to be adjusted again to know the camera without a turn, or with more
coefficients.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dashcalib_ros.arrays import Floats, Ints

NONE = np.zeros(0)


@dataclass(frozen=True)
class Quadratic:
    """A cost about m parameters: hessian (m, m); score (m,), half its negative gradient.

    by_track: (m, m) the sum over tracks of the outer products of their scores: the covariance of
    the score where each track is one measurement, as its observations may share an error.
    """

    hessian: Floats
    score: Floats
    by_track: Floats

    @staticmethod
    def prior(information: Floats, further: Floats = NONE, score: Floats | None = None
              ) -> Quadratic:
        """Return a prior about n parameters, and about e further ones that are independent.

        information: (n, n) the inverse of its covariance; further: (e,) likewise. score: (n + e,)
        how the prior draws at the solution; 0 where it is not given.
        """
        count, size = len(information), len(information) + len(further)
        hessian = np.zeros((size, size))
        hessian[:count, :count] = information
        hessian[count:, count:] = np.diag(further)
        return Quadratic(hessian, np.zeros(size) if score is None else score,
                         np.zeros((size, size)))

    @staticmethod
    def together(costs: Iterable[Quadratic]) -> Quadratic:
        """Return the sum of costs about the same parameters: of several turns, of a prior."""
        parts = list(costs)
        return Quadratic(np.sum([part.hessian for part in parts], axis=0),
                         np.sum([part.score for part in parts], axis=0),
                         np.sum([part.by_track for part in parts], axis=0))

    def at_noise(self, variance: float) -> Quadratic:
        """Return the cost in units of the noise: a cost of 1 is what one sigma makes."""
        return Quadratic(self.hessian / variance, self.score / variance,
                         self.by_track / variance**2)

    def curved(self, factor: float) -> Quadratic:
        """Return the cost with another curvature and the same gradient."""
        return Quadratic(factor * self.hessian, self.score, self.by_track)

    def of(self, places: Sequence[int] | Ints) -> Quadratic:
        """Return the cost about these parameters; the others are fixed at the solution."""
        places = np.asarray(places)
        block = np.ix_(places, places)
        return Quadratic(self.hessian[block], self.score[places], self.by_track[block])

    def eliminated(self, count: int) -> Quadratic:
        """Return the cost about all but the first parameters, those being at their optimum.

        They follow each step of the others (Schur complement).
        """
        first, rest = slice(count), slice(count, None)
        follow = np.linalg.solve(self.hessian[first, first], self.hessian[first, rest])
        combine = np.concatenate([-follow.T, np.eye(len(self.score) - count)], axis=1)
        return Quadratic(
            self.hessian[rest, rest] - self.hessian[rest, first] @ follow,
            self.score[rest] - follow.T @ self.score[first],
            combine @ self.by_track @ combine.T)

    def moved(self, step: Floats) -> Quadratic:
        """Return the same cost about another place, a step (m,) away."""
        return Quadratic(self.hessian, self.score - self.hessian @ step, self.by_track)

    def change(self, step: Floats) -> float:
        """Return by how much a step (m,) changes the cost."""
        return float(step @ self.hessian @ step - 2 * self.score @ step)

    @property
    def optimum(self) -> Floats:
        """Return the step (m,) to the least cost."""
        return np.asarray(np.linalg.solve(self.hessian, self.score))

    @cached_property
    def covariance(self) -> Floats:
        """Return (m, m) the covariance of the optimum, where residuals are independent."""
        return np.asarray(np.linalg.inv(self.hessian))

    @property
    def chance(self) -> float:
        """Return by how much noise alone makes the optimum lower, each track one measurement."""
        return float(np.sum(self.covariance * self.by_track))
