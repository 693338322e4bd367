# SPDX-License-Identifier: Apache-2.0
"""Turns with exact truth but without pictures: what tests of the geometry are made of."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dashcalib_ros.camera import Camera, Fisheye, Radial
from dashcalib_ros.detect import TurnId
from dashcalib_ros.problem.observations import Structure, Tracks
from dashcalib_ros.reconstruct.scene import Profile, Scene, retriangulated

SIZE = (800, 450)
LENS = Radial(SIZE, 520.0, 521.0, 407.0, 219.0, -0.28, 0.09)
# between two keyframes
KEYFRAME_S = 0.3
NEAR_M, FAR_M = 2.0, 45.0
# before and after a turn; on which the wheel is turned
STRAIGHT_M, EASED_M = 6.0, 4.0
# rad (100 degrees) off the axis, to which tests of a fisheye look
WIDEST = 1.75


@dataclass(frozen=True)
class SyntheticTurn:
    """Truth of a turn: the tracks as they are measured, and the structure behind them."""

    tracks: Tracks
    structure: Structure

    def scene(self, camera: Camera, center: int = 0) -> Scene:
        """Return the scene that is triangulated from the true poses with a camera."""
        ratio = camera.fx / camera.image_size[0]
        ratios = ratio * np.array([0.64, 0.8, 1.0, 1.25, 1.56])
        costs = 0.1 + np.log(ratios / ratio) ** 2
        profile = Profile(ratios, costs, int(self.tracks.seen.sum()))
        scene = Scene(TurnId.at(center), self.tracks, self.structure, camera, profile)
        return retriangulated(scene, camera, 2.0, 1.0)


def rotation(axis: int, angle: float) -> np.ndarray:
    """Return the (3, 3) rotation by an angle in rad about a coordinate axis."""
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[[i, i, j, j], [i, j, i, j]] = [np.cos(angle), -np.sin(angle),
                                          np.sin(angle), np.cos(angle)]
    return matrix


@dataclass(frozen=True)
class Path:
    """How the camera of a turn moves, at any time; as smoothly as cars do.

    yaw: rad, of the whole turn. seconds: (k,) of the keyframes. bumps: (k, 3) pitch and roll, rad,
    and height, m, at the keyframes. shaking: (k, 3) rad/s, by how much faster each keyframe's
    camera turns than this path. aliased: the bumps are faster than the keyframes, so that no path
    through these shows how fast the camera pitches and rolls: as shaking says.
    """

    yaw: float
    seconds: np.ndarray
    bumps: np.ndarray
    shaking: np.ndarray
    aliased: bool = False
    radius_m: float = 10.0

    @property
    def arc_m(self) -> float:
        return abs(self.yaw) * self.radius_m

    def heading(self, at_m: np.ndarray) -> np.ndarray:
        """Return the heading, rad: of a circle into which the wheel turns within EASED_M."""
        def summed(x: np.ndarray) -> np.ndarray:
            inside = np.clip(x, 0, self.arc_m)
            return inside**2 / 2 + self.arc_m * np.maximum(x - self.arc_m, 0)

        x = at_m - STRAIGHT_M
        return np.sign(self.yaw) / self.radius_m / EASED_M * (
            summed(x + EASED_M / 2) - summed(x - EASED_M / 2))

    def local(self, points: np.ndarray, late_s: np.ndarray) -> np.ndarray:
        """Return (k, t, 3) points (t, 3) in the camera's axes so long after each keyframe (k, t).
        """
        length = self.arc_m + 2 * STRAIGHT_M
        fine = np.linspace(-2 * STRAIGHT_M, length + 2 * STRAIGHT_M, 4000)
        heading, step = self.heading(fine), fine[1] - fine[0]
        seconds = self.seconds[:, None] + late_s
        at = length * seconds / self.seconds[-1]
        x, z = (np.interp(at, fine, np.cumsum(along(heading)) * step)
                for along in (np.sin, np.cos))
        pitch, roll, height = np.moveaxis(self._bumps(seconds), -1, 0)
        local = points - np.stack([x, height, z], axis=-1)
        for axis, angle in ((1, self.heading(at)), (0, pitch), (2, roll)):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            first, second = local[..., i], local[..., j]
            local[..., i], local[..., j] = (
                np.cos(angle) * first + np.sin(angle) * second,
                np.cos(angle) * second - np.sin(angle) * first)
        return local + np.cross(self.shaking[:, None] * late_s[..., None], local)

    def _bumps(self, seconds: np.ndarray) -> np.ndarray:
        keyframes = np.broadcast_to(self.seconds[:, None], seconds.shape)
        if self.aliased or np.array_equal(seconds, keyframes):
            return np.broadcast_to(self.bumps[:, None], (*seconds.shape, 3))
        # it takes half a second to load, and test_rooms.py says where it is not needed
        from scipy.interpolate import CubicSpline
        return CubicSpline(self.seconds, self.bumps)(seconds)

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world-to-camera rotations (k, 3, 3) and translations (k, 3): x right, y down."""
        axes = np.concatenate([np.zeros((1, 3)), np.eye(3)])
        local = self.local(axes, np.zeros((len(self.seconds), 4)))
        return (local[:, 1:] - local[:, :1]).transpose(0, 2, 1), local[:, 0]


def path_of(yaw_deg: float, seconds: np.ndarray, seed: int, shaking_deg_s: float = 0.0,
            aliased: bool = False) -> Path:
    """Return a turn's path, with random bumps; shaking_deg_s: of pitch and roll."""
    rng, count = np.random.default_rng([seed, 1]), len(seconds)
    bumps = rng.standard_normal((count, 3)) * (*np.radians([0.7, 0.7]), 0.03)
    shaking = np.radians(shaking_deg_s) * rng.standard_normal((count, 3)) * (1, 0, 1)
    return Path(np.radians(yaw_deg), seconds, bumps, shaking, aliased)


def synthetic_turn(camera: Camera = LENS, yaw_deg: float = 80.0, keyframes: int = 20,
                   tracks: int = 350, noise_px: float = 0.2, outliers: float = 0.0, seed: int = 0,
                   world: int = 0, extra: tuple[float, float, float] = (0.0, 0.0, 0.0),
                   readout_s: float = 0.0, shaking_deg_s: float = 0.0,
                   keyframe_s: float = KEYFRAME_S, uneven: float = 0.0,
                   aliased: bool = False) -> SyntheticTurn:
    """Return a turn through random points.

    seed: of the noise; world: of the path and the points. outliers: share of the observations that
    are 5 to 40 px off. extra: p1, p2, k3 of the lens that took the pictures.
    readout_s: of a rolling shutter. shaking_deg_s: how fast bumps pitch and roll the camera in
    each keyframe, which no path through the keyframes shows. keyframe_s: between two keyframes;
    uneven: of it, up to which their true times differ from the even ones that they have. aliased:
    the bumps are faster than the keyframes.
    """
    rng = np.random.default_rng([world, 2])
    late = uneven * np.random.default_rng([world, 4]).uniform(-1, 1, keyframes)
    path = path_of(yaw_deg, keyframe_s * (np.arange(keyframes) + late), world, shaking_deg_s,
                   aliased)
    rotations, translations = path.poses()
    centres = -np.einsum('kji,kj->ki', rotations, translations)
    many = 40 * tracks
    # in front of some image, between the kerb and the roofs
    origin = rng.integers(0, keyframes, many)
    depth = np.exp(rng.uniform(np.log(4.0), np.log(35.0), many))
    local = np.stack([rng.uniform(-0.8, 0.8, many) * depth, rng.uniform(-5, 1.4, many), depth], 1)
    points = np.einsum('nji,nj->ni', rotations[origin], local) + centres[origin]
    seen_from = points @ rotations.transpose(0, 2, 1) + translations[:, None]
    width, height = camera.image_size
    wide = isinstance(camera, Fisheye)
    distance = np.linalg.norm(seen_from, axis=2) if wide else seen_from[:, :, 2]
    behind = distance < NEAR_M
    seen_from[behind] = [0, 0, 1]
    xy = project(seen_from, camera, extra)
    for _ in range(4 if readout_s else 0):
        late = np.clip((xy[:, :, 1] + 0.5) / height - 0.5, -1.0, 1.0)
        seen_from = path.local(points, readout_s * late)
        seen_from[behind] = [0, 0, 1]
        xy = project(seen_from, camera, extra)
    off_axis = np.linalg.norm(seen_from[:, :, :2], axis=2)
    in_view = (np.arctan2(off_axis, seen_from[:, :, 2]) < WIDEST if wide else
               off_axis / seen_from[:, :, 2] < 0.98 * fold_radius(camera))
    visible = (~behind & (distance < FAR_M) & in_view
               & (xy[:, :, 0] > 8) & (xy[:, :, 0] < width - 9)
               & (xy[:, :, 1] > 8) & (xy[:, :, 1] < height - 9))
    visible = longest_runs(visible)
    chosen = np.flatnonzero(visible.sum(axis=0) >= 4)
    chosen = np.sort(rng.choice(chosen, min(tracks, len(chosen)), replace=False))
    noise = np.random.default_rng([seed, world, 3])
    measured = xy[:, chosen] + noise_px * noise.standard_normal((keyframes, len(chosen), 2))
    wrong = noise.random((keyframes, len(chosen))) < outliers
    angle = noise.uniform(0, 2 * np.pi, wrong.sum())
    measured[wrong] += (noise.uniform(5, 40, wrong.sum())[:, None]
                        * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    measured[~visible[:, chosen]] = np.nan
    everything = Tracks(np.arange(keyframes) * 3, measured, camera.image_size,
                        np.arange(keyframes) * round(keyframe_s * 1e9))
    structure = Structure(rotations, translations, points[chosen], np.ones(keyframes, bool),
                          visible[:, chosen])
    return SyntheticTurn(everything, structure)


def project(points: np.ndarray, camera: Camera, extra: tuple[float, float, float]) -> np.ndarray:
    """Return pixels of points in the camera's frame, with OpenCV's p1, p2, k3 besides."""
    if isinstance(camera, Fisheye):
        return project_wide(points, camera)
    p1, p2, k3 = extra
    x, y = np.moveaxis(points[..., :2] / points[..., 2:], -1, 0)
    square = x * x + y * y
    radial = 1 + camera.k1 * square + camera.k2 * square**2 + k3 * square**3
    return np.stack([
        camera.fx * (x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)) + camera.cx,
        camera.fy * (y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y) + camera.cy], -1)


def project_wide(points: np.ndarray, camera: Fisheye) -> np.ndarray:
    """Return pixels of points anywhere: equidistant, with four coefficients."""
    radius = np.maximum(np.hypot(points[..., 0], points[..., 1]), 1e-12)
    theta = np.arctan2(radius, points[..., 2])
    bent = theta + sum(k * theta ** (2 * n + 3)
                       for n, k in enumerate((camera.k1, camera.k2, camera.k3, camera.k4)))
    return np.stack([camera.fx * bent * points[..., 0] / radius + camera.cx,
                     camera.fy * bent * points[..., 1] / radius + camera.cy], -1)


def fold_radius(camera: Camera) -> float:
    """Return the undistorted radius at which the distortion folds over."""
    roots = np.roots([5 * camera.k2, 3 * camera.k1, 1.0])
    real = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 0]
    return float(np.sqrt(min(real))) if real else 6.0


def longest_runs(visible: np.ndarray) -> np.ndarray:
    """Return (k, t) with only each column's longest run of True: a track that is lost is lost."""
    lengths = np.zeros(visible.shape, int)
    for k, row in enumerate(visible):
        # nothing is before the first row, and the last one is still 0
        lengths[k] = (lengths[k - 1] + 1) * row
    last, rows = lengths.argmax(axis=0), np.arange(len(visible))[:, None]
    return (rows <= last) & (rows > last - lengths.max(axis=0))


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle between two rotations, in degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1))))
