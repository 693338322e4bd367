"""Turns with exact truth but without pictures: what tests of the geometry are made of."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dashcalib_ros.camera import Camera, Fisheye, Radial
from dashcalib_ros.detect import TurnId
from dashcalib_ros.reconstruct.scene import Profile, Scene, Structure, retriangulated
from dashcalib_ros.reconstruct.tracks import Tracks

SIZE = (800, 450)
LENS = Radial(SIZE, 520.0, 521.0, 407.0, 219.0, -0.28, 0.09)
# between two keyframes
KEYFRAME_S = 0.3
NEAR_M, FAR_M = 2.0, 45.0
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


def poses_of_turn(yaw_deg: float, count: int, seed: int, radius_m: float = 10.0,
                  tilt_deg: float = 0.7) -> tuple[np.ndarray, np.ndarray]:
    """Return world-to-camera rotations (k, 3, 3) and translations (k, 3): x right, y down."""
    rng = np.random.default_rng([seed, 1])
    arc = abs(np.radians(yaw_deg)) * radius_m
    length = arc + 12.0
    at = np.linspace(0, length, count)
    heading = np.sign(yaw_deg) * np.clip(at - 6.0, 0, arc) / radius_m
    fine = np.linspace(0, length, 2000)
    fine_heading = np.sign(yaw_deg) * np.clip(fine - 6.0, 0, arc) / radius_m
    step = fine[1]
    x = np.interp(at, fine, np.cumsum(np.sin(fine_heading)) * step)
    z = np.interp(at, fine, np.cumsum(np.cos(fine_heading)) * step)
    centres = np.stack([x, 0.03 * rng.standard_normal(count), z], axis=1)
    tilt = np.radians(tilt_deg) * rng.standard_normal((count, 2))
    rotations = np.array([
        (rotation(1, heading[k]) @ rotation(0, tilt[k, 0]) @ rotation(2, tilt[k, 1])).T
        for k in range(count)])
    return rotations, -np.einsum('kij,kj->ki', rotations, centres)


def synthetic_turn(camera: Camera = LENS, yaw_deg: float = 80.0, keyframes: int = 20,
                   tracks: int = 350, noise_px: float = 0.2, outliers: float = 0.0, seed: int = 0,
                   world: int = 0, extra: tuple[float, float, float] = (0.0, 0.0, 0.0),
                   readout_s: float = 0.0) -> SyntheticTurn:
    """Return a turn through random points.

    seed: of the noise; world: of the path and the points. outliers: share of the observations that
    are 5 to 40 px off. extra: p1, p2, k3 of the lens that took the pictures.
    readout_s: of a rolling shutter; keyframes are KEYFRAME_S apart.
    """
    rng = np.random.default_rng([world, 2])
    rotations, translations = poses_of_turn(yaw_deg, keyframes, world)
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
    global_shutter = seen_from.copy()
    seen_from[behind] = [0, 0, 1]
    xy = project(seen_from, camera, extra)
    for _ in range(4 if readout_s else 0):
        late = ((xy[:, :, 1] + 0.5) / height - 0.5) * readout_s / KEYFRAME_S
        seen_from = between(global_shutter, np.clip(late, -1.0, 1.0))
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
                        np.arange(keyframes) * round(KEYFRAME_S * 1e9))
    structure = Structure(rotations, translations, points[chosen], np.ones(keyframes, bool),
                          visible[:, chosen])
    return SyntheticTurn(everything, structure)


def between(local: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return (k, t, 3) points a share (k, t) of the way to the next keyframe, or the last."""
    step = np.diff(local, axis=0)
    ahead, back = np.concatenate([step, step[-1:]]), np.concatenate([step[:1], step])
    return local + share[:, :, None] * np.where(share[:, :, None] > 0, ahead, back)


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
