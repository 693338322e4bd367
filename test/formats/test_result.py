# SPDX-License-Identifier: Apache-2.0
"""result.json: the contract, strict JSON, and reading it back."""
from __future__ import annotations

import io
import json
import math

import numpy as np
import pytest
from made_calibration import EACH_MODEL, SIGMA, TRUTH, calibration_of, make_calibration
from refused import refused
from rich.console import Console

from dashcalib_ros.config import Config
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.formats import (
    calibration_yaml,
    load_calibration,
    load_camera,
    result_dict,
    result_json,
)
from dashcalib_ros.judge import Verdict
from dashcalib_ros.judge.calibration import (
    CameraAt,
    Drift,
    Part,
    StoredTurnSummary,
    Witness,
    Witnesses,
)
from dashcalib_ros.report.page import report_html
from dashcalib_ros.report.tables import summary
from dashcalib_ros.solve.spread import PictureSigma


def test_stored_turns_are_apart_as_they_count_no_frames_of_this_input():
    stored = StoredTurnSummary(TurnId.stored(0), 1.7e9, 0.05, 88.0, 20, True, 0.9,
                               reprojection_error_px=0.37)
    calibration = make_calibration(stored_turns=(stored,))
    result = strict(result_json(calibration))
    assert result['stored_turns'] == [{
        'stamp': 1.7e9, 'prominence': 0.05, 'yaw_deg': 88.0, 'images': 20, 'used': True,
        'misfit': 0.9, 'unused_because': None, 'reprojection_error_px': 0.37}]
    assert len(result['turns']) == 2 and calibration.turns_used == 2
    page = report_html(calibration)
    assert 'turns of earlier drives</td><td>1 of 1 used' in page and '0.37 px' in page
    assert result_dict(make_calibration())['stored_turns'] == []


def test_witnesses_are_written_and_read_and_told_in_one_line(tmp_path):
    said = Witness(0.04, 0.0006, 1.0012, 0.0011, -0.13, 0.14, True,
                   ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), 0.4, (0.01, 0.0, -0.02))
    clock = Witness(0.21, 0.02, drift_ppm=30.0, drift_sigma_ppm=90.0)
    calibration = make_calibration(witnesses=Witnesses(gyro=said, odometry=clock))
    result = strict(result_json(calibration))
    assert result['witnesses']['gps'] is None
    gyro = result['witnesses']['gyro']
    assert list(gyro)[:7] == ['time_offset_s', 'time_sigma_s', 'scale', 'scale_sigma',
                              'fx_percent', 'fx_sigma_percent', 'agrees']
    (tmp_path / 'result.json').write_text(result_json(calibration))
    assert load_calibration(tmp_path).witnesses == calibration.witnesses
    line = 'the gyro agrees: fx off by -0.13 ± 0.14 %, its time stamps late by 40 ± 0.6 ms'
    assert line in report_html(calibration)
    console = Console(width=200, file=io.StringIO())
    console.print(summary(calibration))
    assert line in console.file.getvalue() and 'late by 210 ± 20.0 ms' in console.file.getvalue()
    nothing = result_dict(make_calibration())['witnesses']
    assert nothing == dict.fromkeys(('gyro', 'gps', 'odometry'))


def test_a_camera_that_steps_is_written_and_read_with_both_sides(tmp_path):
    def at(time_s, times):
        return CameraAt(time_s, {**TRUTH.named, 'fx': times * TRUTH.fx}, SIGMA)

    parts = (Part(1.0, 30.0, 'accepted', (), (), 'radial', TRUTH.named, SIGMA,
                  PictureSigma(0.3, 0.9)),
             Part(50.0, 80.0, 'refused', ('too few turns',), ('E-FEW-TURNS',), None, None, None))
    calibration = make_calibration('weak', parts=parts, intrinsics_at=(
        at(1.0, 0.99), at(30.0, 0.99), at(50.0, 1.01), at(80.0, 1.01)))
    (tmp_path / 'result.json').write_text(result_json(calibration))
    read = load_calibration(tmp_path)
    assert read.parts == parts and read.intrinsics_at == calibration.intrinsics_at
    for time_s, times in ((0.0, 0.99), (35.0, 0.99), (45.0, 1.01), (99.0, 1.01)):
        camera, sigma = read.at(time_s)
        assert camera.fx == pytest.approx(times * TRUTH.fx) and sigma == SIGMA
    drifting = make_calibration(intrinsics_at=(at(0.0, 1.0), at(100.0, 1.02)))
    assert drifting.at(25.0)[0].fx == pytest.approx(1.005 * TRUTH.fx)
    assert make_calibration().at(25.0) == (TRUTH, SIGMA)


def test_a_size_per_kelvin_is_written_and_read_and_gives_other_temperatures(tmp_path):
    drift = Drift(0.1, 0.05, 0.0, 0.05, 0.01, 20.0, 40.0)
    calibration = make_calibration(drift=drift, temperature_c=30.0)
    (tmp_path / 'result.json').write_text(result_json(calibration))
    (tmp_path / 'calibration.yaml').write_text(calibration_yaml(calibration))
    for name in ('result.json', 'calibration.yaml'):
        found, whole = load_camera(tmp_path / name), load_calibration(tmp_path / name)
        assert (whole.drift, whole.temperature_c) == (drift, 30.0)
        assert (found.drift, found.temperature_c) == (drift, 30.0)
        assert found.at_temperature(30.0) == TRUTH
        # no farther than was seen
        for at_c, times in ((34.0, 1.002), (60.0, 1.005), (-10.0, 0.995)):
            assert found.at_temperature(at_c).fx == pytest.approx(times * TRUTH.fx)
    (tmp_path / 'result.json').write_text(result_json(make_calibration()))
    found = load_camera(tmp_path / 'result.json')
    assert found.drift is None and found.at_temperature(60.0) == TRUTH


def strict(text):
    def refuse(word):
        raise AssertionError(f'{word} is not JSON')
    return json.loads(text, parse_constant=refuse)


def test_result_has_the_contract_s_keys_and_values():
    result = strict(result_json(make_calibration()))
    assert result['reason_codes'] == []
    contract = ['verdict', 'reasons', 'image_size', 'intrinsics', 'sigma', 'turns', 'frames',
                'reprojection_error_px', 'timing', 'seed', 'versions', 'config']
    assert list(result)[:len(contract)] == contract
    assert result['verdict'] == 'accepted'
    assert result['image_size'] == [1242, 375]
    assert result['intrinsics'] == TRUTH.named  # to the last digit
    assert result['sigma'] == SIGMA
    assert result['seed'] == 7
    assert result['config'] == Config(seed=7).flat()
    assert result['turns'][0] == {
        'center': 88, 'first': 58, 'last': 118, 'stamp': 8.8, 'prominence': 0.061,
        'images': 31, 'registered': 30, 'used': True, 'yaw_deg': 91.5,
        'reprojection_error_px': 0.46, 'misfit': 1.1, 'unused_because': None, 'right_deg': None}
    assert result['masked_fraction'] == pytest.approx(75 / 375)


@pytest.mark.parametrize('model', EACH_MODEL)
def test_intrinsics_have_the_keys_of_the_model(model):
    lens = EACH_MODEL[model]
    result = strict(result_json(calibration_of(lens)))
    assert result['camera_model'] == model
    assert result['intrinsics'] == lens.named
    assert list(result['sigma']) == list(lens.names())


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
        details=details, sigma={**SIGMA, 'k2': math.nan})))
    assert result['sigma']['k2'] is None
    assert result['details'] == {
        'profile': [[0.5, None], [None, 2.0]], 'best': 1.5, 'n': 3, '4': [None, None],
        'turn': SIGMA, 'ok': True}


def test_a_result_reads_back(tmp_path):
    path = tmp_path / 'result.json'
    path.write_text(result_json(make_calibration('weak')), encoding='utf-8')
    assert json.loads(path.read_text()) == result_dict(make_calibration('weak'))


def test_a_result_with_the_earlier_name_of_a_setting_reads_back(tmp_path):
    data = result_dict(make_calibration(config=Config.of({'workers': 3})))
    data['config']['threads'] = data['config'].pop('workers')
    (tmp_path / 'result.json').write_text(json.dumps(data))
    assert load_calibration(tmp_path).config.workers == 3


@pytest.mark.parametrize(('content', 'code'), [
    (b'{"verdict": ', 'E-JSON-INVALID'), (b'{"a": ' * 100000, 'E-JSON-INVALID'),
    (b'\xff\xfe\x00junk', 'E-FILE-NOT-TEXT'),
    (b'{"fx": ' + b'7' * 5000 + b'}', 'E-JSON-INVALID'),
    (b'{"notes": "' + b' ' * 2**23 + b'"}', 'E-FILE-TOO-LARGE'),
    (b'[1, 2]', 'E-OTHER-CALIBRATION'),
    (b'{"verdict": "weak", "image_size": [3, 2]}', 'E-NO-RESULT-FILE'),
])
def test_what_is_no_result_is_refused_in_one_line(tmp_path, content, code):
    path = tmp_path / 'result.json'
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_calibration(path)
    assert caught.value.code == code
    assert str(path) in str(caught.value) and '\n' not in str(caught.value)


def test_codes_of_reasons_are_written_and_read_back(tmp_path):
    verdict = Verdict('weak', (
        Notice('E-ONE-CODE', 'one', 'do'), Notice('E-SECOND-CODE', 'two', 'do')))
    calibration = make_calibration('weak', verdict=verdict)
    assert strict(result_json(calibration))['reason_codes'] == list(verdict.codes)
    calibration.save(tmp_path)
    for name in ('result.json', 'calibration.weak.yaml'):
        assert load_calibration(tmp_path / name).verdict.codes == verdict.codes
    old = result_dict(calibration)
    del old['reason_codes']
    (tmp_path / 'result.json').write_text(json.dumps(old))
    assert load_calibration(tmp_path).verdict.codes == ('', '')


def test_a_missing_result_is_an_input_error(tmp_path):
    with refused(InputError, 'E-FILE-MISSING', 'none.json'):
        load_calibration(tmp_path / 'none.json')
