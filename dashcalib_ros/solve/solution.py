"""What the joint adjustment found."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.reconstruction.scene import Profile, Scene, errors_px
from dashcalib_ros.solve.choice import Candidate
from dashcalib_ros.solve.departures import Crops, Departure
from dashcalib_ros.solve.information import Information, step_to_wider_model
from dashcalib_ros.solve.picture import PictureSigma, SigmaMap
from dashcalib_ros.solve.prior import extra_sigma_of
from dashcalib_ros.turns.turn import TurnId


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
    as for covariance().
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
    misfits: Mapping[TurnId, float] = field(default_factory=dict)
    tried: tuple[Candidate, ...] = ()
    departures: tuple[Departure, ...] = ()
    crops: Crops = field(default_factory=dict)
    systematic: float = 1.0

    @property
    def sigma(self) -> Floats:
        """Return the n standard deviations (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def picture(self) -> PictureSigma:
        """Return the sigma over the picture."""
        return self.sigma_map.whole

    @property
    def step_to_wider_model(self) -> Floats:
        """Return the Gauss-Newton step of all parameters of the wider model, from this camera."""
        return step_to_wider_model(self.parts, self.prior_information, extra_sigma_of(self.camera))

    @property
    def reprojection_error_px(self) -> float:
        """Return the root mean square reprojection error of the used observations, px."""
        squares = [errors_px(scene, self.camera)[scene.structure.used] ** 2
                   for scene in self.scenes]
        return float(np.sqrt(np.mean(np.concatenate(squares))))
