"""What the joint adjustment found."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as default

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.scene import Profile, Scene, rms_px
from dashcalib_ros.solve.choice import Candidate
from dashcalib_ros.solve.departures import Crops, Departure
from dashcalib_ros.solve.field import FoundField, displacements
from dashcalib_ros.solve.information import Information, pooled, step_to_wider_model
from dashcalib_ros.solve.picture import PictureSigma, SigmaMap, picture_covariance, sigma_over
from dashcalib_ros.solve.prior import extra_sigma_of


@dataclass(frozen=True)
class Solution:
    """All turns adjusted together.

    camera: its n parameters; covariance: (n, n) of them; step1: the camera after the first step.
    scenes: as adjusted, in the order given; parts: the information of each about the lens.
    coarse: the sum of the turns' focal profiles; around: the profile near the result, of all
    turns. bounds: (2, n) lowest and highest values that were allowed.
    prior_information: (n, n) information that the prior adds to that of the turns.
    readout_s: from the first row to the last of a rolling shutter whose effect was removed from
    the scenes' tracks; 0 for a global one. readout_sigma_s: its standard deviation.
    misfits: of every turn that was given: the ratio of its cost with this camera to its cost
    with its own camera. tried: the models that were compared, the simplest first; empty where
    the first one left nothing to explain. sigma_map: over the picture. departures: from a fixed
    camera, the strongest first. crops: of a stabilised video, taken out of the tracks. systematic:
    as for picture_covariance(). field: what no lens model has; None: nothing speaks for one.
    floor: (n,) sigmas of systematic errors. one_turn_sigma: of fx, px, where one turn is all.
    doubt: (n, n) the part of covariance that says how little this drive's turns confirm those of
    earlier drives; None where there are none.
    px: of the input's pictures, in one pixel of the scenes.
    """

    camera: Camera
    covariance: Floats
    step1: Camera
    scenes: tuple[Scene, ...]
    parts: tuple[Information, ...]
    coarse: Profile
    around: Profile
    bounds: Floats
    prior_information: Floats
    sigma_map: SigmaMap
    readout_s: float = 0.0
    readout_sigma_s: float = 0.0
    misfits: Mapping[TurnId, float] = default(default_factory=dict)
    tried: tuple[Candidate, ...] = ()
    departures: tuple[Departure, ...] = ()
    crops: Crops = default(default_factory=dict)
    systematic: float = 1.0
    field: FoundField | None = None
    floor: Floats = default(default_factory=lambda: np.zeros(0))
    one_turn_sigma: float = 0.0
    doubt: Floats | None = None
    px: float = 1.0

    @property
    def sigma(self) -> Floats:
        """Return the n standard deviations (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def picture(self) -> PictureSigma:
        """Return the sigma over the picture."""
        return self.sigma_map.whole

    @property
    def rays_sigma_px(self) -> float:
        """Return how far rays with the camera and the field may be off, RMS over the picture."""
        count, found = len(self.camera.names()), self.field
        if found is None:
            return self.picture.rms
        together = pooled(self.parts, self.prior_information)
        moves, pixels = sensitivity(self.camera)
        bends = displacements(pixels, self.camera.image_size, found.basis)
        # the readout, if there is one, moves nothing in the picture of a camera that stands
        still = np.zeros((*bends.shape[:2], len(together.inverse) - count - bends.shape[2]))
        camera_only = sigma_over(moves, together.inverse[:count, :count])
        both = sigma_over(np.concatenate([moves, still, bends], axis=2), together.inverse)
        covariance = picture_covariance(
            self.camera, self.parts, self.prior_information, self.floor, self.step_to_wider_model,
            self.systematic, self.one_turn_sigma)[:count, :count]
        inflation = np.sum(sigma_over(moves, covariance)**2) / np.sum(camera_only**2)
        return float(np.sqrt(inflation * np.mean(both**2)))

    @property
    def step_to_wider_model(self) -> Floats:
        """Return the Gauss-Newton step of all parameters of the wider model, from this camera."""
        return step_to_wider_model(self.parts, self.prior_information, extra_sigma_of(self.camera))

    @property
    def reprojection_error_px(self) -> float:
        """Return the root mean square reprojection error of the used observations, px."""
        return rms_px(self.scenes, self.camera)
