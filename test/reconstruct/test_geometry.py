# SPDX-License-Identifier: Apache-2.0
"""Poses from viewing rays, with each engine: exact, robust, in any direction, repeatable."""
from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from refused import refused
from synthetic import LENS, angle_deg, synthetic_turn

from dashcalib_ros import config as config_module
from dashcalib_ros.config import COLMAP, OPENCV, Config, ReconstructConfig
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.reconstruct.chain import chain
from dashcalib_ros.reconstruct.geometry import Engine, engine_named

# 29 of 200 are wrong
OUTLIERS = slice(None, None, 7)


@pytest.fixture(params=[
    pytest.param(COLMAP, marks=pytest.mark.skipif(not find_spec('pycolmap'), reason='needs it')),
    OPENCV])
def engine(request) -> Engine:
    return engine_named(request.param)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def rotation_of(yaw: float) -> np.ndarray:
    return np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])


def two_views(widest_deg: float, noise: float = 0.0):
    """Return rays of the same points in two images, the points, and the second image's pose."""
    rng = np.random.default_rng(1)
    points = rng.uniform([-30, -5, -20], [30, 5, 60], (4000, 3))
    rotation, translation = rotation_of(0.2), np.array([0.3, 0.0, -2.0])
    local = points @ rotation.T + translation
    angles = [np.arctan2(np.hypot(x, y), z) for x, y, z in (points.T, local.T)]
    seen = np.maximum(*angles) < np.radians(widest_deg)
    points, local = points[seen][:200], local[seen][:200]
    if widest_deg > 90:
        assert (local[:, 2] < 0).any()
    before, after = (unit(unit(each) + noise * rng.normal(size=each.shape))
                     for each in (points, local))
    after[OUTLIERS] = unit(rng.normal(size=after[OUTLIERS].shape))
    return before, after, points, rotation, translation


@pytest.mark.parametrize('widest_deg', [40, 100])
@pytest.mark.parametrize(('noise', 'off_deg', 'off_m'), [(0.0, 0.05, 0.02), (3e-4, 0.2, 0.1)])
def test_poses_come_from_rays_in_any_direction(engine, widest_deg, noise, off_deg, off_m):
    before, after, points, rotation, translation = two_views(widest_deg, noise)
    for found, far in ((engine.relative_pose(before, after, 1e-3, 3), False),
                       (engine.absolute_pose(after, points, 1e-3, 3), True)):
        assert found is not None
        (turned, moved), agree = found
        assert angle_deg(turned, rotation) < off_deg
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-9)
        assert 160 <= agree <= 175
        np.testing.assert_allclose(moved if far else moved * np.linalg.norm(translation),
                                   translation, atol=off_m)


def test_the_same_seed_gives_the_same_pose(engine):
    before, after, points, _, _ = two_views(60, 1e-3)
    for estimate, other in ((engine.relative_pose, before), (engine.absolute_pose, points)):
        first, again = (estimate(after, other, 1e-3, 5) for _ in range(2))
        np.testing.assert_array_equal(np.column_stack(first[0]), np.column_stack(again[0]))
        assert first[1] == again[1]


def test_too_few_rays_give_no_pose(engine):
    before, after, points, _, _ = two_views(60)
    assert engine.relative_pose(before[1:5], after[1:5], 1e-3, 0) is None
    assert engine.absolute_pose(after[1:3], points[1:3], 1e-3, 0) is None
    assert engine.absolute_pose(after[:0], points[:0], 1e-3, 0) is None


def test_few_rays_agree_where_nothing_fits(engine):
    rng = np.random.default_rng(2)
    rays, others = (unit(rng.normal(size=(200, 3))) for _ in range(2))
    for estimate, other in ((engine.relative_pose, others),
                            (engine.absolute_pose, rng.normal(size=(200, 3)))):
        found = estimate(rays, other, 1e-3, 0)
        assert found is None or found[1] < 30


def test_points_at_one_place_and_rays_all_alike_are_no_crash(engine):
    rays, points = np.tile([0.0, 0.0, 1.0], (30, 1)), np.ones((30, 3))
    for found in (engine.relative_pose(rays, rays, 1e-3, 0),
                  engine.absolute_pose(rays, points, 1e-3, 0)):
        assert found is None or found[1] <= 30


def test_a_chain_finds_every_image(engine):
    turn = synthetic_turn(yaw_deg=80.0, outliers=0.05)
    structure = chain(turn.tracks, LENS, 3.2, 0.3, engine=engine)
    assert structure is not None and structure.registered.all()
    assert structure.used.sum() > 0.85 * turn.tracks.seen.sum()
    true = turn.structure.rotations
    for k in range(1, len(true)):
        relative = structure.rotations[k] @ structure.rotations[0].T
        assert angle_deg(relative, true[k] @ true[0].T) < 0.5


def test_the_engine_is_colmap_where_it_is_installed(monkeypatch):
    for installed, used in ((True, COLMAP), (False, OPENCV)):
        spec = find_spec('numpy') if installed else None
        monkeypatch.setattr(config_module, 'find_spec', lambda name, spec=spec: spec)
        assert ReconstructConfig().used == used
        assert ReconstructConfig(OPENCV).used == OPENCV
    # a Config that exists is valid
    with refused(ConfigError, 'E-ENGINE-MISSING', 'reconstruct.engine'):
        Config().replace({'reconstruct.engine': COLMAP})
    with refused(ConfigError, 'E-CONFIG-CHOICE', 'reconstruct.engine'):
        replace(Config(), reconstruct=ReconstructConfig('other'))
