# SPDX-License-Identifier: Apache-2.0
"""The normal equations: derivatives agree with differences, also behind a rolling shutter."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, scenes_of
from synthetic import LENS, SIZE, synthetic_turn

from dashcalib_ros.camera import Brown, Camera, Fisheye
from dashcalib_ros.camera.rotation import rotation_matrices
from dashcalib_ros.reconstruct.scene import Scene, residuals_px
from dashcalib_ros.solve.imaging import Imaging, imaging_with, shake_precision
from dashcalib_ros.solve.linear import IMAGE, noise_of, normal_equations, residuals
from dashcalib_ros.solve.optimise import Estimate, optimised

DECENTRED = Brown(SIZE, *LENS.params, 0.001, -0.001, 0.005)
WIDE = Fisheye(SIZE, 300.0, 300.6, 404.0, 221.0, 0.02, -0.008, 0.003, -0.0005)
# s: long enough that how poses change the motion counts
READOUT_S = 0.02
VARIANCE = 0.04


def small_scene(camera: Camera) -> Scene:
    """Return a turn of few tracks with its true structure."""
    turn = synthetic_turn(camera, 70.0, 6, 30, keyframe_s=0.15)
    return replace(turn.scene(camera), structure=turn.structure)


def as_seen(scene: Scene, imaging: Imaging, noise_px: float = 0.02) -> Scene:
    """Return a turn with its tracks where they are by the imaging, up to noise.

    The field's columns are taken where points are projected; so they hold near there.
    """
    used, noise = scene.structure.used, np.random.default_rng(4).normal(size=(10**4, 2))
    for n in range(8):
        xy = scene.tracks.xy.copy()
        xy[used] -= residuals(scene, imaging) - noise_px * noise[:used.sum()] * (n == 7)
        scene = replace(scene, tracks=replace(scene.tracks, xy=xy))
    return scene


def imaging_of(camera: Camera, scene: Scene, readout_s: float, few: int = 5) -> Imaging:
    """Return the imaging with few directions of the field, and with some of everything."""
    found, rng = imaging_with(camera, [scene]), np.random.default_rng(2)
    count = len(scene.tracks.frames)
    return replace(
        found, readout_s=readout_s, basis=found.basis[:, :few],
        directions=0.02 * rng.normal(size=few),
        images={scene.turn: rng.normal(size=(count, 3)) * (0.5, 0.5, 1e-4)},
        shaking={scene.turn: 0.01 * readout_s * rng.normal(size=(count, 3))} if readout_s else {},
        shaken_s=readout_s)


def numeric(scene: Scene, imaging: Imaging, loss_px: float, by_image: bool
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return hessian and score by differences, all poses, points and shaking eliminated."""
    structure, turn = scene.structure, scene.turn
    k, t = structure.used.shape
    shaking = 3 * k if imaging.readout_s else 0
    sizes = [6 * k, shaking, 3 * t, IMAGE * k if by_image else 0, len(imaging.camera.params) + 1
             + len(imaging.directions)]

    def off(values: np.ndarray) -> np.ndarray:
        pose, shake, point, image, step = np.split(values, np.cumsum(sizes)[:-1])
        turned, moved = np.split(pose.reshape(k, 6), 2, axis=1)
        other = replace(scene, structure=replace(
            structure, rotations=rotation_matrices(turned) @ structure.rotations,
            translations=structure.translations + moved,
            points=structure.points + point.reshape(t, 3)))
        now = imaging.stepped(step)
        if shaking:
            now = replace(now, shaking={turn: imaging.shaking[turn] + shake.reshape(k, 3)})
        if by_image:
            now = replace(now, images={turn: imaging.images[turn] + image.reshape(k, IMAGE)})
        return residuals(other, now).ravel()

    here = np.zeros(sum(sizes))
    base = off(here)
    jacobian = np.zeros((len(base), len(here)))
    for j in range(len(here)):
        step = np.zeros(len(here))
        step[j] = 1e-5
        jacobian[:, j] = (off(here - step) - off(here + step)) / 2e-5
    weight = np.repeat(1 / (1 + np.sum(base.reshape(-1, 2)**2, axis=1) / loss_px**2), 2)
    weighted = jacobian * weight[:, None]
    normal, pull = weighted.T @ weighted, weighted.T @ base
    if shaking:
        own = slice(sizes[0], sizes[0] + shaking)
        precision = VARIANCE * np.kron(np.eye(k), shake_precision(
            imaging.axes[turn], imaging.shaken_s))
        normal[own, own] += precision
        pull[own] -= precision @ imaging.shaking[turn].ravel()
    inner = np.linalg.pinv(normal[:-sum(sizes[3:]), :-sum(sizes[3:])], rcond=1e-11, hermitian=True)
    first, rest = slice(len(inner)), slice(len(inner), None)
    follow = normal[rest, first] @ inner
    return normal[rest, rest] - follow @ normal[first, rest], pull[rest] - follow @ pull[first]


@pytest.mark.parametrize(('camera', 'readout_s', 'loss_px', 'by_image'), [
    (DECENTRED, 0.0, 0.5, False), (DECENTRED, 0.0, 50.0, True), (DECENTRED, READOUT_S, 0.5, True),
    (DECENTRED, -READOUT_S, 50.0, False), (WIDE, READOUT_S, 50.0, False)])
def test_they_agree_with_differences(camera, readout_s, loss_px, by_image):
    scene = small_scene(camera)
    imaging = imaging_of(camera, scene, readout_s)
    scene = as_seen(scene, imaging)
    found = normal_equations(scene, imaging, loss_px, by_image, variance=VARIANCE).cost
    hessian, score = numeric(scene, imaging, loss_px, by_image)
    scale = 1 / np.sqrt(np.diag(hessian))
    np.testing.assert_allclose(found.hessian * np.outer(scale, scale),
                               hessian * np.outer(scale, scale), atol=0.011)
    np.testing.assert_allclose(found.score * scale, score * scale, atol=1e-3)
    assert np.abs(score * scale).max() > 0.03


def test_residuals_are_seen_minus_projected():
    scene = small_scene(LENS)
    np.testing.assert_allclose(residuals(scene, imaging_with(LENS)),
                               -residuals_px(scene, LENS)[scene.structure.used])


def test_there_is_no_gradient_at_the_optimum():
    scenes = tuple(scenes_of(2, start=LENS, tracks=120))
    start = Estimate(imaging_with(LENS.widened(), scenes), scenes, LENS.widened(), CONFIG, 0.15)
    loss_px = start.loss_px()

    def pull(now: Estimate) -> float:
        """Return how far the least cost is, in sigmas of the parameter that is farthest."""
        noise = now.noise(loss_px).variance * now.inflation
        total = type(now.prior()).together([now.prior(), *(
            normal_equations(scene, now.imaging, loss_px, variance=noise).cost.at_noise(noise)
            for scene in now.scenes)])
        return float(np.abs(total.optimum / np.sqrt(np.diag(total.covariance))).max())

    assert pull(optimised(start, 0.0, 20, settled=1e-6)) < 0.05 < 0.3 < pull(start)


def test_the_variance_of_the_noise_is_found():
    scenes = tuple(scenes_of(2, start=LENS, noise_px=0.3))
    start = Estimate(imaging_with(LENS.widened(), scenes), scenes, LENS.widened(), CONFIG, 0.15)
    found = optimised(start, 100.0, 5)
    noise = noise_of(found.scenes, found.residuals, 6, 100.0)
    assert noise.variance == pytest.approx(0.09, rel=0.08)
    assert noise.curvature == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize('readout_s', [0.0, READOUT_S])
def test_points_and_poses_follow_the_camera(readout_s):
    scene = small_scene(LENS)
    imaging = replace(imaging_with(LENS, [scene]), readout_s=readout_s)
    scene = as_seen(scene, imaging)
    normal = normal_equations(scene, imaging, 50.0)
    step = np.zeros(len(normal.cost.score))
    step[0] = 1e-3 * LENS.fx
    zero = np.zeros((len(scene.tracks.frames), 3))

    def rms(structure, now: Imaging) -> float:
        return float(np.sqrt(np.mean(residuals(replace(scene, structure=structure), now)**2)))

    def after(step: np.ndarray) -> float:
        return rms(normal.eliminated.moved(scene.structure, step), replace(
            imaging.stepped(step), shaking={scene.turn: normal.eliminated.shaken(zero, step)}))

    best = after(np.zeros_like(step))
    # they make up for nearly all that another focal length spoils
    assert after(step) - best < 0.1 * (rms(scene.structure, imaging.stepped(step)) - best)
    for rotation in normal.eliminated.moved(scene.structure, step).rotations:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def test_a_lens_that_sees_none_of_some_points_counts_them_for_nothing():
    [scene] = scenes_of(1, start=LENS)
    points = scene.structure.points.copy()
    # behind the camera, all the time
    points[:len(points) // 2] = scene.structure.path()[1][0] - (0.0, 0.0, 1e4)
    normal = normal_equations(replace(scene, structure=replace(
        scene.structure, points=points)), imaging_with(LENS, [scene]), 0.5)
    assert np.isfinite(normal.cost.hessian).all() and np.isfinite(normal.cost.score).all()
