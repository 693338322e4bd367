"""What straight lines add to a check."""
from __future__ import annotations

from dataclasses import replace

import pytest
from made_lines import made_lines
from synthetic import LENS, SIZE

from dashcalib_ros import Config
from dashcalib_ros.judge import Check, with_lines


@pytest.mark.parametrize(('answer', 'off', 'expected'), [
    ('right', 0.0, 'right'), ('wrong', 0.0, 'wrong'), ('right', 0.1, 'cannot tell'),
    ('cannot tell', 0.1, 'cannot tell'), ('wrong', 0.1, 'wrong')])
def test_lines_take_back_a_right_and_nothing_else(answer, off, expected):
    given = replace(LENS, k1=LENS.k1 + off)
    found = with_lines(Check(answer, ('the turns say so',)), given,
                       made_lines(LENS, noise_px=0.05), SIZE, Config())
    assert found.answer == expected and found.reasons[0] == 'the turns say so'
    assert found.straight_lines.k1 == pytest.approx(-off, abs=0.02)
    assert ('do not contradict' in found.reasons[1]) == (off == 0.0)


def test_without_enough_lines_or_for_another_size_nothing_is_added():
    found = Check('right', ('the turns say so',))
    lines = made_lines(LENS)
    assert with_lines(found, LENS, made_lines(LENS, count=5), SIZE, Config()) == found
    assert with_lines(found, replace(LENS, image_size=(80, 45)), lines, SIZE, Config()) == found
