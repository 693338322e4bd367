# SPDX-License-Identifier: Apache-2.0
"""A picture -> the smooth upright edges in it, as a few points each; those of a whole drive.

Only edges within 45 degrees of the picture's columns are looked for: poles, the edges of houses,
doors and windows stand upright and are straight. What lies on the ground is not: kerbs and lane
marks follow the road's bends, and whatever crosses the road follows its camber; wires sag.

Nothing is known about the camera here, so an edge may be curved, but not by more than a cubic.
"""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, Floats32, GreyImage, Ints, Mask, Pixels
from dashcalib_ros.robust import EvenlySpaced

# points of an edge: means over as many equal parts of it
KNOTS = 16
# px; along an edge noise is smoothed more than across it
BLUR_ACROSS, BLUR_ALONG = 1.0, 1.5
# Sobel's filter gives so many times the slope in grey levels per px
SOBEL = 8
# px; an edge whose points are farther from a cubic (root mean square) is not smooth
SMOOTH_PX = 0.4
# pixels in a row of an edge, on average; where there are more, it branches
BRANCHES = 1.1
# px left out at both ends of an edge: other things begin there, and the filter sees them
ENDS = 4
# px left out at the picture's border
BORDER = 3
# px; a shorter line shows too little of its bend
MIN_LENGTH_PX = 40
# grey levels per px across a line; noise of 6 levels comes to 0.7
CONTRAST = 4.0
# edges kept of a picture, the longest: they show most, and a fence may have hundreds
MOST = 50
# s between the images that are searched; more often costs time and adds little
PERIOD_S = 0.5


@dataclass(frozen=True)
class Lines:
    """Edges that may be straight in the world, from many pictures of one camera.

    points: (n, KNOTS, 2) px along each edge, from above. stamps_s: (n,) of their pictures.
    """

    points: Floats32
    stamps_s: Floats

    def __len__(self) -> int:
        return len(self.stamps_s)

    def chosen(self, keep: Mask) -> Lines:
        """Return the lines where keep (n,) is True."""
        return Lines(self.points[keep], self.stamps_s[keep])

    def within(self, valid: Mask | None) -> Lines:
        """Return the lines that lie on valid (h, w) pixels only; None: everywhere."""
        if valid is None:
            return self
        column, row = np.rint(self.points.reshape(-1, 2).T).astype(int)
        height, width = valid.shape
        inside = valid[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        return self.chosen(inside.reshape(-1, KNOTS).all(axis=1))


def upright_edges(image: GreyImage) -> Floats32:
    """Return the points (n, KNOTS, 2) px of a picture's upright edges, from above."""
    blurred = cv2.GaussianBlur(image, (0, 0), sigmaX=BLUR_ACROSS, sigmaY=BLUR_ALONG)
    slope = cv2.Sobel(blurred, cv2.CV_16S, 1, 0)
    steep = np.abs(slope)
    middle = steep[:, 1:-1]
    peak = np.zeros(image.shape, bool)
    peak[:, 1:-1] = ((middle >= steep[:, :-2]) & (middle > steep[:, 2:])
                     & (middle > SOBEL * CONTRAST))
    peak[:, :BORDER] = peak[:, -BORDER:] = peak[:BORDER] = peak[-BORDER:] = False
    # from dark to bright and from bright to dark: such edges may touch each other
    signs = (peak & (slope > 0), peak & (slope < 0))
    return np.concatenate([_knots(_traced(each, MIN_LENGTH_PX), steep) for each in signs])


@dataclass(frozen=True)
class _Traced:
    """Edges, one pixel wide. row, column, edge: (m,) of each pixel; top, bottom: (n,) of edges."""

    row: Ints
    column: Ints
    edge: Ints
    top: Ints
    bottom: Ints


def _traced(peak: Mask, shortest: float) -> _Traced:
    _, labels = cv2.connectedComponents(peak.view(np.uint8), connectivity=8)
    places = np.flatnonzero(peak)
    pixels = np.bincount(label := np.asarray(labels, np.int32).ravel()[places])
    # most are short: they are dropped first
    long = pixels >= shortest
    on, used = long[label], np.flatnonzero(long)
    row, column = np.divmod(places[on], peak.shape[1])
    edge = (np.cumsum(long) - 1)[label[on]]
    (top, bottom), (left, right) = (_extent(place, edge, len(used)) for place in (row, column))
    height = bottom - top + 1
    good = ((height >= shortest) & (right - left < height)
            & (pixels[used] <= BRANCHES * height))
    top, bottom = top + ENDS, bottom - ENDS
    on = good[edge] & (row >= top[edge]) & (row <= bottom[edge])
    return _Traced(row[on], column[on], (np.cumsum(good) - 1)[edge[on]], top[good], bottom[good])


def _extent(place: Ints, edge: Ints, count: int) -> tuple[Ints, Ints]:
    low, high = np.full(count, np.iinfo(np.int64).max), np.zeros(count, np.int64)
    np.minimum.at(low, edge, place)
    np.maximum.at(high, edge, place)
    return low, high


def _knots(traced: _Traced, steep: Pixels) -> Floats32:
    """Return the points (n, KNOTS, 2) of the smooth edges, to a fraction of a pixel.

    steep: (h, w) the slope across edges, which peaks on them.
    """
    row, column, edge = traced.row, traced.column, traced.edge
    before, peak, after = (steep[row, column + side].astype(np.float64) for side in (-1, 0, 1))
    # the peak of the parabola through three pixels
    x = column + (before - after) / 2 / np.minimum(before - 2 * peak + after, -1)
    height = traced.bottom - traced.top + 1
    part = (row - traced.top[edge]) * KNOTS // height[edge] + KNOTS * edge
    count = KNOTS * len(height)
    pixels = np.bincount(part, minlength=count)
    points = np.stack([np.bincount(part, place, count) / pixels for place in (x, row)], axis=1)
    points = points.reshape(-1, KNOTS, 2)
    return np.asarray(points[_smooth(points[:, :, 0])], np.float32)


def _smooth(across: Floats) -> Mask:
    """Return which edges (n,) are near a cubic; across: (n, KNOTS) px."""
    along = np.linspace(-1.0, 1.0, KNOTS)
    cubic, _ = np.linalg.qr(np.vander(along, 4))
    rest = across - across @ cubic @ cubic.T
    return np.asarray(np.sqrt(np.mean(rest**2, axis=1)) <= SMOOTH_PX)


def _longest_edges(image: GreyImage) -> Floats32:
    points = upright_edges(image)
    height = points[:, -1, 1] - points[:, 0, 1]
    return points[np.sort(np.argsort(-height, kind='stable')[:MOST])]

# pictures that are searched at most; of more, every second one is dropped
IMAGES = 300


class LineCollector:
    """Searches a picture every period; keeps points of edges only, never a picture."""

    def __init__(self, images: int = IMAGES, beside: bool = False) -> None:
        """images: that are searched at most. beside: a thread searches until the next one."""
        self._thread = ThreadPoolExecutor(1) if beside else None
        # what returns the points, once they are found
        self._found: EvenlySpaced[Callable[[], Floats32]] = EvenlySpaced(PERIOD_S, images)

    def push(self, image: GreyImage, stamp_ns: int) -> None:
        """Take a picture of the moving car; it is searched if the last one is long enough ago."""
        if not self._found.wants(stamp_ns):
            return
        if self._thread is None:
            points = _longest_edges(image)
            self._found.append(stamp_ns, lambda: points)
        else:
            for _, last in self._found.items[-1:]:
                last()
            self._found.append(stamp_ns, self._thread.submit(_longest_edges, image).result)

    def close(self) -> None:
        """End the thread: if Ctrl-C comes while it starts, nothing else ends it."""
        if self._thread is not None:
            self._thread.shutdown(wait=False)

    def lines(self) -> Lines:
        """Return the lines found so far."""
        items = self._found.items
        found = [np.zeros((0, KNOTS, 2), np.float32), *(points() for _, points in items)]
        return Lines(np.concatenate(found),
                     np.repeat([stamp_ns / 1e9 for stamp_ns, _ in items],
                               [len(points) for points in found[1:]]))
