# SPDX-License-Identifier: Apache-2.0
"""The mask of the ego vehicle: what moves with the camera does not move in the picture.

It replaces the paper's segmentation network by evidence from the drive. Image gradients are summed
over the drive as vectors: those of the world have changing directions and cancel, those of bonnet,
pillars and burnt-in text add up. An image counts for a cell only if the world moves there: on a
straight road the horizon stands still, too.
"""
from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Floats32, GreyImage, Mask
from dashcalib_ros.input.scale import shrink_image
from dashcalib_ros.robust import cauchy_fit

# px at the mask's resolution; with less flow the world does not count as moving
LEAST_FLOW_PX = 2.5
# px, the same for flow from rotation, above the horizon: epipoles are less exact than points
LEAST_ROTATION_PX = 4.0
# of new weights of the points that the flow is fitted to
FLOW_ROUNDS = 3
# samples a cell needs before it is classified
SAMPLES = 12
# samples of a cell at which all sums are halved: new samples count more than old ones
REMEMBERED = 2000
# least coherence of a pixel's gradient
PIXEL_COHERENCE = 0.7
# effective number of samples a pixel needs: a few may be alike by chance
PIXEL_SAMPLES = 6.0
# of a cell's pixels that must stay: text covers little of a cell
PIXELS = 0.06
# grey levels per px; a gradient below this is noise or a flat place
FLAT = 1.5
# share of a flat region's outline that must be vehicle, for the region to be vehicle, too
ENCLOSED = 0.4
# px at the working width; resolution of the mask
CELL = 16
# coherence of a cell's gradient: the world's is about 0, the vehicle's 0.7
CELL_COHERENCE = 0.4
# of the picture; a mask of the vehicle that hides more is not used
LARGEST = 0.4


class EgoMask:
    """Accumulates what stays in the picture; works at half the working resolution."""

    def __init__(self, size: tuple[int, int]) -> None:
        """size: (width, height) at the working resolution."""
        self._size = size[0] // 2, size[1] // 2
        self._cell = max(2, CELL // 2)
        width, height = self._size
        self.grid = -(-height // self._cell), -(-width // self._cell)
        self._sum = np.zeros((2, height, width), np.float32)
        self._strength = np.zeros((height, width), np.float32)
        self._squares = np.zeros((height, width), np.float32)
        self._weight = np.zeros((height, width), np.float32)
        self._samples = np.zeros(self.grid, np.float32)

    def push(self, image: GreyImage, before: Floats32, after: Floats32, epipoles: Floats) -> None:
        """Take an image (working resolution) and the points' motion shortly before it.

        before, after: (n, 2) px, points in an earlier image and in this one. epipoles: (2, 2) of
        that pair, relative to the image centre and the width.
        """
        flow = self._world_flow(before / np.float32(2), after / np.float32(2), epipoles)
        if flow is None:
            return
        moves = np.linalg.norm(flow, axis=2)
        counts = moves > LEAST_FLOW_PX
        if not counts.any():
            return
        half = shrink_image(image, 2).astype(np.float32)
        # remove slow changes of brightness: sky and vignetting
        half -= cv2.blur(half, (15, 15))
        x = cv2.Sobel(half, cv2.CV_32F, 1, 0, scale=0.125)
        y = cv2.Sobel(half, cv2.CV_32F, 0, 1, scale=0.125)
        strength = np.sqrt(x * x + y * y)  # see points.py about cv2.magnitude
        # an edge along the flow does not seem to move (lanes, kerbs, roofs): weigh by the angle
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
        """Return (rows, columns), True where the ego vehicle is; None before enough samples."""
        known = self._samples >= SAMPLES
        if not known.any():
            return None
        stays, strength, pixels = self._evidence()
        flat = known & (strength < FLAT)
        ego = known & ~flat & (stays > CELL_COHERENCE) | known & (pixels > PIXELS)
        ego = _without_specks(ego)
        filled = _closed(ego | self._flat_parts(flat & ~ego, ego, stays))
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

        Coherence is |sum g|^2 / (sum |g|)^2, without the products of each sample with itself:
        0 for random directions, however few the samples are, and 1 for what never changes.
        """
        squared = self._strength ** 2
        products = self._sum[0] ** 2 + self._sum[1] ** 2 - self._squares
        most = squared - self._squares
        stays = self._pool(products) / np.maximum(self._pool(most), 1e-6)
        strength = self._pool(self._strength) / np.maximum(self._pool(self._weight), 1e-6)
        lasting = ((products > PIXEL_COHERENCE * most) & (squared > PIXEL_SAMPLES * self._squares)
                   & (self._strength > 2 * FLAT * self._weight))
        return stays, strength, self._pool(lasting) / self._cell ** 2

    def _world_flow(self, before: Floats32, after: Floats32, epipoles: Floats) -> Floats32 | None:
        """Return (rows, columns, 2) px: the flow that the world has in each cell.

        Below the horizon it is a smooth fit to the tracked points. Above it, where things may be
        as far as the sky, it is the flow from rotation only: from one epipole to the other.
        """
        width, height = self._size
        flow = after - before
        moved = np.linalg.norm(flow, axis=1) > 0.5
        if len(before) < 30 or moved.mean() < 0.5:
            return None
        terms = _quadratic(before[moved] / width)
        # both components have parameters of their own, and one weight
        both = np.einsum('nk,ij->nikj', terms, np.eye(2)).reshape(len(terms), 2, -1)
        fit = cauchy_fit(both, flow[moved].astype(np.float64), lambda off: np.median(off) + 0.1,
                         FLOW_ROUNDS, power=2).params.reshape(-1, 2)
        rows, columns = np.mgrid[:self.grid[0], :self.grid[1]]
        places = (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) * self._cell
        world = (_quadratic(places / width) @ fit).reshape(*self.grid, 2)
        horizon = height / 2 + epipoles[:, 1].max() * width
        rotation = (epipoles[1] - epipoles[0]) * width
        if np.linalg.norm(rotation) < LEAST_ROTATION_PX:
            rotation = np.zeros(2)
        world[places[:, 1].reshape(self.grid) < horizon + self._cell] = rotation
        return np.asarray(world, np.float32)

    def _flat_parts(self, flat: Mask, ego: Mask, stays: Floats) -> Mask:
        """Return the flat regions at the picture's border that are of the vehicle.

        Their outline is vehicle, or they reach the bottom and have a gradient that stays, as a
        bonnet's shading does. A clear sky's gradient may stay, too, but not at the bottom.
        """
        count, labels = cv2.connectedComponents(flat.astype(np.uint8), connectivity=4)
        result = np.zeros_like(flat)
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        border = np.ones_like(flat)
        border[:-1, 1:-1] = False  # not the top: that is the sky
        for label in range(1, count):
            region = labels == label
            outline = (cv2.dilate(region.astype(np.uint8), cross) > 0) & ~region
            enclosed = outline.any() and ego[outline].mean() >= ENCLOSED
            shaded = region[-1].any() and np.median(stays[region]) > CELL_COHERENCE
            if (region & border).any() and (enclosed or shaded):
                result |= region
        return result

    def _pool(self, values: npt.NDArray[Any]) -> Floats:
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


def _quadratic(xy: npt.NDArray[np.floating]) -> Floats:
    """Return (n, 6) terms of a second-order polynomial in (n, 2) places."""
    x, y = xy[:, 0].astype(np.float64), xy[:, 1].astype(np.float64)
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
