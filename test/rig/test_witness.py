# SPDX-License-Identifier: Apache-2.0
"""Matches of two cameras: what they leave, and what they say about the rotation."""
from __future__ import annotations

import numpy as np

from dashcalib_ros.camera import Radial
from dashcalib_ros.camera.rotation import rotation_matrices, rotation_vectors
from dashcalib_ros.rig.witness import (
    fitted,
    matched,
    rays_of,
    residual_over,
    rotation_by_matches,
    sees_alike,
)

CAMERA = Radial((800, 450), 520.0, 520.0, 400.0, 225.0, -0.2, 0.05)
TRUE = rotation_matrices(np.radians([[0.5, -2.0, 1.0]]))[0]


def matches(noise_px=0.2, wrong=40):
    rng = np.random.default_rng(0)
    depth = rng.uniform(6, 40, 900)
    points = depth[:, None] * np.column_stack([
        rng.uniform(-0.6, 0.6, 900), rng.uniform(-0.35, 0.35, 900), np.ones(900)])
    a, b = CAMERA.project(points), CAMERA.project(points @ TRUE.T + [-0.5, 0.02, 0.03])
    a, b = (xy + noise_px * rng.normal(size=xy.shape) for xy in (a, b))
    b[:wrong] += rng.uniform(20, 60, (wrong, 2))
    inside = np.isfinite(a + b).all(axis=1)
    return a[inside], b[inside]


def test_the_right_rotation_leaves_the_noise_and_another_one_more():
    rays, xy = rays_of((CAMERA, CAMERA), [matches()])
    right = fitted(rays, TRUE, CAMERA.fx)
    assert right is not None and right.inside.sum() > 700
    found = residual_over(CAMERA, xy, right)
    assert found.median < 0.25 and found.cells_rms < 0.08
    wrong = fitted(rays, rotation_matrices(np.radians([[0.0, 0.0, 0.5]]))[0] @ TRUE, CAMERA.fx)
    assert wrong is None or residual_over(CAMERA, xy, wrong).cells_rms > 0.3


def test_matches_find_the_rotation_again():
    rays, _ = rays_of((CAMERA, CAMERA), [matches()])
    start = rotation_matrices(np.radians([[0.2, 0.2, -0.3]]))[0] @ TRUE
    found = fitted(rays, start, CAMERA.fx, free=True)
    assert found is not None
    off = np.degrees(rotation_vectors((found.rotation @ TRUE.T)[None])[0])
    assert np.abs(off[[0, 2]]).max() < 0.05 and abs(off[1]) < 0.3


def test_a_rotation_by_matches_follows_both_lenses():
    sigmas = [np.array([2.0, 2.0, 1.5, 1.5, 0.01, 0.01, 1e-5])] * 2
    found = rotation_by_matches(('a', 'b'), (CAMERA, CAMERA), [matches()], (None, None), TRUE,
                                sigmas)
    off = rotation_vectors((found.rotation @ TRUE.T)[None])[0]
    assert np.all(np.abs(off) < 3.5 * np.sqrt(np.diag(found.covariance)))
    # matches stay where they are, and the lens is taken for another one
    step = np.array([4.0, 4.0, 0.0, -2.0, 0.0, 0.01, 0.0])
    other = CAMERA.with_params(CAMERA.params + step[:6])
    again = rotation_by_matches(('a', 'b'), (CAMERA, other), [matches()], (None, None), TRUE,
                                sigmas)
    moved = rotation_vectors((again.rotation @ found.rotation.T)[None])[0]
    assert np.linalg.norm(moved) > 1e-3
    np.testing.assert_allclose(found.follow['b'] @ step, moved, atol=0.3 * np.linalg.norm(moved))
    assert found.follow['a'].shape == (3, 7) and not found.follow['a'][:, 6].any()


def test_few_matches_and_dark_pictures_say_nothing():
    rays, _ = rays_of((CAMERA, CAMERA), [tuple(side[:30] for side in matches())])
    assert fitted(rays, TRUE, CAMERA.fx) is None
    assert rotation_by_matches(('a', 'b'), (CAMERA, CAMERA), [
        tuple(side[:30] for side in matches())], (None, None), TRUE, [np.ones(6)] * 2) is None
    dark = np.zeros((100, 100), np.uint8)
    assert len(matched(dark, dark)[0]) == 0


def test_cameras_that_look_elsewhere_see_nothing_alike():
    assert sees_alike(CAMERA, CAMERA, TRUE)
    assert not sees_alike(CAMERA, CAMERA, rotation_matrices(np.radians([[0.0, 170.0, 0.0]]))[0])


def test_matches_by_chance_say_nothing():
    a, b = matches()
    shuffled = np.random.default_rng(1).permutation(b)
    rays, _ = rays_of((CAMERA, CAMERA), [(a, shuffled)])
    assert fitted(rays, TRUE, CAMERA.fx, free=True) is None
