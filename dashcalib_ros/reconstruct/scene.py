# SPDX-License-Identifier: Apache-2.0
"""A reconstructed turn: tracks, poses and points, camera, focal profile; and a picture of it."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, GreyImage, Mask, Pixels
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.rotation import centres_of
from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.problem.observations import Stretch, Tracks, main_axis

# cosine (11 degrees); a point farther off its viewing ray is an outlier, wherever it projects
ALONG = 0.98
# px^2 per observation; a profile whose minimum is higher may have it anywhere
BAD_COST = 1.8
# by which the road may turn a car about any axis
BUMPS_DEG = 10.0
# degrees of yaw; a stretch that has less is straight
BEND_DEG = 3.0
# px; wider pictures are made smaller: several of them go into one report
PICTURE_WIDTH = 720
# world to camera: rotation (3, 3), translation (3,)
Pose = tuple[Floats, Floats]

# minimum number of keyframes of a turn; with fewer it is not reconstructed
MIN_KEYFRAMES = 6


def triangulate(camera: Camera, rays: Floats, rotations: Floats, translations: Floats,
                registered: Mask, error_px: float, min_angle_deg: float
                ) -> tuple[Floats, Mask]:
    """Triangulate every track from all registered images that see it, linearly.

    rays: (k, t, 3) unit viewing rays. error_px: largest error, see ray_errors_px().
    Returns points (t, 3) and used (k, t): the good observations of the points that are kept. Those
    have at least 2 good observations and a triangulation angle of at least min_angle_deg.
    """
    rays, rotations, translations = (
        each[registered] for each in (rays, rotations, translations))
    seen = np.isfinite(rays[:, :, 0])
    flat = camera.without_distortion()
    pixels = flat.project(rays)

    def good_of(points: Floats, tracks: Mask | slice) -> Mask:
        error = _errors_px(flat, rays[:, tracks], pixels[:, tracks], rotations, translations,
                           points)
        return np.asarray(seen[:, tracks] & (error < error_px), bool)

    points = _linear_points(rays, rotations, translations, seen)
    good = good_of(points, np.s_[:])
    # a bad observation makes a linear solution wrong: solve again without it
    spoiled = (good.sum(axis=0) >= 2) & (good.sum(axis=0) < seen.sum(axis=0))
    if spoiled.any():
        points[spoiled] = _linear_points(
            rays[:, spoiled], rotations, translations, good[:, spoiled])
        good[:, spoiled] = good_of(points[spoiled], spoiled)
    enough = (good.sum(axis=0) >= 2) & (
        _widest_angle(rotations, translations, points, good) > np.radians(min_angle_deg))
    used = np.zeros((len(registered), len(points)), bool)
    used[registered] = good & enough
    return points, used


def ray_errors_px(camera: Camera, rays: Floats, rotations: Floats, translations: Floats,
                  points: Floats) -> Floats:
    """Return (k, t) reprojection errors, px; inf where a point does not lie along its ray.

    They are those of a picture without distortion: barrel distortion makes the rim of the picture
    small, and errors there, too. A model that folds over projects other directions to the same
    pixel, too: those do not count.
    """
    flat = camera.without_distortion()
    return _errors_px(flat, rays, flat.project(rays), rotations, translations, points)


def _errors_px(flat: Camera, rays: Floats, pixels: Floats, rotations: Floats,
               translations: Floats, points: Floats) -> Floats:
    local = points @ rotations.transpose(0, 2, 1) + translations[:, None]
    # einsum takes a fifth of the time of norm
    along = np.einsum('ktc,ktc->kt', local, rays) > ALONG * np.sqrt(
        np.einsum('ktc,ktc->kt', local, local))
    off = flat.project(local) - pixels
    error = np.sqrt(np.einsum('ktc,ktc->kt', off, off))
    return np.asarray(np.where(along & np.isfinite(error), error, np.inf))


def _linear_points(rays: Floats, rotations: Floats, translations: Floats, seen: Mask) -> Floats:
    """Return (t, 3) points that minimise the algebraic error over their observations.

    With P = [R t] and a unit ray r, the error of a homogeneous point X is P X - r (r . P X).
    """
    poses = np.concatenate([rotations, translations[:, :, None]], axis=2)
    along = np.where(seen[:, :, None], rays, 0.0) @ poses
    squares = (poses.transpose(0, 2, 1) @ poses).reshape(-1, 16)
    normal = (seen.T.astype(np.float64) @ squares).reshape(-1, 4, 4)
    normal -= along.transpose(1, 2, 0) @ along.transpose(1, 0, 2)
    homogeneous = _least_eigenvectors(normal)
    scale = homogeneous[:, 3:]
    scale = np.where(np.abs(scale) < 1e-12, 1e-12, scale)
    return np.asarray(homogeneous[:, :3] / scale)


def _least_eigenvectors(matrices: Floats) -> Floats:
    """Return (t, n) the eigenvector of the least eigenvalue of each matrix (t, n, n).

    The matrices are symmetric and have no negative eigenvalues. Inverse iteration takes half the
    time of finding all eigenvectors.
    """
    size = matrices.shape[-1]
    # added to the diagonal: the eigenvectors stay, and a singular matrix has an inverse, too
    small = 1e-12 * np.trace(matrices, axis1=1, axis2=2) + 1e-30
    power = np.linalg.inv(matrices + small[:, None, None] * np.eye(size))
    for _ in range(2):
        power = power @ power
        power /= np.max(np.abs(power), axis=(1, 2), keepdims=True)
    largest = np.argmax(np.einsum('tnn->tn', power), axis=1)
    return np.asarray(power[np.arange(len(power)), largest])


def _widest_angle(rotations: Floats, translations: Floats, points: Floats, seen: Mask) -> Floats:
    """Return (t,) the angle in radians between the first and the last ray of each track."""
    centres = centres_of(rotations, translations)
    first = seen.argmax(axis=0)
    last = len(seen) - 1 - seen[::-1].argmax(axis=0)
    a, b = points - centres[first], points - centres[last]
    # atan2 is exact for small angles, arccos is not
    return np.asarray(
        np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


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

    @property
    def tells(self) -> bool:
        """Return whether the turn is explained well enough for its minimum to mean anything."""
        return bool(self.costs.min() <= BAD_COST)

    def contrast(self, ratio: float) -> float:
        """Return the relative rise of the cost from the sample at a ratio to the lowest other one.

        Negative when another focal length explains the observations better.
        """
        at = int(np.argmin(np.abs(self.ratios - ratio)))
        return float(np.delete(self.costs, at).min() / self.costs[at] - 1)


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
class Scene(Stretch):
    """One turn, reconstructed: its tracks, the structure that explains them, and its profile.

    profile: of the camera's kind of lens. rivals: the starts of other kinds that were tried.
    """

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
    def right_deg(self) -> float:
        """Return the heading at its end against that at its start, positive to the right."""
        return float(self.yaws_deg[-1] - self.yaws_deg[0])

    @cached_property
    def yaws_deg(self) -> Floats:
        """Return the yaw of each registered keyframe since the first one, degrees."""
        yaws = -np.degrees(self.turned @ main_axis(self.turned))
        # less than bumps do: then what counts is the vertical of upright pictures
        return np.asarray(yaws if np.ptp(yaws) > BUMPS_DEG else -np.degrees(self.turned[:, 1]))

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


def rms_px(scenes: Sequence[Scene], camera: Camera) -> float:
    """Return the root mean square of the used observations' errors in px, of those it projects.

    One that a camera, found later, no longer projects has no error.
    """
    errors = np.concatenate([errors_px(scene, camera)[scene.structure.used] for scene in scenes])
    return float(np.sqrt(np.mean(errors[np.isfinite(errors)] ** 2)))


def residuals_px(scene: Scene, camera: Camera) -> Floats:
    """Return (k, t, 2) projected minus observed, px; NaN where unseen or behind the camera."""
    return np.asarray(camera.project(scene.structure.local) - scene.tracks.xy)


def truncated_cost(scene: Scene, camera: Camera, limit_px: float) -> float:
    """Return the mean squared error over every observation, px^2, each cut at the limit.

    An observation that the scene leaves out costs the full limit: a scene that explains a few
    tracks perfectly does not win over one that explains them all.
    """
    seen = scene.tracks.seen
    errors = np.minimum(errors_px(scene, camera), limit_px)
    return float(np.sum(errors[seen] ** 2) / max(int(seen.sum()), 1))


def rays_of(tracks: Tracks, camera: Camera) -> Floats:
    """Return (k, t, 3) unit viewing rays; NaN where a track is not seen, which most are not."""
    seen = tracks.seen
    rays = np.full((*seen.shape, 3), np.nan)
    rays[seen] = camera.rays(tracks.xy[seen])
    return rays


def retriangulated(scene: Scene, camera: Camera, limit_px: float, min_angle_deg: float) -> Scene:
    """Return the scene with every track triangulated anew, also those that were not used."""
    structure = scene.structure
    points, used = triangulate(
        camera, rays_of(scene.tracks, camera), structure.rotations, structure.translations,
        structure.registered, limit_px, min_angle_deg)
    return replace(scene, structure=replace(structure, points=points, used=used), camera=camera)


@dataclass(frozen=True)
class TurnPicture:
    """A picture of a turn, for people: small, and of a keyframe, so that tracks fit on it.

    frame: its index among the input's frames; stamp_ns: its time.
    image: uint8, at most PICTURE_WIDTH wide; (h, w) grey, or (h, w, 3) BGR.
    """

    frame: int
    stamp_ns: int
    image: Pixels

    def coloured(self, image: Pixels) -> TurnPicture:
        """Return the same with the input's own image of this frame, grey or in colour."""
        size = self.image.shape[1::-1]
        return replace(self, image=cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def picture_of(turn: Turn, scene: Scene | None) -> TurnPicture | None:
    """Return the picture at the turn's centre: of a registered keyframe, if there is a scene.

    None where the turn has no frames any more.
    """
    shown = {frame.index: frame for frame in turn.frames}
    if scene is not None:
        registered = scene.tracks.frames[scene.structure.registered]
        shown = {index: shown[index] for index in map(int, registered) if index in shown}
    if not shown:
        return None
    index = min(shown, key=lambda index: abs(index - turn.center))
    return TurnPicture(index, shown[index].stamp_ns, _small(shown[index].image))


def _small(image: GreyImage) -> GreyImage:
    height, width = image.shape
    if width <= PICTURE_WIDTH:
        # a view may keep much more than this picture in memory
        return np.array(image)
    size = (PICTURE_WIDTH, max(1, round(height * PICTURE_WIDTH / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
