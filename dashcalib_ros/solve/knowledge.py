"""What all turns know together of a camera: its covariance, and what another model would do.

The covariance is taken in directions of the parameters that are independent of each other in the
picture. In each, the largest of three estimates counts:

- what the noise of the residuals makes of it: right if they were independent and the model exact;
- the same with each track as one measurement: residuals of one track may share an error (drift, a
  moving car);
- the scatter between turns, whatever makes them disagree: one number for all directions (Birge's
  ratio), for in one direction few turns say too little of it. It is itself uncertain: Student's t
  takes the place of the normal distribution, so that 2 sigma hold 95 %.

The square of the step to the wider model is added: the error of a model that real lenses do not
follow exactly. Where a field is left that no model has, camera_info is off by that, too; and the
field takes up errors that all tracks of a place share in all turns: then the second estimate is
not made smaller by the number of turns.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from statistics import NormalDist

import numpy as np

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.solve.prior import extra_sigma_of
from dashcalib_ros.solve.quadratic import Quadratic, TurnCost, noise_of

# a turn's information in a direction, as a share of its best one; with less it says nothing there
LEAST_SHARE = 1e-6
# noise variances of a track: a larger model, or a field, must predict turns so much better
LEAST_GAIN = 30.0
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
    return np.asarray(np.sqrt(variances))


@dataclass(frozen=True)
class Knowledge:
    """What turns know of a camera with n parameters, which is at the optimum of them all.

    turns: the cost of each turn. prior: at unit noise, of the p = n + e parameters that are free:
    the camera's, and what else turns share. floor: (n,) sigmas of systematic errors, which no
    number of turns averages out. systematic: by how much errors that tracks share inflate the
    second estimate. turns_err_alike: whether the errors of tracks are the same ones in all turns,
    so that these do not average them out: a field takes up what all tracks of a place share.
    one_turn_sigma: px by which fx differs between turns: a single one does not show that.
    """

    camera: Camera
    turns: tuple[TurnCost, ...]
    prior: Quadratic
    floor: Floats
    systematic: float = 1.0
    turns_err_alike: bool = False
    one_turn_sigma: float = 0.0

    def of(self, places: Iterable[int]) -> Knowledge:
        """Return what these turns know."""
        return replace(self, turns=tuple(self.turns[place] for place in places))

    def without(self, place: int) -> Knowledge:
        """Return what all turns but one know."""
        return self.of(n for n in range(len(self.turns)) if n != place)

    @property
    def noise(self) -> float:
        """Return the variance of a residual, px^2."""
        return noise_of(self.turns)

    @property
    def own(self) -> Ints:
        """Return (n,) the places of the camera's own parameters in a turn's cost."""
        return np.arange(len(self.camera.names()))

    @property
    def wider(self) -> Ints:
        """Return (lens,) the places of the wider model's parameters, the camera's own first."""
        return np.arange(self.turns[0].lens)

    @property
    def free(self) -> Ints:
        """Return (p,) the places of what is free: the wider model's others are fixed at 0."""
        first = self.turns[0]
        return np.concatenate([self.own, np.arange(first.lens, len(first.score))])

    def each(self, places: Ints) -> list[Quadratic]:
        """Return each turn's cost about these parameters, at unit noise."""
        return [turn.of(places).at_noise(self.noise) for turn in self.turns]

    def sum(self, places: Ints) -> Quadratic:
        """Return the cost of all turns about these parameters, px^2."""
        return Quadratic.together(turn.of(places) for turn in self.turns)

    def with_prior(self, turns: Iterable[Quadratic]) -> Quadratic:
        """Return the sum of costs about the camera's own parameters, and of its prior."""
        return Quadratic.together([*turns, self.prior.of(self.own)])

    @cached_property
    def total(self) -> Quadratic:
        """Return the cost of all turns and the prior about what is free, at unit noise."""
        total = Quadratic.together([*self.each(self.free), self.prior])
        # summed first: so a result stays the same to its last bit
        return replace(total, by_track=self.sum(self.free).by_track / self.noise**2)

    @cached_property
    def left(self) -> Floats:
        """Return (p,) the step to the optimum: 0 but for a field that was left in the tracks."""
        settled = np.diag(self.prior.hessian) == 0
        settled[self.own] = True
        return np.asarray(self.total.covariance @ self.total.settled(settled).score)

    @cached_property
    def turns_at_optimum(self) -> tuple[Quadratic, ...]:
        """Return each turn's cost about what is free, at unit noise, at the optimum of all."""
        return tuple(turn.moved(self.left) for turn in self.each(self.free))

    def offset_of(self, some: Knowledge) -> Floats:
        """Return (n,) how far the camera of some of these turns is off that of them all."""
        prior = Quadratic.prior(self.noise * self.prior.of(self.own).hessian)
        cost = Quadratic.together([prior, *(turn.of(self.own) for turn in some.turns)])
        # at the solution the prior balances the scores of all turns
        return np.asarray(np.linalg.solve(cost.hessian, cost.score - self.sum(self.own).score))

    # the wider model

    def _with_wider_prior(self, turns: Iterable[Quadratic], score: Floats | None = None
                          ) -> Quadratic:
        """Return the sum of costs about the wider model's parameters, and of their prior."""
        return Quadratic.together([*turns, Quadratic.prior(
            self.prior.of(self.own).hessian, 1 / np.square(extra_sigma_of(self.camera)), score)])

    @cached_property
    def step_to_wider_model(self) -> Floats:
        """Return (lens,) the Gauss-Newton step when all parameters of the wider model are free.

        Only those that this model does not have have a gradient. What else turns share is fixed.
        """
        total = self._with_wider_prior([self.sum(self.wider).at_noise(self.noise)])
        return total.settled(self.wider < len(self.own)).optimum

    @property
    def gains_of_wider_model(self) -> Floats:
        """Return by how much the wider model predicts each turn (t,) better, at unit noise.

        From the other turns. Both models' steps start from this model's solution; those of the
        narrower one leave the further coefficients at 0.
        """
        turns, own, gains = self.each(self.wider), self.own, []
        # at the solution the prior balances the turns' scores
        balance = np.where(self.wider < len(own), -Quadratic.together(turns).score, 0.0)
        for n, turn in enumerate(turns):
            others = self._with_wider_prior([*turns[:n], *turns[n + 1:]], balance)
            narrow = np.zeros(len(balance))
            narrow[own] = others.of(own).optimum
            gains.append(turn.change(narrow) - turn.change(others.optimum))
        return np.array(gains)

    def seen_by_turns(self, given: Camera) -> Floats:
        """Return (n,) the parameters of this model that turns find where given is true.

        given: of this model, or of its wider one. Where it has coefficients that are 0 here, the
        turns make up for them with their other parameters.
        """
        count = len(self.own)
        others = given.params[count:]
        if not len(others):
            return given.params
        turns = self.sum(self.wider).hessian
        hessian = turns[:count, :count] + self.noise * self.prior.of(self.own).hessian
        return np.asarray(
            given.params[:count] + np.linalg.solve(hessian, turns[:count, count:] @ others))

    # the covariance

    @cached_property
    def covariance(self) -> Floats:
        """Return the (lens, lens) covariance of the wider model's parameters.

        The camera's own come first; of the others only the step is known, which counts as an
        error.
        """
        count = len(self.own)
        covariance = np.outer(self.step_to_wider_model, self.step_to_wider_model)
        covariance[:count, :count] += self.own_covariance
        covariance[:count, :count] += self.covariance_between_turns
        return covariance

    @property
    def own_covariance(self) -> Floats:
        """Return the (n, n) covariance of the camera's parameters if the lens followed its model.

        Without what a single turn does not show.
        """
        left, block = self.left[self.own], np.ix_(self.own, self.own)
        alike = (len(self.turns) - 1) * self.total.covariance_by_track[block]
        return np.asarray(np.diag(self.floor**2) + np.outer(left, left) + self._largest_estimate
                          + self.turns_err_alike * alike)

    @property
    def covariance_between_turns(self) -> Floats:
        """Return the (n, n) covariance that few turns do not show: how much turns differ.

        Of a single turn the other parameters follow fx as the turn lets them make up for it.
        """
        if len(self.turns) > 1:
            shown = self._largest_estimate
            return np.asarray(max(self._variance_of_fx() / shown[0, 0] - 1, 0.0) * shown)
        own = self.total.covariance[0, self.own]
        along = self.one_turn_sigma * own / own[0]
        return np.outer(along, along)

    def _variance_of_fx(self) -> float:
        """Return the variance of fx if each turn may be off by one_turn_sigma more."""
        alone = [self.of([n]) for n in range(len(self.turns))]
        offsets = np.array([self.offset_of(each)[0] for each in alone])
        variances = np.array([each._largest_estimate[0, 0] for each in alone])
        return variance_if_turns_differ(offsets, variances, self.one_turn_sigma**2)

    @cached_property
    def _largest_estimate(self) -> Floats:
        root, count = np.linalg.cholesky(self.total.covariance), len(self.own)
        # a readout or a field, if there is one, moves nothing in the picture of a camera that
        # stands
        _, _, modes = np.linalg.svd(_triangle_of(self.camera) @ root[:count])
        basis = root @ modes.T
        back = modes @ np.linalg.inv(root)
        by_track = back @ self.total.covariance_by_track @ back.T
        # in these directions the covariance of the first estimate is the unit matrix
        estimates = [np.ones(len(modes)), self.systematic * np.diag(by_track)]
        if len(self.turns) > 1:
            scatter = scatter_between_turns(self.turns_at_optimum, self.total.covariance, basis)
            estimates.append(np.full(len(modes), scatter))
        own = basis[:count]
        return np.asarray(own * np.max(estimates, axis=0) @ own.T)

    @property
    def track_inflation(self) -> float:
        """Return by how much errors that a track's observations share inflate the variances."""
        own = np.diag(self.total.covariance)
        return max(float(np.median(np.diag(self.total.covariance_by_track) / own)), 1.0)

    @property
    def readout_sigma(self) -> float:
        """Return the sigma of a rolling shutter's readout, s: it is behind the camera's own."""
        place = len(self.own)
        return float(np.sqrt(max(
            self.total.covariance[place, place],
            self.systematic * self.total.covariance_by_track[place, place])))

    def sigma_map(self, field: Field | None = None) -> SigmaMap:
        """Return the sigma at a grid of pixels, those for which the camera has a viewing ray.

        field: what the camera leaves out.
        """
        moves, pixels = sensitivity(self.camera.widened())
        sigma = sigma_over(moves, self.covariance)
        if field is not None:
            sigma = np.hypot(sigma, np.linalg.norm(field.displacement(pixels), axis=-1))
        return SigmaMap(pixels, sigma)


@lru_cache(maxsize=4)
def _triangle_of(camera: Camera) -> Floats:
    """Return (n, n) QR's triangle of the picture's derivatives by the camera's parameters.

    It has the same directions as the many rows of pixels. Many sets of turns ask for it.
    """
    moves, _ = sensitivity(camera)
    return np.asarray(np.linalg.qr(moves.reshape(-1, moves.shape[2]), mode='r'))


def variance_if_turns_differ(offsets: Floats, variances: Floats, more: float,
                             still_more: bool = False) -> float:
    """Return the variance of a common value where each turn may be off by a variance more.

    offsets, variances: (t,) of what each of at least two turns says alone. Either turns differ as
    their noise says, or by that more: both are as likely before, and are weighed by how well they
    explain the turns. Several sharp turns that agree leave nothing of the second case; where one
    turn knows nearly all, it stays. still_more: where they differ by more than a case says, its
    variance grows with that.
    """
    logs, found = [], []
    for extra in (0.0, more):
        weights = 1 / (variances + extra)
        mean = float(np.average(offsets, weights=weights))
        squares = weights @ (offsets - mean)**2
        logs.append(0.5 * float(np.log(weights).sum() - np.log(weights.sum()) - squares))
        ratio = max(float(squares) / (len(offsets) - 1), 1.0) if still_more else 1.0
        found.append(ratio / float(weights.sum()) + mean**2)
    share = 1 / (1 + np.exp(min(logs[0] - logs[1], LARGEST_LOG)))
    return float((1 - share) * found[0] + share * found[1])


def scatter_between_turns(turns: Sequence[Quadratic], covariance: Floats, basis: Floats) -> float:
    """Return by how much turns scatter more than their noise explains: a ratio of variances.

    turns: at the optimum of all, at unit noise, about p parameters; covariance: (p, p) of that
    optimum. basis: (p, d) directions in which it is the unit matrix. The ratio is that of the
    d (t - 1) degrees of freedom that t turns have, times what makes 2 sigma hold 95 % (Student's
    t).
    """
    squares, freedom = 0.0, 0
    for turn in turns:
        # the covariance of a score where the model holds, the turns' own optimum counted
        expected = basis.T @ (turn.hessian - turn.hessian @ covariance @ turn.hessian) @ basis
        values, vectors = np.linalg.eigh(expected)
        known = values > LEAST_SHARE * max(float(values[-1]), LEAST_SHARE)
        squares += float(np.sum((turn.score @ basis @ vectors)[known]**2 / values[known]))
        freedom += int(known.sum())
    tail = t_over_normal(max(freedom * (1 - 1 / len(turns)), 1.0))
    return float(squares / max(freedom, 1) * tail**2)


def t_over_normal(freedom: float) -> float:
    """Return the ratio of the limits that hold 95 %: Student's t's to a normal distribution's.

    freedom: 1 or more. With t = sqrt(freedom) tan(a), the density is cos(a)^(freedom - 1). SciPy
    has the quantiles, but takes 0.13 s and 27 MB to load, in each process.
    """
    angles = np.linspace(0.0, np.pi / 2, 10_001)
    density = np.cos(angles)**(freedom - 1)
    below = np.cumsum(density[1:] + density[:-1])
    angle = np.interp(0.95 * below[-1], below, angles[1:])
    return float(np.sqrt(freedom) * np.tan(angle) / NormalDist().inv_cdf(0.975))


def is_clear(gains: Floats, least: float = LEAST_GAIN) -> bool:
    """Return whether the gains (n,) of turns, in noise variances of a track, are clear evidence.

    They must be larger in sum than least, and not come from one turn.
    """
    several = len(gains) < 2 or (np.sum(np.sort(gains)[:-1]) > 0
                                 and np.sum(gains > 0) > len(gains) / 2)
    return bool(gains.sum() > least and several)
