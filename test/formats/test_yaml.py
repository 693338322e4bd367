# SPDX-License-Identifier: Apache-2.0
"""calibration.yaml: camera_calibration_parsers' keys, order and layout, at full precision."""
from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess

import cv2
import pytest
import yaml
from made_calibration import EACH_MODEL, SIGMA, TRUTH, calibration_of, make_calibration

from dashcalib_ros.camera import Brown, Fisheye, Radial
from dashcalib_ros.config import Config
from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.formats import calibration_yaml, export, load_camera
from dashcalib_ros.formats.load import load_with_faults
from dashcalib_ros.ros.store import CameraIdentity, StoredCalibration

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
        assert load_camera(tmp_path / 'calibration.yaml').camera == lens
    assert shown['same'][0] == lens.fx
    assert shown['all'][0] < shown['crop'][0] and shown['all'][0] == shown['all'][5]


def test_layout_is_one_flow_list_a_matrix():
    text = calibration_yaml(make_calibration())
    assert text.startswith(
        '%YAML 1.2\n---\n'
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
    odd = dataclasses.replace(TRUTH, fx=2 / 3 * 1000, k1=-1e-17 / 3, k2=1 / 7)
    path = tmp_path / 'calibration.yaml'
    path.write_text(calibration_yaml(make_calibration(camera=odd)), encoding='utf-8')
    camera = load_with_faults(path)
    assert camera.camera == odd
    assert camera.sigma == SIGMA
    assert camera.verdict == 'accepted'
    assert camera.image_size == (1242, 375)


def test_the_same_calibration_gives_the_same_text():
    assert calibration_yaml(make_calibration()) == calibration_yaml(make_calibration())


# what breaks OpenCV's parser, and names that are numbers nearly
ODD = 'a: "b" \\ #c ü %, {[ 4.2.1'


@pytest.fixture(scope='module')
def each_file(tmp_path_factory):
    """One file of each kind that this package writes, by name."""
    folder = tmp_path_factory.mktemp('calibrations')
    texts = {name: calibration_yaml(calibration_of(lens, input_name=ODD), created='2026-11-22')
             for name, lens in EACH_MODEL.items()}
    texts['weak'] = calibration_yaml(make_calibration('weak', input_name='x' * 5000), '4k_front')
    texts['alone'] = export(TRUTH, 'ros')
    kept = StoredCalibration.of(make_calibration(input_name=ODD),
                                CameraIdentity('360cam', '/image_raw'), 'front: #1')
    texts['kept'], texts['kept_with_p'] = kept.text, kept.rectified('all').text
    assert texts['kept'] != texts['kept_with_p']
    for name, text in texts.items():
        (folder / f'{name}.yaml').write_text(text, encoding='utf-8')
    return {path.stem: path for path in sorted(folder.iterdir())}


def lens_of(name):
    return EACH_MODEL.get(name, TRUTH)


def values_of(path):
    """Return what each reader must find: size, K, D, and the text of our own block."""
    lens = lens_of(path.stem)
    own = yaml.safe_load(path.read_text()).get('dashcalib', {})
    return [lens.image_size[0], *lens.matrix.ravel(), *lens.ros_distortion()], own.get('input', '')


def test_opencv_opens_each(each_file):
    for path in each_file.values():
        numbers, text = values_of(path)
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        assert file.isOpened(), path
        k, d = (file.getNode(key).mat() for key in ('camera_matrix', 'distortion_coefficients'))
        assert [file.getNode('image_width').real(), *k.ravel(), *d.ravel()] == numbers
        assert file.getNode('dashcalib').getNode('input').string() == text
        file.release()


# opens each file named by its arguments, and writes what it has as one line of JSON
OTHER_OPENCV = '''
import cv2, json, sys
for path in sys.argv[1:]:
    file = cv2.FileStorage(path, cv2.FILE_STORAGE_READ)
    k, d = (file.getNode(n).mat() for n in ('camera_matrix', 'distortion_coefficients'))
    print(json.dumps([[file.getNode('image_width').real(), *k.ravel(), *d.ravel()],
                      file.getNode('dashcalib').getNode('input').string()]))
'''
ROS_1 = '''
import camera_calibration_parsers, json, sys, yaml
for path in sys.argv[1:]:
    _, info = camera_calibration_parsers.readCalibration(path)
    own = yaml.safe_load(open(path)).get('dashcalib', {})
    print(json.dumps([[info.width, *info.K, *info.D], own.get('input', '')]))
'''


@pytest.mark.parametrize(('module', 'program'), [
    ('cv2', OTHER_OPENCV), ('camera_calibration_parsers', ROS_1)])
def test_the_distribution_s_readers_open_each(each_file, module, program):
    """OpenCV 4, and ROS 1's parsers: Debian's and Ubuntu's packages, where they are installed."""
    python = '/usr/bin/python3'
    try:
        subprocess.run([python, '-c', f'import {module}'], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip(f'{python} has no {module}')
    told = subprocess.run([python, '-c', program, *map(str, each_file.values())], check=True,
                          capture_output=True, text=True).stdout.splitlines()
    for path, line in zip(each_file.values(), told, strict=True):
        assert json.loads(line) == list(values_of(path)), path


# as ROS 2's camera_calibration_parsers asks yaml-cpp
YAML_CPP = r'''
#include <iostream>
#include <yaml-cpp/yaml.h>
int main(int count, char ** paths) {
  std::cout.precision(17);
  for (int i = 1; i < count; ++i) {
    YAML::Node doc = YAML::LoadFile(paths[i]);
    std::cout << "[[" << doc["image_width"].as<int>();
    for (auto key : {"camera_matrix", "distortion_coefficients"})
      for (auto value : doc[key]["data"]) std::cout << ", " << value.as<double>();
    YAML::Node own = doc["dashcalib"];
    std::cout << "], " << (own ? own["verdict"].as<std::string>().size() : 0) << "]" << std::endl;
  }
}
'''


def test_yaml_cpp_opens_each(each_file, tmp_path):
    source = tmp_path / 'reads.cpp'
    source.write_text(YAML_CPP)
    made = shutil.which('g++') and subprocess.run(
        ['g++', str(source), '-o', str(tmp_path / 'reads'), '-lyaml-cpp'], capture_output=True)
    if not made or made.returncode:
        pytest.skip('there is no g++, or no libyaml-cpp-dev')
    told = subprocess.run([tmp_path / 'reads', *each_file.values()], check=True,
                          capture_output=True, text=True).stdout.splitlines()
    for path, line in zip(each_file.values(), told, strict=True):
        numbers, length = json.loads(line)
        verdict = yaml.safe_load(path.read_text()).get('dashcalib', {}).get('verdict', '')
        assert (numbers, length) == (values_of(path)[0], len(verdict)), path


def test_a_file_of_an_older_version_loads(tmp_path):
    """It has no line %YAML."""
    text = calibration_yaml(make_calibration())
    (tmp_path / 'old.yaml').write_text(text.partition('---\n')[2])
    assert load_camera(tmp_path / 'old.yaml').camera == TRUTH


def test_names_from_outside_cannot_break_the_file():
    name = 'drive: "#1"\n- [x] ü.mcap'
    text = calibration_yaml(make_calibration(input_name=name))
    assert yaml.safe_load(text)['dashcalib']['input'] == name


@pytest.mark.parametrize('name', ['narrow_stereo', '', 'my cam', 'a:b', 'käm'])
def test_camera_names_that_drivers_refuse_are_refused(name):
    with pytest.raises(ConfigError) as caught:
        calibration_yaml(make_calibration(), name)
    assert caught.value.code == (
        'E-CAMERA-NAME-TAKEN' if name == 'narrow_stereo' else 'E-CAMERA-NAME')


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
    camera = load_camera(path)
    assert camera.camera == Brown((640, 480), 500, 501.5, 320, 240, -0.1, 1e-5, 0.001, -0.002,
                                  0.003)
    assert camera.sigma is None and camera.verdict is None


@pytest.mark.parametrize('name', ['equidistant', 'fisheye'])
def test_another_tool_s_fisheye_loads(tmp_path, name):
    path = tmp_path / 'ost.yaml'
    path.write_text(FOREIGN.replace('plumb_bob', name).replace('cols: 5', 'cols: 4').replace(
        '-0.1, 1e-05, 0.001, -0.002, 0.003', '-0.1, 1e-05, 0.001, -0.002'))
    assert load_camera(path).camera == Fisheye(
        (640, 480), 500, 501.5, 320, 240, -0.1, 1e-5, 0.001, -0.002)


# '' is the code of an error of another room
@pytest.mark.parametrize(('old', 'new', 'code', 'value'), [
    ('image_width: 640\n', '', 'E-CALIBRATION-NO-SIZE', 'image width'),
    ('image_height: 480', 'image_height: 0', 'E-CALIBRATION-NO-SIZE', 'image height'),
    ('plumb_bob', 'equidistant', '', 'equidistant'),
    ('data: [500, 0, 320, 0, 501.5, 240, 0, 0, 1]', 'data: [500]', 'E-CALIBRATION-COUNT',
     '9 numbers'),
    ('data: [500, 0, 320', 'data: [0, 0, 320', 'E-CALIBRATION-EMPTY', ''),
    ('data: [500, 0, 320', 'data: [.nan, 0, 320', 'E-CALIBRATION-NUMBER', 'camera_matrix'),
    ('distortion_coefficients', 'distortion_coefficents', 'E-LENS-COEFFICIENTS',
     'distortion_coefficients'),
    ('camera_matrix', 'matrix', 'E-CALIBRATION-FORMAT', ''),
    ('image_width: 640', 'image_width: [', '', 'valid YAML'),
    ('image_width: 640', f'image_width: {"9" * 200}', 'E-CALIBRATION-TOO-LARGE', '65535'),
    ('data: [500, 0, 320', f'data: [{"5" * 400}, 0, 320', '', 'more than 300 digits'),
    ('data: [500, 0, 320', f'data: [0x{"f" * 290}, 0, 320', 'E-CALIBRATION-NUMBER', ''),
    ('camera_matrix:', f'laughs: {"[" * 40}{"]" * 40}\ncamera_matrix:', '', '30 levels'),
    ('camera_matrix:', f'large: [{"1, " * 2**20}]\ncamera_matrix:', '', 'more than 1 MB'),
])
def test_broken_files_are_refused_with_what_is_wrong(tmp_path, old, new, code, value):
    assert old in FOREIGN
    path = tmp_path / 'ost.yaml'
    path.write_text(FOREIGN.replace(old, new))
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert not code or raised.value.code == code
    assert str(path) in str(raised.value) and value in str(raised.value)


@pytest.mark.parametrize(('key', 'place', 'words'), [
    ('camera_matrix', 1, 'K[1] is 50'), ('rectification_matrix', 1, 'R is not a rotation'),
    ('projection_matrix', 2, 'P does not map the image')])
def test_faults_beside_the_camera_are_read(tmp_path, key, place, words):
    path = tmp_path / 'calibration.yaml'
    data = yaml.safe_load(export(Radial((100, 60), 80.0, 80.0, 49.5, 29.5), 'ros'))
    path.write_text(yaml.safe_dump(data))
    assert load_camera(path).faults == ()
    data[key]['data'][place] += 50.0
    path.write_text(yaml.safe_dump(data))
    [fault] = load_with_faults(path).faults
    assert words in fault
    # what would be lost in another format
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert raised.value.code == 'E-CAMERA-FAULTS'
