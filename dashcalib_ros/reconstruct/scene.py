"""A reconstructed turn: its tracks, structure, camera and focal profile."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.structure import Structure, triangulate
from dashcalib_ros.reconstruct.tracks import Tracks

# by which the road may turn a car about any axis
BUMPS_DEG = 10.0


@dataclass(frozen=True)
class Profile:
    """How well a turn can be explained at each focal length held fixed.

    ratios: (n,) focal length over image width, ascending. costs: (n,) truncated_cost(), px^2 per
    observation. observations: how many there were.
    """

    ratios: Floats
    costs: Floats
    observations: int

    @property
    def best(self) -> float:
        """Return the ratio with the least cost."""
        return float(self.ratios[np.argmin(self.costs)])


@dataclass(frozen=True)
class Start:
    """Where a kind of lens may start from: its focal profile, and the camera of its minimum."""

    profile: Profile
    camera: Camera


@dataclass(frozen=True)
class Draft:
    """A turn half reconstructed: its tracks, and where to start from.

    rivals: the starts of other kinds of lenses that were tried.
    """

    tracks: Tracks
    start: Start
    rivals: tuple[Start, ...] = ()


@dataclass(frozen=True)
class Scene:
    """One turn, reconstructed: its tracks, the structure that explains them, and its profile.

    profile: of the camera's kind of lens. rivals: the starts of other kinds that were tried.
    """

    turn: TurnId
    tracks: Tracks
    structure: Structure
    camera: Camera
    profile: Profile
    rivals: tuple[Start, ...] = ()

    @property
    def starts(self) -> dict[str, Start]:
        """Return a start for each kind of lens that was tried, by its family."""
        starts = (*self.rivals, Start(self.profile, self.camera))
        return {start.camera.family: start for start in starts}

    @property
    def yaw_deg(self) -> float:
        """Return by how much the camera turned about the axis of the turn, in degrees."""
        return float(np.ptp(self.yaws_deg))

    @property
    def yaws_deg(self) -> Floats:
        """Return the yaw of each registered keyframe since the first one, degrees."""
        yaws = -np.degrees(self.turned @ main_axis(self.turned))
        # less than bumps do: then what counts is the vertical of upright pictures
        return np.asarray(yaws if np.ptp(yaws) > BUMPS_DEG else -np.degrees(self.turned[:, 1]))

    @property
    def turned(self) -> Floats:
        """Return (k, 3) rad, by how much each registered keyframe turned about x, y and z.

        It is the sum of the steps since the first one, each in the camera's own frame: a car turns
        about one axis of it, the vertical, which is (0, 1, 0) where the pictures are upright.
        """
        from scipy.spatial.transform import Rotation
        rotations = self.structure.rotations[self.structure.registered]
        steps = Rotation.from_matrix(rotations[1:] @ rotations[:-1].transpose(0, 2, 1))
        return np.concatenate([np.zeros((1, 3)), np.cumsum(steps.as_rotvec(), axis=0)])

    @property
    def explained(self) -> float:
        """Return the share of all observations that the structure explains."""
        return float(self.structure.used.sum() / max(int(self.tracks.seen.sum()), 1))


def main_axis(turned: Floats) -> Floats:
    """Return the unit vector about which was turned most, its largest component positive."""
    axis = np.linalg.svd(turned, full_matrices=False)[2][0]
    return np.asarray(axis * np.sign(axis[np.argmax(np.abs(axis))]))


def errors_px(scene: Scene, camera: Camera) -> Floats:
    """Return (k, t) reprojection errors in px; inf where the scene does not explain a track."""
    structure = scene.structure
    residual = residuals_px(scene, camera)
    explained = structure.registered[:, None] & structure.used.any(axis=0)
    error = np.linalg.norm(residual, axis=2)
    return np.asarray(np.where(explained & np.isfinite(error), error, np.inf))


def rms_px(scenes: Sequence[Scene], camera: Camera) -> float:
    """Return the root mean square of the used observations' errors in px, of those it projects.

    One that a camera, found later, no longer projects has no error.
    """
    errors = np.concatenate([errors_px(scene, camera)[scene.structure.used] for scene in scenes])
    return float(np.sqrt(np.mean(errors[np.isfinite(errors)] ** 2)))


def residuals_px(scene: Scene, camera: Camera) -> Floats:
    """Return (k, t, 2) projected minus observed, px; NaN where unseen or behind the camera."""
    structure = scene.structure
    local = (structure.points @ structure.rotations.transpose(0, 2, 1)
             + structure.translations[:, None])
    return np.asarray(camera.project(local) - scene.tracks.xy)


def projected_px(scene: Scene, camera: Camera) -> Floats:
    """Return (n, 2) where the points of the used observations are projected, image by image."""
    structure = scene.structure
    image, point = np.nonzero(structure.used)
    local = np.einsum('nij,nj->ni', structure.rotations[image], structure.points[point])
    return camera.project(local + structure.translations[image])


def truncated_cost(scene: Scene, camera: Camera, limit_px: float) -> float:
    """Return the mean squared error over every observation, px^2, each cut at the limit.

    An observation that the scene leaves out costs the full limit: a scene that explains a few
    tracks perfectly does not win over one that explains them all.
    """
    seen = scene.tracks.seen
    errors = np.minimum(errors_px(scene, camera), limit_px)
    return float(np.sum(errors[seen] ** 2) / max(int(seen.sum()), 1))


def retriangulated(scene: Scene, camera: Camera, limit_px: float, min_angle_deg: float) -> Scene:
    """Return the scene with every track triangulated anew, also those that were not used."""
    structure = scene.structure
    points, used = triangulate(
        camera, camera.rays(scene.tracks.xy), structure.rotations, structure.translations,
        structure.registered, limit_px, min_angle_deg)
    return replace(scene, structure=replace(structure, points=points, used=used), camera=camera)
