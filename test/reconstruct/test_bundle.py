# SPDX-License-Identifier: Apache-2.0
"""The adjustment of a turn: to the minimum that SciPy finds, too."""
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from synthetic import SIZE, synthetic_turn

from dashcalib_ros.camera import Brown, Camera, Fisheye, Radial
from dashcalib_ros.reconstruct.bundle import UNSEEN_PX, Lens, Observed, adjusted

LOSS_PX = 0.5
LENSES = {
    'radial': Radial(SIZE, 520.0, 530.0, 399.5, 224.5, -0.25, 0.05),
    'brown': Brown(SIZE, 520.0, 530.0, 399.5, 224.5, -0.25, 0.05, 1e-3, -2e-3, 0.01),
    'fisheye': Fisheye(SIZE, 420.0, 425.0, 399.5, 224.5, -0.02, 0.004)}


def observed(lens: Camera, count: int = 40) -> Observed:
    """Return a turn of this lens with noise, outliers, and a start that is off."""
    made, rng = synthetic_turn(yaw_deg=40.0, keyframes=6).structure, np.random.default_rng(0)
    local = (made.points @ made.rotations.transpose(0, 2, 1) + made.translations[:, None])
    pixels = lens.project(local)
    seen = np.isfinite(pixels[:, :, 0]) & (pixels > 0).all(axis=2) & (pixels < SIZE).all(axis=2)
    tracks = np.flatnonzero(seen.sum(axis=0) >= 3)[:count]
    image, point = np.nonzero(seen[:, tracks])
    xy = pixels[:, tracks][image, point] + rng.normal(size=(len(image), 2)) * 0.2
    xy[::25] += 8.0
    points = made.points[tracks] * (1 + 0.02 * rng.normal(size=(len(tracks), 1)))
    translations = made.translations + 0.02 * rng.normal(size=made.translations.shape)
    everything = np.arange(len(made.rotations))
    return Observed(image, point, xy, made.rotations, translations, points, everything, tracks)


def cost(turn: Observed, camera: Camera) -> float:
    local = np.einsum('nij,nj->ni', turn.rotations[turn.image], turn.points[turn.point])
    off = camera.project(local + turn.translations[turn.image]) - turn.observed
    off = np.nan_to_num(off, nan=UNSEEN_PX)
    return float(0.5 * LOSS_PX**2 * np.log1p(np.sum(off**2, axis=1) / LOSS_PX**2).sum())


def free(camera: Camera, *places: int) -> Lens:
    count = len(camera.params)
    return Lens(camera, np.eye(count)[:, list(places)], np.full(count, -np.inf),
                np.full(count, np.inf))


def minimum(turn: Observed, lens: Lens) -> float:
    """Return the least cost that SciPy finds, by all parameters at once."""
    images, points = len(turn.rotations), len(turn.points)
    sizes = np.cumsum([3 * images, 3 * images, 3 * points])

    def moved(values: np.ndarray) -> tuple[Observed, Camera]:
        turned, shifted, points, step = np.split(values, sizes)
        rotations = np.array([cv2.Rodrigues(each)[0] for each in turned.reshape(-1, 3)])
        return replace(
            turn, rotations=rotations @ turn.rotations,
            translations=turn.translations + shifted.reshape(-1, 3),
            points=turn.points + points.reshape(-1, 3)), lens.moved(step).camera

    def distances(values: np.ndarray) -> np.ndarray:
        now, camera = moved(values)
        local = np.einsum('nij,nj->ni', now.rotations[now.image], now.points[now.point])
        off = camera.project(local + now.translations[now.image]) - now.observed
        squares = np.sum(off**2, axis=1)
        # the root of the robust cost, along the residual
        return ((LOSS_PX * np.sqrt(np.log1p(squares / LOSS_PX**2) / squares))[:, None]
                * off).ravel()

    found = least_squares(distances, np.zeros(sizes[-1] + lens.directions.shape[1]),
                          method='trf', xtol=1e-12, ftol=1e-12, max_nfev=60)
    return cost(*moved(found.x))


@pytest.mark.parametrize(('name', 'places'), [
    ('radial', (4, 5)), ('radial', ()), ('brown', (4, 5, 6, 7, 8)), ('fisheye', (0, 4, 5))])
def test_the_minimum_is_the_one_that_scipy_finds(name, places):
    camera = LENSES[name]
    turn, lens = observed(camera), free(camera, *places)
    [found], moved = adjusted([turn], lens, LOSS_PX, 60, 1e-12)
    assert cost(found, moved.camera) < 0.5 * cost(turn, camera)
    assert cost(found, moved.camera) == pytest.approx(minimum(turn, lens), rel=1e-3)
    still = np.setdiff1d(np.arange(len(camera.params)), places)
    np.testing.assert_array_equal(moved.camera.params[still], camera.params[still])


def test_turns_share_the_lens_and_nothing_else():
    camera = LENSES['radial']
    start = camera.with_params(camera.params + [0, 0, 0, 0, 0.05, 0.02])
    turns = [observed(camera, count) for count in (40, 60)]
    found, moved = adjusted(turns, free(start, 4, 5), LOSS_PX, 60, 1e-12)
    np.testing.assert_allclose(moved.camera.params[4:], camera.params[4:], atol=0.02)
    # with the lens held, each is where it is alone
    for turn, each in zip(turns, adjusted(turns, free(camera), LOSS_PX, 60, 1e-12)[0],
                          strict=True):
        [alone], _ = adjusted([turn], free(camera), LOSS_PX, 60, 1e-12)
        assert cost(each, camera) == pytest.approx(cost(alone, camera), rel=1e-4)
    assert [len(each.points) for each in found] == [len(turn.points) for turn in turns]


def test_a_point_behind_the_camera_moves_nothing_and_is_no_crash():
    camera = LENSES['radial']
    turn = observed(camera)
    points = turn.points.copy()
    points[0] = [0.0, 0.0, -1e3]
    behind = replace(turn, points=points)
    [found], moved = adjusted([behind], free(camera, 4, 5), LOSS_PX, 20, 1e-9)
    assert np.isfinite(found.points).all() and np.isfinite(moved.camera.params).all()
    np.testing.assert_array_equal(found.points[0], points[0])
    without = turn.point != 0
    assert cost(replace(found, image=turn.image[without], point=turn.point[without],
                        observed=turn.observed[without]), moved.camera) < 0.5 * cost(turn, camera)


def test_a_lens_stays_in_its_bounds():
    camera = LENSES['radial']
    lens = free(camera.with_params(camera.params + [0, 0, 0, 0, 0.1, 0.0]), 4)
    low, high = lens.low.copy(), lens.high.copy()
    low[4], high[4] = -0.2, 0.0
    _, moved = adjusted([observed(camera)], Lens(lens.camera, lens.directions, low, high),
                        LOSS_PX, 30, 1e-9)
    assert moved.camera.k1 == -0.2


def test_a_turn_that_determines_nothing_is_no_crash():
    camera = LENSES['radial']
    turn = observed(camera)
    # all images at one place, all points in one direction
    same = replace(turn, translations=turn.translations * 0,
                   rotations=np.broadcast_to(np.eye(3), turn.rotations.shape),
                   points=np.tile([0.0, 0.0, 5.0], (len(turn.points), 1)))
    for start in (same, replace(same, points=1e12 * same.points)):
        [found], moved = adjusted([start], free(camera, 4, 5), LOSS_PX, 30, 1e-9)
        assert np.isfinite(moved.camera.params).all()
        assert cost(found, moved.camera) <= cost(start, camera)


def test_equations_without_a_solution_move_nothing(monkeypatch):
    def fails(*arguments):
        raise np.linalg.LinAlgError

    turn, lens = observed(LENSES['radial']), free(LENSES['radial'], 4, 5)
    monkeypatch.setattr(np.linalg, 'solve', fails)
    [found], moved = adjusted([turn], lens, LOSS_PX, 30, 1e-9)
    np.testing.assert_array_equal(found.points, turn.points)
    assert moved.camera == lens.camera
