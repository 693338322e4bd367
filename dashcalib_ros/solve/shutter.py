"""Rolling shutter: its readout, the time from the first row to the last, is found and removed.

The rows are exposed one after another, so that a moving camera sees them from different places.
A point in row y of h is seen (y / h - 1/2) times the readout after the picture's middle row. The
poses of the neighbouring keyframes tell how fast each point moves through the picture. So the
readout is one more parameter of the solution, and each observation can be moved to where a global
shutter, exposed with the middle row, would have seen it.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.knowledge import Knowledge
from dashcalib_ros.solve.normal import Further, turn_cost
from dashcalib_ros.solve.quadratic import Quadratic

# s; step of the central difference for a point's speed in the picture
STEP_S = 1e-3


def row_shift(scene: Scene, camera: Camera) -> Floats:
    """Return (k, t, 2) by how many px each observation is displaced per second of readout.

    0 where the scene has no point for a track, or no pose.
    """
    structure = scene.structure
    poses = np.flatnonzero(structure.registered)
    shift = np.zeros(scene.tracks.xy.shape)
    if len(poses) < 2:
        return shift
    local = (structure.points @ structure.rotations[poses].transpose(0, 2, 1)
             + structure.translations[poses, None])
    seconds = scene.tracks.stamps_ns[poses] / 1e9
    before = np.maximum(np.arange(len(poses)) - 1, 0)
    after = np.minimum(np.arange(len(poses)) + 1, len(poses) - 1)
    passed = (seconds[after] - seconds[before])[:, None, None]
    # equal stamps give no speed
    velocity = np.where(passed > 0, local[after] - local[before], 0.0) / np.maximum(passed, STEP_S)
    ahead, behind = local + STEP_S * velocity, local - STEP_S * velocity
    seen = (scene.tracks.seen[poses] & structure.used.any(axis=0)
            & (np.minimum(ahead[:, :, 2], behind[:, :, 2]) > 0))
    moving = np.zeros(local.shape[:2] + (2,))
    moving[seen] = (camera.project(ahead[seen]) - camera.project(behind[seen])) / (2 * STEP_S)
    late = (scene.tracks.xy[poses, :, 1] + 0.5) / camera.image_size[1] - 0.5
    shift[poses] = np.where(seen[:, :, None], moving * late[:, :, None], 0.0)
    return shift


def readout_parameter(camera: Camera, sigma_s: float = np.inf) -> Further:
    """Return the readout as a parameter that turns share. sigma_s: of its prior."""
    return Further(lambda scene: row_shift(scene, camera)[scene.structure.used][..., None],
                   np.array([sigma_s]))


def readout(scenes: Sequence[Scene], camera: Camera, loss_px: float, prior: Floats
            ) -> tuple[float, float]:
    """Return the readout that is still left in the scenes, and its sigma, s.

    prior: (n, n) information of the camera's prior. One Gauss-Newton step from a solution without
    a readout. The sigma treats each track as one measurement, and is inf where nothing moves or
    the stamps give no speed.
    """
    turns = tuple(turn_cost(scene, camera, loss_px, [readout_parameter(camera)])
                  for scene in scenes)
    if not any(turn.hessian[-1, -1] for turn in turns):
        return 0.0, float(np.inf)
    known = Knowledge(camera, turns, Quadratic.prior(prior, np.zeros(1)), np.zeros(len(prior)))
    # the camera is at its optimum: only the readout has a gradient
    score = np.sum([turn.score[-1] for turn in known.turns_at_optimum])
    return float(known.total.covariance[-1, -1] * score), known.readout_sigma


def remove_rolling_shutter(scene: Scene, measured: Scene, camera: Camera, readout_s: float
                           ) -> Scene:
    """Return the scene with its tracks where a global shutter would have seen them.

    measured: the same scene with the tracks as they were measured.
    """
    xy = measured.tracks.xy
    # the displacement depends on the row as measured
    as_measured = replace(scene, tracks=replace(scene.tracks, xy=xy))
    return replace(scene, tracks=replace(
        scene.tracks, xy=xy - readout_s * row_shift(as_measured, camera)))
