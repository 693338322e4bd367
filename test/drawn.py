# SPDX-License-Identifier: Apache-2.0
"""A calibration with all that the report draws: made scenes, solved, and pictures of noise."""
from __future__ import annotations

from functools import lru_cache

import numpy as np
from solving import CONFIG, scenes_of, solved
from synthetic import SIZE

from dashcalib_ros.detect import Turn
from dashcalib_ros.input import Frame
from dashcalib_ros.input.scale import FULL_SIZE
from dashcalib_ros.judge.conclude import Evidence, conclude
from dashcalib_ros.report import Calibration
from dashcalib_ros.solve.solution import Solution

START_S = 1.7e9
# frames at the centres of the turns: three with a scene, one that failed, one that nobody tried
CENTERS = (0, 1, 2, 300, 400)


@lru_cache(maxsize=1)
def solution() -> Solution:
    """Return three made turns, solved; scenes_of() names them 0, 1, 2."""
    return solved(scenes_of(3, tracks=110))


def turns() -> tuple[Turn, ...]:
    """Return turns at CENTERS, each with one picture at the scenes' keyframes."""
    rng = np.random.default_rng(1)
    image = rng.integers(0, 255, SIZE[::-1], np.uint8)
    frames = tuple(Frame(index, round(1e9 * START_S) + index * 100_000_000, image)
                   for index in range(0, 30, 3))
    return tuple(Turn(center, center, center + 30, START_S + 5 + 0.1 * center, 0.05, frames)
                 for center in CENTERS)


def drawn_calibration(found: Solution | None, **changes) -> Calibration:
    """Return what conclude() makes of a solution of them. changes: of the Evidence."""
    mask = np.ones(SIZE[::-1], bool)
    mask[400:] = False
    stamps = START_S + 0.1 * np.arange(500)
    magnitudes = np.column_stack([stamps, 0.02 + 0.01 * np.sin(stamps)])
    evidence = {
        'image_size': SIZE, 'frames': 500, 'turns': turns(), 'scale': FULL_SIZE, 'timing': {},
        'built': {scene.turn: scene for scene in solution().scenes}, 'magnitudes': magnitudes,
        'mask': mask, 'start_s': START_S, 'left_out': {turns()[3].id: 'it was too dark'}}
    return Calibration.of(conclude(found, Evidence(**evidence | changes), CONFIG))
