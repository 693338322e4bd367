# SPDX-License-Identifier: Apache-2.0
"""Random dashcams: lens, shutter, glass, picture and drive of each are drawn from a seed.

A drive is rendered, and its turns are reconstructed: that takes most of the time of a calibration,
and does not change with the solution. So it is kept in a file, with the truth.
"""
from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from mapping import GRID, camera_that_sees
from measure import ALL_KEYS, processor_s
from wide import WideDrive

from dashcalib_ros import Calibrator, Config
from dashcalib_ros.demo import Drive, DriveSpec, FisheyeLens, Glass, Lens, Turn
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.stamps import least_step_ns
from dashcalib_ros.judge.conclude import Evidence, evidence_of_detection
from dashcalib_ros.reconstruct.scene import Scene

Floats = npt.NDArray[np.float64]
AnyLens = Lens | FisheyeLens

# (width, height) and how often
SIZES = {(640, 360): 3, (640, 480): 3, (800, 450): 2, (848, 480): 3, (960, 540): 4,
         (1024, 576): 2, (1242, 375): 1, (1280, 720): 4, (1392, 512): 1, (1920, 1080): 1}
# Hz and how often
RATES = {10.0: 5, 12.5: 3, 15.0: 4, 20.0: 2, 25.0: 1, 30.0: 2}
# shares of the cameras
FISHEYES, GLASSES, SHUTTERS, DECENTRED, NEAR_FOLDS = 0.25, 0.35, 0.6, 0.5, 0.25
# share of the turns that are bends; degrees and radius of both
BENDS, BEND_DEG, BEND_RADIUS_M = 0.25, (15.0, 40.0), (25.0, 80.0)
TURN_DEG, TURN_RADIUS_M = (30.0, 90.0), (8.0, 13.0)
# share of the cameras whose pixels may be up to 1 % from square
STRETCHED = 0.3
# k1 of the strongest barrel
MOST_BARREL = -0.42
# of a pinhole: undistorted radius, in focal lengths, of what the corners see
WIDEST_RADIUS = 3.0
WIDEST_CORNER_DEG = 100.0


@dataclass(frozen=True)
class Case:
    """What is made of a seed. size: of the input; the truth is in its pixels.

    scenes: what solve() gets with config, the best first. more: what it gets where these leave
    the result weak; empty where there are no more. evidence: what conclude() gets. lens: the
    parameters. pixels, rays: (n, 2), (n, 3) over the whole picture, through lens and glass.
    closest: of each model, the camera that sees these rays best. cpu_s: of rendering and tracking.
    """

    seed: int
    config: Config
    scenes: tuple[Scene, ...]
    more: tuple[Scene, ...]
    evidence: Evidence
    size: tuple[int, int]
    lens: Mapping[str, Any]
    pixels: Floats
    rays: Floats
    closest: Mapping[str, Mapping[str, float]]
    readout_ms: float
    glass: Glass | None
    spec: DriveSpec
    cpu_s: float


def load_case(path: Path) -> Case:
    """Return what save_case() has written."""
    with path.open('rb') as file:
        case: Case = pickle.load(file)
    return case


def save_case(case: Case, path: Path) -> None:
    """Write a case; an interrupted run leaves no file, or a whole one."""
    fresh = path.with_suffix('.new')
    with fresh.open('wb') as file:
        pickle.dump(case, file)
    fresh.replace(path)


def drive_of(seed: int) -> Drive:
    """Return the drive of a seed: its own camera, street and turns."""
    rng = np.random.default_rng([seed, 47])
    size = _one_of(SIZES, rng)
    rate = _one_of(RATES, rng)
    count = int(rng.integers(3, 7))
    bends = rng.random(count) < BENDS
    side = rng.choice([-1.0, 1.0])
    spec = DriveSpec(
        seed=seed, rate=rate,
        turns=tuple(Turn(float(side * (-1.0) ** i * rng.uniform(*BEND_DEG if bend else TURN_DEG)),
                         float(rng.uniform(*BEND_RADIUS_M if bend else TURN_RADIUS_M)))
                    for i, bend in enumerate(bends)),
        straight_m=float(rng.uniform(20.0, 30.0)), lead_m=float(rng.uniform(20.0, 30.0)),
        speed_mps=float(rng.uniform(8.0, 12.0)), turn_speed_mps=float(rng.uniform(4.5, 7.0)),
        height_m=float(rng.uniform(1.1, 1.7)), mount_deg=float(rng.uniform(0.5, 4.0)),
        vibration_deg=float(rng.uniform(0.1, 0.7)),
        shortest_bump_m=float(rng.uniform(0.8, 2.5)), noise=float(rng.uniform(0.5, 4.0)),
        blur=float(rng.uniform(0.3, 1.0)), vignetting=float(rng.uniform(0.0, 0.5)),
        flicker=float(rng.uniform(0.0, 0.03)), moving_cars=int(rng.integers(0, 5)),
        bonnet=bool(rng.random() < 0.5), pillar=bool(rng.random() < 0.15),
        timestamp=bool(rng.random() < 0.5),
        jpeg_quality=int(rng.integers(40, 96)) if rng.random() < 0.7 else None,
        rolling_shutter_ms=(float(rng.uniform(3.0, min(30.0, 900.0 / rate)))
                            if rng.random() < SHUTTERS else 0.0))
    wide, behind = rng.random() < FISHEYES, rng.random() < GLASSES
    look, glass_px = rng.random() < 0.7, float(rng.uniform(0.2, 2.0))
    glass = Glass(glass_px, 'windscreen' if look else 'rectified', seed) if behind else None
    if wide:
        fisheye = _drawn(_fisheye, size, float(rng.uniform(105.0, 175.0)), glass, rng)
        return WideDrive(fisheye, spec)
    return Drive(_drawn(_pinhole, size, float(rng.uniform(42.0, 100.0)), glass, rng), spec)


def _one_of(weights: Mapping[Any, int], rng: np.random.Generator) -> Any:
    values = list(weights)
    return values[rng.choice(len(values), p=np.array(list(weights.values()))
                             / sum(weights.values()))]


def _drawn(make: Callable[..., Any], size: tuple[int, int], across_deg: float,
           glass: Glass | None, rng: np.random.Generator) -> Any:
    """Return a lens, drawn anew until the picture's rim is within its fold, glass included."""
    while True:
        try:
            lens = make(size, across_deg, rng)
        except ConfigError:
            continue
        lens = replace(lens, glass=glass)
        if _sees_its_corners(lens):
            return lens


def _pinhole(size: tuple[int, int], across_deg: float, rng: np.random.Generator) -> Lens:
    """Return a lens that may fold within the picture; across_deg: without distortion."""
    width, height = size
    x, y = np.clip(rng.normal(0.0, 0.012, 2), -0.03, 0.03) * width
    plain = Lens.of(width, height, across_deg, 0.0, 0.0, (float(x), float(y)),
                    _aspect(rng))
    corner = math.hypot(width, height) / 2 / plain.fx
    k1 = float(rng.uniform(MOST_BARREL, 0.12))
    k2 = float(k1 * k1 * rng.uniform(0.0, 1.4))
    if rng.random() < NEAR_FOLDS:
        k1, k2 = _nearly_folding(corner, rng.uniform(0.6, 0.97), rng.uniform(-0.6, -0.2))
        if k1 < MOST_BARREL:
            raise ConfigError('E-BENCHMARK', 'no dashcam has so much distortion')
    p1 = p2 = k3 = 0.0
    if rng.random() < DECENTRED:
        p1, p2 = rng.uniform(-0.003, 0.003, 2).tolist()
        k3 = float(rng.uniform(-0.05, 0.05) / max(1.0, corner) ** 6)
    return replace(plain, k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)


def _aspect(rng: np.random.Generator) -> float:
    """Return fy / fx: of a sensor, or of a picture that was stretched."""
    stretched = rng.random() < STRETCHED
    return 1.0 + float(rng.uniform(-0.01, 0.01) if stretched else rng.normal(0.0, 0.001))


def _nearly_folding(corner: float, share: float, first: float) -> tuple[float, float]:
    """Return k1, k2 of a lens that folds at 1 / share of the undistorted radius of its corners.

    corner: their distorted radius; first: k1 times the square of the radius at which it folds.
    """
    second = -(1.0 + 3.0 * first) / 5.0
    folds_at = corner / (1.0 + first * share**2 + second * share**4) / share
    return float(first / folds_at**2), float(second / folds_at**4)


def _fisheye(size: tuple[int, int], across_deg: float, rng: np.random.Generator) -> FisheyeLens:
    """Return an equidistant lens with four terms; across_deg: with distortion."""
    x, y = np.clip(rng.normal(0.0, 0.012, 2), -0.03, 0.03) * size[0]
    k = rng.uniform(-1.0, 1.0, 4) * (0.06, 0.015, 0.004, 0.0008)
    return FisheyeLens.of(*size, across_deg, tuple(k.tolist()), (float(x), float(y)), _aspect(rng))


def _sees_its_corners(lens: AnyLens) -> bool:
    """Return whether each pixel of the rim has a ray, which comes back to it."""
    x, y = np.linspace(-0.5, lens.width - 0.5, 65), np.linspace(-0.5, lens.height - 0.5, 37)
    rim = np.concatenate([np.column_stack([side, np.full_like(side, at)][::order])
                          for side, ends, order in ((x, y, 1), (y, x, -1))
                          for at in ends[[0, -1]]])
    seen = rays_of(lens, rim)
    widest = (np.tan(np.arccos(seen[:, 2])).max() < WIDEST_RADIUS if isinstance(lens, Lens)
              else lens.widest_deg < WIDEST_CORNER_DEG)
    return bool(widest and (np.abs(lens.project(seen) - rim) < 0.01).all())


def rays_of(lens: AnyLens, pixels: Floats) -> Floats:
    """Return the unit rays (n, 3) that pixels (n, 2) see, glass included."""
    if isinstance(lens, FisheyeLens):
        return lens.rays(pixels)
    rays = np.column_stack([lens.undistort(pixels), np.ones(len(pixels))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def parameters_of(lens: AnyLens) -> dict[str, Any]:
    """Return the model, the parameters by name, width and height; glass aside."""
    names = [name for name in (*ALL_KEYS, 'width', 'height') if hasattr(lens, name)]
    return {'model': 'fisheye' if isinstance(lens, FisheyeLens) else 'brown',
            **{name: getattr(lens, name) for name in names}}


def closest_cameras(lens: AnyLens, rays: Floats, pixels: Floats) -> dict[str, dict[str, float]]:
    """Return of each model the camera that projects the rays closest to the pixels.

    Without glass, that of the lens's own model is the lens. A pinhole for a fisheye: none.
    """
    own = parameters_of(lens)
    if isinstance(lens, FisheyeLens):
        return {'fisheye': own if lens.glass is None else {
            **own, **camera_that_sees(rays, pixels, {**own, **_named('k3', 'k4')})}}
    plain = {**own, **dict.fromkeys(('p1', 'p2', 'k3'), 0.0)}
    straight = own == {**plain, 'model': 'brown'} and lens.glass is None
    wide = {**own, 'model': 'fisheye', **dict.fromkeys(('k1', 'k2', 'k3', 'k4'), 1e-9)}
    return {
        'radial': own if straight else {**plain, **camera_that_sees(rays, pixels, plain)},
        'brown': own if lens.glass is None else {
            **own, **camera_that_sees(rays, pixels, {**own, **_named('p1', 'p2', 'k3')})},
        'fisheye': {**wide, **camera_that_sees(rays, pixels, wide)}}


def _named(*names: str) -> dict[str, float]:
    """Return a start for coefficients that camera_that_sees() leaves out where they are 0."""
    return dict.fromkeys(names, 1e-9)


def reconstructed(seed: int, config: Config) -> Case:
    """Render a drive, detect and reconstruct its turns."""
    cv2.setNumThreads(1)
    drive = drive_of(seed)
    lens: AnyLens = drive.wide_lens if isinstance(drive, WideDrive) else drive.lens
    with Calibrator(config, inline=True) as calibrator:
        for frame in _looked_at(drive, config.motion.rate):
            calibrator.push(frame)
        calibrator.detection.finish()
        chosen = calibrator.scenes
        chosen.submit()
        scenes, more = chosen.wanted(_silent, True), []
        if chosen.widen():
            more = chosen.wanted(_silent, True)
        evidence = evidence_of_detection(calibrator.detection, chosen.built())
        evidence = replace(
            evidence, warnings=(*evidence.warnings, *chosen.warnings), pictures=None,
            left_out=chosen.left_out(), turns=tuple(
                replace(turn, frames=(), released_images=turn.images) for turn in evidence.turns))
    x, y = np.meshgrid(np.linspace(0, lens.width - 1, GRID[0]),
                       np.linspace(0, lens.height - 1, GRID[1]))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    rays = rays_of(lens, pixels)
    return Case(seed, chosen.config, tuple(scenes), tuple(more), evidence,
                (lens.width, lens.height), parameters_of(lens), pixels, rays,
                closest_cameras(lens, rays, pixels), drive.spec.rolling_shutter_ms, lens.glass,
                drive.spec, processor_s())


def _looked_at(drive: Drive, rate: float) -> Iterator[Frame]:
    """Yield all frames of a drive; those that the detector skips, by their stamps, are black."""
    before, black = None, np.zeros((drive.lens.height, drive.lens.width), np.uint8)
    for index in range(len(drive)):
        stamp_ns = drive.stamp_ns(index)
        if before is not None and stamp_ns - before < least_step_ns(rate):
            yield Frame(index, stamp_ns, black)
        else:
            before = stamp_ns
            yield drive.frame(index)


def _silent(stage: str, share: float) -> None:
    """Tell nobody."""
