#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""A focal length that changes: what is found, and how often it is named where it does not.

    python benchmark/drift.py [--cameras 10] [--cache FOLDER] [--results]

Drives of five turns, a minute apart, with exact tracks of random points through a random camera,
and noise. --cache: pickled pairs of scenes and px per pixel, of recorded drives: all combinations
of three and more of their stretches.
"""
from __future__ import annotations

import argparse
import dataclasses
import itertools
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import with_tests  # noqa: F401
from measure import commit, complain, load, save, table
from synthetic import SIZE, synthetic_turn

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera, Radial
from dashcalib_ros.config import Config
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution

YAWS, APART_S, KEYFRAME_S, KEYFRAMES = (80.0, -70.0, 85.0, -90.0, 65.0), 60.0, 0.3, 14
MIDDLE = (np.array(SIZE) - 1) / 2
Zoom = Callable[[Floats], Floats]


def camera_of(seed: int) -> Camera:
    """Return a random camera."""
    rng = np.random.default_rng([seed, 61])
    fx = rng.uniform(0.5, 0.95) * SIZE[0]
    k1 = rng.uniform(-0.33, 0.02) * min(fx / 520, 1.0)
    return Radial(SIZE, fx, fx * rng.normal(1, 0.001), MIDDLE[0] + rng.normal(0, 8),
                  MIDDLE[1] + rng.normal(0, 8), k1, -0.3 * k1)


def drive(camera: Camera, zoom: Zoom, seed: int, apart_s: float = APART_S) -> list[Scene]:
    """Return the scenes of a drive. zoom: times the focal length, by s since the first turn."""
    found = []
    for n, yaw in enumerate(YAWS):
        turn = synthetic_turn(camera, yaw, keyframes=KEYFRAMES, tracks=180, noise_px=0.25,
                              seed=seed, world=10 * seed + n)
        stamps_s: Floats = n * apart_s + KEYFRAME_S * np.arange(float(KEYFRAMES))
        times = zoom(stamps_s)
        tracks = dataclasses.replace(
            turn.tracks, xy=MIDDLE + (turn.tracks.xy - MIDDLE) * times[:, None, None],
            stamps_ns=np.round(1e9 * stamps_s).astype(np.int64))
        start = camera.with_focal(1.02 * camera.fx * float(times.mean()))
        found.append(dataclasses.replace(turn, tracks=tracks).scene(
            dataclasses.replace(start, cx=MIDDLE[0], cy=MIDDLE[1]), n))
    return found


def growing(size: float) -> Zoom:
    """Return a growth by size, from the first turn's begin to the last one's end."""
    last = (len(YAWS) - 1) * APART_S + KEYFRAME_S * (KEYFRAMES - 1)
    return lambda stamps_s: 1 + size * (stamps_s / last - 0.5)


def stepping(size: float, before: int) -> Zoom:
    """Return a step by size before a turn."""
    return lambda stamps_s: np.where(stamps_s < before * APART_S - 1, 1.0, 1 + size)


def zooming(stamps_s: Floats) -> Floats:
    """Return a zoom by 1.5 within a minute, which begins and ends gently."""
    return np.asarray(1 + 0.5 * np.clip(stamps_s / 60, 0, 1)**1.3)


@dataclass(frozen=True)
class Case:
    """A way of changing. before: the turn before which it steps."""

    name: str
    zoom: Zoom
    apart_s: float = APART_S
    before: int | None = None


def cases(seed: int) -> list[Case]:
    """Return what is measured with each camera."""
    before = 1 + seed % (len(YAWS) - 1)
    return [*(Case(f'grows by {size:g} %', growing(size / 100)) for size in (0, 0.2, 0.5, 1)),
            *(Case(f'steps by {size:g} %', stepping(size / 100, before), before=before)
              for size in (1, 2, 5)), Case('zooms by 1.5', zooming, 15.0)]


def row_of(case: Case, camera: Camera, solution: Solution) -> dict[str, float | str | None]:
    """Return what is found of a drive, as numbers."""
    stamps = [scene.tracks.stamps_ns for scene in solution.scenes]
    times = case.zoom(np.array([min(map(min, stamps)), max(map(max, stamps))]) / 1e9)
    off = []
    for stamp_ns in (int(own[len(own) // 2]) for own in stamps):
        found, sigma = solution.at(stamp_ns)
        off.append((found.fx / (camera.fx * float(case.zoom(np.array([stamp_ns / 1e9]))[0])) - 1)
                   * found.fx / sigma[0])
    drift, parts = solution.drift, [each for each in solution.parts if each is not None]
    step_ns = None if drift is None else drift.step_ns
    return {
        'case': case.name, 'named': float(drift is not None),
        'z': None if drift is None else (
            drift.size - float(np.diff(times)[0] / times.mean())) / drift.sigma,
        'sigma': None if drift is None else 100 * drift.sigma,
        'within': float(np.mean(np.abs(off) < 2)),
        'stretch': None if case.before is None else float(
            step_ns is not None and 1 + int(step_ns / 1e9 // case.apart_s) == case.before),
        'parts': None if not parts else float(np.mean([
            abs(each.camera.fx - camera.fx * float(case.zoom(np.array([
                int(each.scenes[0].tracks.stamps_ns[0]) / 1e9]))[0])) < 2 * each.sigma[0]
            for each in parts])),
        'weak': float(judge(solution, Config().verdict).level != 'accepted')}


def recorded(cache: Path) -> list[list[str]]:
    """Return how often a drift is named in recorded drives."""
    rows = []
    for path in sorted(cache.glob('*.pkl')):
        scenes, _ = pickle.loads(path.read_bytes())
        some = [each for count in range(3, len(scenes) + 1)
                for each in itertools.combinations(scenes, count)][:MOST]
        named = [found is not None and found.drift is not None
                 for found in (solve(each, Config()) for each in some)]
        rows.append([path.stem, str(len(some)), str(sum(named))])
        complain(' '.join(rows[-1]))
    return rows


# combinations of a recorded drive's stretches at the most
MOST = 60
HEAD = ('drive', 'drives', 'named', 'weak', 'drift within 2 sigma', 'its sigma, %',
        'fx at the turns within 2 sigma', 'step at its place', 'fx of parts within 2 sigma')


def summary(rows: Sequence[dict[str, float | str | None]]) -> list[str]:
    """Return the row of the table for drives of one kind."""
    def mean(values: Sequence[float | str | None]) -> str:
        known = [float(each) for each in values if each is not None]
        return f'{100 * np.mean(known):.0f} %' if known else ''

    column = {name: [row[name] for row in rows] for name in rows[0]}
    z, sigma = ([float(each) for each in column[name] if each is not None]
                for name in ('z', 'sigma'))
    return [str(rows[0]['case']), str(len(rows)),
            *(str(sum(each == 1.0 for each in column[name])) for name in ('named', 'weak')),
            mean([float(abs(each) < 2) for each in z]),
            f'{np.median(sigma):.2f}' if sigma else '',
            *(mean(column[name]) for name in ('within', 'stretch', 'parts'))]


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--cameras', type=int, default=10)
    parser.add_argument('--cache', type=Path, help='scenes of recorded drives')
    parser.add_argument('--results', action='store_true', help='write the table into results/')
    args = parser.parse_args()
    path = Path('measured/drift.json')
    known, found = load(path), dict[str, list[dict[str, float | str | None]]]()
    for seed in range(args.cameras):
        camera = camera_of(seed)
        for case in cases(seed):
            key = f'{case.name}, camera {seed}'
            if key not in known:
                solution = solve(drive(camera, case.zoom, seed, case.apart_s), Config())
                known[key] = None if solution is None else row_of(case, camera, solution)
                save(path, known)
                complain(f'{key}: {known[key]}')
            if known[key] is not None:
                found.setdefault(case.name, []).append(known[key])
    text = table(HEAD, [summary(rows) for rows in found.values()]) + '\n'
    if args.cache is not None:
        text += '\n' + table(('recorded drive', 'combinations', 'drift named'),
                             recorded(args.cache)) + '\n'
    print(text)
    if args.results:
        (Path(__file__).parent / 'results' / 'drift.md').write_text(
            f'# A focal length that changes\n```bash\npython benchmark/drift.py --results\n```\n'
            f'At {commit()}. Five turns, a minute apart (zoom: 15 s), exact tracks with 0.25 px '
            f'of noise, random cameras.\n\n{text}')


if __name__ == '__main__':
    main()
