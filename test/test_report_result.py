"""result.json: the contract, strict JSON, and reading it back."""
from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError
from dashcalib_ros.intrinsics import Calibration, Intrinsics, TurnSummary, Verdict
from dashcalib_ros.intrinsics.calibration import StoredTurnSummary
from dashcalib_ros.report import load_result, result_dict, result_json
from dashcalib_ros.report.page import report_html

TRUTH = Intrinsics(721.5377, 724.25, 609.5593, 172.854, -0.363, 0.151)
SIGMA = Intrinsics(3.5, 3.75, 2.0, 2.25, 0.004, 0.003)


def make_calibration(level='accepted', **changes):
    """Make a small but complete calibration by hand; refused ones have no intrinsics."""
    turn = TurnSummary(88, 58, 118, 8.8, 0.061, 31, 30, True, 91.5, 0.46, 1.1)
    unused = TurnSummary(275, 245, 305, 27.5, 0.012, 31, 4, False)
    stamps = np.arange(300) * 0.1
    magnitude = 0.01 + 0.06 * np.exp(-((stamps - 8.8) / 1.5) ** 2)
    mask = np.ones((375, 1242), bool)
    mask[300:] = False
    calibration = Calibration(
        verdict=Verdict(level, () if level == 'accepted' else ('only 1 of 5 turns',)),
        image_size=(1242, 375),
        intrinsics=None if level == 'refused' else TRUTH,
        sigma=None if level == 'refused' else SIGMA,
        turns=(turn, unused), frames=300, reprojection_error_px=0.46,
        timing={'detect': 3.0, 'calibrate': 20.0, 'total': 23.0},
        versions={'pycolmap': '4.2.1'}, config=Config(seed=7), input_name='drive.mcap',
        magnitudes=np.column_stack([stamps, magnitude]), mask=mask)
    return dataclasses.replace(calibration, **changes)


def test_stored_turns_are_apart_as_they_count_no_frames_of_this_input():
    stored = StoredTurnSummary(-1, 1.7e9, 0.05, 88.0, 20, True, 0.9)
    calibration = make_calibration(stored_turns=(stored,))
    result = strict(result_json(calibration))
    assert result['stored_turns'] == [{
        'stamp': 1.7e9, 'prominence': 0.05, 'yaw_deg': 88.0, 'images': 20, 'used': True,
        'misfit': 0.9}]
    assert len(result['turns']) == 2 and calibration.turns_used == 2
    assert '1 of 1 stored turn used' in report_html(calibration)
    assert result_dict(make_calibration())['stored_turns'] == []


def strict(text):
    def refuse(word):
        raise AssertionError(f'{word} is not JSON')
    return json.loads(text, parse_constant=refuse)


def test_result_has_the_contract_s_keys_and_values():
    result = strict(result_json(make_calibration()))
    contract = ['verdict', 'reasons', 'image_size', 'intrinsics', 'sigma', 'turns', 'frames',
                'reprojection_error_px', 'timing', 'seed', 'versions', 'config']
    assert list(result)[:len(contract)] == contract
    assert result['verdict'] == 'accepted'
    assert result['image_size'] == [1242, 375]
    assert result['intrinsics'] == dataclasses.asdict(TRUTH)  # to the last digit
    assert result['sigma'] == dataclasses.asdict(SIGMA)
    assert result['seed'] == 7
    assert result['config'] == Config(seed=7).flat()
    assert result['turns'][0] == {
        'center': 88, 'first': 58, 'last': 118, 'stamp': 8.8, 'prominence': 0.061,
        'images': 31, 'registered': 30, 'used': True, 'yaw_deg': 91.5,
        'reprojection_error_px': 0.46, 'misfit': 1.1}
    assert result['masked_fraction'] == pytest.approx(75 / 375)


def test_a_refused_result_has_null_intrinsics():
    result = result_dict(make_calibration('refused'))
    assert result['intrinsics'] is None
    assert result['sigma'] is None
    assert result['reasons'] == ['only 1 of 5 turns']


def test_numbers_that_json_lacks_become_null():
    details = {'profile': np.array([[0.5, np.nan], [np.inf, 2.0]], np.float32),
               'best': np.float64(1.5), 'n': np.int64(3), 4: (math.nan, -math.inf),
               'turn': SIGMA, 'ok': np.bool_(True)}
    result = strict(result_json(make_calibration(
        details=details, sigma=dataclasses.replace(SIGMA, k2=math.nan))))
    assert result['sigma']['k2'] is None
    assert result['details'] == {
        'profile': [[0.5, None], [None, 2.0]], 'best': 1.5, 'n': 3, '4': [None, None],
        'turn': dataclasses.asdict(SIGMA), 'ok': True}


def test_a_result_reads_back(tmp_path):
    path = tmp_path / 'result.json'
    path.write_text(result_json(make_calibration('weak')), encoding='utf-8')
    assert load_result(path) == result_dict(make_calibration('weak'))


@pytest.mark.parametrize(('content', 'complaint'), [
    (b'{"verdict": ', 'not valid JSON'),
    (b'[' * 100000, 'not valid JSON'),
    (b'[1, 2]', 'no JSON object'),
    (b'{"verdict": "weak", "image_size": [3, 2]}', "no 'intrinsics'"),
    (b'\xff\xfe\x00junk', 'not a text file'),
])
def test_what_is_no_result_is_refused_in_one_line(tmp_path, content, complaint):
    path = tmp_path / 'result.json'
    path.write_bytes(content)
    with pytest.raises(InputError, match=complaint) as caught:
        load_result(path)
    assert '\n' not in str(caught.value)


def test_a_missing_result_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match='does not exist'):
        load_result(tmp_path / 'none.json')
