# SPDX-License-Identifier: Apache-2.0
"""Paths of several cameras of one car, with exact truth and no pictures; and a result of three."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dashcalib_ros.camera.rotation import rotation_matrices
from dashcalib_ros.errors import Notice
from dashcalib_ros.problem.trajectory import Trajectory
from dashcalib_ros.rig.paths import CameraPaths, ScenePath
from dashcalib_ros.rig.placed import PlacedCamera, RigCalibration, base_camera, not_placed, three
from dashcalib_ros.rig.witness import Epipolar

# s, degrees of each turn; m/s
LENGTH_S, SPEED = 5.0, 6.0
# of seen_rig(): degrees and m of each camera, rotation and translation against the front
SIGMA, METRES = (0.06, 0.08, 0.04), (0.02, 0.5, 0.02)
PLACES = {'left': ((1.0, 70.0, -2.0), (-0.5, 0.2, 1.0)),
          'right': ((3.0, -75.0, 1.0), (0.6, 0.1, 1.1)),
          'rear': ((2.0, 177.5, 1.5), (0.3, -0.2, -2.0))}


@dataclass(frozen=True)
class Mounted:
    """Where a camera sits: from the base's axes; its clock, and the times of its images."""

    vector_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    late_s: float = 0.0
    step_s: float = 0.2
    phase_s: float = 0.0

    @property
    def rotation(self) -> np.ndarray:
        return rotation_matrices(np.radians([self.vector_deg]))[0]


def base_poses(times: np.ndarray, yaw_deg: float, world: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the base's poses, world to camera, in a turn that takes LENGTH_S from time 0."""
    fine = np.linspace(-1.0, LENGTH_S + 1.0, 3001)
    share = np.clip((fine - 0.8) / (LENGTH_S - 1.6), 0, 1)
    heading = np.radians(yaw_deg) * share**2 * (3 - 2 * share)
    step = SPEED * (fine[1] - fine[0])
    rng = np.random.default_rng([world, 7])
    waves = [(rng.uniform(0.5, 1.6), rng.uniform(0, 6.3)) for _ in range(2)]
    pitch, roll = (np.radians(0.4) * np.sin(2 * np.pi * rate * fine + phase)
                   for rate, phase in waves)
    # the base sits 1.5 m ahead of what goes where the car points
    axle = np.stack([np.cumsum(np.sin(heading)) * step, 0 * fine,
                     np.cumsum(np.cos(heading)) * step], axis=1)
    at = np.stack([np.interp(times, fine, each) for each in (heading, pitch, roll, *axle.T)], 1)
    turned = (rotation_matrices(np.column_stack([0 * at[:, 0], 0 * at[:, 0], at[:, 2]]))
              @ rotation_matrices(np.column_stack([at[:, 1], 0 * at[:, 0], 0 * at[:, 0]]))
              @ rotation_matrices(np.column_stack([0 * at[:, 0], -at[:, 0], 0 * at[:, 0]])))
    centres = at[:, 3:] + np.einsum('nji,j->ni', turned, (0.0, 0.0, 1.5))
    return turned, -np.einsum('nij,nj->ni', turned, centres)


def made_paths(cameras: Mapping[str, Mounted], yaws: Sequence[float] = (85.0, -75.0, 90.0),
               seed: int = 0, turn_deg: float = 0.005, move: float = 0.002,
               lens_sigma: float = 1.0) -> tuple[dict[str, CameraPaths], dict[str, np.ndarray]]:
    """Return what cameras know about turns, 40 s apart, and how far each one's lens is off.

    turn_deg, move (of a step): noise of poses, of which a half is known. lens_sigma: of three
    parameters, in units of 0.1 degrees about the vertical, 0.1 about x, and 0.3 % of the turning.
    """
    rng, found, lenses = np.random.default_rng(seed), {}, {}
    for name, mounted in cameras.items():
        lens, scenes = rng.normal(size=3) * lens_sigma, []
        for n, yaw in enumerate(yaws):
            times = np.arange(mounted.phase_s, LENGTH_S - 1e-9, mounted.step_s)
            base, shift = base_poses(times, yaw, n)
            rotations = mounted.rotation @ base
            translations = shift @ mounted.rotation.T + mounted.translation_m
            gauge = rotation_matrices(rng.normal(size=(1, 3)))[0]
            move_by, scale = rng.normal(size=3), np.exp(rng.normal())
            # X = scale (gauge X') + move_by
            rotations, translations = rotations @ gauge, (
                rotations @ move_by + translations) / scale
            follow = _follow(rotations, translations)
            count, step = len(times), SPEED * mounted.step_s / scale
            sigma = np.tile([np.radians(turn_deg)] * 3 + [move * step] * 3, (count, 1))
            off = np.einsum('kcn,n->kc', follow, -lens) + sigma * rng.normal(size=(count, 6))
            scenes.append(ScenePath(Trajectory(
                times + 40.0 * n + mounted.late_s, rotation_matrices(off[:, :3]) @ rotations,
                translations + off[:, 3:], np.arange(count), count, True),
                np.diag((0.5 * sigma.ravel())**2), follow.reshape(-1, 3)))
        found[name] = CameraPaths(name, tuple(scenes), lens_sigma**2 * np.eye(3))
        lenses[name] = lens
    return found, lenses


def _follow(rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """Return (k, 6, 3) how poses follow a lens: two of its parameters turn the camera's axes."""
    count, tenth = len(rotations), np.radians(0.1)
    found = np.zeros((count, 6, 3))
    for column, axis in enumerate((1, 0)):
        unit = np.eye(3)[axis] * tenth
        found[:, :3, column] = unit
        found[:, 3:, column] = np.cross(unit, translations)
        # a centre that is off turns all of them: what is constant in the world is no change
    steps = rotations @ rotations[0].T
    angle = np.unwrap(np.arctan2(steps[:, 0, 2] - steps[:, 2, 0], steps[:, 0, 0] + steps[:, 2, 2]))
    unit = 0.003 * angle[:, None] * [0.0, 1.0, 0.0]
    found[:, :3, 2] = unit
    found[:, 3:, 2] = np.cross(unit, translations)
    return found


def front_left_rear(left: PlacedCamera, why: str) -> RigCalibration:
    """Return a rig of which the rear camera has no place. why: in words."""
    return RigCalibration('front', {
        'front': base_camera('front/result.json'), 'left': left,
        'rear': not_placed('rear/result.json', Notice('E-RIG-OTHER-DRIVE', why))},
        {('front', 'left'): Epipolar(900, 0.3, 0.05)})


def seen_rig(*names, turned=None, by=(0.0, 1.0, 0.0), metric=True, seed=0):
    """Return front and others; turned: the camera that sits otherwise, by degrees in its axes."""
    rng, cameras = np.random.default_rng(seed), {'front': base_camera('front/result.json')}
    by_base = Rotation.from_rotvec(by if turned == 'front' else (0, 0, 0), degrees=True)
    for name in names:
        vector, shift = PLACES[name]
        own = Rotation.from_rotvec(by if turned == name else (0, 0, 0), degrees=True)
        noise = Rotation.from_rotvec(np.array(SIGMA) * rng.normal(size=3), degrees=True)
        turn = noise * own * Rotation.from_rotvec(vector, degrees=True) * by_base.inv()
        moved = own.apply(shift) + np.array(METRES) * rng.normal(size=3)
        cameras[name] = PlacedCamera(
            f'{name}/result.json', 'accepted', three(turn.as_rotvec(degrees=True)), SIGMA,
            three(moved) if metric else None, METRES if metric else None, 0.0, 0.001)
    return RigCalibration('front', cameras)
