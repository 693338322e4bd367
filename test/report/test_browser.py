# SPDX-License-Identifier: Apache-2.0
"""The page in a real browser, where there is one: nothing is cut, no text over other text."""
from __future__ import annotations

from dataclasses import replace

import pytest
from browser import BROWSER, found_by_the_browser
from drawn import drawn_calibration, solution
from made_calibration import make_calibration

from dashcalib_ros.report import NamedCamera, report_html


@pytest.mark.skipif(BROWSER is None, reason='no chromium on the PATH')
@pytest.mark.parametrize(('width', 'media'), [(1280, 'screen'), (390, 'screen'), (688, 'print')])
def test_nothing_is_cut_nor_over_other_text_and_blocks_and_views_work(tmp_path, width, media):
    c = drawn_calibration(solution())
    text = report_html(c, NamedCamera('truth', replace(c.camera, fx=c.camera.fx + 123.4)))
    # a sheet of paper is so wide, and here its style is the screen's
    text = text.replace(f'@media {media} {{', '@media all {')
    found = found_by_the_browser(tmp_path, text, width)
    assert found.pop('texts') > 50 and found.pop('copied') > 3
    assert not any(found.values()), found


@pytest.mark.skipif(BROWSER is None, reason='no chromium on the PATH')
def test_turns_that_follow_each_other_closely_keep_their_numbers_apart(tmp_path):
    [turn, _] = make_calibration().turns
    turns = tuple(replace(turn, center=n, stamp_s=8.8 + 0.1 * n) for n in range(12))
    found = found_by_the_browser(tmp_path, report_html(make_calibration(turns=turns)), 1200)
    assert found.pop('texts') > 12 and found.pop('copied')
    assert not any(found.values()), found


@pytest.mark.skipif(BROWSER is None, reason='no chromium on the PATH')
def test_the_browser_would_notice(tmp_path):
    text = report_html(make_calibration()).replace(
        '</body>', '<svg viewBox="0 0 99 20"><text x="5" y="12">one</text>'
        '<text x="9" y="12">two</text><path d="M1 1lM"/></svg>'
        '<p style="width: 9px; white-space: nowrap">is cut</p></body>')
    found = found_by_the_browser(tmp_path, text, 1200)
    assert found['overlaps'] == [['one', 'two']] and found['console']
    assert found['cut'] == [['P', 'is cut']]
