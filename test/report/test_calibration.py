# SPDX-License-Identifier: Apache-2.0
"""A Calibration in a program's hands: one line of text, K and D, pictures without distortion."""
from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
from drawn import drawn_calibration, solution
from made_calibration import EACH_MODEL, TRUTH, calibration_of, make_calibration

from dashcalib_ros.camera.field import Field
from dashcalib_ros.detect import Bend, TurnId
from dashcalib_ros.errors import InputError, Notice, OutputError
from dashcalib_ros.formats import export, load_camera, result_dict
from dashcalib_ros.judge import Verdict
from dashcalib_ros.judge.calibration import (
    Condition,
    LensField,
    Shutter,
    Stabiliser,
    StoredTurnSummary,
)
from dashcalib_ros.report import Calibration
from dashcalib_ros.solve.solution import LeftOut
from dashcalib_ros.solve.spread import PictureSigma


@pytest.fixture(params=EACH_MODEL)
def calibration(request):
    return calibration_of(EACH_MODEL[request.param])


def test_it_is_one_line(calibration):
    text = repr(calibration)
    assert '\n' not in text and len(text) < 340
    assert 'accepted' in text and calibration.camera.model in text
    assert f'fx {calibration.camera.fx:.1f} ± 3.5' in text
    lone = dataclasses.replace(calibration, turns=calibration.turns[:1])
    assert repr(lone).endswith('; from one turn alone, which nothing confirms)')
    refused = repr(make_calibration('refused'))
    assert 'refused' in refused and 'only 1 of 5 turns' in refused


@pytest.mark.parametrize(('sigma', 'text'), [
    (12.34, 'fx 722 ± 12,'), (0.96, 'fx 721.54 ± 0.96,'), (0.0997, 'fx 721.538 ± 0.100,'),
    (1234.0, 'fx 722 ± 1234,'), (0.0, 'fx 721.538,'), (float('nan'), 'fx 721.538,')])
def test_values_are_printed_to_the_digits_of_their_sigmas(sigma, text):
    calibration = make_calibration()
    known = dataclasses.replace(calibration, sigma={**calibration.sigma, 'fx': sigma})
    assert text in repr(known) and 'e+' not in repr(known)


def test_k_and_d_are_opencv_s(calibration):
    lens, points = calibration.camera, np.array([[0.2, -0.1, 1.0], [-0.4, 0.1, 1.0]])
    if lens.model == 'fisheye':
        seen, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3),
                                            calibration.K, calibration.D)
    else:
        seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), calibration.K,
                                    calibration.D)
    np.testing.assert_allclose(seen.reshape(-1, 2), lens.project(points), atol=1e-6)


def test_undistorted_points_lie_where_a_pinhole_sees_them(calibration):
    lens = calibration.camera
    width, height = lens.image_size
    ray = np.array([-0.3, 0.08, 1.0])
    x, y = lens.project(ray[None])[0]
    rows, columns = np.indices((height, width))
    dot = np.exp(-0.5 * ((columns - x)**2 + (rows - y)**2) / 3.0**2)
    flat = calibration.undistort((255 * dot).astype(np.uint8)).astype(float)
    place = [np.sum(grid * flat) / flat.sum() for grid in (columns, rows)]
    np.testing.assert_allclose(place, lens.without_distortion().project(ray[None])[0]
                               if lens.model != 'fisheye'
                               else (lens.fx * ray[0] + lens.cx, lens.fy * ray[1] + lens.cy),
                               atol=0.5)


def test_what_cannot_be_is_said(calibration):
    with pytest.raises(InputError, match='32x24') as caught:
        calibration.undistort(np.zeros((24, 32), np.uint8))
    assert caught.value.code == 'E-OTHER-IMAGE-SIZE'
    refused = make_calibration('refused')
    for ask in (lambda: refused.K, lambda: refused.D,
                lambda: refused.undistort(np.zeros((375, 1242), np.uint8))):
        with pytest.raises(InputError, match='only 1 of 5 turns') as caught:
            ask()
        assert caught.value.code == 'E-CALIBRATION-REFUSED'


def test_the_covariance_is_that_of_the_sigmas(calibration):
    known = drawn_calibration(solution())
    names = known.camera.names()
    sigma = np.array([known.sigma[name] for name in names])
    assert known.covariance.shape == (len(names), len(names))
    np.testing.assert_allclose(np.diag(known.covariance), sigma**2)
    np.testing.assert_allclose(known.covariance, known.covariance.T)
    np.linalg.cholesky(known.covariance)
    # of the picture it is of the next larger model, and never smaller
    count = len(known.camera.widened().names())
    assert known.picture_covariance.shape == (count, count)
    assert calibration.covariance is None and make_calibration('refused').covariance is None


def test_a_calibration_writes_what_the_command_writes(calibration, tmp_path):
    files = calibration.save(tmp_path / 'new' / 'folder')
    assert [file.name for file in files] == ['calibration.yaml', 'result.json', 'report.html']
    assert all(file.parent == tmp_path / 'new' / 'folder' and file.exists() for file in files)
    refused = make_calibration('refused').save(tmp_path / 'refused')
    assert [file.name for file in refused] == ['result.json', 'report.html']
    with pytest.raises(OutputError) as caught:
        calibration.save(files[0])
    assert caught.value.code == 'E-NAME-TAKEN'


def test_it_is_read_back(calibration, tmp_path):
    count = len(calibration.camera.names())
    stored = StoredTurnSummary(TurnId.stored(0), 1.7e9, 0.05, 88.0, 20, True, 0.9)
    full = dataclasses.replace(
        calibration, mask=None, verdict=Verdict('accepted', conditions=(
            Condition('E-FEW-TURNS', 'turns used', '3', 'at least 2', True),)),
        stored_turns=(stored,), details={'profile_contrast': 0.3},
        covariance=np.eye(count) / 3, picture_covariance=np.eye(count) / 7,
        rolling_shutter=Shutter(21.0, 0.3), stabiliser=Stabiliser(30.0),
        warnings=(Notice('E-DARK', 'dark'),), sigma_px=PictureSigma(0.5, 1.5),
        straight_lines=Bend(9, 3, 0.2, 0.01, 0.02, None, 0.5),
        held_out=(LeftOut(TurnId.at(88), 0.5, 0.7, 0.8), LeftOut(TurnId.stored(1), 1.0, 2.0, 3.0)))
    full.save(tmp_path)
    for path in (tmp_path, tmp_path / 'result.json'):
        read = Calibration.load(path)
        assert result_dict(read) == result_dict(full)
        np.testing.assert_array_equal(read.covariance, full.covariance)
        np.testing.assert_array_equal(read.picture_covariance, full.picture_covariance)
        assert read.details == full.details and read.verdict == full.verdict
        assert repr(read) == repr(full) and read.used_turns == full.used_turns
        read.save(tmp_path / 'again')
        assert load_camera(tmp_path / 'again').camera == full.camera
    short = Calibration.load(tmp_path / 'calibration.yaml')
    assert (short.camera, short.sigma, short.verdict.level, short.versions) == (
        full.camera, full.sigma, 'accepted', full.versions)


def test_only_a_calibration_of_this_package_is_one(tmp_path):
    refused = make_calibration('refused', mask=None)
    refused.save(tmp_path)
    assert result_dict(Calibration.load(tmp_path)) == result_dict(refused)
    data = result_dict(make_calibration())
    data['config']['setting.of.another.version'] = 1
    (tmp_path / 'result.json').write_text(json.dumps({**data, 'verdict': 'weak'}))
    assert Calibration.load(tmp_path).verdict.level == 'weak'
    for key, value in (('turns', [{}]), ('config', []), ('sigma', 3)):
        (tmp_path / 'result.json').write_text(json.dumps({**data, key: value}))
        with pytest.raises(InputError) as caught:
            Calibration.load(tmp_path)
        assert caught.value.code == 'E-CALIBRATION-DAMAGED'
    (tmp_path / 'ost.yaml').write_text(export(TRUTH, 'ros'))
    with pytest.raises(InputError) as caught:
        Calibration.load(tmp_path / 'ost.yaml')
    assert caught.value.code == 'E-OTHER-CALIBRATION'


def test_print_says_that_a_field_is_used(calibration):
    field = LensField(Field(calibration.image_size, np.zeros((2, 5))), True, 0.31, 0.7, 0.2)
    used = repr(dataclasses.replace(calibration, field=field))
    assert ', and a smooth field of 0.3 px, above its sigma of 0.2 px' in used
    assert 'field' not in repr(calibration)
    assert 'field' not in repr(dataclasses.replace(
        calibration, field=dataclasses.replace(field, used=False)))
