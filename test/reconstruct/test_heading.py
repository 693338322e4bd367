# SPDX-License-Identifier: Apache-2.0
"""Which way up the pictures are, and by how much the car turned, whichever way that is."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import LENS, rotation, synthetic_turn

from dashcalib_ros.reconstruct.heading import roll_deg
from dashcalib_ros.reconstruct.scene import Scene, errors_px, rms_px


def on_a_road(yaw_deg: float, world: int) -> Scene:
    """Return a turn in which all that is below the roofs is the road."""
    turn = synthetic_turn(yaw_deg=yaw_deg, world=world, tracks=200, keyframes=14)
    points = turn.structure.points.copy()
    points[points[:, 1] > -1.5, 1] = 1.4
    scene = turn.scene(LENS, world)
    return replace(scene, structure=replace(turn.structure, points=points))


def rolled(scene: Scene, roll_deg: float) -> Scene:
    """Return the scene seen by a camera that is turned about its optical axis."""
    turn = rotation(2, np.radians(-roll_deg))
    return replace(scene, structure=replace(
        scene.structure, rotations=turn @ scene.structure.rotations,
        translations=scene.structure.translations @ turn.T))


@pytest.mark.parametrize('roll', [0, 8, -8, 90, 180, -90])
def test_which_way_up_pictures_are(roll):
    scenes = [rolled(on_a_road(yaw, world), roll) for world, yaw in enumerate((80.0, -40.0))]
    found = roll_deg(scenes)
    assert (found - roll + 180) % 360 - 180 == pytest.approx(0, abs=3)
    # it turned by as much, whichever way up its pictures are
    assert [scene.yaw_deg for scene in scenes] == pytest.approx([80, 40], abs=2)


def test_gentle_turns_do_not_show_which_way_up_pictures_are():
    """Of a car that hardly turns, bumps and lean decide about which axis."""
    sharp, gentle = on_a_road(80.0, 0), rolled(on_a_road(20.0, 1), 90)
    assert roll_deg([gentle]) is None
    assert roll_deg([sharp, gentle]) == roll_deg([sharp])


def test_an_observation_that_is_no_longer_projected_has_no_error():
    scene = synthetic_turn(tracks=100, keyframes=10).scene(LENS)
    points = scene.structure.points.copy()
    points[scene.structure.used[0].argmax()] = [0, 0, -1e3]  # behind the camera
    behind = replace(scene, structure=replace(scene.structure, points=points))
    assert np.isinf(errors_px(behind, LENS)[behind.structure.used]).any()
    assert 0 < rms_px([behind], LENS) < 1
