"""A reconstructed turn: its tracks, structure, camera and focal profile."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.reconstruction.structure import Structure, triangulate
from dashcalib_ros.reconstruction.tracks import Tracks
from dashcalib_ros.turns.turn import TurnId


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
        """Return a start for each kind of lens that was tried, by its ros_model."""
        starts = (*self.rivals, Start(self.profile, self.camera))
        return {start.camera.ros_model: start for start in starts}

    @property
    def yaw_deg(self) -> float:
        """Return by how much the camera turned about its vertical axis, in degrees."""
        return float(np.ptp(self.yaws_deg))

    @property
    def yaws_deg(self) -> Floats:
        """Return the yaw of each registered keyframe since the first one, degrees."""
        rotations = self.structure.rotations[self.structure.registered]
        # the optical axes in the first camera's frame: pitch and roll do not count
        ahead = rotations[:, 2] @ rotations[0].T
        return np.asarray(np.degrees(np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 2]))))

    @property
    def explained(self) -> float:
        """Return the share of all observations that the structure explains."""
        return float(self.structure.used.sum() / max(int(self.tracks.seen.sum()), 1))


def errors_px(scene: Scene, camera: Camera) -> Floats:
    """Return (k, t) reprojection errors in px; inf where the scene does not explain a track."""
    structure = scene.structure
    residual = residuals_px(scene, camera)
    explained = structure.registered[:, None] & structure.used.any(axis=0)
    error = np.linalg.norm(residual, axis=2)
    return np.asarray(np.where(explained & np.isfinite(error), error, np.inf))


def residuals_px(scene: Scene, camera: Camera) -> Floats:
    """Return (k, t, 2) projected minus observed, px; NaN where unseen or behind the camera."""
    structure = scene.structure
    local = (structure.points @ structure.rotations.transpose(0, 2, 1)
             + structure.translations[:, None])
    return np.asarray(camera.project(local) - scene.tracks.xy)


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
