# SPDX-License-Identifier: Apache-2.0
"""Comparing calibrations: against numbers of the scoring tool, and by construction."""
from __future__ import annotations

import dataclasses
import json
import math
import re

import numpy as np
import pytest
from made_calibration import (
    EACH_MODEL,
    MOUNT,
    SIGMA,
    TRUTH,
    calibration_of,
    make_calibration,
)
from refused import refused
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dashcalib_ros.camera import Brown, Fisheye, Radial, camera_from_ros
from dashcalib_ros.camera.field import TERMS as FIELD_TERMS
from dashcalib_ros.camera.field import Field
from dashcalib_ros.camera.mapping import apart, mapping_error
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats import (
    calibrated_camera,
    calibration_yaml,
    load_calibration,
    load_camera,
    result_json,
)
from dashcalib_ros.judge.calibration import LensField
from dashcalib_ros.report import NamedCamera, compare
from dashcalib_ros.report.compare import answers, comparison_rows
from dashcalib_ros.report.page import difference_html
from dashcalib_ros.solve.spread import PictureSigma

SIZE = (1242, 375)
REFERENCE = NamedCamera('truth', TRUTH)


def shifted(**changes):
    """Return TRUTH with some parameters moved by an amount, as a camera."""
    moved = {key: getattr(TRUTH, key) + value for key, value in changes.items()}
    return NamedCamera('moved', dataclasses.replace(TRUTH, **moved))


@pytest.mark.parametrize(('k1', 'apart'), [(1e-4, False), (2e-3, True)])
def test_what_no_drive_tells_apart_is_no_difference(k1, apart):
    """However well the turns say that they determine some direction."""
    other = shifted(k1=k1)
    sure = NamedCamera('sure', TRUTH, covariance=1e-16 * np.eye(6),
                       sigma_px=PictureSigma(0.01, 0.02))
    found = compare(other, sure).whole
    assert (found.rms_px > 0.05) == apart and found.told_apart == apart
    assert found.answer == ('differs' if apart else 'right')


def scoring_tool(estimate, truth):
    """Compute the mapping error the scoring tool's way: point by point, fixed-point rays."""
    def bend(c, x, y):
        s = 1 + c.k1 * (x * x + y * y) + c.k2 * (x * x + y * y) ** 2
        return x * s, y * s

    w, h = SIZE
    t, e = truth.camera, estimate.camera
    uv = np.array([(u, v) for v in np.linspace(0, h - 1, 15) for u in np.linspace(0, w - 1, 25)])
    rays = []
    for u, v in uv:
        xd, yd = (u - t.cx) / t.fx, (v - t.cy) / t.fy
        x, y = xd, yd
        for _ in range(100):
            bx, by = bend(t, x, y)
            x, y = x + xd - bx, y + yd - by
        rays.append((x, y, 1.0))

    def residual(rotation):
        q = Rotation.from_rotvec(rotation).apply(rays)
        x, y = bend(e, q[:, 0] / q[:, 2], q[:, 1] / q[:, 2])
        return (np.stack([e.fx * x + e.cx, e.fy * y + e.cy], -1) - uv).ravel()
    fit = least_squares(residual, np.zeros(3))
    return math.sqrt(np.mean(fit.fun.reshape(-1, 2) ** 2) * 2)


@pytest.mark.parametrize('estimate', [
    shifted(fx=7, fy=4, cx=-5, cy=3, k1=0.01, k2=-0.02),
    shifted(fx=-60, fy=-60),
    shifted(cx=20, cy=-12),
    shifted(k1=0.363, k2=-0.151),
], ids=['all', 'focal', 'centre', 'distortion'])
def test_mapping_error_agrees_with_the_scoring_tool(estimate):
    mine = mapping_error(estimate.camera, TRUTH)
    assert mine == pytest.approx(scoring_tool(estimate, REFERENCE), abs=1e-4)
    assert mine > 0.5


def test_a_camera_maps_like_itself():
    assert mapping_error(TRUTH, TRUTH) == pytest.approx(0, abs=1e-9)


def test_a_common_rotation_hides_most_of_a_shifted_centre():
    assert 0 < mapping_error(shifted(cx=2.0).camera, TRUTH) < 1.0


WIDE = Fisheye((1280, 720), 390.0, 391.0, 630.0, 365.0, -0.02, 0.004, -0.002, 0.0003)


@pytest.mark.parametrize('estimate', [
    dataclasses.replace(WIDE, fx=392.0, cy=366.0, k1=-0.022, k4=0.0004),
    Radial(WIDE.image_size, 380.0, 385.0, 635.0, 360.0, 0.002, 0.0),
    Brown(WIDE.image_size, 380.0, 385.0, 635.0, 360.0, -0.01, 0.001, 1e-4, 1e-4, 0.0),
], ids=['fisheye', 'radial', 'brown'])
def test_mapping_error_against_a_fisheye_agrees_with_the_scoring_tool(estimate):
    """Its rule: rays beyond 88 degrees are left out where the estimate is no fisheye."""
    width, height = WIDE.image_size
    uv = np.array([(u, v) for v in np.linspace(0, height - 1, 15)
                   for u in np.linspace(0, width - 1, 25)])
    xy = (uv - [WIDE.cx, WIDE.cy]) / [WIDE.fx, WIDE.fy]
    radius = np.hypot(*xy.T)
    theta = radius.copy()
    for _ in range(100):
        s = theta**2
        value = theta * (1 + s * (WIDE.k1 + s * (WIDE.k2 + s * (WIDE.k3 + s * WIDE.k4))))
        slope = 1 + s * (3 * WIDE.k1 + s * (5 * WIDE.k2 + s * (7 * WIDE.k3 + 9 * s * WIDE.k4)))
        theta = theta - (value - radius) / slope
    rays = np.column_stack([xy / radius[:, None] * np.sin(theta)[:, None], np.cos(theta)])
    fisheye = isinstance(estimate, Fisheye)
    kept = fisheye | (theta < np.radians(88.0))

    def residual(rotation):
        x, y, z = Rotation.from_rotvec(rotation).apply(rays[kept]).T
        c = {**dict.fromkeys(('p1', 'p2', 'k3', 'k4'), 0.0), **estimate.named}
        if fisheye:
            r = np.hypot(x, y)
            t = np.arctan2(r, z)
            s = t * t
            factor = t / r * (1 + s * (c['k1'] + s * (c['k2'] + s * (c['k3'] + s * c['k4']))))
            x, y = x * factor, y * factor
        else:
            x, y = x / z, y / z
            s = x * x + y * y
            factor = 1 + s * (c['k1'] + s * (c['k2'] + s * c['k3']))
            x, y = (x * factor + 2 * c['p1'] * x * y + c['p2'] * (s + 2 * x * x),
                    y * factor + c['p1'] * (s + 2 * y * y) + 2 * c['p2'] * x * y)
        return (np.stack([c['fx'] * x + c['cx'], c['fy'] * y + c['cy']], -1) - uv[kept]).ravel()

    fit = least_squares(residual, np.zeros(3))
    expected = math.sqrt(np.mean(fit.fun.reshape(-1, 2) ** 2) * 2)
    assert mapping_error(estimate, WIDE) == pytest.approx(expected, rel=1e-6)
    found = compare(NamedCamera('estimate', estimate), NamedCamera('truth', WIDE))
    assert found.unseen == pytest.approx(1 - np.mean(kept))
    assert found.to_dict()['unseen'] == found.unseen and (found.unseen == 0) == fisheye
    # a coefficient of the same name has another meaning in another family
    own = [f'{name} ({camera.model})' for camera in (estimate, WIDE)
           for name in camera.names()[4:]]
    assert [row.name for row in found.differences] == (
        list(WIDE.names()) if fisheye else ['fx', 'fy', 'cx', 'cy', *own])
    if not fisheye:
        rows = {row.name: row for row in found.differences}
        assert (rows['k1 (fisheye)'].a, rows['k1 (fisheye)'].b) == (None, WIDE.k1)
        assert rows[own[0]].a == estimate.k1 and rows[own[0]].difference is None
        assert dict(zip(own, comparison_rows(found)[1][4:], strict=True))['k1 (fisheye)'][1:4] == (
            '-', '-0.0200', '-')
        json.dumps(found.to_dict(), allow_nan=False)


@pytest.mark.parametrize('k2', [0.0, 0.1])
def test_pixels_beyond_a_fold_have_no_ray_and_no_number_is_made_up(k2):
    # with k2 = 0.1 there is a second, false root far out: the search must not take it
    for folding in (Radial(SIZE, 300, 300, 621, 187, -0.6, k2),
                    Brown(SIZE, 300, 300, 621, 187, -0.6, k2, 1e-5)):
        rays = folding.rays(np.array([[621.0, 187.0], [0.0, 0.0]]))
        assert rays[0] == pytest.approx([0, 0, 1])
        assert np.isnan(rays[1]).all()
        assert mapping_error(TRUTH, folding) is None


def test_differences_percent_and_combined_sigmas():
    estimate = NamedCamera('a', dataclasses.replace(TRUTH, fx=TRUTH.fx * 1.01, k2=0.0), SIGMA)
    other = NamedCamera('b', dataclasses.replace(TRUTH, k2=0.0), SIGMA)
    rows = {row.name: row for row in compare(estimate, other).differences}
    assert list(rows) == ['fx', 'fy', 'cx', 'cy', 'k1', 'k2']
    assert rows['fx'].difference == pytest.approx(7.215377)
    assert rows['fx'].percent == pytest.approx(1.0)
    assert rows['fx'].sigma == pytest.approx(SIGMA['fx'] * math.sqrt(2))
    assert rows['fx'].z == pytest.approx(7.215377 / (SIGMA['fx'] * math.sqrt(2)))
    assert rows['k2'].percent is None  # of zero there is no percentage
    one_sided = compare(estimate, REFERENCE).differences[0]
    assert one_sided.sigma == SIGMA['fx']
    assert compare(shifted(fx=1), REFERENCE).differences[0].z is None


def test_percent_keeps_the_sign_for_negative_parameters():
    row = compare(shifted(k1=0.0363), REFERENCE).differences[4]
    assert row.difference > 0 and row.percent == pytest.approx(10.0)


def test_tangential_terms_are_compared_where_there_are_any():
    other = NamedCamera('decentred', Brown.of(SIZE, [*TRUTH.params, 0.01, 0, 0]))
    found = compare(REFERENCE, other)
    assert [row.name for row in found.differences][6:] == ['p1', 'p2', 'k3']
    assert found.mapping_px > 0.1


def test_all_three_formats_say_the_same(tmp_path):
    calibration = make_calibration()
    (tmp_path / 'result.json').write_text(result_json(calibration))
    (tmp_path / 'calibration.yaml').write_text(calibration_yaml(calibration))
    (tmp_path / 'truth.json').write_text(json.dumps(
        {**TRUTH.named, 'width': 1242, 'height': 375, 'fps': 10}))
    result = load_camera(tmp_path)  # a folder stands for its result.json
    for name in ('result.json', 'calibration.yaml', 'truth.json'):
        camera = load_camera(tmp_path / name)
        assert camera.camera == TRUTH
        assert compare(result, camera).mapping_px == pytest.approx(0, abs=1e-9)
    assert load_camera(tmp_path / 'calibration.yaml').sigma == result.sigma == SIGMA


@pytest.mark.parametrize('model', EACH_MODEL)
def test_all_formats_know_all_models(tmp_path, model):
    lens = EACH_MODEL[model]
    calibration = calibration_of(lens)
    (tmp_path / 'result.json').write_text(result_json(calibration))
    (tmp_path / 'calibration.yaml').write_text(calibration_yaml(calibration))
    (tmp_path / 'truth.json').write_text(json.dumps(
        {**lens.named, 'width': 1242, 'height': 375,
         **({'model': 'fisheye'} if model == 'fisheye' else {})}))
    for name in ('result.json', 'calibration.yaml', 'truth.json'):
        read = load_camera(tmp_path / name)
        assert read.camera == lens
        assert read.sigma == (None if name == 'truth.json' else calibration.sigma)


@pytest.mark.parametrize(('model', 'expected'), [
    ('fisheye', 'fisheye'), ('equidistant', 'fisheye'), ('radial', 'radial'), ('brown', 'radial'),
    ('plumb_bob', 'radial')])
def test_a_truth_may_name_its_model(tmp_path, model, expected):
    data = {**TRUTH.named, 'width': 1242, 'height': 375, 'model': model}
    (tmp_path / 'truth.json').write_text(json.dumps(data))
    camera = load_camera(tmp_path / 'truth.json').camera
    assert camera.model == expected and camera.named == {
        **TRUTH.named, **({'k3': 0.0, 'k4': 0.0} if expected == 'fisheye' else {})}


@pytest.mark.parametrize(('change', 'code', 'value'), [
    ({'model': 'mirror'}, 'E-CAMERA-MODEL', "'mirror'; use one of radial, brown, fisheye"),
    ({'model': ['fisheye']}, 'E-CAMERA-MODEL', 'radial'),
    ({'k4': 0.01}, 'E-LENS-AMBIGUOUS', '"model": "fisheye"'),
    ({'model': 'plumb_bob', 'k4': 0.01}, 'E-LENS-COEFFICIENTS', 'plumb_bob model has no k4'),
    ({'skew': 0.5}, 'E-LENS-COEFFICIENTS', 'has no skew'),
    ({'model': 'fisheye', 'p1': 0.01}, 'E-LENS-COEFFICIENTS', 'equidistant model has no p1')])
def test_a_truth_of_no_model_here_is_refused(tmp_path, change, code, value):
    data = {**TRUTH.named, 'width': 1242, 'height': 375, **change}
    (tmp_path / 'truth.json').write_text(json.dumps(data))
    with pytest.raises(InputError) as raised:
        load_camera(tmp_path / 'truth.json')
    assert raised.value.code == code and value in str(raised.value)


@pytest.mark.parametrize(('changes', 'code'), [
    ({'camera_model': 'x' * 1000}, 'E-CAMERA-MODEL'),
    ({'image_size': [1242]}, 'E-CALIBRATION-PAIR'),
    ({'image_size': '9' * 1000}, 'E-CALIBRATION-PAIR'),
    ({'field': {'used': True, 'coefficients': [[1.0], [2.0]]}}, 'E-CALIBRATION-FIELD'),
    ({'field': {'used': True, 'coefficients': 'none'}}, 'E-CALIBRATION-FIELD')])
def test_a_result_without_a_camera_of_ours_is_refused(tmp_path, changes, code):
    data = json.loads(result_json(make_calibration())) | changes
    (tmp_path / 'result.json').write_text(json.dumps(data))
    with refused(InputError, code) as caught:
        load_camera(tmp_path)
    assert len(str(caught.value)) < 400


def test_different_image_sizes_are_an_error():
    for size, remedy in (((621, 187), "export 'my truth' --to ros --size 621x187 --out "),
                         ((640, 480), '--crop')):
        with refused(InputError, 'E-COMPARE-SIZE', '1242x375', '{}x{}'.format(*size), remedy):
            compare(dataclasses.replace(REFERENCE, name='my truth'),
                    NamedCamera('other', dataclasses.replace(TRUTH, image_size=size)))


@pytest.mark.parametrize('number', ['7' * 400, '-' + '7' * 400, '1e999'])
def test_a_truth_has_numbers_that_a_computer_can_hold(tmp_path, number):
    path = tmp_path / 'truth.json'
    path.write_text(f'{{"fx": {number}, "fy": 1, "cx": 1, "cy": 1, "k1": 0, "k2": 0, '
                    f'"width": 640, "height": 480}}')
    with refused(InputError, 'E-CALIBRATION-NUMBER', 'fx') as caught:
        load_camera(path)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(('change', 'code', 'value'), [
    ({'k1': 1e300}, 'E-CALIBRATION-LENS', 'k1 = 1e+300'),
    ({'k2': -1e300}, 'E-CALIBRATION-LENS', 'k2 = -1e'),
    ({'fx': 1e300}, 'E-CALIBRATION-LENS', 'fx = 1e'),
    ({'cy': -1e9}, 'E-CALIBRATION-LENS', 'cy = -1e'),
    ({'fx': 1e-300}, 'E-CALIBRATION-ASPECT', ''),
    ({'cx': 1e6, 'k1': -1}, 'E-CALIBRATION-CENTRE', '640x480'),
    ({'width': 60_000, 'height': 60_000}, 'E-IMAGE-TOO-LARGE', '60000x60000')])
def test_numbers_that_no_lens_has_are_one_line(tmp_path, change, code, value):
    path = tmp_path / 'truth.json'
    path.write_text(json.dumps({'width': 640, 'height': 480, 'fx': 400, 'fy': 400, 'cx': 320,
                                'cy': 240, 'k1': 0, 'k2': 0, **change}))
    with refused(InputError, code, path, value):
        load_camera(path)


def test_a_lens_whose_rays_no_other_kind_has_is_not_compared():
    given = camera_from_ros((320, 180), 'equidistant', [200, 0, -1e6, 0, 200, 90, 0, 0, 1],
                            [0, 10, 0, 10])
    assert apart(camera_from_ros((320, 180), 'plumb_bob', [200, 0, 160, 0, 200, 90, 0, 0, 1],
                                 [0.1]), given) is None


@pytest.mark.parametrize(('missing', 'code'), [
    ('width', 'E-CALIBRATION-NO-SIZE'), ('height', 'E-CALIBRATION-NO-SIZE'),
    ('k2', 'E-NO-DISTORTION')])
def test_a_truth_must_be_complete(tmp_path, missing, code):
    data = {**TRUTH.named, 'width': 1242, 'height': 375}
    del data[missing]
    (tmp_path / 'truth.json').write_text(json.dumps(data))
    with refused(InputError, code, missing):
        load_camera(tmp_path / 'truth.json')


def test_a_refused_result_cannot_be_compared(tmp_path):
    (tmp_path / 'result.json').write_text(result_json(make_calibration('refused')))
    with refused(InputError, 'E-NO-INTRINSICS', tmp_path, 'only 1 of 5 turns'):
        load_camera(tmp_path)
    with refused(InputError, 'E-NO-INTRINSICS', 'only 1 of 5 turns'):
        calibrated_camera(make_calibration('refused'))


def test_a_drive_given_by_mistake_is_not_read_whole(tmp_path):
    path = tmp_path / 'drive.mp4'
    with path.open('wb') as stream:
        stream.truncate(2**40)  # sparse; reading it all would be noticed
    with pytest.raises(InputError) as caught:
        load_camera(path)
    assert caught.value.code == 'E-FILE-TOO-LARGE'


def test_the_comparison_is_strict_json():
    found = compare(NamedCamera('a', TRUTH, {**SIGMA, 'k1': math.nan}),
                    dataclasses.replace(REFERENCE, verdict='weak'))
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert data['b'] == {'name': 'truth', 'verdict': 'weak'}
    assert data['parameters']['k1']['z'] is None
    assert data['parameters']['fx'] == {
        'a': TRUTH.fx, 'b': TRUTH.fx, 'difference': 0.0, 'percent': 0.0, 'sigma': SIGMA['fx'],
        'z': 0.0}


def test_the_page_of_a_difference_has_maps_in_px_and_in_sigmas():
    covariance = np.diag([0.4, 0.4, 0.3, 0.3, 1e-4, 1e-4])**2
    known = NamedCamera('<b>', TRUTH, covariance=covariance, sigma_px=PictureSigma(0.3, 0.9))
    moved = shifted(fx=7.0)
    page = difference_html(compare(moved, known))
    assert page.count('<svg') == 3 and '<b>' not in page and 'http' not in page
    numbers = [float(each) for each in re.findall(r'<text[^>]*>([\d.e+-]+)</text>', page)]
    found = compare(moved, known).whole
    # the first map's corner, its last, is what apart() says; the third is the first by the second
    assert numbers[14] == pytest.approx(found.apart.lengths[-1], rel=0.05)
    assert numbers[29] == pytest.approx(found.sigma_map.sigma[-1], rel=0.05)
    assert numbers[44] == pytest.approx(numbers[14] / numbers[29], rel=0.15)
    # without a sigma there is one map, and none where a lens folds over
    assert difference_html(compare(moved, REFERENCE)).count('<svg') == 1
    folding = NamedCamera('f', dataclasses.replace(TRUTH, fx=300, fy=300, k1=-0.6, k2=0))
    assert '<svg' not in difference_html(compare(moved, folding))


def test_cameras_of_two_models_are_compared_with_what_either_knows():
    brown = Brown.of(SIZE, [*TRUTH.params, 0.0, 0.0, 0.0])
    small = np.diag([0.4, 0.4, 0.3, 0.3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-3])**2
    sigma = PictureSigma(0.3, 0.9)
    wide = NamedCamera('brown', brown, covariance=small, sigma_px=sigma)
    narrow = NamedCamera('radial', TRUTH, covariance=small[:6, :6], sigma_px=sigma)
    plain = NamedCamera('file', TRUTH)
    for a, b in ((wide, narrow), (narrow, wide), (wide, plain), (plain, wide)):
        found = compare(a, b).whole
        assert (found.told_apart, found.matters) == (False, False)
        far = compare(dataclasses.replace(a, camera=dataclasses.replace(
            a.camera, fx=1.02 * TRUTH.fx)), b).whole
        assert (far.told_apart, far.matters) == (True, True)
    # both know something: together less than either alone
    assert compare(wide, narrow).whole.sigma_px.rms == pytest.approx(0.3 * math.sqrt(2))
    assert np.all(compare(wide, narrow).whole.sigma_map.sigma
                  > compare(plain, narrow).whole.sigma_map.sigma)


def test_result_json_keeps_the_covariance_of_the_picture(tmp_path):
    covariance = np.diag([0.4, 0.4, 0.3, 0.3, 1e-3, 1e-3])**2
    calibration = dataclasses.replace(
        make_calibration(), sigma_px=PictureSigma(0.3, 0.9),
        picture_covariance=covariance)
    (tmp_path / 'result.json').write_text(result_json(calibration))
    for camera in (load_camera(tmp_path), calibrated_camera(calibration)):
        np.testing.assert_array_equal(camera.covariance, covariance)
        assert camera.sigma_px == PictureSigma(0.3, 0.9)
    for broken in ([[1.0]], (-covariance).tolist(), 'x', [[None] * 6] * 6, None):
        data = json.loads(result_json(calibration))
        data['details']['picture_covariance'] = broken
        data['sigma_px'] = {'rms': None, 'worst': 1.0}
        (tmp_path / 'result.json').write_text(json.dumps(data))
        camera = load_camera(tmp_path)
        assert camera.covariance is None and camera.sigma_px is None


@pytest.mark.parametrize('name', ['result.json', 'calibration.yaml'])
def test_how_the_camera_sits_is_compared_where_both_files_say(tmp_path, name):
    def of(mount):
        found, path = make_calibration(mount=mount), tmp_path / name
        path.write_text(result_json(found) if name == 'result.json' else calibration_yaml(found))
        return load_camera(path)

    before, now = of(MOUNT), of(dataclasses.replace(MOUNT, yaw_left_deg=3.0, roll_right_deg=1.0))
    moved = dataclasses.replace(MOUNT, moved_s=17.5)
    assert before.mount == MOUNT and of(moved).mount == moved and of(None).mount is None
    found = compare(now, before)
    mount = found.to_dict()['mount']
    assert mount['moved'] and set(mount) == {'moved', 'yaw_left_deg', 'pitch_up_deg'}
    assert mount['yaw_left_deg'] == pytest.approx({'difference': 1.0, 'sigma': 0.1 * 2**0.5})
    assert 'yaw 1.00 ± 0.14° to the left' in answers(found)[-1] and 'moved' in answers(found)[-1]
    assert 'moved' not in answers(compare(before, before))[-1]
    assert compare(now, of(None)).to_dict()['mount'] is None
    assert not any('mounting' in line for line in answers(compare(now, of(None))))


@pytest.mark.parametrize('spoiled', [
    {'sigma': 3}, {'travel_px': [1.0]}, {'yaw_left_deg': 'left'}, {'verdict': 7, 'reasons': None}])
def test_a_mounting_that_cannot_be_read_costs_nothing_else(tmp_path, spoiled):
    data = json.loads(result_json(make_calibration(mount=MOUNT)))
    data['mount'] |= spoiled
    (tmp_path / 'result.json').write_text(json.dumps(data))
    found = load_camera(tmp_path / 'result.json')
    assert found.mount is None and found.camera == TRUTH


def test_a_field_is_part_of_the_difference():
    # 1 px of bend, which no rotation removes
    coefficients = np.zeros((2, len(FIELD_TERMS)))
    coefficients[0, FIELD_TERMS.index((2, 0))] = 2.0
    field = Field(SIZE, coefficients)
    bent = dataclasses.replace(REFERENCE, field=field)
    for a, b in ((bent, REFERENCE), (REFERENCE, bent)):
        found = compare(a, b)
        assert 0.5 < found.mapping_px < 1.0 and found.answer == found.whole.answer
        assert 'metrology' not in found.whole.good_for
    assert compare(bent, bent).mapping_px < 1e-3


@pytest.mark.parametrize(('sigma_px', 'used'), [(0.5, True), (1.5, False)])
def test_a_field_below_its_sigma_is_not_used(tmp_path, sigma_px, used):
    field = LensField(Field(SIZE, np.ones((2, len(FIELD_TERMS)))), True, 1.0, 2.0, sigma_px)
    # as files of 0.2.0 have it: always used
    (tmp_path / 'result.json').write_text(result_json(make_calibration(field=field)))
    assert (load_camera(tmp_path).field is not None) == used
    assert load_calibration(tmp_path / 'result.json').field.used == used


def test_a_centre_that_is_far_off_is_good_for_nothing():
    sigma = np.diag([0.2, 0.2, 0.3, 0.3, 0.0003, 0.0003])**2
    known = dataclasses.replace(REFERENCE, covariance=sigma, sigma_px=PictureSigma(0.1, 0.2))
    found = compare(shifted(cx=0.02 * SIZE[0]), known).to_dict()
    assert (found['answer'], found['good_for']) == ('wrong', [])
