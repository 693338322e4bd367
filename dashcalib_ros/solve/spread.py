# SPDX-License-Identifier: Apache-2.0
"""How far the result may be off: one covariance of all that turns share.

Two things make it. The errors of tracks: each track is one measurement, as its observations share
errors (the sandwich). And what makes turns, and drives, differ beyond that: each may ask for a
focal length of its own, and each drive for a camera of its own. How much they differ is not known
before; each size in a range is as likely, and is weighed by how well it explains the turns. So two
turns say little of it, and several sharp ones that agree leave nothing of it.
"""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.problem.quadratic import Quadratic

# of fx: by how much turns may differ. Real ones do by 0.2 to 1 %, rendered ones by nothing
TURNS_DIFFER = (0.0, 0.0015, 0.003, 0.006, 0.012)
# of fx, alone or with as much over the picture in every other parameter: two units of one make
DRIVES_DIFFER = 0.02
# of likelihoods; beyond it the less likely case counts for nothing
LARGEST_LOG = 100.0


@dataclass(frozen=True)
class PictureSigma:
    """Standard deviation of where the camera sees a ray, the best common rotation removed, px.

    rms: over the picture. worst: where it is largest, mostly a corner.
    """

    rms: float
    worst: float

    def times(self, px: float) -> PictureSigma:
        """Return the same in pixels that are px times smaller."""
        return PictureSigma(px * self.rms, px * self.worst)


@dataclass(frozen=True)
class SigmaMap:
    """The same at single pixels. pixels: (m, 2), a grid over the picture; sigma: (m,), px."""

    pixels: Floats
    sigma: Floats

    @property
    def whole(self) -> PictureSigma:
        """Return the sigma over the whole picture."""
        return PictureSigma(float(np.sqrt(np.mean(self.sigma**2))), float(self.sigma.max()))


def sigma_over(moves: Floats, covariance: Floats) -> Floats:
    """Return (m,) the sigma of pixels, px, where the parameters have a covariance (n, n).

    moves: (m, 2, n) derivatives of pixels by the parameters, as sensitivity() returns them.
    """
    variances = np.einsum('mai,ij,maj->m', moves, covariance, moves)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


@dataclass(frozen=True)
class Posterior:
    """What turns know about what they share: the lens with n parameters, then the rest, m in all.

    lens: at the optimum of all turns. alike_in_all: (n, n) covariance of the lens's parameters by
    errors that all turns share: where a field is left that no lens makes, so is what looks like
    one. turns: the cost of each about that optimum, at the noise.
    earlier: (t,) whether a turn is of an earlier drive. prior: from the present values. differ:
    (d,) sizes of what makes turns differ, of fx. further: of what is known besides turns (a gyro).
    rivals: priors that may hold instead, each with the log of how much likelier it is before.
    """

    lens: Camera
    alike_in_all: Floats
    turns: tuple[Quadratic, ...]
    earlier: Mask
    prior: Quadratic
    differ: tuple[float, ...] = TURNS_DIFFER
    further: tuple[Quadratic, ...] = ()
    rivals: tuple[tuple[float, Quadratic], ...] = ()

    def of(self, places: Iterable[int]) -> Posterior:
        """Return what these turns know."""
        chosen = list(places)
        return replace(self, turns=tuple(self.turns[place] for place in chosen),
                       earlier=self.earlier[chosen])

    def without(self, place: int) -> Posterior:
        """Return what all turns but one know."""
        return self.of(n for n in range(len(self.turns)) if n != place)

    @property
    def alike(self) -> Posterior:
        """Return the same where nothing makes turns differ but the errors of their tracks."""
        return replace(self, differ=(0.0,))

    @property
    def own(self) -> Ints:
        """Return (n,) the places of the lens's parameters."""
        return np.arange(len(self.lens.params))

    @cached_property
    def total(self) -> Quadratic:
        """Return the cost of all turns and the prior, where turns do not differ."""
        return Quadratic.together([*self.turns, self.prior])

    @cached_property
    def offset(self) -> Floats:
        """Return (m,) how far the mean of these turns is off the optimum of all."""
        return self._informed[0]

    @cached_property
    def covariance(self) -> Floats:
        """Return (m, m) the covariance about the optimum of these turns.

        What is known besides moves that optimum by as much as it moves their mean.
        """
        return self._informed[1]

    @cached_property
    def _informed(self) -> tuple[Floats, Floats]:
        weights, means, covariances = self._cases
        away = means - self.total.optimum
        spread = np.einsum('c,cij->ij', weights, covariances) + (weights * away.T) @ away
        # the prior is right for lenses; a picture of which a side was cut off has its centre
        # elsewhere: by how much it has drawn the result
        drawn = self.total.covariance[:, 2:4] @ self.prior.score[2:4]
        spread += np.outer(drawn, drawn)
        spread[np.ix_(self.own, self.own)] += self.alike_in_all
        found = np.asarray(weights @ means), np.asarray(spread)
        for cost in self.further:
            found = informed(*found, cost)
        return found

    def erring_together(self, size: float) -> Posterior:
        """Return it where all turns may be off by the same share of fx, with a sigma of size."""
        along = size * self._along_fx[self.own]
        return replace(self, alike_in_all=self.alike_in_all + along @ along.T)

    @property
    def rival_share(self) -> float:
        """Return the probability that another prior holds than the one of the optimum."""
        weights = self._cases[0]
        return float(weights[len(weights) // (1 + len(self.rivals)):].sum())

    @cached_property
    def of_another_drive(self) -> float:
        """Return the evidence that earlier drives had another camera, in nats; 0: no such turns.

        Over that for the same camera, both as likely before.
        """
        if self.earlier.all() or not self.earlier.any():
            return 0.0
        logs = np.array([[self._case(turns, drives, self.prior)[0] for turns in self.differ]
                         for drives in self._drives])
        same, *others = np.logaddexp.reduce(logs, axis=1)
        return float(np.logaddexp.reduce(others) - np.log(len(others)) - same)

    @cached_property
    def _cases(self) -> tuple[Floats, Floats, Floats]:
        """Return the weights (c,), means (c, m) and covariances (c, m, m) of all cases."""
        several = self.earlier.any() and not self.earlier.all()
        found = [(before + log, mean, covariance)
                 for before, prior in ((0.0, self.prior), *self.rivals) for turns in self.differ
                 for drives in (self._drives if several else self._drives[:1])
                 for log, mean, covariance in [self._case(turns, drives, prior)]]
        logs = np.array([log for log, _, _ in found])
        weights = np.exp(np.maximum(logs - logs.max(), -LARGEST_LOG))
        return (weights / weights.sum(), np.array([mean for _, mean, _ in found]),
                np.array([covariance for _, _, covariance in found]))

    def _case(self, turns: float, drives: Floats, prior: Quadratic
              ) -> tuple[float, Floats, Floats]:
        """Return the evidence, in nats, the mean and the covariance of one case.

        turns: by how much they differ, of fx. drives: (m, d) columns by which they differ.
        """
        along = turns * self._along_fx
        log, groups = 0.0, []
        for earlier in (False, True):
            own = []
            for turn in (self.turns[n] for n in np.flatnonzero(self.earlier == earlier)):
                gain, turn = softened(turn, along) if turns else (0.0, turn)
                own.append(turn)
                log += gain
            if own:
                group = Quadratic.together(own)
                if earlier and drives.size:
                    gain, group = softened(group, drives)
                    log += gain
                groups.append(group)
        total = Quadratic.together([*groups, prior])
        covariance = total.covariance
        mean = covariance @ total.score
        log += 0.5 * float(total.score @ mean - np.linalg.slogdet(total.hessian)[1])
        # the sandwich; of priors the covariance is what they say
        noise = sum(group.by_track for group in groups) + prior.hessian
        return log, mean, covariance @ noise @ covariance

    @cached_property
    def _along_fx(self) -> Floats:
        """Return (m, 1) how all follow where fx is 100 % longer, as the turns let them."""
        column = self.total.covariance[:, :1]
        return np.asarray(self.lens.fx * column / column[0])

    @cached_property
    def _drives(self) -> tuple[Floats, ...]:
        """Return the cases of (m, d) columns by which drives differ: not at all, in fx, in all."""
        moves, _ = sensitivity(self.lens)
        by_unit = np.sqrt(np.mean(np.sum(moves**2, axis=1), axis=0))
        places = np.eye(len(self.prior.score))[:, self.own]
        return (places[:, :0], DRIVES_DIFFER * self._along_fx,
                DRIVES_DIFFER * self.lens.fx * places * (by_unit[0] / by_unit))


def informed(mean: Floats, covariance: Floats, cost: Quadratic) -> tuple[Floats, Floats]:
    """Return a mean (m,) and a covariance (m, m), updated by a cost as in a Kalman filter.

    The covariance may be singular, as where a parameter is held. The cost's hessian is taken for
    its information; its by_track does not count.
    """
    smaller = np.linalg.solve(np.eye(len(mean)) + covariance @ cost.hessian, covariance)
    return (np.asarray(mean + smaller @ (cost.score - cost.hessian @ mean)),
            np.asarray((smaller + smaller.T) / 2))


def softened(cost: Quadratic, columns: Floats) -> tuple[float, Quadratic]:
    """Return a cost where the truth may be off, for it alone, by columns times unit noise.

    columns: (m, d). Also the evidence, in nats, that it is so. by_track keeps its meaning, the
    covariance of the score; what makes the cost soft is in it.
    """
    inner = columns.T @ cost.hessian @ columns + np.eye(columns.shape[1])
    follow = cost.hessian @ columns
    spread = np.linalg.solve(inner, follow.T)
    pulled = np.linalg.solve(inner, columns.T @ cost.score)
    keep = np.eye(len(cost.score)) - follow @ np.linalg.solve(inner, columns.T)
    log = 0.5 * float(cost.score @ columns @ pulled - np.linalg.slogdet(inner)[1])
    return log, Quadratic(
        cost.hessian - follow @ spread, cost.score - follow @ pulled,
        keep @ cost.by_track @ keep.T + spread.T @ spread)
