"""A Calibration in a program's hands: one line of text, K and D, pictures without distortion."""
from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from made_calibration import EACH_MODEL, calibration_of, make_calibration

from dashcalib_ros.errors import InputError, OutputError


@pytest.fixture(params=EACH_MODEL)
def calibration(request):
    return calibration_of(EACH_MODEL[request.param])


def test_it_is_one_line(calibration):
    text = repr(calibration)
    assert '\n' not in text and len(text) < 300
    assert 'accepted' in text and calibration.camera.model in text
    assert f'fx {calibration.camera.fx:.6g} ± 4' in text
    refused = repr(make_calibration('refused'))
    assert 'refused' in refused and 'only 1 of 5 turns' in refused


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
    with pytest.raises(InputError, match='32x24'):
        calibration.undistort(np.zeros((24, 32), np.uint8))
    refused = make_calibration('refused')
    for ask in (lambda: refused.K, lambda: refused.D,
                lambda: refused.covariance,
                lambda: refused.undistort(np.zeros((375, 1242), np.uint8))):
        with pytest.raises(InputError, match='refused'):
            ask()


def test_the_covariance_is_that_of_the_sigmas(calibration):
    names = calibration.camera.names()
    correlation = np.eye(len(names))
    correlation[0, 1] = correlation[1, 0] = 0.5
    known = dataclasses.replace(calibration, details={'correlation': correlation.tolist()})
    sigma = np.array([calibration.sigma[name] for name in names])
    assert known.covariance.shape == (len(names), len(names))
    np.testing.assert_allclose(np.diag(known.covariance), sigma**2)
    assert known.covariance[0, 1] == known.covariance[1, 0] == pytest.approx(
        0.5 * sigma[0] * sigma[1])
    with pytest.raises(InputError, match='correlated'):
        _ = calibration.covariance


def test_a_calibration_writes_what_the_command_writes(calibration, tmp_path):
    files = calibration.save(tmp_path / 'new' / 'folder')
    assert [file.name for file in files] == ['calibration.yaml', 'result.json', 'report.html']
    assert all(file.parent == tmp_path / 'new' / 'folder' and file.exists() for file in files)
    refused = make_calibration('refused').save(tmp_path / 'refused')
    assert [file.name for file in refused] == ['result.json', 'report.html']
    with pytest.raises(OutputError, match='choose another output folder'):
        calibration.save(files[0])
