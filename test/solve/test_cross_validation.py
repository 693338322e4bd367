# SPDX-License-Identifier: Apache-2.0
"""What turns say about a calibration that was made without them."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, only, scenes_of, solved
from synthetic import LENS

from dashcalib_ros.camera.mapping import mapping_error
from dashcalib_ros.solve.solution import LEAST_TURNS, cross_validation


@pytest.fixture(scope='module')
def solution():
    return solved(scenes_of(4))


def test_turns_of_one_camera_predict_each_other(solution):
    found = cross_validation(solution)
    assert [each.turn for each in found] == [scene.turn for scene in solution.scenes]
    for each in found:
        assert 0 < each.px <= each.sigma_px + each.others_sigma_px
        assert each.sigmas == pytest.approx(
            each.px / np.hypot(each.sigma_px, each.others_sigma_px))
        # three turns know more than one
        assert each.others_sigma_px < each.sigma_px
        assert each.times(2.0).px == 2 * each.px and each.times(2.0).sigmas == each.sigmas


def test_a_turn_of_another_lens_stands_out():
    lens = replace(LENS, fx=1.02 * LENS.fx, fy=1.02 * LENS.fy)
    scenes = [*scenes_of(3), scenes_of(4, lens)[3]]
    # a loss that does not outvote it
    found = cross_validation(solved(scenes, CONFIG.replace({'intrinsics.loss': 50.0})))
    worst = max(found, key=lambda each: each.px)
    assert worst.turn == scenes[3].turn
    assert worst.px == pytest.approx(mapping_error(lens, LENS), rel=0.3)


def test_two_turns_are_too_few(solution):
    assert LEAST_TURNS == 3
    assert cross_validation(only(solution, range(2))) == ()
