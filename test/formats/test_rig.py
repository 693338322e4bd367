# SPDX-License-Identifier: Apache-2.0
"""rig.json: what is written is read back, and the contract of its keys."""
from __future__ import annotations

import json

import pytest

from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.formats.rig import load_rig, rig_json
from dashcalib_ros.rig.placed import (
    PlacedCamera,
    RigCalibration,
    Visible,
    base_camera,
    not_placed,
)
from dashcalib_ros.rig.witness import Epipolar

SURE = ('accepted', 'accepted', 'accepted')
RIG = RigCalibration('front', {
    'front': base_camera('front/result.json'),
    'left': PlacedCamera('left/result.json', 'accepted', (1.0, 70.0, -2.0), (0.05, 0.06, 0.04),
                         (0.5, 0.0, -0.2), (0.02, 1.0, 0.02), 0.03, 0.001,
                         Visible(SURE, ('accepted', 'not visible', 'accepted'), 'accepted'),
                         (Notice('E-RIG-TRANSLATION', 'no height'),)),
    'rear': not_placed('rear/result.json', Notice('E-RIG-OTHER-DRIVE', 'another drive'))},
    {('front', 'left'): Epipolar(900, 0.3, 0.05)})


def test_a_rig_is_read_back(tmp_path):
    (tmp_path / 'rig.json').write_text(rig_json(RIG))
    assert load_rig(tmp_path) == RIG and rig_json(load_rig(tmp_path / 'rig.json')) == rig_json(RIG)
    assert load_rig(tmp_path).cameras == RIG.cameras
    assert load_rig(tmp_path).witness == RIG.witness


def test_the_keys_are_those_of_the_contract():
    data = json.loads(rig_json(RIG))
    assert data['base'] == 'front' and data['witness'] == {
        'epipolar_px': {'front-left': {'matches': 900, 'median': 0.3, 'cells_rms': 0.05}}}
    assert {'calibration', 'verdict', 'rotation_deg', 'rotation_sigma_deg', 'translation_m',
            'translation_sigma_m', 'time_offset_s', 'time_sigma_s', 'visible'} <= set(
                data['cameras']['left'])
    assert set(data['cameras']['left']['visible']) == {'rotation', 'translation', 'clock'}
    assert data['cameras']['rear']['translation_m'] is None


@pytest.mark.parametrize('text', [
    '{}', '[]', '{"base": "x", "cameras": {}, "witness": {"epipolar_px": {}}}',
    '{"base": "a", "cameras": {"a": 3}}', 'no json'])
def test_what_is_no_rig_is_named(tmp_path, text):
    (tmp_path / 'rig.json').write_text(text)
    with pytest.raises(InputError):
        load_rig(tmp_path)
