#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""A focal length that changes: what is found, and how often it is named where it does not.

    python benchmark/drift.py [--seeds 0-9] [--results]

Drives of five turns, a minute apart, with exact tracks of random points through a random camera,
and noise.
"""
from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from measure import commit, complain, keep_table, load, parser_with, save, table
from synthetic import SIZE, synthetic_turn

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera, Radial
from dashcalib_ros.config import Config
from dashcalib_ros.input.motion import Samples
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


def following(size: float, seed: int) -> Case:
    """Return a drive that follows a temperature, by size of 1 per kelvin. It wanders by 10 K."""
    rng = np.random.default_rng([seed, 7])
    stamps_s = np.arange(0.0, len(YAWS) * APART_S, 10.0)
    degrees = 30 + rng.normal(0, 5) + 10 * np.sin(
        2 * np.pi * (stamps_s / rng.uniform(240, 600) + rng.uniform()))
    warmth = Samples(stamps_s, degrees[:, None])
    return Case(f'{100 * size:g} % per kelvin',
                lambda at_s: 1 + size * (warmth.at(at_s)[:, 0] - degrees.mean()), warmth=warmth,
                per_kelvin=size)


def zooming(stamps_s: Floats) -> Floats:
    """Return a zoom by 1.5 within a minute, which begins and ends gently."""
    return np.asarray(1 + 0.5 * np.clip(stamps_s / 60, 0, 1)**1.3)


@dataclass(frozen=True)
class Case:
    """A way of changing. before: the turn before which it steps.

    warmth: the temperature, with which it grows by so much of 1 per kelvin.
    """

    name: str
    zoom: Zoom
    apart_s: float = APART_S
    before: int | None = None
    warmth: Samples | None = None
    per_kelvin: float = 0.0


def cases(seed: int) -> list[Case]:
    """Return what is measured with each camera."""
    before = 1 + seed % (len(YAWS) - 1)
    return [*(Case(f'grows by {size:g} %', growing(size / 100)) for size in (0, 0.2, 0.5, 1)),
            *(Case(f'steps by {size:g} %', stepping(size / 100, before), before=before)
              for size in (1, 2, 5)), Case('zooms by 1.5', zooming, 15.0),
            *(following(size / 100, seed) for size in (0, 0.02, 0.05, 0.1))]


def row_of(case: Case, camera: Camera, solution: Solution) -> dict[str, Any]:
    """Return what is found of a drive. within: of the turns; parts: of a step's two cameras."""
    def fx_at(stamp_ns: int) -> float:
        return camera.fx * float(case.zoom(np.array([stamp_ns / 1e9]))[0])

    def right(found: Camera, sigma: Floats, stamp_ns: int) -> bool:
        return bool(abs(found.fx - fx_at(stamp_ns)) < 2 * sigma[0])

    stamps = [[int(each) for each in scene.tracks.stamps_ns] for scene in solution.scenes]
    first, last = fx_at(min(map(min, stamps))), fx_at(max(map(max, stamps)))
    drift, middles = solution.drift, [own[len(own) // 2] for own in stamps]
    row = {'named': drift is not None,
           'weak': judge(solution, Config().verdict).level != 'accepted',
           'within': np.mean([right(*solution.at(when), when) for when in middles])}
    of_kelvin = None if drift is None else drift.of_kelvin
    if case.warmth is not None and drift is not None:
        if of_kelvin is not None:
            assert drift.ways.warmth is not None
            zoomed = 1 + case.per_kelvin * (drift.ways.warmth.mean_c - case.warmth.values.mean())
            row |= {'z': (of_kelvin[0] - case.per_kelvin / zoomed) / of_kelvin[1],
                    'sigma': 100 * of_kelvin[1]}
    elif drift is not None:
        row |= {'z': (drift.size - 2 * (last - first) / (last + first)) / drift.sigma,
                'sigma': 100 * drift.sigma}
    if case.before is not None:
        row['step'] = (drift is not None and drift.step_ns is not None
                       and 1 + int(drift.step_ns / 1e9 // case.apart_s) == case.before)
    parts = [each for each in solution.parts if each is not None]
    return row | ({'parts': np.mean([right(each.camera, each.sigma, int(
        each.scenes[0].tracks.stamps_ns[0])) for each in parts])} if parts else {})


HEAD = ('drive', 'drives', 'named', 'weak', 'drift within 2 sigma', 'its sigma, %',
        'fx at the turns within 2 sigma', 'step at its place', 'fx of parts within 2 sigma')


def summary(name: str, rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the line of the table for drives of one kind."""
    def column(key: str) -> list[float]:
        return [float(row[key]) for row in rows if key in row]

    def share(values: Sequence[float]) -> str:
        return f'{100 * np.mean(values):.0f} %' if values else ''

    sigma = column('sigma')
    return [name, str(len(rows)), *(f'{sum(column(key)):.0f}' for key in ('named', 'weak')),
            share([float(abs(z) < 2) for z in column('z')]),
            f'{np.median(sigma):.2f}' if sigma else '',
            *(share(column(key)) for key in ('within', 'step', 'parts'))]


def main() -> None:
    """Measure."""
    args = parser_with(__doc__, 'seeds', 'again', seeds=range(10)).parse_args()
    path, at = args.out / 'drift.json', commit()
    known, found = load(path), dict[str, list[dict[str, Any]]]()
    for seed in args.seeds:
        camera = camera_of(seed)
        for case in cases(seed):
            key = f'{case.name}, camera {seed}'
            if key not in known or args.again:
                solution = solve(drive(camera, case.zoom, seed, case.apart_s), Config(),
                                 case.warmth)
                known[key] = {'commit': at, **(
                    {} if solution is None else row_of(case, camera, solution))}
                save(path, known)
                complain(f'{key}: {known[key]}')
            found.setdefault(case.name, []).append(known[key])
    keep_table('drift', table(HEAD, [summary(*each) for each in found.items()]), args,
               [row['commit'] for rows in found.values() for row in rows])


if __name__ == '__main__':
    main()
