# SPDX-License-Identifier: Apache-2.0
"""What makes the other reasons comes first, and in the words of the input."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, scenes_of, solved
from synthetic import SIZE, rotation

from dashcalib_ros.input.scale import FULL_SIZE
from dashcalib_ros.judge.conclude import Evidence, conclude
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.solve import start
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
    assert f'-vf {back} ' in verdict.remedies[0]
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
    assert f'{0.25 * solution.camera.fx:.0f} px and about' in str(reason)


MOVES, TIMES = 'E-PICTURE-MOVES', 'E-TIMES-ASSUMED'


def with_times(solution: Solution, late_s: float) -> Solution:
    """Return the solution with stamps that are late, every second one."""
    def scene_of(scene):
        late = round(1e9 * late_s) * (np.arange(len(scene.tracks.frames)) % 2)
        return replace(scene, tracks=replace(scene.tracks,
                                             stamps_ns=scene.tracks.stamps_ns + late))
    return replace(solution, scenes=tuple(map(scene_of, solution.scenes)))


@pytest.mark.thorough
def test_uneven_times_that_are_taken_as_even_ones_are_named(monkeypatch):
    """With a rolling shutter they look as a stabiliser does, with a global one as nothing."""
    monkeypatch.setattr(start, 'PROBES', (1.0,))
    dense = {'keyframes': 24, 'keyframe_s': 0.15, 'noise_px': 0.1, 'tracks': 120}
    found = solved(scenes_of(2, readout_s=0.03, uneven=0.48, **dense))
    codes = judge(found, CONFIG.verdict).codes
    assert codes[0] == MOVES and TIMES in codes
    assert 'times.txt' in judge(found, CONFIG.verdict).remedies[codes.index(TIMES)]
    # true times are no even ones
    codes = judge(with_times(found, 0.002), CONFIG.verdict).codes
    assert codes[0] == MOVES and TIMES not in codes
    fixed = solved(scenes_of(2, uneven=0.48, **dense))
    assert not fixed.rolling and judge(fixed, CONFIG.verdict).level == 'accepted'


def test_only_a_crop_that_matters_is_named(solution):
    """A slow shift that the turns do not exclude is in sigma."""
    def moving(px: float) -> tuple[str, ...]:
        path = px * np.sin(np.linspace(0, 6, 14))[:, None] * (1.0, 0.0)
        found = conclude(
            replace(solution, crops={scene.turn: path for scene in solution.scenes}),
            Evidence(SIZE, 100, (), {}, np.zeros((0, 2)), None, FULL_SIZE, {}), CONFIG)
        return (*found.verdict.codes, *(each.code for each in found.warnings))
    # of a width of 800 px; sigma over the picture is less than both
    assert solution.picture.rms < 1.0
    assert moving(2.5) == () and moving(8.0) == (MOVES,)
