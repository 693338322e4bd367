# SPDX-License-Identifier: Apache-2.0
"""The world's surfaces: textured rectangles."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Ints


@dataclass(frozen=True)
class Quads:
    """Rectangles, seen from their front only.

    origin: (n, 3) m, the corner of the texture's first texel. right, down: (n, 3) m, the sides
    along the texture's rows and columns, at right angles. texture: (n,) index into the atlas.
    """

    origin: Floats
    right: Floats
    down: Floats
    texture: Ints

    def __len__(self) -> int:
        return int(self.texture.size)

    def take(self, chosen: npt.NDArray[np.intp]) -> Quads:
        """Return the chosen rectangles."""
        return Quads(self.origin[chosen], self.right[chosen], self.down[chosen],
                     self.texture[chosen])

    @staticmethod
    def join(parts: Sequence[Quads]) -> Quads:
        """Return all the parts' rectangles, in order."""
        return Quads(np.concatenate([part.origin for part in parts]),
                     np.concatenate([part.right for part in parts]),
                     np.concatenate([part.down for part in parts]),
                     np.concatenate([part.texture for part in parts]))


@dataclass
class QuadList:
    """Collects rectangles and boxes while a world is built."""

    rows: list[tuple[Floats, Floats, Floats, int]] = field(default_factory=list)

    def add(self, origin: npt.ArrayLike, right: npt.ArrayLike, down: npt.ArrayLike,
            texture: int) -> None:
        """Add one rectangle; all in metres."""
        self.rows.append((np.asarray(origin, np.float64), np.asarray(right, np.float64),
                          np.asarray(down, np.float64), texture))

    def box(self, center: npt.ArrayLike, heading: float, size: tuple[float, float],
            bottom: float, top: float, textures: Sequence[int | None]) -> None:
        """Add an upright box.

        center: (2,) m. size: along and across the heading (rad), m. textures: of the sides that
        face the heading, its left, its back, its right, and up; None leaves a side out.
        """
        middle = np.asarray(center, np.float64)
        ahead = np.array([np.cos(heading), np.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        down = np.array([0.0, 0.0, bottom - top])
        half = 0.5 * np.array(size)
        for side in range(4):
            # outwards, and rightwards for someone who looks at this side from outside
            out, across = ((ahead, left), (left, -ahead), (-ahead, -left), (-left, ahead))[side]
            far, wide = (half[0], half[1]) if side % 2 == 0 else (half[1], half[0])
            texture = textures[side]
            if texture is not None:
                corner = middle + out * far - across * wide
                self.add([*corner, top], [*(2.0 * wide * across), 0.0], down, texture)
        if textures[4] is not None:
            corner = middle + ahead * half[0] + left * half[1]
            self.add([*corner, top], [*(-left * size[1]), 0.0], [*(-ahead * size[0]), 0.0],
                     textures[4])

    def quads(self) -> Quads:
        """Return what was collected."""
        if not self.rows:
            none = np.zeros((0, 3))
            return Quads(none, none, none, np.zeros(0, np.int64))
        return Quads(np.array([row[0] for row in self.rows]),
                     np.array([row[1] for row in self.rows]),
                     np.array([row[2] for row in self.rows]),
                     np.array([row[3] for row in self.rows], np.int64))
