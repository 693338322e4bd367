"""What one turn says of a camera in use, and of where that camera points."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.heading import Heading, heading
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.normal import turn_cost
from dashcalib_ros.solve.prior import loss_px_of
from dashcalib_ros.solve.quadratic import Quadratic


@dataclass(frozen=True)
class Reading:
    """One turn, explained with a fixed camera.

    cost: about the camera's n parameters, at unit noise, each track one measurement. heading: of
    the camera in the car; None where the turn does not show it. misfit: the turn's cost with this
    camera over that with its own. explained: False where it is so large that no quadratic function
    says by how much the camera is off; cost is 0 then.
    """

    turn: TurnId
    cost: Quadratic
    heading: Heading | None
    explained: bool = True
    misfit: float = 1.0

    def gain(self, offsets: Floats) -> float:
        """Return by how much the turn prefers a camera with other parameters, (n,) offsets.

        It is twice the logarithm of a ratio of likelihoods, positive where the other one is
        likelier.
        """
        return -self.cost.change(offsets)


def reading_of(scene: Scene, camera: Camera, config: Config) -> Reading:
    """Explain a turn with a fixed camera, poses and points adjusted anew; loads COLMAP.

    scene: as its turn was reconstructed. camera: of the scene's pictures.
    """
    from dashcalib_ros.solve.fitting import misfits, scene_with
    count = len(camera.names())
    found = scene_with(camera, scene, config)
    misfit = np.inf if found is None else misfits(
        [scene], [found], camera, config.scene.error_px)[scene.turn]
    if found is None or misfit > config.verdict.max_misfit:
        nothing = Quadratic.prior(np.zeros((count, count)))
        return Reading(scene.turn, nothing, None, False, misfit)
    turn = turn_cost(found, camera, loss_px_of([found], camera, config.intrinsics))
    cost = turn.of(np.arange(count)).at_noise(turn.squares / turn.freedom)
    # errors that the observations of a track share make it worth less than their number
    inflation = max(1.0, float(np.trace(np.linalg.pinv(cost.hessian) @ cost.by_track)) / count)
    return Reading(scene.turn, cost.at_noise(inflation), heading(found), misfit=misfit)
