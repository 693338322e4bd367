# SPDX-License-Identifier: Apache-2.0
"""Rotation vectors and matrices, by OpenCV: SciPy's take 0.2 s to load, in every process."""
from __future__ import annotations

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats

# an optical frame that looks ahead (z ahead, x to the right, y downwards) to the car's (REP-103)
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def rotation_matrices(vectors: Floats) -> Floats:
    """Return the (n, 3, 3) matrices of rotation vectors (n, 3), rad."""
    return np.array([cv2.Rodrigues(vector)[0] for vector in vectors]).reshape(-1, 3, 3)


def rotation_vectors(matrices: Floats) -> Floats:
    """Return the vectors (n, 3), rad, of rotation matrices (n, 3, 3); less than 1e-5 rad is 0."""
    return np.array([cv2.Rodrigues(matrix)[0][:, 0] for matrix in matrices]).reshape(-1, 3)


def quaternion(matrix: Floats) -> tuple[float, float, float, float]:
    """Return a rotation matrix (3, 3) as (x, y, z, w), as ROS has it."""
    from scipy.spatial.transform import Rotation
    x, y, z, w = Rotation.from_matrix(matrix).as_quat().tolist()
    return x, y, z, w
