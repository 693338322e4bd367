# SPDX-License-Identifier: Apache-2.0
"""How well a camera finds the car's true motion: the turns' rotations and scales beside poses.

The turns' paths become files in TUM's format, which evo reads and plots.

Each turn is adjusted with each camera held, all alike. The angle of a turn's rotation is the same
in every frame that is fixed to the car, so it does not matter where the poses' sensor sits.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera import Camera, Radial
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.errors import InputError, spared
from dashcalib_ros.input.poses import Poses
from dashcalib_ros.judge.calibration import Witness
from dashcalib_ros.judge.witnesses import clock_of_poses
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.solution import Solution

# keyframes with poses; a turn with fewer says nothing
LEAST_KEYFRAMES = 4


@dataclass(frozen=True)
class TurnPath:
    """Where a turn's keyframes were. rotations: (k, 3, 3) to the world; positions: (k, 3)."""

    rotations: Floats
    positions: Floats


@dataclass(frozen=True)
class TurnOdometry:
    """A turn as the poses and as each camera has it, at the same k keyframes.

    true: in metres; paths: by the camera's name, each in its own scale and frame. stamps_ns: (k,).
    """

    turn: TurnId
    stamps_ns: Ints
    true: TurnPath
    paths: Mapping[str, TurnPath]

    @property
    def angle_deg(self) -> float:
        """Return by how much the car truly turned from the first keyframe to the last."""
        return angle_deg(self.true.rotations)

    @property
    def length_m(self) -> float:
        """Return how far the car truly drove."""
        return length(self.true.positions)

    def rotation_deg(self, name: str) -> float:
        """Return by how much a camera misses the turn's angle."""
        return abs(angle_deg(self.paths[name].rotations) - self.angle_deg)

    def scale_drift(self, name: str) -> float:
        """Return by how much a camera's scale changes from the turn's first half to its second."""
        middle = len(self.stamps_ns) // 2
        first, second = (
            length(self.paths[name].positions[part]) / max(length(self.true.positions[part]),
                                                            1e-9)
            for part in (slice(0, middle + 1), slice(middle, None)))
        return second / max(first, 1e-12) - 1


@dataclass(frozen=True)
class Odometry:
    """All turns that have poses. names: of the cameras. clock: of the poses; None: not known."""

    names: tuple[str, ...]
    turns: tuple[TurnOdometry, ...]
    clock: Witness | None = None

    def medians(self) -> dict[str, dict[str, float]]:
        """Return the medians over the turns, by what is measured and by the camera's name."""
        found: dict[str, dict[str, float]] = {
            'rotation_deg': {}, 'rotation_deg_per_100m': {}, 'scale_drift': {}}
        for name in self.names:
            rows = [(turn.rotation_deg(name),
                     100 * turn.rotation_deg(name) / max(turn.length_m, 1e-9),
                     abs(turn.scale_drift(name))) for turn in self.turns]
            for each, median in zip(found.values(), np.median(rows, axis=0), strict=True):
                each[name] = float(median)
        return found


def trivial_guess(image_size: tuple[int, int]) -> Camera:
    """Return what people assume of an unknown camera: f is the width, the centre in the middle."""
    return Radial.centred(image_size, float(image_size[0]))


def beside_poses(solution: Solution, given: Camera, poses: Poses, config: Config) -> Odometry:
    """Compare the motion that cameras find in the turns with true poses.

    The cameras: given, of the turns' pictures; the drive's own; and a trivial guess. Raises
    InputError where no turn has poses.
    """
    own = solution.camera
    cameras = {'given': given, 'ours': own, 'guess': trivial_guess(own.image_size)}
    found = odometry(solution.scenes, cameras, poses, config)
    # a track has the headings of its way, which are not the car's
    return found if poses.of_track else replace(found, clock=spared(
        'the clock of the poses', [], clock_of_poses, solution, poses, config))


def odometry(scenes: Sequence[Scene], cameras: Mapping[str, Camera], poses: Poses, config: Config
             ) -> Odometry:
    """Return what each camera makes of each turn.

    scenes: as solved. cameras: by name, of the scenes' pictures. Raises InputError where no turn
    has poses. Loads COLMAP.
    """
    found = [turn for scene in scenes
             if (turn := _turn(scene, cameras, poses, config)) is not None]
    if not found:
        raise InputError('E-NO-POSES-OF-TURNS',
                         'none of the turns has poses: use poses with the time stamps of the '
                         "drive, or KITTI's format with one line for each frame and no stamps")
    return Odometry(tuple(cameras), tuple(found))


def _turn(scene: Scene, cameras: Mapping[str, Camera], poses: Poses, config: Config
          ) -> TurnOdometry | None:
    from dashcalib_ros.solve.start import scene_with
    tracks = scene.tracks
    rotations, positions, known = poses.at(tracks.frames, tracks.stamps_ns)
    if known.sum() < LEAST_KEYFRAMES:
        return None
    held = {name: scene_with(camera, scene, config) for name, camera in cameras.items()}
    structures = {name: each.structure for name, each in held.items() if each is not None}
    if len(structures) < len(cameras):
        return None
    # the same keyframes for all
    common = np.logical_and.reduce([known, *(each.registered for each in structures.values())])
    if common.sum() < LEAST_KEYFRAMES:
        return None
    paths = {}
    for name, each in structures.items():
        turned = each.rotations[common].transpose(0, 2, 1)
        paths[name] = TurnPath(turned, -np.einsum('kij,kj->ki', turned, each.translations[common]))
    return TurnOdometry(scene.turn, tracks.stamps_ns[common],
                        TurnPath(rotations[common], positions[common]), paths)


def angle_deg(rotations: Floats) -> float:
    """Return the angle of the rotation from the first to the last of (k, 3, 3)."""
    from scipy.spatial.transform import Rotation
    return float(np.degrees(Rotation.from_matrix(rotations[0].T @ rotations[-1]).magnitude()))


def length(positions: Floats) -> float:
    """Return how long the way through positions (k, 3) is."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


TRUE = 'poses'


def path_files(found: Odometry) -> dict[str, str]:
    """Return texts by the names of their files: for each turn and camera a .tum.

    TURN_poses.tum has the true path with the camera's orientation, so that evo can compare the
    others with it: evo_rpe tum turn_000094_poses.tum turn_000094_ours.tum --align --correct_scale
    """
    texts = {}
    mounted = mounting(found)
    for turn in found.turns:
        true = TurnPath(turn.true.rotations @ mounted, turn.true.positions)
        for name, path in {TRUE: true, **turn.paths}.items():
            texts[f'turn_{turn.turn.number:06}_{name}.tum'] = _tum_text(turn, path)
    return texts


def mounting(found: Odometry) -> Floats:
    """Return (3, 3) the rotation from the camera to the frame of the poses (hand-eye).

    From the turns' rotations as the second camera has them, which is the drive's own.
    """
    from scipy.spatial.transform import Rotation
    name = found.names[min(1, len(found.names) - 1)]
    true, seen = (np.concatenate([_since_first(path) for path in paths]) for paths in (
        [turn.true for turn in found.turns], [turn.paths[name] for turn in found.turns]))
    rotation, _ = Rotation.align_vectors(true, seen)
    return np.asarray(rotation.as_matrix())


def _since_first(path: TurnPath) -> Floats:
    """Return (k - 1, 3) the rotation vectors since the first keyframe."""
    from scipy.spatial.transform import Rotation
    return np.asarray(Rotation.from_matrix(
        path.rotations[0].T @ path.rotations[1:]).as_rotvec())


def _tum_text(turn: TurnOdometry, path: TurnPath) -> str:
    from scipy.spatial.transform import Rotation
    quaternions = Rotation.from_matrix(path.rotations).as_quat()
    lines = []
    for stamp_ns, place, quaternion in zip(turn.stamps_ns.tolist(), path.positions, quaternions,
                                           strict=True):
        # as text: a float has too few digits for nanoseconds since 1970
        stamp = f'{stamp_ns // 10**9}.{stamp_ns % 10**9:09}'
        lines.append(' '.join([stamp, *(f'{value:.9f}' for value in (*place, *quaternion))]))
    return '\n'.join(lines) + '\n'
