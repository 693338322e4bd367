# SPDX-License-Identifier: Apache-2.0
"""Turns of earlier drives: of the same camera they help, of another they must not harm unseen."""
from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from solving import CONFIG, START, YAWS, scenes_of, z_of
from synthetic import LENS, SyntheticTurn, synthetic_turn

from dashcalib_ros.camera import Camera
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.judge.agreement import OTHER_CAMERA, turns_of_earlier_cameras
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve import solve

pytestmark = pytest.mark.usefixtures('no_profile')


def longer(by: float) -> Camera:
    return replace(LENS, fx=by * LENS.fx, fy=by * LENS.fy)


@cache
def five_turns(camera: Camera) -> list[Scene]:
    ratio = camera.fx / LENS.fx
    return scenes_of(5, camera, tracks=110,
                     start=replace(START, fx=START.fx * ratio, fy=START.fy * ratio))


def mixed(own: int, earlier: Camera) -> list[Scene]:
    """Return five turns, the first so many of this drive, the others of an earlier one."""
    scenes, before = five_turns(LENS), five_turns(earlier)
    return scenes[:own] + [replace(scene, turn=TurnId.stored(n))
                           for n, scene in enumerate(before[own:])]


def solved(scenes: list[Scene]):
    solution = solve(scenes, CONFIG)
    assert solution is not None
    return solution


def test_of_the_same_camera_they_help_as_far_as_this_drive_confirms_them():
    together = solved(mixed(1, LENS))
    assert len(together.scenes) == 5 and np.abs(z_of(together)).max() < 3
    alone, own_too = solved(mixed(1, LENS)[:1]), solved(mixed(3, LENS))
    assert own_too.sigma[0] < together.sigma[0] < alone.sigma[0]
    # more than the turns themselves would say, over the picture too
    same = solved([replace(scene, turn=TurnId.at(n)) for n, scene in enumerate(mixed(1, LENS))])
    assert together.sigma[0] > same.sigma[0]
    assert together.picture.rms > same.picture.rms
    np.testing.assert_array_equal(together.camera.params, same.camera.params)


@pytest.mark.parametrize(('own', 'by'), [
    (1, 1.02), pytest.param(3, 1.05, marks=pytest.mark.thorough), (1, 1.3)])
def test_a_lens_exchanged_since_is_left_out_or_in_sigma(own, by):
    scenes = mixed(own, longer(by))
    solution = solved(scenes)
    used = [scene.turn for scene in solution.scenes]
    assert any(turn.of_this_drive for turn in used)
    off = abs(solution.camera.fx - LENS.fx)
    assert off < 2.5 * solution.sigma[0]
    left_out = turns_of_earlier_cameras(scenes, solution)
    assert set(left_out) == {scene.turn for scene in scenes} - {*used} - {*solution.misfits}
    if off > 0.02 * LENS.fx:
        assert judge(solution, CONFIG.verdict).level != 'accepted'


@pytest.mark.thorough
def test_a_camera_that_hangs_upside_down_now_is_another_one():
    """Its centre is nearly the same, and so is its lens: only the road is on the other side."""
    scenes = [on_a_road(world, yaw) for world, yaw in enumerate(YAWS[:4])]
    scenes[2:] = [replace(scene, turn=TurnId.stored(n)) for n, scene in enumerate(scenes[2:])]
    turned = np.diag([-1.0, -1.0, 1.0])

    def upside_down(scene: Scene) -> Scene:
        structure = scene.structure
        return replace(scene, tracks=replace(scene.tracks, xy=[799, 449] - scene.tracks.xy),
                       structure=replace(structure, rotations=turned @ structure.rotations,
                                         translations=structure.translations @ turned))

    both = [*map(upside_down, scenes[:2]), *scenes[2:]]
    assert not turns_of_earlier_cameras(scenes, solved(scenes))
    assert turns_of_earlier_cameras(both, solved(both)) == {
        scene.turn: OTHER_CAMERA for scene in scenes[2:]}


def on_a_road(world: int, yaw: float) -> Scene:
    """Return a turn with a part of the points on the road, the others at any height above it."""
    turn = synthetic_turn(LENS, yaw, tracks=1000, keyframes=14, world=world)
    height = turn.structure.points[:, 1]
    road, above = np.flatnonzero(height > 1.1), np.flatnonzero(height < 0)
    some = np.r_[road, above[:2 * len(road)]]
    return SyntheticTurn(
        replace(turn.tracks, xy=turn.tracks.xy[:, some]),
        replace(turn.structure, points=turn.structure.points[some],
                used=turn.structure.used[:, some])).scene(START, world)


def test_turns_of_earlier_drives_alone_are_as_they_are():
    own = scenes_of(2, tracks=110)
    stored = solved([replace(scene, turn=TurnId.stored(n)) for n, scene in enumerate(own)])
    np.testing.assert_allclose(stored.sigma, solved(own).sigma)
