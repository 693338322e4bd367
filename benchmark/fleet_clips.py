# SPDX-License-Identifier: Apache-2.0
"""Clips for fleet.py: rendered streets, cut and seen through other lenses; and made turns."""
from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import with_tests  # noqa: F401
from drives import pictures_of
from views import View, Viewed

from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.input import Frame

# without distortion, and wide enough for the lenses it is seen through
STREET_LENS = Lens.of(800, 450, 90.0)
MODEL = Lens(640, 360, 420.0, 420.4, 322.0, 177.0, -0.10, 0.02)
RATE = 10.0


def street(seed: int, cache: Path) -> tuple[Drive, list[Frame]]:
    """Return a drive of five turns and its pictures, rendered at the first call."""
    drive = Drive(STREET_LENS, DriveSpec(rate=RATE, turns=5, seed=seed))
    return drive, list(pictures_of(drive, cache))


def unit_of(rng: np.random.Generator, factor: float = 1.0) -> Lens:
    """Return a unit of the model: 1 % of spread in the focal length, its own centre."""
    focal = factor * (1 + 0.01 * rng.standard_normal())
    return replace(MODEL, fx=MODEL.fx * focal, fy=MODEL.fy * focal,
                   cx=MODEL.cx + 3 * rng.standard_normal(),
                   cy=MODEL.cy + 3 * rng.standard_normal())


def cuts(drive: Drive) -> list[tuple[int, int]]:
    """Return the first frame and the one after the last of clips with one turn each."""
    middles = [(one + other) // 2 for one, other in zip(
        drive.turn_centers, drive.turn_centers[1:], strict=False)]
    return list(zip([0, *middles], [*middles, len(drive)], strict=True))


def write_clip(path: Path, frames: Sequence[Frame], lens: Lens) -> Path:
    """Write frames of a street, seen through a lens, as a video."""
    if path.exists():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    making = path.with_suffix('.new.avi')
    video = cv2.VideoWriter(str(making), cv2.VideoWriter.fourcc(*'MJPG'), RATE,
                            (lens.width, lens.height))
    video.set(cv2.VIDEOWRITER_PROP_QUALITY, 97)
    for frame in Viewed(View(path.stem, lens), frames, STREET_LENS):
        video.write(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR))
    video.release()
    making.rename(path)
    return path


def fleet(folder: Path, cache: Path, videos: int) -> Path:
    """Make 200 clips of 20 cameras of two makes, 0 to 3 turns each; return the manifest.

    So many cameras have four videos each; the clips of the others are gathered turns, made from
    points with exact truth. One clip in 40 cannot be read.
    """
    rng = np.random.default_rng(16)
    rows = [*_video_rows(folder, cache, videos, rng),
            *_made_rows(folder, 200 - 4 * videos, 20 - videos, rng)]
    for n, row in enumerate(rows):
        if n % 40 == 39:
            bad = folder / f'bad/{n}.avi'
            bad.parent.mkdir(parents=True, exist_ok=True)
            bad.write_bytes(b'' if n % 80 == 39 else b'no video' * 100)
            row['clip'] = str(bad.relative_to(folder))
    manifest = folder / 'fleet.csv'
    with manifest.open('w', newline='') as stream:
        writer = csv.DictWriter(stream, ['clip', 'camera', 'make'])
        writer.writeheader()
        writer.writerows(rows)
    return manifest


def _video_rows(folder: Path, cache: Path, cameras: int, rng: np.random.Generator
                ) -> Iterator[dict[str, str]]:
    for camera in range(cameras):
        lens = unit_of(rng)
        drive, frames = street(1 + camera % 2, cache)
        one_turn = cuts(drive)
        first = camera // 2 % 2
        parts = [one_turn[first], one_turn[first + 1], (one_turn[first + 2][0],
                                                        one_turn[first + 3][1]),
                 (0, max(drive.turn_centers[0] - 35, 10))]
        for n, (begin, end) in enumerate(parts):
            path = write_clip(folder / f'videos/{camera}-{n}.avi', frames[begin:end], lens)
            yield {'clip': str(path.relative_to(folder)), 'camera': f'v{camera:02}',
                   'make': 'north'}


def _made_rows(folder: Path, count: int, cameras: int, rng: np.random.Generator
               ) -> Iterator[dict[str, str]]:
    from fleet_made import clip_of, lens_of, written
    lenses = [lens_of(1 + 0.01 * rng.standard_normal()) for _ in range(cameras)]
    for n in range(count):
        camera, turns = n % cameras, int(rng.integers(0, 4))
        yaws = (rng.choice([-1, 1], turns) * rng.uniform(50, 100, turns)).tolist()
        path = folder / f'made/{n}.npz'
        if not path.exists():
            written(clip_of(lenses[camera], yaws, world=10 * n, tracks=60, keyframes=7), path)
        yield {'clip': str(path.relative_to(folder)), 'camera': f'm{camera:02}',
               'make': 'south' if camera % 2 else 'north'}


def bends(seed: int, units: int = 30, zooms: Sequence[float] = (1.15, 0.8, 1.4)
          ) -> list[tuple[Any, float, Any]]:
    """Return the lens, the zoom and one bend's clip of each unit of a model.

    Bends of 5 to 9 degrees, noise of 0.8 px, 3 % of outliers: each knows fx to 2 or 3 %.
    """
    from fleet_made import clip_of, lens_of
    from synthetic import SIZE

    from dashcalib_ros.camera import Radial
    rng, found = np.random.default_rng(seed), []
    for n, zoom in enumerate([*[1.0] * units, *zooms]):
        factor = zoom * (1 + 0.01 * rng.standard_normal())
        lens = replace(lens_of(factor), k1=-0.28 + 0.003 * rng.standard_normal(),
                       cx=407 + 4 * rng.standard_normal(), cy=219 + 4 * rng.standard_normal())
        yaw = float(rng.uniform(5, 9)) * (-1) ** n
        start = Radial.centred(SIZE, 520.0 * zoom, -0.25)
        found.append((lens, zoom, clip_of(
            lens, [yaw], 10000 * seed + n, start=start, noise_px=0.8, tracks=110, keyframes=12,
            outliers=0.03)))
    return found
