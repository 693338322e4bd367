"""The epipoles of a pair of images, and what they say about turning (paper, 3.1).

The paper takes the epipoles' mean distance from the image centre. That distance is mostly the
camera's mounting (where straight ahead is in the picture) and its lever arm to the rear axle, and
a bend adds to it or takes from it, depending on the side. The two epipoles of a pair see the same
direction, the baseline, from before and from after: e' ~ K R K^-1 e. Half their distance from each
other is their distance from the pair's own centre, and that is rotation alone, wherever the camera
points. On kitti03 (triplets over 0.6 s) its median correlates with the true yaw rate by 0.98,
the distance from the image centre by 0.34.
"""
from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.motion.points import Points

Floats = npt.NDArray[np.float64]
# fewer points fit a fundamental matrix by chance
MIN_POINTS = 30
# a fundamental matrix that fits fewer than this share describes chance, or one moving car
MIN_INLIERS = 0.4
ITERATIONS = 300
METHOD = cv2.USAC_FAST
CONFIDENCE = 0.99


def epipoles_of(before: Points, after: Points, size: tuple[int, int], threshold_px: float
                ) -> Floats | None:
    """Return the (2, 2) epipoles in the first and the second image, or None if there are none.

    before, after: (n, 2) px. size: (width, height). The epipoles are relative to the image centre
    and the width, and drawn in to a distance of 1 when they lie further out, up to infinity.
    """
    if len(before) < MIN_POINTS:
        return None
    # the same answer whatever was estimated before: USAC draws from the global generator
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
    # homogeneous: from pixels to (centre, width) without dividing by what may be zero
    ends[:, 0] -= ends[:, 2] * (width - 1) / 2
    ends[:, 1] -= ends[:, 2] * (height - 1) / 2
    ends[:, 2] *= width
    # both seen on the same side, also where they lie at infinity
    ends *= np.where(ends[:, 2] < 0, -1.0, 1.0)[:, None]
    reach = np.linalg.norm(ends[:, :2], axis=1)
    return np.asarray(ends[:, :2] / np.maximum(ends[:, 2], reach)[:, None], np.float64)


def turning(epipoles: Floats) -> float:
    """Return half the distance between a pair's epipoles (2, 2), of the image width."""
    return float(np.linalg.norm(epipoles[1] - epipoles[0]) / 2)
