"""Cross-validation: what each turn says of the camera that was found without it."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.solve.knowledge import sigma_over
from dashcalib_ros.solve.solution import Solution

# fewer turns are not left out: one of two says little of the other
LEAST_TURNS = 3


@dataclass(frozen=True)
class LeftOut:
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

    def times(self, px: float) -> LeftOut:
        """Return the same in pixels that are px times smaller."""
        return LeftOut(self.turn, px * self.px, px * self.sigma_px, px * self.others_sigma_px)

    @property
    def sigmas(self) -> float:
        """Return the difference in units of its own standard deviation."""
        return self.px / float(np.hypot(self.sigma_px, self.others_sigma_px))


def cross_validation(solution: Solution) -> tuple[LeftOut, ...]:
    """Return what each turn says of the calibration without it; () for fewer than three turns.

    Neither camera needs a new adjustment. What one turn cannot show, that others differ from it,
    is left out of sigma: it is what is asked here.
    """
    known = replace(solution.known, one_turn_sigma=0.0)
    if len(known.turns) < LEAST_TURNS:
        return ()
    moves, _ = sensitivity(known.camera)
    block = np.ix_(known.own, known.own)
    found = []
    for n, scene in enumerate(solution.scenes):
        alone, others = known.of([n]), known.without(n)
        apart = moves @ (known.offset_of(alone) - known.offset_of(others))
        found.append(LeftOut(
            scene.turn, _rms(np.linalg.norm(apart, axis=1)),
            *(_rms(sigma_over(moves, some.covariance[block])) for some in (alone, others))))
    return tuple(found)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
