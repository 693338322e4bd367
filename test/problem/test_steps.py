# SPDX-License-Identifier: Apache-2.0
"""The steps to the optimum of a problem: to the minimum that SciPy finds, too."""
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from synthetic import SIZE, synthetic_turn

from dashcalib_ros.camera import Brown, Camera, Fisheye, Radial
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.problem.blocks import Imaging, Lens, lens_alone
from dashcalib_ros.problem.observations import Stretch, Structure, Tracks
from dashcalib_ros.problem.steps import (
    FIRST_RADIUS,
    State,
    Stepping,
    Undetermined,
    optimised,
)

LOSS_PX = 0.5
LENSES = {
    'radial': Radial(SIZE, 520.0, 530.0, 399.5, 224.5, -0.25, 0.05),
    'brown': Brown(SIZE, 520.0, 530.0, 399.5, 224.5, -0.25, 0.05, 1e-3, -2e-3, 0.01),
    'fisheye': Fisheye(SIZE, 420.0, 425.0, 399.5, 224.5, -0.02, 0.004)}


def stretch_of(lens: Camera, count: int = 40) -> Stretch:
    """Return a stretch of this lens with noise, outliers, and a start that is off."""
    made, rng = synthetic_turn(yaw_deg=40.0, keyframes=6).structure, np.random.default_rng(0)
    local = (made.points @ made.rotations.transpose(0, 2, 1) + made.translations[:, None])
    pixels = lens.project(local)
    seen = np.isfinite(pixels[:, :, 0]) & (pixels > 0).all(axis=2) & (pixels < SIZE).all(axis=2)
    tracks = np.flatnonzero(seen.sum(axis=0) >= 3)[:count]
    used = seen[:, tracks]
    xy = np.where(used[:, :, None], pixels[:, tracks], np.nan)
    found = xy[used] + rng.normal(size=(int(used.sum()), 2)) * 0.2
    found[::25] += 8.0
    xy[used] = found
    count = len(made.rotations)
    structure = Structure(
        made.rotations, made.translations + 0.02 * rng.normal(size=made.translations.shape),
        made.points[tracks] * (1 + 0.02 * rng.normal(size=(len(tracks), 1))),
        np.ones(count, bool), used)
    stamps = (np.arange(count) * 10**8).astype(np.int64)
    return Stretch(TurnId(True, 0), Tracks(np.arange(count), xy, SIZE, stamps), structure)


def cost(stretch: Stretch, camera: Camera) -> float:
    return State(lens_alone(camera), (stretch,)).cost(LOSS_PX, 1.0)


def free(camera: Camera, *places: int) -> Lens:
    count = len(camera.params)
    return Lens(camera, np.eye(count)[:, list(places)], held=not places)


def adjusted(stretches: list[Stretch], lens: Lens, steps: int = 60, tolerance: float = 1e-12
             ) -> tuple[tuple[Stretch, ...], Camera]:
    found = optimised(State(Imaging.of(lens), tuple(stretches)), Stepping(
        LOSS_PX, steps, unit=1.0, tolerance=tolerance, radius=FIRST_RADIUS))
    return found.stretches, found.camera


def minimum(stretch: Stretch, lens: Lens) -> float:
    """Return the least cost that SciPy finds, by all parameters at once."""
    made, free = stretch.structure, np.zeros((0, 0)) if lens.held else lens.directions
    images, points = len(made.rotations), len(made.points)
    sizes = np.cumsum([3 * images, 3 * images, 3 * points])

    def moved(values: np.ndarray) -> tuple[Stretch, Camera]:
        turned, shifted, points, step = np.split(values, sizes)
        rotations = np.array([cv2.Rodrigues(each)[0] for each in turned.reshape(-1, 3)])
        return (stretch.moved(rotations @ made.rotations,
                              made.translations + shifted.reshape(-1, 3),
                              made.points + points.reshape(-1, 3)),
                lens.camera if lens.held else lens.moved(step).camera)

    def distances(values: np.ndarray) -> np.ndarray:
        now, camera = moved(values)
        off = lens_alone(camera).seen(now).off
        squares = np.sum(off**2, axis=1)
        # the root of the robust cost, along the residual
        return ((LOSS_PX * np.sqrt(np.log1p(squares / LOSS_PX**2) / squares))[:, None]
                * off).ravel()

    found = least_squares(distances, np.zeros(sizes[-1] + free.shape[1]),
                          method='trf', xtol=1e-12, ftol=1e-12, max_nfev=60)
    return cost(*moved(found.x))


@pytest.mark.parametrize(('name', 'places'), [
    ('radial', (4, 5)), ('radial', ()), ('brown', (4, 5, 6, 7, 8)), ('fisheye', (0, 4, 5))])
def test_the_minimum_is_the_one_that_scipy_finds(name, places):
    camera = LENSES[name]
    start, lens = stretch_of(camera), free(camera, *places)
    [found], moved = adjusted([start], lens)
    assert cost(found, moved) < 0.5 * cost(start, camera)
    assert cost(found, moved) == pytest.approx(minimum(start, lens), rel=1e-3)
    still = np.setdiff1d(np.arange(len(camera.params)), places)
    np.testing.assert_array_equal(moved.params[still], camera.params[still])


def test_stretches_share_the_lens_and_nothing_else():
    camera = LENSES['radial']
    off = camera.with_params(camera.params + [0, 0, 0, 0, 0.05, 0.02])
    starts = [stretch_of(camera, count) for count in (40, 60)]
    _, moved = adjusted(starts, free(off, 4, 5))
    np.testing.assert_allclose(moved.params[4:], camera.params[4:], atol=0.02)
    # with the lens held, each is where it is alone
    for start, each in zip(starts, adjusted(starts, free(camera))[0], strict=True):
        [alone], _ = adjusted([start], free(camera))
        assert cost(each, camera) == pytest.approx(cost(alone, camera), rel=1e-4)


def test_a_point_behind_the_camera_moves_nothing_and_is_no_crash():
    camera = LENSES['radial']
    start = stretch_of(camera)
    points = start.structure.points.copy()
    points[0] = [0.0, 0.0, -1e3]
    behind = replace(start, structure=replace(start.structure, points=points))
    [found], moved = adjusted([behind], free(camera, 4, 5), 20, 1e-9)
    assert np.isfinite(found.structure.points).all() and np.isfinite(moved.params).all()
    np.testing.assert_array_equal(found.structure.points[0], points[0])
    used = found.structure.used & (np.arange(len(points)) != 0)
    without = replace(found, structure=replace(found.structure, used=used))
    assert cost(without, moved) < 0.5 * cost(start, camera)


def test_a_lens_stays_in_its_bounds():
    camera = LENSES['radial']
    bounds = np.array([np.full(6, -np.inf), np.full(6, np.inf)])
    bounds[:, 4] = -0.2, 0.0
    off = camera.with_params(camera.params + [0, 0, 0, 0, 0.1, 0.0])
    _, moved = adjusted([stretch_of(camera)], replace(free(off, 4), bounds=bounds), 30, 1e-9)
    assert moved.k1 == -0.2


def at_one_place(scale: float) -> Stretch:
    """Return a stretch whose images are at one place, and its points in one direction."""
    start = stretch_of(LENSES['radial'])
    made = start.structure
    return start.moved(np.tile(np.eye(3), (len(made.rotations), 1, 1)), made.translations * 0,
                       np.tile([0.0, 0.0, 5.0 * scale], (len(made.points), 1)))


@pytest.mark.parametrize('scale', [1.0, 1e12])
def test_a_stretch_that_determines_nothing_is_no_crash(scale):
    camera, start = LENSES['radial'], at_one_place(scale)
    [found], moved = adjusted([start], free(camera, 4, 5), 30, 1e-9)
    assert np.isfinite(moved.params).all()
    assert cost(found, moved) <= cost(start, camera)


def test_what_nothing_determines_is_named():
    # all points on the axis: they do not see the distortion
    lens = Lens(LENSES['radial'], np.eye(6)[:, 4:])
    with pytest.raises(Undetermined) as raised:
        optimised(State(Imaging.of(lens), (at_one_place(1.0),)), Stepping(LOSS_PX, 5, unit=1.0))
    assert set(raised.value.names) <= {'k1', 'k2'} and raised.value.names


def test_equations_without_a_solution_move_nothing(monkeypatch):
    def fails(*arguments):
        raise np.linalg.LinAlgError

    start, lens = stretch_of(LENSES['radial']), free(LENSES['radial'], 4, 5)
    monkeypatch.setattr(np.linalg, 'solve', fails)
    [found], moved = adjusted([start], lens, 30, 1e-9)
    np.testing.assert_array_equal(found.structure.points, start.structure.points)
    assert moved == lens.camera


def test_the_last_step_says_how_near_the_optimum_is():
    camera = LENSES['radial']
    off = camera.with_params(camera.params + [0, 0, 0, 0, 0.1, 0])
    start, lens = stretch_of(camera), free(off, 4, 5)

    def after(steps: int) -> np.ndarray:
        return optimised(State(Imaging.of(lens), (start,)), Stepping(LOSS_PX, steps)).last

    assert np.abs(after(20)).max(initial=0.0) < 1e-4 < 0.02 < np.abs(after(1)).max()
