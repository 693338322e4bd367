# SPDX-License-Identifier: Apache-2.0
"""What a dashcam sees of its own car, and burns into the picture."""
from __future__ import annotations

import datetime

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, Floats32, Mask
from dashcalib_ros.demo.paint import noise

Singles = Floats32

# the bonnet's edge: of the height, in the middle and at the sides
BONNET_MIDDLE = 0.905
BONNET_SIDE = 0.955
SHIFT = 4


class Overlay:
    """Static parts are painted once; the time stamp changes every second.

    mask: (height, width) bool, True where bonnet or pillar hide the world.
    """

    def __init__(self, width: int, height: int, bonnet: bool, pillar: bool,
                 timestamp: bool, seed: int) -> None:
        self.timestamp = timestamp
        self.alpha = np.zeros((height, width), np.float32)
        self.paint = np.zeros((height, width), np.float32)
        rng = np.random.default_rng([seed, 4])
        if bonnet:
            self._bonnet(rng)
        if pillar:
            self._pillar()
        self.mask: Mask = self.alpha > 0.0
        self.any = bool(self.mask.any())

    def apply(self, image: Singles, stamp_ns: int) -> None:
        """Cover the picture (height, width), in place."""
        if self.any:
            image += self.alpha * (self.paint - image)
        if self.timestamp:
            self._text(image, stamp_ns)

    def _fill(self, polygon: Floats, paint: Singles) -> None:
        shape = np.zeros(self.alpha.shape, np.uint8)
        points = np.round(polygon * (1 << SHIFT)).astype(np.int32)
        cv2.fillPoly(shape, [points], 255, cv2.LINE_AA, SHIFT)
        cover = cv2.GaussianBlur(shape, (0, 0), 0.8).astype(np.float32) / np.float32(255.0)
        self.paint = np.where(cover > 0.0, paint, self.paint)
        self.alpha = np.maximum(self.alpha, cover)

    def _bonnet(self, rng: np.random.Generator) -> None:
        height, width = self.alpha.shape
        x = np.linspace(-8.0, width + 8.0, 80)
        bend = ((x - 0.5 * width) / (0.5 * width)) ** 2
        y = height * (BONNET_MIDDLE + (BONNET_SIDE - BONNET_MIDDLE) * bend)
        polygon = np.concatenate([np.stack([x, y], axis=1),
                                  [[width + 8.0, height + 8.0], [-8.0, height + 8.0]]])
        gloss = np.linspace(1.0, 0.0, max(2, height // 8), dtype=np.float32)
        paint = np.full((height, width), 32.0, np.float32)
        paint[-gloss.size:] += 45.0 * gloss[:, None]
        paint += noise(rng, (height, width), (width / 5.0, width / 30.0), (7.0, 3.0))
        # creases that run towards the windscreen
        for share in (0.3, 0.7):
            end = round(width * (0.5 + 2.2 * (share - 0.5)))
            cv2.line(paint, (round(width * share), round(0.88 * height)), (end, height), 85.0,
                     max(1, width // 400), cv2.LINE_AA)
        self._fill(polygon, paint)

    def _pillar(self) -> None:
        height, width = self.alpha.shape
        polygon = np.array([[-8.0, 0.10 * height], [0.035 * width, 0.10 * height],
                            [0.005 * width, height], [-8.0, height]])
        polygon[:2, 1] = -8.0
        polygon[1, 0] = 0.06 * width
        self._fill(polygon, np.full((height, width), 24.0, np.float32))

    def _text(self, image: Singles, stamp_ns: int) -> None:
        height, width = image.shape
        clock = datetime.datetime.fromtimestamp(stamp_ns // 10**9, datetime.timezone.utc)
        scale = height / 900.0
        base = round(0.06 * height)
        for text, share in ((clock.strftime('%Y-%m-%d %H:%M:%S'), 0.02), ('DASHCAM', 0.83)):
            place = (round(share * width), base)
            strip = np.zeros((2 * base, width), np.uint8)
            cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, 255,
                        max(1, round(1.5 * scale)), cv2.LINE_AA)
            area = image[:2 * base]
            for cover, grey in ((cv2.dilate(strip, np.ones((3, 3))), 15.0), (strip, 240.0)):
                area += cover / np.float32(255.0) * (np.float32(grey) - area)
