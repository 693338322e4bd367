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
from dashcalib_ros.problem.blocks import (
    Imaging,
    Lens,
    Readout,
    Shift,
    Smooth,
    Zoom,
    bounds_of,
    imaging_with,
)
from dashcalib_ros.problem.normal import (
    Normal,
    linearised,
    noise_of,
    normal_equations,
    poses_given_shared,
)
from dashcalib_ros.problem.quadratic import Quadratic
from dashcalib_ros.reconstruct.scene import Scene, residuals_px
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


def residuals(scene: Scene, imaging: Imaging) -> np.ndarray:
    return imaging.seen(scene).off


def normal_of(scene: Scene, imaging: Imaging, loss_px: float, **options) -> Normal:
    return normal_equations(linearised(imaging.seen(scene), loss_px), **options)


@pytest.mark.parametrize('readout_s', [0.0, READOUT_S])
def test_poses_follow_what_is_shared_as_the_normal_equations_say(readout_s):
    scene = small_scene(LENS)
    linear = linearised(Imaging.of(Lens(LENS), Readout(np.array([readout_s]))).seen(scene), 1.0)
    assert (linear.follow is None) == (not readout_s)
    known, normal = poses_given_shared(linear, VARIANCE), normal_equations(linear)
    np.testing.assert_allclose(known.follow, -normal.response, rtol=1e-8, atol=1e-12)
    # one sigma of the noise is what the scores of the poses are worth
    score = np.random.default_rng(2).normal(size=len(known.covariance))
    moved = known.covariance @ score
    assert score @ moved > 0
    twice = poses_given_shared(linear, 2 * VARIANCE).covariance
    np.testing.assert_allclose(twice, 2 * known.covariance, rtol=1e-8, atol=1e-15)


@pytest.mark.parametrize('readout_s', [0.0, READOUT_S])
def test_poses_go_where_they_go_when_what_is_shared_takes_no_step(readout_s):
    scene = small_scene(LENS)
    seen = imaging_of(LENS, scene, readout_s).seen(scene)
    every = normal_equations(linearised(seen, 1.0))
    every = every.follow(np.zeros(len(every.cost.score)))
    alone = normal_equations(linearised(seen, 1.0, alone=True)).follow(np.zeros(0))
    assert np.abs(every.poses).max() > 1e-6
    np.testing.assert_allclose(alone.poses, every.poses, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(alone.points, every.points, rtol=1e-6, atol=1e-9)
    assert alone.images.keys() == every.images.keys()


def test_images_that_show_no_motion_do_not_shake():
    """Their shakes stood in the places of what is shared, or beyond the last of them."""
    turn = synthetic_turn(LENS, 70.0, 2, 30, keyframe_s=0.15)
    scene = replace(turn.scene(LENS), structure=turn.structure)
    imaging = imaging_of(LENS, scene, READOUT_S)
    linear = linearised(imaging.seen(scene), 1.0)
    assert imaging.coupled and not scene.trajectory.moves and linear.follow is None
    places = np.concatenate([*linear.extras.values()])
    assert sorted(places) == [*range(linear.own * len(linear.images))]
    still = imaging.having(replace(imaging.blocks['shake'], held=True))
    np.testing.assert_allclose(normal_equations(linear).cost.hessian,
                               normal_of(scene, still, 1.0).cost.hessian)


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
    smooth = Smooth(0.002 * rng.normal(size=few), found.smooth.basis[:, :few])
    moved = rng.normal(size=(count, 3)) * (0.5, 0.5, 1e-4)
    shaking = {scene.turn: 0.01 * rng.normal(size=(count, 3))} if readout_s else {}
    return found.having(
        Readout(np.array([readout_s])), smooth, Shift({scene.turn: moved[:, :2]}, held=True),
        Zoom({scene.turn: moved[:, 2:]}, held=True),
        replace(found.blocks['shake'], value=shaking, readout_s=readout_s))


def numeric(scene: Scene, imaging: Imaging, loss_px: float, kept: tuple[str, ...]
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return hessian and score by differences, all poses, points and shaking eliminated."""
    structure = scene.structure
    k, t = structure.used.shape
    gone = [block.name for block in imaging.of_each_image(scene) if block.name not in kept]
    blocks = {name: imaging.blocks[name] for name in [*gone, *kept]}
    sizes = [6 * k, *(k * blocks[name].count for name in gone), 3 * t,
             *(k * blocks[name].count for name in kept), len(imaging.names)]
    ends = np.cumsum(sizes)

    def off(values: np.ndarray) -> np.ndarray:
        pose, *more, step = np.split(values, ends[:-1])
        point = more.pop(len(gone))
        turned, moved = np.split(pose.reshape(k, 6), 2, axis=1)
        other = replace(scene, structure=replace(
            structure, rotations=rotation_matrices(turned) @ structure.rotations,
            translations=structure.translations + moved,
            points=structure.points + point.reshape(t, 3)))
        return residuals(other, imaging.moved(step).having(*(
            block.moved_in(scene, each) for block, each in zip(blocks.values(), more,
                                                               strict=True)))).ravel()

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
    for n, name in enumerate(gone):
        own = slice(ends[n], ends[n + 1])
        precision, away = blocks[name].prior_of(scene)
        normal[own, own] += VARIANCE * precision
        pull[own] -= VARIANCE * precision @ away
    count = ends[len(gone) + 1]
    unit = 1 / np.sqrt(np.diag(normal)[:count])
    inner = unit[:, None] * np.linalg.pinv(
        normal[:count, :count] * np.outer(unit, unit), rcond=1e-11, hermitian=True) * unit
    follow = normal[count:, :count] @ inner
    return normal[count:, count:] - follow @ normal[:count, count:], (
        pull[count:] - follow @ pull[:count])


@pytest.mark.parametrize(('camera', 'readout_s', 'loss_px', 'by_image'), [
    (DECENTRED, 0.0, 0.5, False), (DECENTRED, 0.0, 50.0, True), (DECENTRED, READOUT_S, 0.5, True),
    (DECENTRED, -READOUT_S, 50.0, False), (WIDE, READOUT_S, 50.0, False)])
def test_they_agree_with_differences(camera, readout_s, loss_px, by_image):
    scene = small_scene(camera)
    imaging = imaging_of(camera, scene, readout_s)
    scene = as_seen(scene, imaging)
    kept = (Shift.name, Zoom.name) if by_image else ()
    imaging = imaging.having(*(replace(imaging.blocks[name], held=False) for name in kept))
    found = normal_of(scene, imaging, loss_px, variance=VARIANCE, kept=kept).cost
    hessian, score = numeric(scene, imaging, loss_px, kept)
    # of images, the numbers of each block stand image by image, as they are asked for
    scale = 1 / np.sqrt(np.diag(hessian))
    np.testing.assert_allclose(found.hessian * np.outer(scale, scale),
                               hessian * np.outer(scale, scale), atol=0.011)
    np.testing.assert_allclose(found.score * scale, score * scale, atol=1e-3)
    assert np.abs(score * scale).max() > 0.03


def test_blocks_of_images_are_eliminated_with_their_priors():
    scene = small_scene(DECENTRED)
    imaging = imaging_of(DECENTRED, scene, READOUT_S)
    # a field's columns hold to the first order only, and its own values are what is beyond it
    imaging = imaging.having(replace(imaging.smooth, value=np.zeros(imaging.smooth.size)))
    scene = as_seen(scene, imaging)
    imaging = imaging.having(replace(imaging.blocks[Shift.name], held=False))
    found = normal_of(scene, imaging, 50.0, variance=VARIANCE).cost
    hessian, score = numeric(scene, imaging, 50.0, ())
    scale = 1 / np.sqrt(np.diag(hessian))
    np.testing.assert_allclose(found.hessian * np.outer(scale, scale),
                               hessian * np.outer(scale, scale), atol=0.011)
    np.testing.assert_allclose(found.score * scale, score * scale, atol=1e-3)


def test_residuals_are_seen_minus_projected():
    scene = small_scene(LENS)
    np.testing.assert_allclose(residuals(scene, imaging_with(LENS)),
                               -residuals_px(scene, LENS)[scene.structure.used])


def started(scenes: tuple[Scene, ...]) -> Estimate:
    wide = LENS.widened()
    return Estimate(imaging_with(wide, scenes).having(
        Lens(wide, centred=wide, bounds=bounds_of(wide))), scenes, config=CONFIG)


def test_there_is_no_gradient_at_the_optimum():
    start = started(tuple(scenes_of(2, start=LENS, tracks=120)))
    loss_px = start.loss_px()

    def pull(now: Estimate) -> float:
        """Return how far the least cost is, in sigmas of the parameter that is farthest."""
        noise = now.noise(loss_px).variance * now.inflation
        total = Quadratic.together([now.imaging.prior(), *(
            normal_equations(each, noise).cost.at_noise(noise) for each in now.linear(loss_px))])
        return float(np.abs(total.optimum / np.sqrt(np.diag(total.covariance))).max())

    assert pull(optimised(start, 0.0, 20, settled=1e-6)) < 0.05 < 0.3 < pull(start)


def test_the_variance_of_the_noise_is_found():
    found = optimised(started(tuple(scenes_of(2, start=LENS, noise_px=0.3))), 100.0, 5)
    noise = noise_of(found.seen, 6, 100.0)
    assert noise.variance == pytest.approx(0.09, rel=0.08)
    assert noise.curvature == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize('readout_s', [0.0, READOUT_S])
def test_points_and_poses_follow_the_camera(readout_s):
    scene = small_scene(LENS)
    imaging = imaging_with(LENS, [scene]).having(Readout(np.array([readout_s])))
    scene = as_seen(scene, imaging)
    normal = normal_of(scene, imaging, 50.0)
    step = np.zeros(len(normal.cost.score))
    step[0] = 1e-3 * LENS.fx

    def rms(scene: Scene, now: Imaging) -> float:
        return float(np.sqrt(np.mean(residuals(scene, now)**2)))

    def after(step: np.ndarray) -> float:
        now, follow = imaging.moved(step), normal.follow(step)
        return rms(normal.moved(step), now.having(*(
            imaging.blocks[name].moved_in(scene, each) for name, each in follow.images.items())))

    best = after(np.zeros_like(step))
    # they make up for nearly all that another focal length spoils
    assert after(step) - best < 0.1 * (rms(scene, imaging.moved(step)) - best)
    for rotation in normal.moved(step).structure.rotations:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def test_drifts_that_tracks_have_in_common_are_in_the_covariance_of_the_score():
    scene = as_seen(small_scene(LENS), imaging := Imaging.of(Lens(LENS)))
    seen, loss_px, drift_px = imaging.seen(scene), 1e4, 0.01
    linear, observed = linearised(seen, loss_px), seen.observed
    expected = normal_equations(linear, tracks=True).cost.by_track
    ages = np.zeros(len(observed.rows))
    for track in range(len(observed.tracks)):
        mine = observed.point == track
        seconds = observed.stamps_ns[mine] / 1e9
        ages[mine] = (seconds - (seconds[0] + seconds[-1]) / 2) / (seconds[-1] - seconds[0])
    x, y = 2 * observed.xy.T / SIZE[0] - np.array([[1.0], [SIZE[1] / SIZE[0]]])
    for pattern in (x**0, x, y, x**2, x * y, y**2):
        for axis in (0, 1):
            xy = scene.tracks.xy.copy()
            xy[observed.rows, observed.columns, axis] += drift_px * ages * pattern
            drifted = replace(scene, tracks=replace(scene.tracks, xy=xy))
            asked = (normal_of(drifted, imaging, loss_px).cost.score
                     - normal_equations(linear).cost.score)
            expected = expected + np.outer(asked, asked)
    found = normal_equations(linear, tracks=True, drift_px=drift_px).cost.by_track
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_a_lens_that_sees_none_of_some_points_counts_them_for_nothing():
    [scene] = scenes_of(1, start=LENS)
    points = scene.structure.points.copy()
    # behind the camera, all the time
    points[:len(points) // 2] = scene.structure.path()[1][0] - (0.0, 0.0, 1e4)
    normal = normal_of(replace(scene, structure=replace(
        scene.structure, points=points)), imaging_with(LENS, [scene]), 0.5)
    assert np.isfinite(normal.cost.hessian).all() and np.isfinite(normal.cost.score).all()
