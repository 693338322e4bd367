"""calibration.yaml: camera_calibration_parsers' keys, order and layout, at full precision."""
from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import yaml
from made_calibration import EACH_MODEL, SIGMA, TRUTH, calibration_of, make_calibration

from dashcalib_ros.camera import Brown, Fisheye
from dashcalib_ros.config import Config
from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.report import calibration_yaml, load_calibration_yaml

PARSERS_KEYS = ['image_width', 'image_height', 'camera_name', 'camera_matrix',
                'distortion_model', 'distortion_coefficients', 'rectification_matrix',
                'projection_matrix']

# as camera_calibration_parsers' yaml-cpp emitter writes it, exponents without a dot among it
FOREIGN = """\
image_width: 640
image_height: 480
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [500, 0, 320, 0, 501.5, 240, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 1e-05, 0.001, -0.002, 0.003]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [500, 0, 320, 0, 0, 501.5, 240, 0, 0, 0, 1, 0]
"""


def test_keys_order_and_values_are_the_parsers_own():
    document = yaml.safe_load(calibration_yaml(make_calibration()))
    c = TRUTH
    assert list(document) == [*PARSERS_KEYS, 'dashcalib']
    assert (document['image_width'], document['image_height']) == (1242, 375)
    assert document['camera_name'] == 'dashcam'
    assert document['distortion_model'] == 'plumb_bob'
    assert document['camera_matrix'] == {
        'rows': 3, 'cols': 3, 'dt': 'd', 'data': [c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1]}
    assert document['distortion_coefficients'] == {
        'rows': 1, 'cols': 5, 'dt': 'd', 'data': [c.k1, c.k2, 0, 0, 0]}
    assert document['rectification_matrix'] == {
        'rows': 3, 'cols': 3, 'dt': 'd', 'data': [1, 0, 0, 0, 1, 0, 0, 0, 1]}
    assert document['projection_matrix'] == {
        'rows': 3, 'cols': 4, 'dt': 'd',
        'data': [c.fx, 0, c.cx, 0, 0, c.fy, c.cy, 0, 0, 0, 1, 0]}
    for key in ('camera_matrix', 'distortion_coefficients', 'projection_matrix'):
        assert list(document[key]) == ['rows', 'cols', 'dt', 'data']
        assert all(type(value) is float for value in document[key]['data'])


def test_a_fisheye_has_four_coefficients():
    lens = EACH_MODEL['fisheye']
    document = yaml.safe_load(calibration_yaml(calibration_of(lens)))
    assert list(document) == [*PARSERS_KEYS, 'dashcalib']
    assert document['distortion_model'] == 'equidistant'
    assert document['distortion_coefficients'] == {
        'rows': 1, 'cols': 4, 'dt': 'd', 'data': [lens.k1, lens.k2, lens.k3, lens.k4]}
    assert document['dashcalib']['camera_model'] == 'fisheye'
    assert list(document['dashcalib']['sigma']) == list(lens.names())


@pytest.mark.parametrize('model', EACH_MODEL)
def test_p_is_what_the_setting_wants(tmp_path, model):
    lens = EACH_MODEL[model]
    shown = {}
    for rectified in ('same', 'crop', 'all'):
        config = Config().replace({'rectified': rectified})
        text = calibration_yaml(calibration_of(lens, config=config))
        document = yaml.safe_load(text)
        shown[rectified] = document['projection_matrix']['data']
        assert document['camera_matrix']['data'][0] == lens.fx
        # what is read is the camera, whatever P is
        (tmp_path / 'calibration.yaml').write_text(text)
        assert load_calibration_yaml(tmp_path / 'calibration.yaml').camera == lens
    assert shown['same'][0] == lens.fx
    assert shown['all'][0] < shown['crop'][0] and shown['all'][0] == shown['all'][5]


def test_layout_is_one_flow_list_a_matrix():
    text = calibration_yaml(make_calibration())
    assert text.startswith(
        'image_width: 1242\nimage_height: 375\ncamera_name: dashcam\ncamera_matrix:\n  rows: 3\n'
        '  cols: 3\n  dt: d\n'
        '  data: [721.5377, 0.0, 609.5593, 0.0, 724.25, 172.854, 0.0, 0.0, 1.0]\n'
        'distortion_model: plumb_bob\n')


def test_our_block_has_sigma_verdict_and_provenance():
    block = yaml.safe_load(calibration_yaml(make_calibration('weak'), created='2025-01-02'))[
        'dashcalib']
    assert block['verdict'] == 'weak'
    assert block['reasons'] == ['only 1 of 5 turns']
    assert block['sigma'] == SIGMA
    assert block['turns_used'] == 1
    assert block['input'] == 'drive.mcap'
    assert block['seed'] == 7
    assert block['created'] == '2025-01-02'


def test_full_precision_survives_the_round_trip(tmp_path):
    odd = dataclasses.replace(TRUTH, fx=2 / 3 * 1000, k1=-1e-17 / 3, k2=1e300 / 7)
    path = tmp_path / 'calibration.yaml'
    path.write_text(calibration_yaml(make_calibration(camera=odd)), encoding='utf-8')
    camera = load_calibration_yaml(path)
    assert camera.camera == odd
    assert camera.sigma == SIGMA
    assert camera.verdict == 'accepted'
    assert camera.image_size == (1242, 375)


def test_the_same_calibration_gives_the_same_text():
    assert calibration_yaml(make_calibration()) == calibration_yaml(make_calibration())


@pytest.mark.parametrize('name', EACH_MODEL)
def test_opencv_opens_it(tmp_path, name):
    lens, odd = EACH_MODEL[name], 'a: "b" \\ #c ü %, {[ 4.2.1'
    path = tmp_path / 'calibration.yaml'
    path.write_text(calibration_yaml(calibration_of(lens, input_name=odd), created='2026-11-22'),
                    encoding='utf-8')
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert file.isOpened() and file.getNode('image_width').real() == lens.image_size[0]
    np.testing.assert_array_equal(file.getNode('camera_matrix').mat(), lens.matrix)
    np.testing.assert_array_equal(file.getNode('distortion_coefficients').mat(),
                                  [lens.ros_distortion()])
    assert file.getNode('dashcalib').getNode('input').string() == odd
    file.release()


def test_names_from_outside_cannot_break_the_file():
    name = 'drive: "#1"\n- [x] ü.mcap'
    text = calibration_yaml(make_calibration(input_name=name))
    assert yaml.safe_load(text)['dashcalib']['input'] == name


@pytest.mark.parametrize('name', ['narrow_stereo', '', 'my cam', 'a:b', 'käm'])
def test_camera_names_that_drivers_refuse_are_refused(name):
    with pytest.raises(ConfigError, match='camera name'):
        calibration_yaml(make_calibration(), name)


def test_a_camera_name_of_digits_stays_text():
    assert yaml.safe_load(calibration_yaml(make_calibration(), '0012'))['camera_name'] == '0012'


def test_without_intrinsics_there_is_no_yaml():
    with pytest.raises(ValueError, match='intrinsics'):
        calibration_yaml(make_calibration('refused'))
    with pytest.raises(ValueError, match='intrinsics'):
        calibration_yaml(make_calibration(camera=dataclasses.replace(TRUTH, k1=float('nan'))))


def test_another_tool_s_file_loads(tmp_path):
    path = tmp_path / 'ost.yaml'
    path.write_text(FOREIGN)
    camera = load_calibration_yaml(path)
    assert camera.camera == Brown((640, 480), 500, 501.5, 320, 240, -0.1, 1e-5, 0.001, -0.002,
                                  0.003)
    assert camera.sigma is None and camera.verdict is None


@pytest.mark.parametrize('name', ['equidistant', 'fisheye'])
def test_another_tool_s_fisheye_loads(tmp_path, name):
    path = tmp_path / 'ost.yaml'
    path.write_text(FOREIGN.replace('plumb_bob', name).replace('cols: 5', 'cols: 4').replace(
        '-0.1, 1e-05, 0.001, -0.002, 0.003', '-0.1, 1e-05, 0.001, -0.002'))
    assert load_calibration_yaml(path).camera == Fisheye(
        (640, 480), 500, 501.5, 320, 240, -0.1, 1e-5, 0.001, -0.002)


@pytest.mark.parametrize(('old', 'new', 'complaint'), [
    ('image_width: 640\n', '', 'image width'),
    ('image_height: 480', 'image_height: 0', 'image height'),
    ('plumb_bob', 'equidistant', 'equidistant'),
    ('data: [500, 0, 320, 0, 501.5, 240, 0, 0, 1]', 'data: [500]', '9 numbers'),
    ('data: [500, 0, 320', 'data: [0, 0, 320', 'uncalibrated'),
    ('data: [500, 0, 320', 'data: [.nan, 0, 320', 'camera_matrix'),
    ('distortion_coefficients', 'distortion_coefficents', 'distortion_coefficients'),
    ('camera_matrix', 'matrix', 'no camera calibration'),
    ('image_width: 640', 'image_width: [', 'not valid YAML'),
    ('image_width: 640', f'image_width: {"9" * 200}', '65535 at the most'),
    ('data: [500, 0, 320', f'data: [{"5" * 400}, 0, 320', 'more than 300 digits'),
    ('data: [500, 0, 320', f'data: [0x{"f" * 290}, 0, 320', 'finite numbers'),
    ('camera_matrix:', f'laughs: {"[" * 5000}\ncamera_matrix:', 'more than 30 levels'),
    ('camera_matrix:', f'large: [{"1, " * 2**20}]\ncamera_matrix:', 'too large'),
])
def test_broken_files_are_refused_with_what_is_wrong(tmp_path, old, new, complaint):
    assert old in FOREIGN
    path = tmp_path / 'ost.yaml'
    path.write_text(FOREIGN.replace(old, new))
    with pytest.raises(InputError, match=complaint):
        load_calibration_yaml(path)
