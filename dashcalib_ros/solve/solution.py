"""What the joint adjustment found, and what each turn says of it without that turn."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from dataclasses import field as default

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.scene import Profile, Scene, rms_px
from dashcalib_ros.solve.field import FoundField, displacements
from dashcalib_ros.solve.fixed_camera import Crops, FixedCameraTest
from dashcalib_ros.solve.knowledge import Knowledge, PictureSigma, SigmaMap, sigma_over

# fewer turns are not left out: one of two says little of the other
LEAST_TURNS = 3
# cost_ratio of the kinds of lenses; behind true fisheyes pinholes have 2.1 and more
CLEAR_KIND_RATIO = 1.5


@dataclass(frozen=True)
class Candidate:
    """A model that was tried.

    loses_by: how much worse than the chosen model it predicts the turns left out: the sum of the
    robust squared errors, in units of the noise of a track; 0 for the chosen one, negative for one
    that does better, but not clearly. apart_px: how far its camera is from the chosen one over the
    picture; None where they cannot be compared. chosen: it is the one that the turns choose.
    cost_ratio: its cost of the turns left out over that of the chosen one.
    """

    model: str
    loses_by: float
    apart_px: float | None = None
    chosen: bool = False
    cost_ratio: float = 1.0


@dataclass(frozen=True)
class Solution:
    """All turns adjusted together.

    camera: its n parameters; covariance: (n, n) of them; centred: the camera with one focal length
    that was found first, about which priors and bounds are. scenes: as adjusted, in the order
    given; known: what they know, in the same order. coarse: the sum of the turns' focal profiles;
    around: the profile near the result, of all turns. bounds: (2, n) lowest and highest values
    that were allowed. readout_s: from the first row to the last of a rolling shutter whose effect
    was removed from the scenes' tracks; 0 for a global one. readout_sigma_s: its standard
    deviation. misfits: of every turn that was given: the ratio of its cost with this camera to its
    cost with its own camera. tried: the models that were compared, the simplest first; empty where
    the first one left nothing to explain. sigma_map: over the picture. fixed_camera: the tests
    whether it is one, the strongest first. crops: of a stabilised video, taken out of the tracks.
    field: what no lens model has; None: nothing speaks for one. doubt: (n, n) the part of
    covariance that says how little this drive's turns confirm those of earlier drives; None where
    there are none; less where a gyro knows more. alone: the solution of the pictures alone, where
    a gyro's angles are in this one. px: of the input's pictures, in one pixel of the scenes.
    """

    camera: Camera
    covariance: Floats
    centred: Camera
    scenes: tuple[Scene, ...]
    known: Knowledge
    coarse: Profile
    around: Profile
    bounds: Floats
    sigma_map: SigmaMap
    readout_s: float = 0.0
    readout_sigma_s: float = 0.0
    misfits: Mapping[TurnId, float] = default(default_factory=dict)
    tried: tuple[Candidate, ...] = ()
    fixed_camera: tuple[FixedCameraTest, ...] = ()
    crops: Crops = default(default_factory=dict)
    field: FoundField | None = None
    doubt: Floats | None = None
    alone: Solution | None = None
    px: float = 1.0

    @property
    def sigma(self) -> Floats:
        """Return the n standard deviations (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def wider_covariance(self) -> Floats:
        """Return the covariance of the wider model's parameters: the camera's own come first.

        Of those that this model has not, the step is all that is known.
        """
        covariance = np.array(self.known.covariance)
        if self.doubt is not None:
            covariance[:len(self.doubt), :len(self.doubt)] += self.doubt
        return covariance

    @property
    def picture(self) -> PictureSigma:
        """Return the sigma over the picture."""
        return self.sigma_map.whole

    @property
    def rays_sigma_px(self) -> float:
        """Return how far rays with the camera and the field may be off, RMS over the picture."""
        found, count, together = self.field, len(self.known.own), self.known.total.covariance
        if found is None:
            return self.picture.rms
        moves, pixels = sensitivity(self.camera)
        bends = displacements(pixels, self.camera.image_size, found.basis)
        # the readout, if there is one, moves nothing in the picture of a camera that stands
        still = np.zeros((*bends.shape[:2], len(together) - count - bends.shape[2]))
        camera_only = sigma_over(moves, together[:count, :count])
        both = sigma_over(np.concatenate([moves, still, bends], axis=2), together)
        covariance = self.known.covariance[:count, :count]
        inflation = np.sum(sigma_over(moves, covariance)**2) / np.sum(camera_only**2)
        return float(np.sqrt(inflation * np.mean(both**2)))

    @property
    def reprojection_error_px(self) -> float:
        """Return the root mean square reprojection error of the used observations, px."""
        return rms_px(self.scenes, self.camera)


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
