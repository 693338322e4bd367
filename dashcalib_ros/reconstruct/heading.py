# SPDX-License-Identifier: Apache-2.0
"""Where the camera points, against the car's direction of travel, from one turn's poses.

A camera ahead of the rear axle moves sideways in a turn, by the path's curvature times its
distance from the axle. So the sideways direction is fitted as a line over the curvature; its
value at no curvature is how the camera is mounted. Up and down, the mean counts: a car dives when
it brakes before the turn, and rises as much when it gathers speed after it.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.rotation import rotation_matrices, rotation_vectors
from dashcalib_ros.problem.observations import main_axis
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.robust import cauchy_fit, mad_sigma


@dataclass(frozen=True)
class Heading:
    """The car's direction of travel, as the camera sees it, degrees, with standard deviations.

    yaw_deg: positive where the car goes to the right of the optical axis. pitch_deg: positive
    where it goes below the axis. rear: the camera looks back, and the angles are of the direction
    that the car comes from.
    """

    yaw_deg: float
    pitch_deg: float
    yaw_sigma_deg: float
    pitch_sigma_deg: float
    rear: bool = False


# keyframes; a line needs more steps between them than it has parameters
LEAST_KEYFRAMES = 6


def heading(scene: Scene) -> Heading | None:
    """Return the heading in a turn, None where too few keyframes are registered."""
    if scene.structure.registered.sum() < LEAST_KEYFRAMES:
        return None
    turned, lengths, ahead = _steps(scene)
    rear = bool(np.median(ahead[:, 2]) < 0)
    if rear:
        ahead = -ahead
    curvature = turned[:, 1] / lengths
    curvature /= max(float(np.abs(curvature).max()), np.finfo(float).tiny)
    yaw = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 2]))
    pitch = np.degrees(np.arcsin(np.clip(ahead[:, 1], -1, 1)))
    yaw_deg, yaw_sigma = _at_no_curvature(curvature, yaw)
    return Heading(yaw_deg, _trimmed_mean(pitch), yaw_sigma,
                   float(np.std(pitch) / np.sqrt(len(pitch))), rear)


def _steps(scene: Scene) -> tuple[Floats, Floats, Floats]:
    """Return the steps of a turn's path: rotation vectors (k, 3), lengths (k,), directions (k, 3).

    A direction is in the camera's frame halfway through its step.
    """
    rotations, centres = scene.structure.path()
    turned = rotation_vectors(rotations[1:] @ rotations[:-1].transpose(0, 2, 1))
    halfway = rotation_matrices(turned / 2) @ rotations[:-1]
    steps = np.diff(centres, axis=0)
    lengths = np.maximum(np.linalg.norm(steps, axis=1), np.finfo(float).tiny)
    return turned, lengths, np.einsum('kij,kj->ki', halfway, steps) / lengths[:, None]


# of the steps at either end, left out of a mean: bumps and bad poses
TRIMMED = 0.1


def _trimmed_mean(values: Floats) -> float:
    """Return the mean without the share TRIMMED at either end; scipy.stats loads for 0.4 s."""
    cut = int(TRIMMED * len(values))
    return float(np.sort(values)[cut:len(values) - cut].mean())


# of the logarithm; the turns of six upright drives have -4.9 to -0.7
OPEN = 0.4


def off_axis_deg(scene: Scene) -> float:
    """Return the median angle of the camera's axis to its own motion, degrees: 90 is sideways.

    A camera that looks back counts like one that looks ahead.
    """
    _, _, ahead = _steps(scene)
    return float(np.median(np.degrees(np.arccos(np.clip(np.abs(ahead[:, 2]), 0, 1)))))


# degrees; only a turn of so much shows the axis about which a car turns: in others bumps and the
# lean of a two-wheeler turn the camera as much
LEAST_YAW_DEG = 30.0


def roll_deg(scenes: Sequence[Scene]) -> float | None:
    """Return by how much the pictures of these turns are turned against the upright, degrees.

    Of the axis about which the car turns, the end where the road is points downwards: points on
    the road all lie as deep, those above the camera at any height. None without a turn of
    LEAST_YAW_DEG.
    """
    scenes = [scene for scene in scenes if abs(scene.yaw_deg) >= LEAST_YAW_DEG]
    if not scenes:
        return None
    down = main_axis(np.concatenate([scene.turned for scene in scenes]))
    if np.median([_open_below(scene, down) for scene in scenes]) > OPEN:
        down = -down
    return float(np.degrees(np.arctan2(down[0], down[1])))


# points near the path; fewer do not tell how high the world is
LEAST_POINTS = 30


def _open_below(scene: Scene, down: Floats) -> float:
    """Return the log of how much farther the deepest points spread than the highest ones."""
    structure = scene.structure
    rotations, centres = structure.path()
    points = structure.points[structure.used.any(axis=0)]
    offsets = points[:, None] - centres
    far = np.linalg.norm(offsets, axis=2)
    nearest = np.argmin(far, axis=1)
    path_length = np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()
    near = far.min(axis=1) < path_length
    depth = offsets[np.arange(len(points)), nearest][near] @ (rotations.transpose(0, 2, 1)
                                                            @ down).mean(axis=0)
    if len(depth) < LEAST_POINTS:
        return 0.0
    highest, high, deep, deepest = np.percentile(depth, [2, 25, 75, 98])
    tiny = np.finfo(float).tiny
    return float(np.log((deepest - deep + tiny) / (high - highest + tiny)))


# rounds of new weights; ten drives changed by less than 0.01 degrees after the fifth
ROUNDS = 9
# of the scatter; errors beyond it lose weight (Cauchy)
LOSS = 2.0
# degrees; less scatter than this is rounding
LEAST_SCATTER = 1e-3


def _at_no_curvature(curvature: Floats, angle: Floats) -> tuple[float, float]:
    """Return the value of a robust line over the curvature at 0, and its standard deviation."""
    def scatter(off: Floats) -> float:
        return max(mad_sigma(off), LEAST_SCATTER)

    line = cauchy_fit(np.column_stack([np.ones(len(curvature)), curvature]), angle,
                      lambda off: LOSS * scatter(off), ROUNDS)
    variance = scatter(line.off)**2 * np.linalg.pinv(line.normal)[0, 0]
    return float(line.params[0]), float(np.sqrt(variance))
