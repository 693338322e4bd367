"""What the joint adjustment found."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dashcalib_ros.intrinsics.information import Information, freed
from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.scene import Profile, Scene, errors_px

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Solution:
    """All turns adjusted together.

    camera: the six parameters; covariance: (6, 6) of them; step1: the camera after the first step.
    scenes: as adjusted, in the order given; parts: what each knows of the lens.
    coarse: the turns' focal profiles, summed; around: the profile near the result, all together.
    bounds: (2, 6) lowest and highest values that were allowed; belief: (6, 6) information that the
    prior adds to theirs.
    readout_s: from the first row to the last of a rolling shutter that was found and undone in the
    scenes' tracks; 0 for a global one. readout_sigma_s: its standard deviation.
    misfits: of every turn that was given, by centre: its cost with this camera, over that with one
    of its own.
    """

    camera: Camera
    covariance: Array
    step1: Camera
    scenes: tuple[Scene, ...]
    parts: tuple[Information, ...]
    coarse: Profile
    around: Profile
    bounds: Array
    belief: Array
    readout_s: float = 0.0
    readout_sigma_s: float = 0.0
    misfits: Mapping[int, float] = field(default_factory=dict)

    @property
    def sigma(self) -> Array:
        """Return the six standard deviations (6,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def freed(self) -> Array:
        """Return (9,) how the six would move if p1, p2, k3 were free, and what these would be."""
        return freed(self.parts, self.belief)

    @property
    def reprojection_error_px(self) -> float:
        """Return the root mean square reprojection error of the used observations, px."""
        squares = [errors_px(scene, self.camera)[scene.structure.used] ** 2
                   for scene in self.scenes]
        return float(np.sqrt(np.mean(np.concatenate(squares))))
