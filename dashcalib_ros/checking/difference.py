"""How far a given camera is from a drive's own solution: in pixels, and in its full covariance.

The solution is a normal distribution of its n parameters. The given camera is a point among them,
at a Mahalanobis distance that chance explains or not. Which parameters make it far is asked by
leaving them out: what the rest alone is away from its own distribution.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.mapping import as_model, mapping_difference, sensitivity
from dashcalib_ros.checking.contradiction import LEAST_SIGMA
from dashcalib_ros.config import IntrinsicsConfig
from dashcalib_ros.solve.opinions import covariance_of, seen_by_turns
from dashcalib_ros.solve.picture import PictureSigma
from dashcalib_ros.solve.solution import Solution

Way = Literal['focal length', 'centre', 'distortion']
# the first parameters of every camera; all behind them are of the distortion
PLACES: dict[Way, tuple[int, ...]] = {'focal length': (0, 1), 'centre': (2, 3)}
# px; by this much cx and cy of two programs differ where their pixels begin elsewhere
HALF_PIXEL = 0.5
# how often chance alone exceeds the limit of a distance
CHANCE = 1e-3


@dataclass(frozen=True)
class Difference:
    """A given camera beside a solution, in the input's pixels.

    offsets: (n,) given minus found, for the solution's model; covariance: (n, n) of what was
    found, with what good calibrations may differ by. rms_px, worst_px: how far apart both see a
    ray, the best common rotation removed; None where they cannot be compared. sigma_px: of the
    solution. limit: of the distance, in sigmas; relevant_px: what a focal length
    RELEVANT of fx off would move.
    """

    given: Camera
    found: Camera
    offsets: Floats
    covariance: Floats
    rms_px: float | None
    worst_px: float | None
    sigma_px: PictureSigma
    relevant_px: float

    @property
    def limit(self) -> float:
        """Return the distance that chance alone exceeds once in a thousand drives."""
        return limit_of(len(self.offsets))

    @property
    def distance(self) -> float:
        """Return the Mahalanobis distance, in sigmas."""
        return distance(self.offsets, self.covariance)

    @property
    def significant(self) -> bool:
        """Return whether chance does not explain the distance."""
        return not self.distance <= self.limit

    @property
    def bound_px(self) -> float | None:
        """Return what the given camera's error over the picture stays below with 95 %."""
        return None if self.rms_px is None else self.rms_px + 2 * self.sigma_px.rms

    def ways(self) -> Mapping[Way, Floats]:
        """Return the fewest parts of the camera that explain the distance, the largest first.

        Each with its offsets that are left when the other parts are as the drive says.
        """
        left: list[Way] = ['focal length', 'centre', 'distortion']
        chosen: list[Way] = []
        while left:
            chosen.append(min(left, key=lambda way: self._without([*chosen, way])))
            left.remove(chosen[-1])
            count = len(self.offsets) - len(self._places(chosen))
            if self._without(chosen) <= limit_of(count):
                break
        places = np.array(self._places(chosen))
        rest = np.setdiff1d(np.arange(len(self.offsets)), places)
        # what the rest, as it is given, leads one to expect of the chosen parts
        expected = self.covariance[np.ix_(places, rest)] @ np.linalg.solve(
            self.covariance[np.ix_(rest, rest)], self.offsets[rest])
        own = dict(zip(places.tolist(), self.offsets[places] - expected, strict=True))
        return {way: np.array([own[place] for place in self._places([way])]) for way in chosen}

    def _without(self, ways: Sequence[Way]) -> float:
        rest = np.setdiff1d(np.arange(len(self.offsets)), self._places(ways))
        return distance(self.offsets[rest], self.covariance[np.ix_(rest, rest)])

    def _places(self, ways: Sequence[Way]) -> list[int]:
        count = len(self.offsets)
        return [place for way in ways for place in PLACES.get(way, range(4, count))]


def limit_of(count: int) -> float:
    """Return the Mahalanobis distance of so many parameters that chance exceeds with CHANCE."""
    from scipy import special
    return float(np.sqrt(special.chdtri(count, CHANCE))) if count else 0.0


def distance(offsets: Floats, covariance: Floats) -> float:
    """Return the Mahalanobis distance of offsets (n,); 0 for none."""
    return float(np.sqrt(offsets @ np.linalg.solve(covariance, offsets))) if len(offsets) else 0.0


def difference_of(given: Camera, solution: Solution, px: float, relevant: float,
                  settings: IntrinsicsConfig) -> Difference:
    """Compare a camera with a solution.

    given: of the input's pictures. px: of the input, in one pixel of the solution's pictures.
    relevant: of the focal length; an error of such a size is what a drive must be able to see.
    """
    found = solution.camera
    small = given.resized(1 / px, found.image_size)
    wide = found.widened()
    alike = small if isinstance(wide, type(small)) else as_model(small, type(wide))
    padded = type(wide).of(wide.image_size, np.pad(
        alike.params, (0, len(wide.params) - len(alike.params))))
    offsets = seen_by_turns(solution, padded) - found.params
    covariance = covariance_of(solution, settings)
    moves, _ = sensitivity(found)
    longer = np.zeros(len(offsets))
    longer[:2] = relevant * found.params[:2]
    relevant_px = np.sqrt(np.mean(np.sum((moves @ longer)**2, axis=1)))
    floor = np.zeros(len(offsets))
    floor[:2] = LEAST_SIGMA * found.fx
    floor[2:4] = HALF_PIXEL / px
    units = np.where(np.arange(len(offsets)) < 4, px, 1.0)
    apart = mapping_difference(small, found)
    lengths = None if apart is None else np.linalg.norm(apart, axis=1) * px
    return Difference(
        given=given, found=found.resized(px, given.image_size), offsets=offsets * units,
        covariance=(covariance + np.diag(floor**2)) * np.outer(units, units),
        rms_px=None if lengths is None else float(np.sqrt(np.mean(lengths**2))),
        worst_px=None if lengths is None else float(lengths.max()),
        sigma_px=PictureSigma(solution.picture.rms * px, solution.picture.worst * px),
        relevant_px=float(relevant_px) * px)
