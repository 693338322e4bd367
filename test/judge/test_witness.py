# SPDX-License-Identifier: Apache-2.0
"""What straight lines add to a check."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from made_lines import made_lines
from synthetic import LENS, SIZE

from dashcalib_ros import Config, open_frames
from dashcalib_ros.camera import Radial
from dashcalib_ros.detect import Bend, LineCollector, bend
from dashcalib_ros.judge import Check
from dashcalib_ros.judge.check import _lines_text, with_lines
from dashcalib_ros.judge.verdict import lines_contradict


@pytest.mark.parametrize(('answer', 'off', 'expected'), [
    ('right', 0.0, 'right'), ('wrong', 0.0, 'wrong'), ('right', 0.1, 'cannot tell'),
    ('cannot tell', 0.1, 'cannot tell'), ('wrong', 0.1, 'wrong'), ('differs', 0.0, 'differs'),
    # more than detection allows; and less: the lines confirm that it differs
    ('differs', 0.1, 'cannot tell'), ('differs', 0.02, 'differs'), ('right', 0.02, 'cannot tell')])
def test_lines_take_back_a_good_answer_and_nothing_else(answer, off, expected):
    given = replace(LENS, k1=LENS.k1 + off)
    found = with_lines(
        Check(answer, ('the turns say so',), limits_px={'detection': 5.0}), given,
        made_lines(LENS, noise_px=0.05), SIZE, Config())
    assert found.answer == expected and found.reasons[0] == 'the turns say so'
    assert found.straight_lines.k1 == pytest.approx(-off, abs=0.02)
    assert (' agree' in str(found.reasons[1])) == (off == 0.0)


@pytest.mark.parametrize(('k1', 'words'), [
    (0.019, ' agree'), (0.033, ' lean against'), (0.041, ' contradict'),
    (-0.041, ' contradict')])
def test_three_sigmas_are_no_agreement(k1, words):
    said = Bend(lines=1000, groups=4, bend_px=0.2, k1=k1, sigma=0.01, camera_sigma=None,
                picture_px=7.0)
    config = Config().verdict
    text = _lines_text(said, lines_contradict(said, 1242, config), config.max_line_sigmas)
    assert words in text and f'{said.sigmas:.1f} sigma, limit 4.0' in text
    # so small a k1 moves no picture
    small = replace(said, k1=0.1, picture_px=0.5)
    assert 'too few pixels' in _lines_text(small, lines_contradict(small, 1242, config), 4.0)


def test_without_enough_lines_or_for_another_size_nothing_is_added():
    found = Check('right', ('the turns say so',))
    lines = made_lines(LENS)
    assert with_lines(found, LENS, made_lines(LENS, count=5), SIZE, Config()) == found
    assert with_lines(found, replace(LENS, image_size=(80, 45)), lines, SIZE, Config()) == found


KITTI = Path(__file__).parents[3] / 'shared/data/kitti07/images'


@pytest.mark.skipif(not KITTI.is_dir(), reason='needs ../shared/data/kitti07')
@pytest.mark.parametrize('rate', [9.65, 10.0])
def test_lines_of_a_real_drive_accuse_no_good_camera(rate):
    """Lines of rectified pictures are bent by 0.09 px by a camera that the true motion confirms.

    Its sigma by the images alone is 0.002, and 4 times that of both was exceeded.
    """
    collector = LineCollector()
    for frame in open_frames(KITTI, fps=rate):
        collector.push(frame.image, frame.stamp_ns)
    lines, good = collector.lines(), Radial((1226, 370), 701.3, 703.8, 604.6, 183.5, 0.022, -0.008)

    def said(k1):
        return bend(lines, replace(good, k1=k1))

    assert 0.01 < said(good.k1).k1 < 0.05
    assert not lines_contradict(said(good.k1), 1226, Config().verdict)
    # of another lens
    for k1 in (-0.1, 0.15):
        assert lines_contradict(said(k1), 1226, Config().verdict), k1
