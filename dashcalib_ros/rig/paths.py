# SPDX-License-Identifier: Apache-2.0
"""What one camera knows about the path of the car: poses of each of its scenes, with covariance.

The poses of a scene follow the lens; how they do is known from the scene's normal equations. So a
lens that is known badly makes a rotation of the rig that is known badly, and a rig whose poses fit
only another lens moves the lens.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera.rotation import centres_of
from dashcalib_ros.problem.normal import linearised, poses_given_shared
from dashcalib_ros.problem.steps import State
from dashcalib_ros.problem.trajectory import Trajectory, logarithms
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.rig.dense import Retraced, imaging_of, loss_of
from dashcalib_ros.solve.solution import Solution

# minimum number of poses of a scene; with fewer it says nothing about a rig
LEAST_POSES = 6


@dataclass(frozen=True)
class ScenePath:
    """The path of a camera through the k keyframes of a scene, in the scene's frame and unit.

    trajectory: its seconds count from the camera's first image. covariance: (6k, 6k) of the poses
    where the lens is known; follow: (6k, n) of the poses by the lens's n parameters. A move of a
    pose is a small rotation in its own axes, and one of its translation.
    """

    trajectory: Trajectory
    covariance: Floats
    follow: Floats

    @property
    def seconds(self) -> Floats:
        """Return (k,) the times of the keyframes."""
        return self.trajectory.seconds

    @property
    def centres(self) -> Floats:
        """Return (k, 3) where the camera was."""
        return self.trajectory.centres

    def within(self, seconds: Floats) -> Mask:
        """Return whether times (n,) are between the first and the last keyframe."""
        return np.asarray((seconds >= self.seconds[0]) & (seconds <= self.seconds[-1]), bool)

    def steps(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Return (n - 1, 3) rad and (n - 1, 3) by which the camera turned and moved.

        From each of the times (n,) to the next, in the camera's axes at the first of both.
        """
        rotations, translations = self.trajectory.at(seconds)
        centres = centres_of(rotations, translations)
        turned = logarithms(rotations[1:] @ rotations[:-1].transpose(0, 2, 1))
        return turned, np.einsum('nij,nj->ni', rotations[:-1], np.diff(centres, axis=0))


@dataclass(frozen=True)
class CameraPaths:
    """All that a camera knows about the car's path. start_s: stamp of its first image.

    lens_covariance: (n, n) of its lens and, last, its readout (s), by all of its scenes.
    """

    name: str
    scenes: tuple[ScenePath, ...]
    lens_covariance: Floats
    start_s: float = 0.0


# s; a readout that is held has no variance at all
LEAST_READOUT_SIGMA_S = 1e-5


def camera_paths(name: str, solution: Solution, stretches: Sequence[Retraced], start_s: float
                 ) -> CameraPaths:
    """Return what a camera knows about the car's path."""
    imaging, found, start_ns = imaging_of(solution), [], round(start_s * 1e9)
    for each in sorted(stretches, key=lambda each: int(each.scene.tracks.stamps_ns[0])):
        scene = each.scene
        rows, structure = scene.observed.keyframes, scene.structure
        path = Trajectory(
            (scene.tracks.stamps_ns[rows] - start_ns) / 1e9, structure.rotations[rows],
            structure.translations[rows], np.arange(len(rows)), len(rows), True)
        if len(rows) < LEAST_POSES or not np.all(np.diff(path.seconds) > 0):
            continue
        state = State(imaging.having(each.shake), (scene,))
        loss_px = loss_of(state)
        known = poses_given_shared(
            linearised(state.seen[0], loss_px), state.noise(loss_px).variance)
        found.append(ScenePath(path, known.covariance, known.follow))
    # also what the written model lacks, such as decentring, moves poses
    follow, left = solution.written.wide_by_solution, solution.written.wide_left
    readout = np.eye(follow.shape[1])[len(solution.posterior.lens.params)]
    follow = np.vstack([follow, readout])
    covariance = follow @ solution.posterior.covariance @ follow.T
    covariance[:-1, :-1] += np.outer(left, left)
    covariance += 1e-6 * np.diag(np.diag(covariance)) + np.diag(
        [*np.zeros(len(left)), LEAST_READOUT_SIGMA_S**2])
    return CameraPaths(name, tuple(found), covariance, start_s)


def coarse_paths(name: str, solution: Solution | None, start_s: float) -> CameraPaths:
    """Return the paths of a camera's own scenes alone, which tell the time but no sigma."""
    scenes = () if solution is None else tuple(
        ScenePath(Trajectory.through(
            scene.structure.rotations, scene.structure.translations, scene.structure.registered,
            scene.tracks.stamps_ns).later(
                scene.tracks.stamps_ns[scene.structure.registered][0] / 1e9 - start_s),
                  np.zeros((0, 0)), np.zeros((0, 0)))
        for scene in ordered(solution))
    return CameraPaths(name, scenes, np.zeros((0, 0)), start_s)


def ordered(solution: Solution) -> list[Scene]:
    """Return the scenes of this drive that say something of a rig, by time."""
    return sorted((scene for scene in solution.scenes if scene.turn.of_this_drive
                   and scene.trajectory.moves
                   and scene.structure.registered.sum() >= LEAST_POSES),
                  key=lambda each: int(each.tracks.stamps_ns[0]))
