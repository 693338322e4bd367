# SPDX-License-Identifier: Apache-2.0
"""Rendered drives through fisheye lenses: what no pinhole camera sees, with exact truth."""
from __future__ import annotations

import zlib
from dataclasses import replace
from typing import Any

import numpy as np
from drives import STREET

from dashcalib_ros.demo import Drive, DriveSpec, FisheyeLens
from dashcalib_ros.errors import ConfigError


class WideDrive(Drive):
    """A drive seen through a fisheye lens."""

    @property
    def wide_lens(self) -> FisheyeLens:
        """Return the lens."""
        assert isinstance(self.lens, FisheyeLens)
        return self.lens

    @property
    def truth(self) -> dict[str, Any]:
        """Return what a calibration should find, and of which model and size it is."""
        return {'model': self.lens.model, **self.lens.truth,
                'width': self.lens.width, 'height': self.lens.height}


WIDE: dict[str, tuple[FisheyeLens, DriveSpec]] = {
    'fisheye 130 deg': (
        FisheyeLens.of(960, 540, 130.0, (-0.02, 0.006, -0.003, 0.0005), (9.0, -7.0), 1.002),
        STREET),
    'fisheye 150 deg, bonnet, text': (
        FisheyeLens.of(1280, 720, 150.0, (0.03, -0.01, 0.004, -0.001), (-14.0, 10.0), 0.998),
        replace(STREET, bonnet=True, timestamp=True, vignetting=0.3)),
    'fisheye 180 deg': (
        FisheyeLens.of(960, 600, 180.0, (-0.04, 0.01, -0.004, 0.0008), (6.0, 8.0), 1.001),
        replace(STREET, vignetting=0.3)),
}


def wide_drive_of(name: str, seed: int) -> WideDrive:
    """Return the drive of a seed: its own street, turns, noise, and its own lens."""
    own = zlib.crc32(f'{name} {seed}'.encode())
    lens, spec = WIDE[name]
    return WideDrive(_varied(lens, own), replace(spec, seed=own))


def _varied(lens: FisheyeLens, seed: int) -> FisheyeLens:
    """Return a lens like this one; drawn anew if it folds.

    f by up to 5 %, the centre by 1.5 % of the size, each k by 20 %.
    """
    rng = np.random.default_rng([seed, 7])
    while True:
        scale, x, y, *k = rng.uniform(-1.0, 1.0, 7).tolist()
        size = 1.0 + 0.05 * scale
        try:
            return replace(
                lens, fx=lens.fx * size, fy=lens.fy * size, cx=lens.cx + 0.015 * lens.width * x,
                cy=lens.cy + 0.015 * lens.height * y,
                k1=lens.k1 * (1.0 + 0.2 * k[0]), k2=lens.k2 * (1.0 + 0.2 * k[1]),
                k3=lens.k3 * (1.0 + 0.2 * k[2]), k4=lens.k4 * (1.0 + 0.2 * k[3]))
        except ConfigError:
            continue
