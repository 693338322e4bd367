"""Rolling shutter: how long the sensor takes from its first row to its last, found and undone.

Rows that are exposed one after another see a moving car's world from different places. A point in
row y of h is seen (y / h - 1/2) times the readout after the picture's middle row. How fast each
point moves through the picture is known from the poses of the keyframes around, so the readout is
one more parameter of the adjusted solution, and each observation can be moved to where the middle
row's moment has it.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dashcalib_ros.intrinsics.information import information, pooled
from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.scene import Scene

Array = npt.NDArray[np.float64]
STEP_S = 1e-3


def row_shift(scene: Scene, camera: Camera) -> Array:
    """Return (k, t, 2) px by which observations are displaced for each second of readout.

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
    # stamps that repeat tell no speed
    velocity = np.where(passed > 0, local[after] - local[before], 0.0) / np.maximum(passed, STEP_S)
    ahead, behind = local + STEP_S * velocity, local - STEP_S * velocity
    seen = (scene.tracks.seen[poses] & structure.used.any(axis=0)
            & (np.minimum(ahead[:, :, 2], behind[:, :, 2]) > 0))
    moving = np.zeros(local.shape[:2] + (2,))
    moving[seen] = (camera.project(ahead[seen]) - camera.project(behind[seen])) / (2 * STEP_S)
    late = (scene.tracks.xy[poses, :, 1] + 0.5) / camera.image_size[1] - 0.5
    shift[poses] = np.where(seen[:, :, None], moving * late[:, :, None], 0.0)
    return shift


def readout(scenes: Sequence[Scene], camera: Camera, loss_px: float, prior: Array
            ) -> tuple[float, float]:
    """Return the readout that the scenes still show, and its sigma, s.

    prior: (6, 6) information of the priors, as for covariance(). One Gauss-Newton step from a
    solution without it; the sigma takes whole tracks as units, and is inf where nothing moves or
    the stamps tell no speed.
    """
    shifts = [row_shift(scene, camera) for scene in scenes]
    if not any(shift.any() for shift in shifts):
        return 0.0, float(np.inf)
    every = pooled([information(scene, camera, loss_px, shift)
                    for scene, shift in zip(scenes, shifts, strict=True)], prior)
    # the six are at their optimum: only the readout pulls
    seconds = every.inverse[6, 6] * every.scores[:, 6].sum()
    return float(seconds), float(np.sqrt(max(every.inverse[6, 6], every.clustered[6])))


def undone(scene: Scene, measured: Scene, camera: Camera, readout_s: float) -> Scene:
    """Return the scene with its tracks where a global shutter would have them.

    measured: the same scene with the tracks as they were measured.
    """
    xy = measured.tracks.xy
    # the row that counts is the measured one
    as_measured = replace(scene, tracks=replace(scene.tracks, xy=xy))
    return replace(scene, tracks=replace(
        scene.tracks, xy=xy - readout_s * row_shift(as_measured, camera)))
