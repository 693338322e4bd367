# SPDX-License-Identifier: Apache-2.0
"""Upright lines as a camera sees them, whose truth is known."""
from __future__ import annotations

import numpy as np

from dashcalib_ros.detect import Lines
from dashcalib_ros.detect.edges import KNOTS


def made_lines(camera, count=600, noise_px=0.1, curved=0.0, lean_deg=3.0, seed=0):
    """Make upright lines as a camera sees them from a car that passes them, ten in an image.

    curved: the share of them that is bent in the world, by up to 5 px.
    """
    rng = np.random.default_rng(seed)
    width, height = camera.image_size
    middle = rng.uniform([20, 0.3 * height], [width - 20, 0.7 * height], (count, 2))
    ray = camera.rays(middle)
    lean = np.radians(rng.normal(0, lean_deg, count))
    down = np.column_stack([np.sin(lean), np.cos(lean), rng.normal(0, 0.05, count)])
    along = np.linspace(-1, 1, KNOTS)[:, None] * rng.uniform(0.05, 0.2, count)[:, None, None]
    points = camera.project(ray[:, None] + along * down[:, None])
    bent = rng.uniform(-5, 5, count) * (rng.random(count) < curved)
    points[:, :, 0] += bent[:, None] * np.linspace(-1, 1, KNOTS)**2
    points += rng.normal(0, noise_px, points.shape)
    inside = ((points >= 0) & (points <= [width - 1, height - 1])).all(axis=(1, 2))
    return Lines(points.astype(np.float32), np.arange(count) // 10 * 0.5).chosen(inside)
