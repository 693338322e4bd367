"""Lines of a whole drive, from a picture now and then, in bounded memory."""
from __future__ import annotations

import numpy as np

from dashcalib_ros.arrays import Floats32, GreyImage
from dashcalib_ros.config import LinesConfig
from dashcalib_ros.detect.edges import KNOTS, Lines, upright_edges

# edges kept of a picture, the longest: they tell most, and a fence may have hundreds
MOST = 50
# s between the images that are searched; more often costs time and adds little
PERIOD_S = 0.5


class LineCollector:
    """Searches a picture every period; keeps points of edges only, never a picture."""

    def __init__(self, config: LinesConfig) -> None:
        self._config = config
        self._period_ns = PERIOD_S * 1e9
        self._found: list[tuple[int, Floats32]] = []

    def push(self, image: GreyImage, stamp_ns: int) -> None:
        """Take a picture of the moving car; it is searched if the last one is long enough ago."""
        if self._found and 0 <= stamp_ns - self._found[-1][0] < self._period_ns:
            return
        points = upright_edges(image)
        if len(points) > MOST:
            height = points[:, -1, 1] - points[:, 0, 1]
            points = points[np.sort(np.argsort(-height, kind='stable')[:MOST])]
        self._found.append((stamp_ns, points))
        if len(self._found) > self._config.images:
            self._found = self._found[::2]
            self._period_ns *= 2

    def lines(self) -> Lines:
        """Return the lines found so far."""
        none = np.zeros((0, KNOTS, 2), np.float32)
        return Lines(np.concatenate([none, *(points for _, points in self._found)]),
                     np.repeat([stamp_ns / 1e9 for stamp_ns, _ in self._found],
                               [len(points) for _, points in self._found]))
