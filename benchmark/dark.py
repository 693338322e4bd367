#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Would a sensor find turns that pictures miss, and are they worth anything?

    python benchmark/dark.py [--drives NAME ...] [--data DIR] [--cache DIR] [--results]

Pictures become dark, or wet. Each true turn is reconstructed as if a sensor had found it; beside
that, which of them pictures find. A line for each film and degree.
"""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from attacks import Film, Grey, film_of
from measure import complain, keep_table, parser_with, table

from dashcalib_ros import Config
from dashcalib_ros.detect import Turn
from dashcalib_ros.detect.detection import detect
from dashcalib_ros.reconstruct import reconstruct
from dashcalib_ros.solve import solve

# gain of the grey levels, and their noise; streaks of rain
DEGREES = ((1.0, 0.0, 0), *((gain, 2.0, 0) for gain in (0.2, 0.1, 0.05, 0.03, 0.02, 0.015)),
           *((1.0, 0.0, streaks) for streaks in (300, 1000, 4000)))
HALF_S = 3.0
LEAST_DEG = 30.0


def spoilt(image: Grey, gain: float, noise: float, streaks: int, rng: np.random.Generator) -> Grey:
    """Return the picture darker, with noise, and with bright streaks."""
    found = gain * image + rng.normal(0.0, noise, image.shape) if noise else gain * image
    height, width = image.shape
    for x, y in zip(rng.integers(0, width, streaks), rng.integers(0, height - 12, streaks),
                    strict=True):
        found[y:y + 12, x] += 60
    return np.clip(np.rint(found), 0, 255).astype(np.uint8)


def true_turns(film: Film) -> list[int]:
    """Return the frames in the middle of six seconds in which the car turns far."""
    seconds = film.seconds
    turned = np.degrees(np.abs(np.interp(seconds + HALF_S, seconds, film.yaw)
                               - np.interp(seconds - HALF_S, seconds, film.yaw)))
    found: list[int] = []
    for k in np.argsort(-turned):
        if turned[k] >= LEAST_DEG and all(abs(seconds[k] - seconds[n]) > 2 * HALF_S
                                          for n in found):
            found.append(int(k))
    return sorted(found)


def cells(film: Film, gain: float, noise: float, streaks: int) -> list[str]:
    """Return what becomes of a film that is spoilt so much: a row of the table."""
    config, rng = Config(), np.random.default_rng(0)
    frames = [replace(frame, image=spoilt(frame.image, gain, noise, streaks, rng))
              for frame in film.frames]
    detection = detect(frames, config)
    centers = [turn.stamp_s for turn in detection.turns()]
    seen, scenes = 0, []
    turns = true_turns(film)
    for k in turns:
        stamp_s = frames[k].stamp_ns / 1e9
        seen += any(abs(stamp_s - center) < HALF_S for center in centers)
        near = tuple(frame for frame in frames if abs(frame.stamp_ns / 1e9 - stamp_s) <= HALF_S)
        turn = Turn(k, near[0].index, near[-1].index, stamp_s, 0.1, near)
        scenes.append(reconstruct(turn, config, detection.valid()))
    good = [scene for scene in scenes if scene is not None]
    solution = solve(good, config) if good else None
    return [f'{gain:g}', f'{noise:g}', str(streaks), str(len(turns)), str(seen), str(len(good)),
            '' if solution is None else
            f'{100 * solution.sigma[0] / solution.camera.fx:.2f}']


def main() -> None:
    options = parser_with(__doc__, 'drives', 'data', 'cache',
                          drives=('kitti07', 'dashcam: bonnet, text')).parse_args()
    cache = options.cache or Path('measured') / 'pictures'
    cache.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in options.drives:
        film = film_of(name, 0, options.data, cache)
        for degree in DEGREES:
            rows.append([name, *cells(film, *degree)])
            complain(' '.join(rows[-1]))
    keep_table('dark', table(['drive', 'gain', 'noise', 'streaks', 'turns', 'found by pictures',
                              'reconstructed', 'sigma of fx, %'], rows), options)


if __name__ == '__main__':
    main()
