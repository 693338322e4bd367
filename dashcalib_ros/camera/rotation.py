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


def crossed(first: Floats, second: Floats, axis: int = -1) -> Floats:
    """Return cross products of vectors along an axis; NumPy's own takes 3 to 5 times as long."""
    (a, b, c), (x, y, z) = np.moveaxis(first, axis, 0), np.moveaxis(second, axis, 0)
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=axis)


def nearest_rotation(matrix: Floats) -> Floats:
    """Return the rotation (3, 3) that a matrix (3, 3) is nearest to: Kabsch's, of A' B."""
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v)


def centres_of(rotations: Floats, translations: Floats) -> Floats:
    """Return where cameras are (n, 3), of poses (n, 3, 3), (n, 3) from the world to them."""
    return np.asarray(-np.einsum('nji,nj->ni', rotations, translations))


def quaternion(matrix: Floats) -> tuple[float, float, float, float]:
    """Return a rotation matrix (3, 3) as (x, y, z, w), as ROS has it."""
    from scipy.spatial.transform import Rotation
    x, y, z, w = Rotation.from_matrix(matrix).as_quat().tolist()
    return x, y, z, w
