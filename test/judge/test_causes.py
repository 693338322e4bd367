"""What makes the other reasons comes first, and in the words of the input."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from solving import CONFIG, scenes_of, solved
from synthetic import rotation

from dashcalib_ros.judge.verdict import judge


def test_turned_pictures_are_named_first_and_not_accepted():
    solution = solved(scenes_of(3))
    assert judge(solution, CONFIG.verdict).level == 'accepted'
    turn = rotation(2, np.pi / 2)
    solution = replace(solution, scenes=tuple(replace(scene, structure=replace(
        scene.structure, rotations=turn @ scene.structure.rotations,
        translations=scene.structure.translations @ turn.T)) for scene in solution.scenes))
    verdict = judge(solution, replace(CONFIG.verdict, min_turns=9))
    assert verdict.level == 'weak' and 'turned by about 90°' in verdict.reasons[0]
    mounted_so = replace(CONFIG.verdict, max_roll_deg=180.0)
    assert judge(solution, mounted_so).level == 'accepted'


def test_pixels_are_those_of_the_input():
    solution = solved(scenes_of(2))
    far = replace(solution.around, ratios=solution.around.ratios * 1.25)
    reason, = (reason for reason in judge(replace(solution, around=far, px=0.25), CONFIG.verdict
                                          ).reasons if 'contradict each other' in reason)
    assert f'{0.25 * solution.camera.fx:.0f} px and about' in reason
