# SPDX-License-Identifier: Apache-2.0
"""Made pairs of images of a car that drives straight on."""
from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic import LENS

from dashcalib_ros.camera.rotation import OPTICAL
from dashcalib_ros.detect.straights import StraightCollector

HEIGHT_M, SPEED = 1.45, 12.0
SPACING_S = 0.6


def mounted(yaw_left, pitch_up, roll_right):
    """Return (3, 3): the car's frame from the camera's."""
    return Rotation.from_euler('ZYX', [yaw_left, -pitch_up, roll_right],
                               degrees=True).as_matrix() @ OPTICAL


def pairs_of(mount, count=40, noise_px=0.2, still=0.0, seed=0):
    """Drive straight on over a plane between houses; still: share of the points on the bonnet."""
    rng = np.random.default_rng(seed)
    collector = StraightCollector()
    for n in range(count):
        world = np.column_stack([rng.uniform(4, 40, 600), rng.uniform(-12, 12, 600),
                                 rng.uniform(0, 6, 600) - HEIGHT_M])
        world[:300, 1:] = np.column_stack([rng.uniform(-3, 3, 300), np.full(300, -HEIGHT_M)])
        # nods from image to image, as a body does
        nod = Rotation.from_euler('y', rng.normal(0, 0.2), degrees=True).as_matrix()
        seen = []
        for at, turned in ((0.0, np.eye(3)), (SPEED * SPACING_S, nod)):
            rays = (world - [at, 0, 0]) @ turned @ mount
            pixels = LENS.project(rays) + rng.normal(0, noise_px, (600, 2))
            seen.append(np.where(rays[:, 2:] > 1, pixels, np.nan))
        inside = [(each > 0).all(axis=1) & (each < [LENS.image_size]).all(axis=1) for each in seen]
        before, after = (each[inside[0] & inside[1]] for each in seen)
        fixed = rng.random(len(before)) < still
        after[fixed] = before[fixed]
        order = rng.permutation(len(before))
        now = int(n * 1e9)
        collector.push(now - int(SPACING_S * 1e9), now, before[order].astype(np.float32),
                       after[order].astype(np.float32))
    return collector.straights()
