"""How well a camera finds the car's true motion: the turns' rotations and scales beside poses.

Each turn is adjusted with each camera held, all alike. The angle of a turn's rotation is the same
in every frame that is fixed to the car: nothing has to be known of where the poses' sensor sits.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera import Camera, Radial
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.errors import InputError
from dashcalib_ros.judge.poses import Poses
from dashcalib_ros.reconstruct.scene import Scene

# keyframes with poses; a turn with fewer says nothing
LEAST_KEYFRAMES = 4


@dataclass(frozen=True)
class Path:
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
    true: Path
    paths: Mapping[str, Path]

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
    """All turns that have poses. names: of the cameras."""

    names: tuple[str, ...]
    turns: tuple[TurnOdometry, ...]

    def medians(self) -> dict[str, dict[str, float]]:
        """Return the medians over the turns, by what is measured and by the camera's name."""
        def of(value: str, name: str) -> float:
            values = {'rotation_deg': lambda turn: turn.rotation_deg(name),
                      'rotation_deg_per_100m':
                          lambda turn: 100 * turn.rotation_deg(name) / max(turn.length_m, 1e-9),
                      'scale_drift': lambda turn: abs(turn.scale_drift(name))}
            return float(np.median([values[value](turn) for turn in self.turns]))
        return {value: {name: of(value, name) for name in self.names}
                for value in ('rotation_deg', 'rotation_deg_per_100m', 'scale_drift')}


def trivial_guess(image_size: tuple[int, int]) -> Camera:
    """Return what people assume of an unknown camera: f is the width, the centre in the middle."""
    return Radial.centred(image_size, float(image_size[0]))


def odometry(scenes: Sequence[Scene], cameras: Mapping[str, Camera], poses: Poses, config: Config
             ) -> Odometry:
    """Return what each camera makes of each turn.

    scenes: as solved. cameras: by name, of the scenes' pictures. Raises InputError where no turn
    has poses. Loads COLMAP.
    """
    found = [turn for scene in scenes
             if (turn := _turn(scene, cameras, poses, config)) is not None]
    if not found:
        raise InputError('none of the turns has poses: do their stamps fit those of the drive? '
                         "KITTI's format has one line for each frame, and needs no stamps")
    return Odometry(tuple(cameras), tuple(found))


def _turn(scene: Scene, cameras: Mapping[str, Camera], poses: Poses, config: Config
          ) -> TurnOdometry | None:
    from dashcalib_ros.solve.fitting import scene_with
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
        paths[name] = Path(turned, -np.einsum('kij,kj->ki', turned, each.translations[common]))
    return TurnOdometry(scene.turn, tracks.stamps_ns[common],
                        Path(rotations[common], positions[common]), paths)


def angle_deg(rotations: Floats) -> float:
    """Return the angle of the rotation from the first to the last of (k, 3, 3)."""
    between = rotations[0].T @ rotations[-1]
    # exact for small angles, too
    sine = np.linalg.norm([between[2, 1] - between[1, 2], between[0, 2] - between[2, 0],
                           between[1, 0] - between[0, 1]]) / 2
    return float(np.degrees(np.arctan2(sine, (np.trace(between) - 1) / 2)))


def length(positions: Floats) -> float:
    """Return how long the way through positions (k, 3) is."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
