# SPDX-License-Identifier: Apache-2.0
"""Fleets without pictures: clips that are gathered turns with exact truth."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from synthetic import LENS, SIZE, synthetic_turn

from dashcalib_ros.camera import Camera, Radial
from dashcalib_ros.config import Config
from dashcalib_ros.store.scene_file import Origin, SceneFile, StoredTurn, encoded

CONFIG = Config().replace({'intrinsics.profile_tracks': 60})
FEW = {'tracks': 110, 'keyframes': 9, 'noise_px': 0.25}
YAWS = (80.0, -70.0, 85.0, -90.0, 65.0, -78.0)


class Here:
    """A worker without a process: for files in memory, which no other process sees."""

    pid = None

    def call(self, function: Callable[..., Any], *arguments: Any, progress: Any = None) -> Any:
        return function(*arguments)

    def close(self) -> None:
        pass


def lens_of(focal_factor: float = 1.0, lens: Radial = LENS) -> Radial:
    return replace(lens, fx=lens.fx * focal_factor, fy=lens.fy * focal_factor)


def clip_of(lens: Radial = LENS, yaws: Sequence[float] = YAWS[:1], world: int = 0,
            start_s: float = 0.0, start: Camera | None = None, prominence: float = 0.05,
            **options: Any) -> SceneFile:
    """Return a clip with these turns. world: of its first one; each has a world of its own.

    prominence: of the first one; below 0.0025 they are other stretches than turns.
    """
    # as a turn's own adjustment leaves it
    start = start or Radial.centred(SIZE, lens.fx, lens.k1, lens.k2)
    turns = []
    for n, yaw in enumerate(yaws):
        scene = synthetic_turn(lens, yaw, seed=world + n, world=world + n,
                               **{**FEW, **options}).scene(start, 100 * n)
        # as in a file, so that what is read equals what is made
        scene = replace(scene, tracks=replace(
            scene.tracks, xy=scene.tracks.xy.astype(np.float32).astype(float)))
        turns.append(StoredTurn(scene, start_s + 10.0 * n, prominence * (1 - 0.02 * n)))
    return SceneFile(Origin(lens.image_size), tuple(turns), len(turns), f'{world:032x}', 'abc',
                     100 * len(yaws) + 50, 10.0 * len(yaws) + 5.0)


def written(clip: SceneFile, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded(clip))
    return path
