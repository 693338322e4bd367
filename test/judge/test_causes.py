# SPDX-License-Identifier: Apache-2.0
"""What makes the other reasons comes first, and in the words of the input."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, scenes_of, solved
from synthetic import rotation

from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.solve.solution import Solution

CODE = 'E-TURNED-PICTURES'


@pytest.fixture(scope='module')
def solution():
    return solved(scenes_of(3))


def turned(solution: Solution, axis: int, degrees: float) -> Solution:
    """Return the solution as a camera finds it that is turned about its x, y or z."""
    turn = rotation(axis, np.radians(degrees))
    return replace(solution, scenes=tuple(replace(scene, structure=replace(
        scene.structure, rotations=turn @ scene.structure.rotations,
        translations=scene.structure.translations @ turn.T)) for scene in solution.scenes))


def narrow(solution: Solution, share: float, axis: int = 1) -> Solution:
    """Return the solution with turns of a share of their angles, about x, y or z."""
    def some(scene):
        yaws = share * np.radians(scene.yaws_deg)
        rotations = np.array(scene.structure.rotations)
        rotations[scene.structure.registered] = [rotation(axis, -yaw) for yaw in yaws]
        return replace(scene, structure=replace(scene.structure, rotations=rotations))
    return replace(solution, scenes=tuple(map(some, solution.scenes)))


def on_a_road(solution: Solution) -> Solution:
    """Return the solution with all that is below the roofs on the road."""
    scenes = []
    for scene in solution.scenes:
        points = scene.structure.points.copy()
        points[points[:, 1] > -1.5, 1] = 1.4
        scenes.append(replace(scene, structure=replace(scene.structure, points=points)))
    return replace(solution, scenes=tuple(scenes))


# by how much the camera is turned clockwise, and ffmpeg's filter that turns its pictures back
@pytest.mark.parametrize(('degrees', 'back'), [
    (90, 'transpose=2'), (-90, 'transpose=1'), (180, 'hflip,vflip')])
def test_turned_pictures_are_named_first_with_the_way_back(solution, degrees, back):
    assert judge(on_a_road(solution), CONFIG.verdict).level == 'accepted'
    found = turned(on_a_road(solution), 2, degrees)
    verdict = judge(found, replace(CONFIG.verdict, min_turns=9))
    assert verdict.level == 'weak' and verdict.codes == (CODE, 'E-FEW-TURNS')
    assert f'-vf {back} ' in verdict.cures[0]
    mounted_so = replace(CONFIG.verdict, max_roll_deg=180.0)
    assert judge(found, mounted_so).level == 'accepted'


@pytest.mark.parametrize(('degrees', 'refused'), [(0, False), (40, False), (90, True),
                                                  (180, False)])
def test_a_camera_that_moves_sideways_is_refused(solution, degrees, refused):
    """A car that turns on the spot moves it so; a camera may look back."""
    verdict = judge(turned(solution, 1, degrees), CONFIG.verdict)
    assert ('E-MOVES-SIDEWAYS' in verdict.codes) == refused == (verdict.level == 'refused')


def test_turns_of_little_yaw_do_not_show_which_way_up_pictures_are(solution):
    """Bumps and the lean of a two-wheeler turn the camera as much."""
    bumps = narrow(solution, 0.2, axis=0)
    assert CODE not in judge(bumps, CONFIG.verdict).codes
    # as much about that axis as a car turns would be named
    assert CODE in judge(turned(solution, 2, 90), CONFIG.verdict).codes


def test_a_path_that_lies_level_contradicts_turned_pictures(solution):
    # the camera turns about its x, as no picture of a level path can be turned
    tumbling = narrow(solution, 1.0, axis=0)
    assert CODE not in judge(tumbling, CONFIG.verdict).codes


def test_pixels_are_those_of_the_input(solution):
    far = replace(solution.around, ratios=solution.around.ratios * 1.25)
    verdict = judge(replace(solution, around=far, px=0.25), CONFIG.verdict)
    reason = verdict.reasons[verdict.codes.index('E-TWO-FOCAL-LENGTHS')]
    assert f'{0.25 * solution.camera.fx:.0f} px and about' in reason
