#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Would a sensor find turns that pictures miss, and are they worth anything?

    python benchmark/dark.py [--films NAME ...] [--data DIR] [--cache DIR]

Pictures become dark, or wet. Each true turn is reconstructed as if a sensor had found it; beside
that, which of them pictures find. A line for each film and degree.
"""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from attacks import Film, Grey, film_of
from measure import parser_with

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


def line(film: Film, gain: float, noise: float, streaks: int) -> str:
    """Return what becomes of a film that is spoilt so much."""
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
    sigma = '' if solution is None else (
        f', sigma of fx {100 * solution.sigma[0] / solution.camera.fx:.2f} %')
    return (f'gain {gain}, noise {noise}, {streaks} streaks: of {len(turns)} turns {seen} found, '
            f'{len(good)} reconstructed{sigma}')


def main() -> None:
    parser = parser_with(__doc__ or '', 'data', 'cache')
    parser.add_argument('--films', nargs='+', default=['kitti07', 'dashcam: bonnet, text'])
    options = parser.parse_args()
    cache = options.cache or Path('measured') / 'pictures'
    cache.mkdir(parents=True, exist_ok=True)
    for name in options.films:
        film = film_of(name, 0, options.data, cache)
        for degree in DEGREES:
            print(f'{name}: {line(film, *degree)}', flush=True)


if __name__ == '__main__':
    main()
