"""What a solution says of its camera, as a normal distribution, and each turn of the others'."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.solve.information import Information, noise_of, step_to_wider_model
from dashcalib_ros.solve.picture import picture_covariance, sigma_over
from dashcalib_ros.solve.prior import extra_sigma_of
from dashcalib_ros.solve.solution import Solution

# fewer turns are not held out: one of two says little of the other
LEAST_TURNS = 3


def wider_covariance_of(solution: Solution) -> Floats:
    """Return the covariance of the wider model's parameters: the camera's own come first.

    Of those that this model has not, the step is all that is known.
    """
    covariance = picture_covariance(
        solution.camera, solution.parts, solution.prior_information, solution.floor,
        solution.step_to_wider_model, solution.systematic, solution.one_turn_sigma)
    if solution.doubt is not None:
        count = len(solution.doubt)
        covariance[:count, :count] += solution.doubt
    return covariance


def seen_by_turns(solution: Solution, given: Camera) -> Floats:
    """Return (n,) the parameters of the solution's model that turns find where given is true.

    given: of the solution's model, or of its wider one. Where it has coefficients that the
    solution holds at 0, the turns make up for them with their other parameters.
    """
    count = len(solution.camera.names())
    others = given.params[count:]
    if not len(others):
        return given.params
    lens = solution.parts[0].lens
    total = sum((part.hessian[:lens, :lens] for part in solution.parts), np.zeros((lens, lens)))
    own = total[:count, :count] + noise_of(solution.parts) * solution.prior_information
    return np.asarray(given.params[:count] + np.linalg.solve(own, total[:count, count:] @ others))


@dataclass(frozen=True)
class HeldOut:
    """A turn, and the calibration that was made without it.

    px: RMS over the picture of the difference between the camera of the other turns and the one
    of this turn alone, the best common rotation removed. sigma_px: of the camera of this turn
    alone; others_sigma_px: of the camera of the others. Good calibrations differ by less than the
    sum of both (mrcal's cross-validation). All are px of the pictures that were solved.
    """

    turn: TurnId
    px: float
    sigma_px: float
    others_sigma_px: float

    def times(self, px: float) -> HeldOut:
        """Return the same in pixels that are px times smaller."""
        return HeldOut(self.turn, px * self.px, px * self.sigma_px, px * self.others_sigma_px)

    @property
    def sigmas(self) -> float:
        """Return the difference in units of its own standard deviation."""
        return self.px / float(np.hypot(self.sigma_px, self.others_sigma_px))


def held_out(solution: Solution) -> tuple[HeldOut, ...]:
    """Return what each turn says of the calibration without it; () for fewer than three turns.

    At the solution each turn's cost is known as a quadratic function of the camera: neither
    camera needs a new adjustment.
    """
    parts = solution.parts
    if len(parts) < LEAST_TURNS:
        return ()
    camera, prior = solution.camera, solution.prior_information
    moves, _ = sensitivity(camera)
    systematic = solution.systematic

    noise, count = noise_of(parts), len(prior)
    balance = sum((part.score[:count] for part in parts), np.zeros(count))

    def camera_of(some: list[Information]) -> tuple[Floats, float]:
        """Return the parameters' offsets from the solution (n,), and the sigma over the picture.

        It is the sigma that a calibration of these turns would state, but for what one turn cannot
        show: that others differ from it is what is asked here.
        """
        total = sum((part.hessian[:count, :count] for part in some), noise * prior)
        # at the solution the prior balances the scores of all turns
        pull = sum((part.score[:count] for part in some), np.zeros(count)) - balance
        covariance = picture_covariance(
            camera, some, prior, solution.floor,
            step_to_wider_model(some, prior, extra_sigma_of(camera)), systematic)
        return (np.asarray(np.linalg.solve(total, pull)),
                _rms(sigma_over(moves, covariance[:count, :count])))

    found = []
    for n, scene in enumerate(solution.scenes):
        others, others_sigma = camera_of([part for m, part in enumerate(parts) if m != n])
        alone, sigma = camera_of([parts[n]])
        apart = _rms(np.linalg.norm(moves @ (alone - others), axis=1))
        found.append(HeldOut(scene.turn, apart, sigma, others_sigma))
    return tuple(found)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
