#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Random dashcams: lens, shutter, glass, picture and drive of each are drawn from a seed.

    python benchmark/population.py [--seeds 1000-1059] [--out DIR] [--workers N]
                                   [--stage scenes|all] [--results] [--again] [--summary]
                                   [--engine colmap|opencv]

DIR/population_ENGINE/SEED.scenes.pkl has what `solve` gets: the reconstructed turns, and the
truth. SEED.json has what the result is off by. What is there is not made again; --again: results
are, from the same scenes. The tables are printed, and written to DIR/population.md. No
seed may be looked at before its run.
"""
from __future__ import annotations

import math
import os
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from mapping import GRID, UNSEEN_PX, WIDEST_DEG, camera_that_sees
from measure import (
    ALL_KEYS,
    commit,
    complain,
    done,
    errors,
    isolated,
    keep_table,
    load,
    parser_with,
    processor_s,
    save,
    table,
)
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from wide import WideDrive

from dashcalib_ros import Calibrator, Config
from dashcalib_ros.config import COLMAP, OPENCV
from dashcalib_ros.demo import Drive, DriveSpec, FisheyeLens, Glass, Lens, Turn
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.stamps import least_step_ns
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.judge.agreement import contradicting_turns
from dashcalib_ros.judge.conclude import Evidence, conclude, evidence_of_detection
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve import solve
from dashcalib_ros.workers.worker import THREAD_VARIABLES

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


def reconstructed(drive: Drive, config: Config) -> Case:
    """Render a drive, detect and reconstruct its turns."""
    cv2.setNumThreads(1)
    lens: AnyLens = drive.wide_lens if isinstance(drive, WideDrive) else drive.lens
    with Calibrator(config, inline=True) as calibrator:
        for frame in _looked_at(drive, config.tracking.rate):
            calibrator.push(frame)
        calibrator.detection.finish()
        chosen = calibrator.scenes
        scenes, more = calibrator.reconstruct(_silent, True), []
        if chosen.widen():
            more = calibrator.reconstruct(_silent, True)
        evidence = evidence_of_detection(calibrator.detection, chosen.built().values())
        evidence = replace(
            evidence, warnings=(*evidence.warnings, *chosen.warnings), pictures=None,
            left_out=chosen.left_out(), turns=tuple(
                replace(turn, frames=(), released_images=turn.images) for turn in evidence.turns))
    x, y = np.meshgrid(np.linspace(0, lens.width - 1, GRID[0]),
                       np.linspace(0, lens.height - 1, GRID[1]))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    rays = rays_of(lens, pixels)
    return Case(drive.spec.seed, chosen.config, tuple(scenes), tuple(more), evidence,
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


# px of glass, and ms of a readout, of which a result must not be silent, nor speak without
TOLD_GLASS_PX, TOLD_READOUT_MS = 0.5, 5.0
# of fx: an accepted result may not be off by more
FX_PERCENT, FX_SIGMAS = 1.0, 3.0


def calibrated(case: Case) -> CalibrationData:
    """Return what the command makes of a case: with more turns, where the first ones are weak."""
    evidence, scenes = case.evidence, case.scenes
    while True:
        solution = solve(scenes, case.config) if scenes else None
        if scenes:
            evidence = replace(evidence, left_out={
                **evidence.left_out,
                **contradicting_turns(scenes, solution)})
        found = conclude(solution, evidence, case.config)
        if found.verdict.level != 'weak' or scenes is case.more or not case.more:
            return found
        case = replace(case, more=tuple(
            scene for scene in case.more if scene.turn not in evidence.left_out))
        scenes = case.more


def measured(path: Path) -> dict[str, Any]:
    """Return what is wrong with the result of a case."""
    cv2.setNumThreads(1)
    case, before = load_case(path), processor_s()
    found = calibrated(case)
    row: dict[str, Any] = {
        'verdict': found.verdict.level, 'reasons': [*map(str, found.verdict.reasons)],
        'warnings': [*map(str, found.warnings)], 'turns': len(case.spec.turn_list),
        'turns_used': found.turns_used, 'size': case.size, 'rate': case.spec.rate,
        'truth_model': case.lens['model'], 'glass_px': case.glass.rms_px if case.glass else 0.0,
        'look': case.glass.look if case.glass else '', 'readout_ms': case.readout_ms,
        'truth': dict(case.lens), 'named': named(found), 'cpu_s': processor_s() - before,
        'scenes_cpu_s': case.cpu_s}
    if found.camera is None or found.sigma_px is None:
        return row
    model = found.camera.model
    shutter = found.rolling_shutter
    row |= {'model': model, 'sigma_px': found.sigma_px.rms,
            'rays_px': off(found.project, case, model),
            'camera_px': off(found.camera.project, case, model),
            'shutter_ms': shutter.readout_ms if shutter else 0.0,
            'shutter_sigma_ms': shutter.sigma_ms if shutter else None}
    if model in case.closest:
        row |= errors({**found.camera.named, 'model': model},
                      {**case.closest[model], 'model': model}, found.sigma)
    return row


def named(found: CalibrationData) -> list[str]:
    """Return which effects the result names."""
    text = ' '.join(map(str, (*found.verdict.reasons, *found.warnings)))
    return [name for name, is_named in (
        ('zoom', 'the zoom changes' in text),
        ('stabilised', found.stabiliser is not None or 'stabil' in text),
        ('bent', 'bent' in text),
        ('shutter', found.rolling_shutter is not None)) if is_named]


def off(project: Callable[[Floats], Floats], case: Case, model: str) -> float:
    """Return the RMS px between where the true rays are seen, the best rotation removed."""
    near = (np.ones(len(case.rays), bool) if model == 'fisheye'
            else case.rays[:, 2] > math.cos(math.radians(WIDEST_DEG)))
    rays, pixels = case.rays[near], case.pixels[near]

    def residual(turn: Floats) -> Floats:
        rest = project(Rotation.from_rotvec(turn).apply(rays)) - pixels
        return np.nan_to_num(rest, nan=UNSEEN_PX).ravel()

    rest = least_squares(residual, np.zeros(3)).fun.reshape(-1, 2)
    return float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))


Row = Mapping[str, Any]
GROUPS: dict[str, Callable[[Row], bool]] = {
    'all': lambda row: True,
    'no glass': lambda row: not row['glass_px'],
    'behind glass': lambda row: row['glass_px'] > 0,
    'glass and shutter': lambda row: row['glass_px'] > 0 and row['readout_ms'] > 0,
    'fisheye': lambda row: row['truth_model'] == 'fisheye',
    'rolling shutter': lambda row: row['readout_ms'] > 0,
}


def summary(rows: Sequence[Row]) -> str:
    """Return the tables: bars, verdicts, error over sigma, shutters, names, and each camera."""
    failed = [row for row in rows if row['verdict'] == 'failed']
    rows = [row for row in rows if row['verdict'] != 'failed']
    return '\n\n'.join([
        *(f'Failed: seed {row["seed"]}: {row["reasons"][0]}' for row in failed),
        _bars(rows), groups(rows), _sigmas(rows), _shutters(rows), _names(rows), cameras(rows)])


def groups(rows: Sequence[Row]) -> str:
    """Return a table of verdicts and errors by kind of camera."""
    lines = []
    for name, belongs in GROUPS.items():
        mine = [row for row in rows if belongs(row)]
        accepted = [row for row in mine if row['verdict'] == 'accepted']
        lines.append([
            name, str(len(mine)),
            *(str(sum(row['verdict'] == level for row in mine))
              for level in ('accepted', 'weak', 'refused')),
            *_spread([row['rays_px'] for row in accepted]),
            *_spread([row['camera_px'] for row in accepted]),
            _median([row['camera_px'] / row['sigma_px'] for row in accepted]),
            _median([abs(row['percent']['fx']) for row in accepted if 'percent' in row], '.3f')])
    return 'Rays with the field, camera alone, over the picture; of those accepted.\n\n' + table(
        ['cameras', 'of them', 'accepted', 'weak', 'refused', 'rays off, px: median', '95 %',
         'camera off, px: median', '95 %', 'camera off / sigma_px', 'fx off, %'], lines)


def _sigmas(rows: Sequence[Row]) -> str:
    lines = []
    for level in ('accepted', 'weak'):
        found = [row['z'] for row in rows if row['verdict'] == level and 'z' in row]
        each = {key: [abs(z[key]) for z in found if key in z] for key in ALL_KEYS}
        for name, values in (('all', [*chain.from_iterable(each.values())]), *each.items()):
            if values:
                lines.append([level, name, str(len(values)), *(
                    f'{sum(value <= limit for value in values) / len(values):.0%}'
                    for limit in (1, 2, 3)), _median(values), f'{max(values):.1f}'])
        shares = [row['camera_px'] / row['sigma_px'] for row in rows
                  if row['verdict'] == level and row.get('sigma_px')]
        lines.append([level, 'picture', str(len(shares)), '', '', '', _median(shares),
                      f'{max(shares, default=math.nan):.1f}'])
    return 'Error over sigma.\n\n' + table(
        ['verdict', '', 'n', 'within 1', '2', '3 sigma', 'median', 'worst'], lines)


def _shutters(rows: Sequence[Row]) -> str:
    lines = []
    for name, belongs in GROUPS.items():
        mine = [row for row in rows if belongs(row) and 'shutter_ms' in row
                and row['readout_ms'] >= TOLD_READOUT_MS]
        told = [row for row in mine if row['shutter_sigma_ms']]
        if not mine:
            continue
        off_ms = [row['shutter_ms'] - row['readout_ms'] for row in told]
        z = [abs(each) / row['shutter_sigma_ms'] for each, row in zip(off_ms, told, strict=True)]
        lines.append([
            name, f'{len(told)} of {len(mine)}',
            _median([100 * each / row['readout_ms'] for each, row in
                     zip(off_ms, told, strict=True)], '+.1f'),
            _median([100 * abs(each) / row['readout_ms'] for each, row in
                     zip(off_ms, told, strict=True)], '.1f'),
            f'{sum(value <= 2 for value in z)} of {len(z)}', _median(z)])
    return f'Readouts of {TOLD_READOUT_MS:g} ms and more.\n\n' + table(
        ['cameras', 'found', 'off, %: median', 'absolute', 'within 2 sigma', 'in sigmas'], lines)


def _names(rows: Sequence[Row]) -> str:
    has: dict[str, Callable[[Row], bool | None]] = {
        'zoom': lambda row: False, 'stabilised': lambda row: False,
        'bent': lambda row: _told(row['glass_px'], TOLD_GLASS_PX),
        'shutter': lambda row: _told(row['readout_ms'], TOLD_READOUT_MS)}
    lines = []
    for name, true in has.items():
        wrong = [row for row in rows if name in row['named'] and true(row) is False]
        right = [row for row in rows if true(row) and row['verdict'] != 'refused']
        lines.append([name, f'{sum(name in row["named"] for row in right)} of {len(right)}',
                      f'{len(wrong)} of {sum(true(row) is False for row in rows)}',
                      ', '.join(f'{row["seed"]} ({row["verdict"]})' for row in wrong)])
    return 'Named findings; what is small may be named or not.\n\n' + table(
        ['', 'named where it is', 'named where it is not', 'which'], lines)


def _told(size: float, limit: float) -> bool | None:
    """Return whether an effect must be named; None where it is too small to matter."""
    return False if size == 0.0 else True if size >= limit else None


def _bars(rows: Sequence[Row]) -> str:
    """Return what the population must show, and what it shows."""
    accepted = [row for row in rows if row['verdict'] == 'accepted']
    z = [abs(value) for row in accepted for value in row.get('z', {}).values()]
    rays = [row['rays_px'] for row in accepted]
    told = [row for row in rows if row['readout_ms'] >= TOLD_READOUT_MS and 'shutter_ms' in row]
    short = [abs(row['shutter_ms'] / row['readout_ms'] - 1) for row in told]
    within = [abs(row['shutter_ms'] - row['readout_ms']) <= 2 * row['shutter_sigma_ms']
              if row['shutter_sigma_ms'] else False for row in told]
    false = [row for row in accepted if 'z' in row and (
        abs(row['z']['fx']) > FX_SIGMAS or row['percent']['fx'] > FX_PERCENT)]
    lines: list[tuple[str, float, str, float, float]] = [
        ('sound lenses accepted', _share(rows, lambda row: not row['glass_px']), '.0%', 0.97, 1),
        ('behind glass accepted', _share(rows, lambda row: row['glass_px'] > 0), '.0%', 0.9, 1),
        ('rays off, px: median', _quantile(rays, 0.5), '.2f', 0, 0.25),
        ('rays off, px: 95 %', _quantile(rays, 0.95), '.2f', 0, 0.8),
        *((f'parameters within {limit} sigma', _mean([value <= limit for value in z]), '.1%',
           *bars) for limit, bars in ((1, (0.6, 0.8)), (2, (0.93, 0.99)), (3, (0.99, 1)))),
        ('camera off over sigma_px: median', _quantile(
            [row['camera_px'] / row['sigma_px'] for row in accepted], 0.5), '.2f', 0.7, 1.2),
        (f'fx more than {FX_SIGMAS:g} sigma, or {FX_PERCENT:g} %, off', len(false), 'd', 0, 0),
        ('readout off: median', _quantile(short, 0.5), '.1%', 0, 0.015),
        ('readout within 2 sigma', _mean(within), '.0%', 0.93, 1)]
    return 'Of those accepted; readouts of all that have a camera.\n\n' + table(
        ['', 'measured', 'at least', 'at most', ''],
        [[name, format(value, form), format(least, form), format(most, form),
          'met' if least <= value <= most else 'missed']
         for name, value, form, least, most in lines if not math.isnan(value)])


def _share(rows: Sequence[Row], belongs: Callable[[Row], bool]) -> float:
    return _mean([row['verdict'] == 'accepted' for row in rows if belongs(row)])


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def _quantile(values: Sequence[float], share: float) -> float:
    return float(np.quantile(values, share)) if values else math.nan


def cameras(rows: Iterable[Row]) -> str:
    """Return a table with a line for each camera."""
    lines = []
    for row in rows:
        z = row.get('z', {})
        worst = max(z, key=lambda key: abs(z[key]), default='')
        lines.append([
            str(row['seed']), '{}x{}'.format(*row['size']), f'{row["rate"]:g}',
            row['truth_model'], f'{row["glass_px"]:.1f}', row['verdict'], row.get('model', ''),
            *(f'{row[key]:.2f}' if key in row else '' for key in (
                'rays_px', 'camera_px', 'sigma_px')),
            f'{row["readout_ms"]:.1f}',
            f'{row["shutter_ms"]:.1f} ± {row["shutter_sigma_ms"]:.1f}'
            if row.get('shutter_sigma_ms') else '',
            f'{100 * row["error"]["fx"] / row["truth"]["fx"]:+.2f}' if 'error' in row else '',
            f'{z["fx"]:+.1f}' if 'fx' in z else '', f'{worst} {z[worst]:+.1f}' if worst else '',
            ', '.join(row['named']), '; '.join(row['reasons'])[:90]])
    return table(['seed', 'size', 'Hz', 'lens', 'glass px', 'verdict', 'model', 'rays off px',
                  'camera off px', 'sigma_px', 'readout ms', 'found', 'fx off %', 'in sigmas',
                  'worst', 'named', 'reasons'], lines)


def _spread(values: Sequence[float]) -> list[str]:
    return [f'{_quantile(values, share):.2f}' if values else '' for share in (0.5, 0.95)]


def _median(values: Sequence[float], form: str = '.2f') -> str:
    return format(_quantile(values, 0.5), form) if values else ''


def run(seed: int, out: Path, stage: str, again: bool, config: Config,
        drive: Callable[[int], Drive] = drive_of) -> None:
    """Make what is missing of a seed. drive: returns that of a seed."""
    scenes, result = out / f'{seed}.scenes.pkl', out / f'{seed}.json'
    if stage == 'all' and not again and done(load(result) or None):
        return
    if not scenes.exists():
        outcome = isolated(_write_case, drive, seed, config, scenes)
        complain(f'{seed}: {outcome.failure or outcome.value}, {outcome.seconds:.0f} s, '
                 f'{outcome.peak_mb:.0f} MB')
        if outcome.failure:
            save(result, {'seed': seed, 'verdict': 'failed', 'reasons': [outcome.failure]})
            return
    if stage == 'all':
        outcome = isolated(measured, scenes)
        row = outcome.value or {'verdict': 'failed', 'reasons': [outcome.failure]}
        save(result, {'seed': seed, 'commit': commit(), 'seconds': outcome.seconds, **row})
        complain(f'{seed}: {row["verdict"]}, {outcome.seconds:.0f} s')


def _write_case(drive: Callable[[int], Drive], seed: int, config: Config, path: Path) -> str:
    case = reconstructed(drive(seed), config)
    save_case(case, path)
    return f'{len(case.scenes)} scenes of {len(case.spec.turn_list)} turns, {case.cpu_s:.0f} CPU s'


def main() -> None:
    """Measure."""
    # processes that start from here inherit it: an inline calibrator needs one thread, and what
    # COLMAP and Ceres warn of is not shown by a calibrator's children either
    os.environ.update({**dict.fromkeys(THREAD_VARIABLES, '1'), 'GLOG_minloglevel': '2'})
    parser = parser_with(__doc__, 'seeds', 'again', seeds=range(4000, 4030))
    parser.add_argument('--workers', type=int, default=1, help='drives at a time')
    parser.add_argument('--stage', choices=('scenes', 'all'), default='all')
    parser.add_argument('--summary', action='store_true', help='of the results there are, and end')
    parser.add_argument('--engine', choices=(COLMAP, OPENCV), default=Config().reconstruct.engine,
                        help='what estimates the poses of turns')
    given = parser.parse_args()
    config = Config().replace({'reconstruct.engine': given.engine})
    folder = given.out / f'population_{given.engine}'
    folder.mkdir(parents=True, exist_ok=True)
    if not given.summary:
        with ThreadPoolExecutor(given.workers) as pool:
            list(pool.map(lambda seed: run(seed, folder, given.stage, given.again, config),
                          given.seeds))
    rows = [row for seed in given.seeds if (row := load(folder / f'{seed}.json'))]
    if rows:
        keep_table('population', f'Engine: {given.engine}.\n\n{summary(rows)}', given,
                   [row['commit'] for row in rows if 'commit' in row])


if __name__ == '__main__':
    main()
