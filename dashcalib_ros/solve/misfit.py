"""The misfit of a turn: how much worse the shared camera explains it than its own camera."""
from __future__ import annotations

from collections.abc import Sequence

from dashcalib_ros.camera import Camera
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.scene import Scene, truncated_cost

# px^2; lower costs count as this, so that the ratio of two tiny costs is near 1
LEAST_COST = 0.01


def misfits(separate: Sequence[Scene], joint: Sequence[Scene], camera: Camera, limit_px: float
            ) -> dict[TurnId, float]:
    """Return the ratio of each turn's cost with the shared camera to that with its own, by turn.

    separate: the turns as they were reconstructed, each with its own camera (one focal length,
    k1, k2). joint: those that are left, adjusted with the shared camera. limit_px: larger errors
    count as this. Costs are means over all observations. The ratio is about 1 or less for a turn
    of the shared camera; a turn that is not in joint costs limit_px squared.
    """
    adjusted = {scene.turn: scene for scene in joint}

    def cost(scene: Scene, camera: Camera) -> float:
        return max(truncated_cost(scene, camera, limit_px), LEAST_COST)

    return {scene.turn: (cost(adjusted[scene.turn], camera) if scene.turn in adjusted
                           else limit_px**2) / cost(scene, scene.camera) for scene in separate}
