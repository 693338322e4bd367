"""The ego vehicle: what moves with the camera does not move in the picture.

Instead of the paper's segmentation network, evidence from the drive itself. Image gradients are
averaged over the drive as vectors: those of the world point here and there and cancel, those of
bonnet, pillars and burnt-in text stay. Only moments count in which the world would have moved at
that place: on a straight road the horizon stands still too.
"""
from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import MaskConfig
from dashcalib_ros.motion.points import Grey, Mask, Points

Singles = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]
# px at the mask's resolution; the world has moved on when its flow is at least this, and
# when the camera has turned by this much (epipoles are less exact than points)
MOVED = 2.5
TURNED = 4.0
# samples a cell needs before anything is said of it
SAMPLES = 12
# ... and remembers: then all counts half, so that a camera that was moved is noticed
REMEMBERED = 2000
# coherence of a cell's gradient over the drive: the world's is about 0, the vehicle's 0.7
STAYS = 0.4
# ... and of a pixel's, of which so many of a cell's must stay (text covers little of a cell); a
# pixel needs so many independent samples, for few look alike by chance
PIXEL_STAYS = 0.7
PIXEL_SAMPLES = 6.0
PIXELS = 0.06
# grey levels per px; a gradient below this is noise or a flat place
FLAT = 1.5
# of a flat region's outline that must stay, for the region to belong to the vehicle
ENCLOSED = 0.6
# of the picture; a vehicle that hides more is not believed
LARGEST = 0.4


class EgoMask:
    """Accumulates what stays in the picture; works at half the working resolution."""

    def __init__(self, config: MaskConfig, size: tuple[int, int]) -> None:
        """size: (width, height) at the working resolution."""
        self._size = size[0] // 2, size[1] // 2
        self._cell = max(2, config.cell // 2)
        width, height = self._size
        self.grid = -(-height // self._cell), -(-width // self._cell)
        self._sum = np.zeros((2, height, width), np.float32)
        self._strength = np.zeros((height, width), np.float32)
        self._squares = np.zeros((height, width), np.float32)
        self._weight = np.zeros((height, width), np.float32)
        self._samples = np.zeros(self.grid, np.float32)

    def push(self, image: Grey, before: Points, after: Points, epipoles: Floats) -> None:
        """Take an image (working resolution) and how the world moved shortly before it.

        before, after: (n, 2) px, points in an earlier image and in this one. epipoles: (2, 2) of
        that pair, relative to the image centre and the width.
        """
        flow = self._world_flow(before / np.float32(2), after / np.float32(2), epipoles)
        if flow is None:
            return
        moves = np.linalg.norm(flow, axis=2)
        counts = moves > MOVED
        if not counts.any():
            return
        half = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA).astype(np.float32)
        # slow changes are the sky's and the lens's
        half -= cv2.blur(half, (15, 15))
        x = cv2.Sobel(half, cv2.CV_32F, 1, 0, scale=0.125)
        y = cv2.Sobel(half, cv2.CV_32F, 0, 1, scale=0.125)
        strength = cv2.magnitude(x, y)
        # an edge along the flow stays where it is though the world moves: lanes, kerbs, roofs
        direction = self._spread(flow / np.maximum(moves, 1e-6)[:, :, None])
        across = (x * direction[:, :, 0] + y * direction[:, :, 1]) / np.maximum(strength, 1e-6)
        weight = across * across * self._spread(counts)
        self._sum[0] += weight * x
        self._sum[1] += weight * y
        strength *= weight
        self._strength += strength
        self._squares += strength * strength
        self._weight += weight
        self._samples += counts
        if self._samples.max() > REMEMBERED:
            for total in (
                    self._sum, self._strength, self._squares, self._weight, self._samples):
                np.multiply(total, 0.5, out=total)

    def cells(self) -> Mask | None:
        """Return (rows, columns): where the ego vehicle is; None while too little is known."""
        known = self._samples >= SAMPLES
        if not known.any():
            return None
        stays, strength, pixels = self._evidence()
        flat = known & (strength < FLAT)
        ego = known & ~flat & (stays > STAYS) | known & (pixels > PIXELS)
        ego = _without_specks(ego)
        filled = _closed(ego | self._enclosed(flat & ~ego, ego))
        for cells in (filled, ego):
            if cells.mean() <= LARGEST:
                return cells
        return None

    def hidden(self, shape: tuple[int, int], factor: int) -> Mask | None:
        """Return (height, width): where the ego vehicle is in the full image; None if unknown.

        factor: how often the full image was shrunk to the working resolution.
        """
        cells = self.cells()
        if cells is None:
            return None
        row, column = (
            np.minimum(np.arange(length) // (2 * factor * self._cell), count - 1)
            for length, count in zip(shape, self.grid, strict=True))
        return np.asarray(cells[row[:, None], column[None, :]], bool)

    def _evidence(self) -> tuple[Floats, Floats, Floats]:
        """Return per cell: the gradient's coherence, its strength, the share of pixels that stay.

        Coherence is |sum g|^2 / (sum |g|)^2 without what each sample has in common with itself:
        0 for directions at random however few the samples are, 1 for what never changes.
        """
        whole = self._strength ** 2
        together = self._sum[0] ** 2 + self._sum[1] ** 2 - self._squares
        most = whole - self._squares
        stays = self._pool(together) / np.maximum(self._pool(most), 1e-6)
        strength = self._pool(self._strength) / np.maximum(self._pool(self._weight), 1e-6)
        lasting = ((together > PIXEL_STAYS * most) & (whole > PIXEL_SAMPLES * self._squares)
                   & (self._strength > 2 * FLAT * self._weight))
        return stays, strength, self._pool(lasting) / self._cell ** 2

    def _world_flow(self, before: Points, after: Points, epipoles: Floats) -> Singles | None:
        """Return (rows, columns, 2) px: how the world would have moved in each cell.

        Below the horizon a smooth flow through the tracked points; above it, where things may be
        as far as the sky, rotation alone: that is what carries one epipole to the other.
        """
        width, height = self._size
        flow = after - before
        moved = np.linalg.norm(flow, axis=1) > 0.5
        if len(before) < 30 or moved.mean() < 0.5:
            return None
        terms = _quadratic(before[moved] / width)
        target = flow[moved]
        weight = np.ones(len(target))
        for _ in range(4):
            scale = weight[:, None]
            fit, *_ = np.linalg.lstsq(terms * scale, target * scale, rcond=None)
            error = np.linalg.norm(terms @ fit - target, axis=1)
            weight = 1 / (1 + (error / (np.median(error) + 0.1)) ** 2)
        rows, columns = np.mgrid[:self.grid[0], :self.grid[1]]
        places = (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) * self._cell
        world = (_quadratic(places / width) @ fit).reshape(*self.grid, 2)
        horizon = height / 2 + epipoles[:, 1].max() * width
        rotation = (epipoles[1] - epipoles[0]) * width
        if np.linalg.norm(rotation) < TURNED:
            rotation = np.zeros(2)
        world[places[:, 1].reshape(self.grid) < horizon + self._cell] = rotation
        return np.asarray(world, np.float32)

    def _enclosed(self, flat: Mask, ego: Mask) -> Mask:
        """Return the flat regions at the picture's border whose outline stays."""
        count, labels = cv2.connectedComponents(flat.astype(np.uint8), connectivity=4)
        result = np.zeros_like(flat)
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        border = np.ones_like(flat)
        border[:-1, 1:-1] = False  # not the top: that is the sky
        for label in range(1, count):
            region = labels == label
            outline = (cv2.dilate(region.astype(np.uint8), cross) > 0) & ~region
            if (region & border).any() and outline.any() and ego[outline].mean() >= ENCLOSED:
                result |= region
        return result

    def _pool(self, values: npt.NDArray[Any]) -> Floats:
        """Sum (height, width) over the cells."""
        rows, columns = self.grid
        height, width = values.shape
        padded = np.zeros((rows * self._cell, columns * self._cell))
        padded[:height, :width] = values
        return np.asarray(
            padded.reshape(rows, self._cell, columns, self._cell).sum(axis=(1, 3)), np.float64)

    def _spread(self, cells: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Repeat (rows, columns, ...) to the mask's resolution."""
        width, height = self._size
        return cells.repeat(self._cell, 0).repeat(self._cell, 1)[:height, :width]


def _without_specks(cells: Mask) -> Mask:
    """Drop groups of one or two cells that do not touch the picture's border."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        cells.astype(np.uint8), connectivity=8)
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    inside = ((left > 0) & (top > 0) & (left + stats[:, cv2.CC_STAT_WIDTH] < cells.shape[1])
              & (top + stats[:, cv2.CC_STAT_HEIGHT] < cells.shape[0]))
    return np.asarray(cells & ~(inside & (stats[:, cv2.CC_STAT_AREA] < 3))[labels], bool)


def _closed(cells: Mask) -> Mask:
    """Fill holes of one cell, also at the border."""
    padded = np.pad(cells, 1, mode='edge').astype(np.uint8)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return np.asarray(closed[1:-1, 1:-1] > 0)


def _quadratic(xy: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return (n, 6) terms of a second-order polynomial in (n, 2) places."""
    x, y = xy[:, 0].astype(np.float64), xy[:, 1].astype(np.float64)
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
