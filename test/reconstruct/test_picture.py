# SPDX-License-Identifier: Apache-2.0
"""The one picture of each turn that people see."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import LENS, SIZE, synthetic_turn

from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.input import Frame
from dashcalib_ros.reconstruct.scene import PICTURE_WIDTH, picture_of


def turn_of(count: int, size: tuple[int, int] = SIZE, center: int = 20) -> Turn:
    frames = tuple(Frame(n, n, np.full(size[::-1], n, np.uint8)) for n in range(count))
    return Turn(center, 0, count - 1, 1.0, 0.05, frames)


def test_it_is_of_the_registered_keyframe_nearest_to_the_centre():
    scene = synthetic_turn(LENS, tracks=60).scene(LENS)  # keyframes 0, 3, 6, ...
    assert picture_of(turn_of(60), scene).frame == 21
    registered = scene.structure.registered.copy()
    registered[7] = False  # frame 21
    scene = replace(scene, structure=replace(scene.structure, registered=registered))
    found = picture_of(turn_of(60), scene)
    assert found.frame == 18 and (found.image == 18).all()


def test_without_a_scene_it_is_the_turn_s_middle_and_without_images_there_is_none():
    assert picture_of(turn_of(60), None).frame == 20
    assert picture_of(turn_of(0), None) is None


@pytest.mark.parametrize(('size', 'shown'), [
    ((1440, 810), (PICTURE_WIDTH, 405)), ((640, 360), (640, 360)),
    ((5000, 2), (PICTURE_WIDTH, 1))])
def test_wide_pictures_are_made_smaller(size, shown):
    turn = turn_of(1, size, 0)
    image = picture_of(turn, None).image
    assert image.shape == shown[::-1]
    # a view would keep the whole frame in memory
    assert not np.shares_memory(image, turn.frames[0].image)
