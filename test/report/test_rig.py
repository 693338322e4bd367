# SPDX-License-Identifier: Apache-2.0
"""The page of a rig: what it draws, and what it says about each degree of freedom."""
from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
from made_calibration import MOUNT, make_calibration
from made_rig import front_left_rear
from page_reader import Page

from dashcalib_ros.formats.rig import placed_cameras
from dashcalib_ros.report.rig import rig_html
from dashcalib_ros.rig.placed import (
    PlacedCamera,
    Visible,
)

SURE = ('accepted', 'accepted', 'accepted')
RIG = front_left_rear(PlacedCamera(
    'left/result.json', 'accepted', (0.0, 90.0, 0.0), (0.1, 0.1, 0.1), (-0.5, 0.0, -1.0),
    (0.02, 0.3, 0.04), 0.0301, 0.001,
    Visible(SURE, ('accepted', 'not visible', 'accepted'), 'accepted')), '<b>another drive')


def page_of(rig, mount=MOUNT):
    calibrations = {name: make_calibration(mount=mount) for name in rig.cameras}
    return rig_html(rig, placed_cameras(rig, calibrations))


def test_it_has_each_degree_of_freedom_and_what_was_seen():
    text = page_of(RIG)
    seen = Page(text).text
    for part in ('90.00 ± 0.10, accepted', '0.000 ± 0.300, not visible', '30.1 ± 1.0, accepted',
                 '900 matches', '<b>another drive'):
        assert part in seen
    assert '<b>' not in text and text.count('<svg') == 2


def test_cameras_are_drawn_where_they_sit():
    drawings = re.findall('<svg.*?</svg>', page_of(RIG, mount=None), re.S)
    above = ElementTree.fromstring(drawings[0])
    places = [(float(each.get('x')), each.text) for each in above.iter('text')
              if each.text in ('front', 'left', 'rear')]
    # it looks to the left, sits 0.5 m ahead of the front one and 1 m to the left
    assert [name for _, name in places] == ['front', 'left']
    ends = [[float(each.get(key)) for key in ('x1', 'y1', 'x2', 'y2')]
            for each in above.iter('line') if each.get('class') == 'all-turns']
    (x, y, tip_x, tip_y), (its_x, its_y, its_tip_x, its_tip_y) = ends
    assert tip_y == y and tip_x > x and abs(its_tip_x - its_x) < 0.2
    assert its_tip_y < its_y < y and its_x > x
    assert len([each for each in above.iter('path') if 'here' in each.get('class')]) == 4


def test_without_metres_all_are_drawn_at_one_place():
    left = replace(RIG.cameras['left'], translation_m=None, translation_sigma_m=None)
    text = page_of(replace(RIG, cameras={**RIG.cameras, 'left': left}))
    assert 'No metres' in Page(text).text
    starts = re.findall(r'class="all-turns" x1="([\d.]+)" y1="([\d.]+)"', text)
    assert len(starts) == 4 and starts[0] == starts[1] and starts[2] == starts[3]
    assert np.isfinite(np.array(starts, float)).all()
