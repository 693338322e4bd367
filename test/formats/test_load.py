# SPDX-License-Identifier: Apache-2.0
"""load_camera(): other programs' files, which camera is meant, and what is refused."""
from __future__ import annotations

import json
import zipfile

import cv2
import numpy as np
import pycolmap
import pytest
from made_calibration import EACH_MODEL, SIZE, TRUTH
from made_drives import ROS1, START, drive, images, info_of, write_bag
from refused import refused
from rosbags.rosbag1 import Writer as Writer1

from dashcalib_ros.camera import Brown, Fisheye, Radial, Rational
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats import load_camera
from dashcalib_ros.formats.load import load_with_faults
from dashcalib_ros.judge.difference import NamedCamera

BROWN, FISHEYE = EACH_MODEL['brown'], EACH_MODEL['fisheye']
SMALL = (640, 480)
LENS5 = Brown(SMALL, 500.0, 501.5, 320.0, 240.0, -0.1, 1e-5, 0.001, -0.002, 0.3)

# of cv2.FileStorage, versions 2 to 5
OPENCV = """%YAML:1.0
---
calibration_time: "Sun Nov 22 10:00:00 2026"
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.0000000000000000e+02, 0., 320., 0., 501.5, 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -1.0000000000000001e-01, 1e-05, 1.0000000000000000e-03,
       -2.0000000000000000e-03, .3 ]
"""
OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<image_Width>640</image_Width><image_Height>480</image_Height>
<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>500. 0. 320. 0. 501.5 240. 0. 0. 1.</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt>
  <data>-0.1 1e-05 1e-03 -2e-3 .3</data></Distortion_Coefficients>
</opencv_storage>
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.1, 1.0e-05, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [500, 501.5, 320, 240]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.01, 0.001, -0.002]
  distortion_model: equidistant
  intrinsics: [500, 501.5, 320, 240]
  resolution: [640, 480]
cam2:
  camera_model: omni
  distortion_coeffs: [0, 0, 0, 0]
  distortion_model: radtan
  intrinsics: [1.1, 500, 501.5, 320, 240]
  resolution: [640, 480]
"""
MRCAL = """# generated on 2026-11-22 with mrcal-calibrate-cameras
{
    'lensmodel':  'LENSMODEL_OPENCV8',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 500, 501.5, 320, 240, -0.1, 1e-05, 0.001, -0.002, 0.3, 0.01, 0.02, 0.03,],
    'extrinsics': [ 0, 0, 0, 0, 0, 0,],
    'imagersize': [ 640, 480,],
    'icam_intrinsics': 0,
    'optimization_inputs': b'VGhpcyBpcyBub3QgcmVhZA==',
}
"""
PLAIN = {'fx': 500, 'fy': 501.5, 'cx': 320, 'cy': 240, 'k1': -0.1, 'k2': 1e-5, 'width': 640,
         'height': 480}
FULL = Brown(SMALL, 500.0, 501.5, 320.0, 240.0, -0.1, 1e-5, 1e-3, -2e-3, 0.3)
NO_K3 = Brown(SMALL, *FULL.params[:8])
MATRIX = {'K': [[500, 0, 320], [0, 501.5, 240], [0, 0, 1]], 'image_size': SMALL}
NERF = {'w': 640, 'h': 480.0, 'fl_x': 500, 'fl_y': 501.5, 'cx': 320.5, 'cy': 240.5}
SFM = {'projection_type': 'perspective', 'width': 640, 'height': 480, 'focal': 0.8, 'k1': -0.1,
       'k2': 0.01}


# a lens profile as it is published, of an action camera
GYROFLOW = json.loads("""{
  "name": "AKASO_v50x___2.7k_16by9_2716x1524-30.00fps", "note": "",
  "camera_brand": "AKASO", "camera_model": "V50x", "lens_model": "", "camera_setting": "",
  "calib_dimension": {"w": 2716, "h": 1524}, "orig_dimension": {"w": 2716, "h": 1524},
  "output_dimension": {"w": 2716, "h": 1524}, "frame_readout_time": null, "gyro_lpf": null,
  "input_horizontal_stretch": 1.0, "num_images": 6, "fps": 29.999979, "official": false,
  "use_opencv_fisheye": true,
  "fisheye_params": {
    "RMS_error": 0.920755232738085,
    "camera_matrix": [[1521.8556549213351, 0.0, 1398.7223429856729],
                      [0.0, 1517.3353528760497, 629.1053659679567], [0.0, 0.0, 1.0]],
    "distortion_coeffs": [0.13409177590858662, -0.33639498801548057, 0.3274956873988361,
                          -0.1478470585818954],
    "radial_distortion_limit": null},
  "use_opencv_standard": false,
  "calib_params": {"RMS_error": 0.0, "camera_matrix": [], "distortion_coeffs": [],
                   "radial_distortion_limit": null},
  "identifier": "", "calibrator_version": "1.0.0-rc4", "date": "2022-02-27",
  "compatible_settings": []}""")
ACTION = Fisheye((2716, 1524), 1521.8556549213351, 1517.3353528760497, 1398.7223429856729,
                 629.1053659679567, 0.13409177590858662, -0.33639498801548057,
                 0.3274956873988361, -0.1478470585818954)
GYROFLOW_LENS = {'camera_matrix': MATRIX['K'], 'distortion_coeffs': [-0.1, 1e-5, 1e-3, -2e-3, 0.3]}
STANDARD = {'calib_dimension': {'w': 640, 'h': 480}, 'distortion_model': 'opencv_standard',
            'fisheye_params': GYROFLOW_LENS}


def gyroflow(d, **changes):
    """Make a lens profile of OpenCV's standard model."""
    return {**STANDARD, 'fisheye_params': {**GYROFLOW_LENS, 'distortion_coeffs': d}, **changes}


@pytest.mark.parametrize(('content', 'name', 'wanted'), [
    (GYROFLOW, None, ACTION),
    ({'title': 'a project', 'calibration_data': GYROFLOW}, None, ACTION),
    # newer versions name what there is not
    ({**{key: GYROFLOW[key] for key in ('calib_dimension', 'fisheye_params')},
      **dict.fromkeys(('distortion_model', 'digital_lens', 'crop', 'interpolations')),
      'asymmetrical': False, 'input_horizontal_stretch': 1.0, 'input_vertical_stretch': 1.0,
      'compatible_settings': [{'width': 1920, 'height': 1080, 'crop': 0.928}]}, None, ACTION),
    (STANDARD, None, FULL),
    (gyroflow([*FULL.params[4:], 0.01, 0.02, 0.03, 0, 0, 0, 0]), None,
     Rational(SMALL, *FULL.params, 0.01, 0.02, 0.03)),
    (gyroflow([]), None, Radial(SMALL, *FULL.params[:4])),
    # without coefficients a fisheye is taken for a pinhole there, too
    (gyroflow([0, 0, 0, 0], distortion_model=None), None, Radial(SMALL, *FULL.params[:4])),
    # of the first versions
    ({'calib_dimension': {'w': 640, 'h': 480}, 'use_opencv_fisheye': False, 'fisheye_params': {},
      'use_opencv_standard': True, 'calib_params': GYROFLOW_LENS}, None, FULL),
    (OPENCV, None, FULL),
    (OPENCV_XML, None, FULL),
    (KALIBR, 'cam0', NO_K3),
    (KALIBR, 'cam1', Fisheye(SMALL, 500.0, 501.5, 320.0, 240.0, -0.1, 0.01, 0.001, -0.002)),
    (MRCAL, None, Rational(SMALL, *FULL.params, 0.01, 0.02, 0.03)),
    ('# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n3 SIMPLE_RADIAL 640 480 500 320.5 240.5 -0.1\n',
     None, Radial(SMALL, 500.0, 500.0, 320.0, 240.0, -0.1)),
    (PLAIN, None, Radial(SMALL, 500.0, 501.5, 320.0, 240.0, -0.1, 1e-5)),
    ({**PLAIN, 'p1': 1e-3, 'p2': -2e-3, 'k3': 0.3}, None, FULL),
    ({**PLAIN, 'model': 'fisheye', 'k4': 0.1}, None,
     Fisheye(SMALL, 500.0, 501.5, 320.0, 240.0, -0.1, 1e-5, 0.0, 0.1)),
    ({**PLAIN, 'k4': 0.1, 'k5': 0.0, 'k6': 0.0}, None,
     Rational(SMALL, 500.0, 501.5, 320.0, 240.0, -0.1, 1e-5, k4=0.1)),
    ({**MATRIX, 'D': [-0.1, 1e-5, 1e-3, -2e-3, 0.3]}, None, FULL),
    ({**MATRIX, 'dist': [[-0.1, 1e-5, 1e-3, -2e-3, 0.3, 0.0, 0.0, 0.0]]}, None, FULL),
    ({**NERF, 'camera_model': 'OPENCV', 'k1': -0.1, 'k2': 1e-5, 'p1': 1e-3, 'p2': -2e-3,
      'frames': []}, None, NO_K3),
    ({'camera_angle_x': 2 * np.arctan(0.64), 'w': 640, 'h': 480, 'frames': [{}]}, None,
     Radial(SMALL, 500.0, 500.0, 319.5, 239.5)),
    ({'frames': [{'file_path': 'a.png', **NERF}, {'file_path': 'b.png', **NERF}]}, 'b.png',
     Radial(SMALL, 500.0, 501.5, 320.0, 240.0)),
    ([{'cameras': {'v2 x 640': SFM}, 'shots': {}}], None,
     Radial(SMALL, 512.0, 512.0, 319.5, 239.5, -0.1, 0.01)),
    ({'v2 x 640': {**SFM, 'projection_type': 'fisheye'}}, None,
     Fisheye(SMALL, 512.0, 512.0, 319.5, 239.5, -0.1, 0.01)),
])
def test_a_file_of_another_program(tmp_path, content, name, wanted):
    path = tmp_path / 'calibration.txt'
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    read = load_camera(path, name=name)
    assert read.camera == type(wanted)(*[
        wanted.image_size, *(pytest.approx(value, rel=1e-12) for value in wanted.params)])
    if name is not None:  # FILE:NAME says the same
        assert load_camera(f'{path}:{name}') == read and read.name == f'{path}:{name}'


@pytest.mark.parametrize(('profile', 'readout_ms'), [
    ({}, None), ({'frame_readout_time': None}, None), ({'frame_readout_time': 0.0}, None),
    ({'frame_readout_time': 14.2}, 14.2), ({'frame_readout_time': -14.2}, -14.2),
    ({'frame_readout_time': 14.2, 'frame_readout_direction': 'BottomToTop'}, -14.2),
    ({'frame_readout_time': 14.2, 'frame_readout_direction': 'LeftToRight'}, None)])
def test_the_readout_time_of_a_lens_profile(tmp_path, profile, readout_ms):
    path = tmp_path / 'profile.json'
    path.write_text(json.dumps({**GYROFLOW, **profile}))
    assert load_camera(path).readout_ms == readout_ms


# '' is the code of an error of another room
@pytest.mark.parametrize(('content', 'code', 'value'), [
    (KALIBR, 'E-CAMERA-CHOICE', 'cam0, cam1, cam2'),
    (KALIBR.replace('radtan', 'fov', 1).partition('cam1')[0], 'E-LENS-MODEL', "'fov'"),
    (KALIBR.partition('cam2:')[2].replace('\n  ', '\n'), 'E-LENS-MODEL', "'omni'"),
    (OPENCV.replace('0., 320.', '.25, 320.'), 'E-CAMERA-FAULTS', 'K[1] is 0.25'),
    (OPENCV.replace('.3 ]', '.3, 0, 0, 0, .1 ]'), '', 'with 9 coefficients'),
    (OPENCV.replace('image_width: 640\n', ''), 'E-CALIBRATION-NO-SIZE', 'add image_width'),
    (OPENCV.replace('-2.0000000000000000e-03, .3', '1.'), 'E-LENS-AMBIGUOUS',
     'distortion_model: plumb_bob'),
    (OPENCV_XML.replace('<opencv', '<!DOCTYPE a [<!ENTITY a "b">]><opencv', 1),
     'E-CALIBRATION-XML', ''),
    (OPENCV_XML.replace('</data></Camera', '</Camera'), 'E-CALIBRATION-XML', ''),
    (MRCAL.replace('LENSMODEL_OPENCV8', 'LENSMODEL_SPLINED_STEREOGRAPHIC_order=3'),
     'E-LENS-MODEL', 'LENSMODEL_OPENCV8'),
    (MRCAL.replace('0.03,]', '0.03, 0, 0, 0, 0.1]').replace('V8', 'V12'), '',
     'with 12 coefficients'),
    (MRCAL.replace('640', 'open("x")'), 'E-CAMERAMODEL', ''),
    ('1 FOV 640 480 500 500 320 240 0.9', 'E-LENS-MODEL', "'FOV'"),
    ('1 PINHOLE 640 480 500 500 320', 'E-CALIBRATION-COUNT', '4 parameters, not 3'),
    ('1 PINHOLE 640 480 500 500 320 240\n2 PINHOLE', 'E-CAMERA-CHOICE', '2 cameras'),
    ({**NERF, 'k4': 0.1}, 'E-LENS-COEFFICIENTS', 'no k4'),
    ({**NERF, 'camera_model': 'EQUIRECTANGULAR'}, 'E-LENS-MODEL', "'EQUIRECTANGULAR'"),
    ({'a': {**SFM, 'projection_type': 'spherical'}}, 'E-LENS-MODEL', "'spherical'"),
    ({**PLAIN, 'k4': 0.1}, 'E-LENS-AMBIGUOUS', 'k4'),
    ({**PLAIN, 'xi': 1.1}, 'E-LENS-COEFFICIENTS', 'no xi'),
    (gyroflow([0.1], distortion_model='poly5'), 'E-LENS-MODEL', "'poly5'"),
    (gyroflow([0.1], digital_lens='gopro_superview'), 'E-LENS-PROFILE',
     "digital_lens = 'gopro_superview'"),
    (gyroflow([0.1], input_horizontal_stretch=1.33), 'E-LENS-PROFILE',
     'input_horizontal_stretch = 1.33'),
    (gyroflow([0.1], frame_readout_time='fast'), 'E-CALIBRATION-NUMBER',
     "frame_readout_time = 'fast'"),
    (gyroflow([0.1], calib_dimension=[640, 480]), 'E-CALIBRATION-MISSING', 'calib_dimension'),
    (gyroflow([0.1], calib_dimension={'w': 640}), 'E-CALIBRATION-NO-SIZE', 'height'),
    (gyroflow([0.1], fisheye_params={}), 'E-CALIBRATION-MISSING', 'camera_matrix'),
    (gyroflow([*[0.1] * 8, 0.01, 0, 0, 0]), '', 'with 9 coefficients'),
    (gyroflow([0.1] * 5, distortion_model='opencv_fisheye'), '', 'with 5 coefficients'),
    (gyroflow([0.1], fisheye_params={
        **GYROFLOW_LENS, 'camera_matrix': [[500, 1, 320], [0, 500, 240], [0, 0, 1]]}),
     'E-CAMERA-FAULTS', 'K[1] is 1'),
    ({'images': []}, 'E-CALIBRATION-FORMAT', ''),
    ({'frames': []}, 'E-CALIBRATION-FORMAT', ''),
    ([], 'E-CALIBRATION-FORMAT', ''),
    ('hello\n', 'E-CALIBRATION-FORMAT', ''),
    ('', 'E-CALIBRATION-FORMAT', ''),
])
def test_what_is_not_said_or_not_known_is_refused_in_one_line(tmp_path, content, code, value):
    path = tmp_path / 'calibration.txt'
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert not code or raised.value.code == code
    assert str(path) in str(raised.value) and value in str(raised.value)
    assert '\n' not in str(raised.value) and len(str(raised.value)) < 500 + len(str(path))


VIEW = {'fx': 700, 'fy': 702, 'cx': 604, 'cy': 186, 'width': 1226, 'height': 370}
LENS = {**VIEW, 'k1': 0.02, 'k2': -0.007}
D5 = [0.02, -0.007, 0.0, 0.0, 0.0]
WANTED = Radial((1226, 370), 700.0, 702.0, 604.0, 186.0, 0.02, -0.007)
# of Waymo's FRONT
NINE = [700, 702, 604, 186, 0.02, -0.007, 0.001, -0.001, 0.0]


def with_matrix(k, d=D5, **more):
    return {'camera_matrix': k, 'distortion_coefficients': d, 'image_width': 1226,
            'image_height': 370, 'distortion_model': 'plumb_bob', **more}


def read(tmp_path, content, name='camera.json'):
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return load_camera(path)


@pytest.mark.parametrize(('changes', 'code', 'value'), [
    # a digit too many, or one at another place
    ({'fy': 7020}, 'E-CALIBRATION-ASPECT', '10 times'), ({'fx': 70}, 'E-CALIBRATION-ASPECT', ''),
    # mm, and shares of the picture
    ({'fx': 4.2, 'fy': 4.2}, 'E-CALIBRATION-FOCAL', 'mm'),
    ({'fx': 0.57, 'fy': 1.9, 'cx': 0.49, 'cy': 0.5}, 'E-CALIBRATION-FOCAL', 'multiply'),
    ({'cx': 186, 'cy': 604}, 'E-CALIBRATION-EXCHANGED', 'cx and cy'),
    # coefficients in percent and in thousandths
    ({'k1': -36.3, 'k2': 15.1}, 'E-CALIBRATION-NO-RAY', 'k1 = -36.3'),
    ({'k1': 20, 'k2': -7}, 'E-CALIBRATION-NO-RAY', 'k1 = 20'),
    # the size is told first: distortion of another size folds
    ({'fx': 200, 'fy': 200, 'cx': 153, 'cy': 46, 'k1': -0.7}, 'E-CALIBRATION-OTHER-SIZE', '')])
def test_numbers_that_no_camera_has_are_refused(tmp_path, changes, code, value):
    with pytest.raises(InputError) as raised:
        read(tmp_path, LENS | changes)
    assert raised.value.code == code and value in str(raised.value)


@pytest.mark.parametrize(('changes', 'code', 'value'), [
    ({}, '', ''), ({'fy': 1.04 * 700}, '', ''), ({'cx': 680, 'cy': 172}, '', ''),
    ({'fy': 933}, 'E-CALIBRATION-ASPECT', '1.33 times'),
    ({'fy': 604, 'cx': 702}, 'E-CALIBRATION-ASPECT', 'fx, fy, cx, cy'),
    ({'fx': 7000, 'fy': 7020}, 'E-CALIBRATION-NARROW', '10.0 degrees'),
    ({'cx': 302, 'cy': 93}, 'E-CALIBRATION-OTHER-SIZE', '613x185'),
    ({'cx': 1208, 'cy': 372}, 'E-CALIBRATION-OTHER-SIZE', '--size 1226x370'),
    ({'cx': 367.2, 'cy': 248.3, 'width': 1920, 'height': 1080}, 'E-CALIBRATION-OTHER-SIZE',
     '752x480'),
    ({'cx': 512.5, 'cy': 384.5, 'width': 640, 'height': 480}, 'E-CALIBRATION-OTHER-SIZE',
     '1024x768'),
    ({'cx': 320, 'cy': 180, 'width': 960, 'height': 528}, 'E-CALIBRATION-OTHER-SIZE', '640x360'),
    # a strip of larger pictures
    ({'cx': 960, 'cy': 236, 'width': 1920, 'height': 886}, 'E-CALIBRATION-CENTRE', '1920x886'),
    ({'k1': 2}, 'E-CALIBRATION-PINCUSHION', 'k1 = 2'),
    ({'k1': -0.7, 'k2': 0}, 'E-CALIBRATION-FOLDS', 'k1 = -0.7')])
def test_what_is_odd_in_a_camera_is_a_warning(tmp_path, changes, code, value):
    found = read(tmp_path, LENS | changes)
    assert [each.code for each in found.warnings] == [code] * bool(code)
    assert value in ''.join(map(str, found.warnings))
    assert found == NamedCamera(found.name, found.camera)


def test_distortion_is_named_before_p_is(tmp_path):
    p = [700, 0, 604, 0, 0, 702, 186, 0, 0, 0, 1, 0]
    folding = with_matrix([700, 0, 604, 0, 702, 186, 0, 0, 1], [
        1342.1, -871.3, 102.9, 1e-4, -2e-4, 1341.7, -870.2, 101.1], projection_matrix=p,
        distortion_model='rational_polynomial')
    with pytest.raises(InputError) as raised:
        read(tmp_path, folding)
    assert raised.value.code == 'E-CALIBRATION-NO-RAY' and 'p1 = 102.9' in str(raised.value)
    part = with_matrix(folding['camera_matrix'], [-0.9, 0, 0, 0, 0], projection_matrix=p)
    assert [each.code for each in read(tmp_path, part).warnings] == ['E-CALIBRATION-FOLDS']


@pytest.mark.parametrize(('k', 'code'), [
    ([700, 702, 604, 186], ''), ([700, 0, 604, 45, 0, 702, 186, 0.2, 0, 0, 1, 0.003], ''),
    ([[700, 0, 604, 0], [0, 702, 186, 0], [0, 0, 1, 0], [0, 0, 0, 1]], ''),
    ({'fx': 700, 'fy': 702, 'u0': 604, 'v0': 186}, ''),
    ({'fu': 700, 'fv': 702, 'ppx': 604, 'ppy': 186}, ''),
    (['700', '0', '604', '0', '702', '186', '0', '0', '1'], ''),
    ([700, 0, 0, 0, 702, 0, 604, 186, 1], 'E-CALIBRATION-TRANSPOSED'),
    (NINE, 'E-CALIBRATION-NO-MATRIX'), ({'a': 1}, 'E-CALIBRATION-NO-MATRIX'),
    ([1.1, 0, 0, 0, 0, 1.8, 0, 0, 0, 0, -1, -0.2, 0, 0, -1, 0], 'E-CALIBRATION-NO-MATRIX'),
    ([700, 604, 186], 'E-CALIBRATION-COUNT')])
def test_intrinsics_are_a_matrix_or_say_what_they_are(tmp_path, k, code):
    if not code:
        assert read(tmp_path, with_matrix(k)).camera == WANTED
        return
    for content in (with_matrix(k), {'Intrinsic': k, 'width': 1226, 'height': 370}):
        with pytest.raises(InputError) as raised:
            read(tmp_path, content)
        assert raised.value.code == code


@pytest.mark.parametrize(('content', 'model'), [
    ({'intrinsic': {'k1': 339.7, 'k2': -31.9, 'model': 'radial_poly', 'width': 1280.0}},
     'radial_poly'),
    ({'intrinsic_type': 'DIVISION_UNDISTORTION', 'intrinsics': {'focal_length': 700}},
     'DIVISION_UNDISTORTION'),
    ({'intrinsics': [{'key': 0, 'value': {'polymorphic_name': 'pinhole_radial_k3',
                                          'ptr_wrapper': {'data': {'disto_k3': [0.1, 0, 0]}}}}]},
     'pinhole_radial_k3'),
    ({'intrinsics': [{'width': '1226', 'type': 'radial3'}]}, 'radial3'),
    ({'camera_type': 'kb4', 'intrinsics': {**LENS, 'k4': 0.1}}, 'kb4'),
    ({'camera_model': 'omni', **with_matrix([700, 702, 604, 186])}, 'omni')])
def test_a_lens_model_that_a_file_says_is_named(tmp_path, content, model):
    with pytest.raises(InputError) as raised:
        read(tmp_path, content)
    assert raised.value.code == 'E-LENS-MODEL' and repr(model) in str(raised.value)


def test_an_object_without_coefficients_leads_to_a_camera(tmp_path):
    content = {'extrinsic': {'x': 1.7}, 'intrinsic': {'fx': 700.0, 'fy': 702.0, 'u0': 604.0,
                                                      'v0': 186.0}}
    for code, more in (('E-NO-DISTORTION', {'k1': 0, 'k2': 0}),
                       ('E-CALIBRATION-NO-SIZE', {'image_width': 1226}),
                       ('E-CALIBRATION-NO-SIZE', {'image_height': 370})):
        with pytest.raises(InputError) as raised:
            read(tmp_path, content)
        assert raised.value.code == code
        content |= more
    assert read(tmp_path, content).camera == Radial((1226, 370), 700.0, 702.0, 604.0, 186.0)


@pytest.mark.parametrize('more', [
    {'RadialDistortion': [0.1, 0.2], 'TangentialDistortion': [0, 0]}, {'k1': 0.1, 'k2': 0.0},
    {'distortion_coefficients': {'k1': 0.1, 'k2': 0.0}}, {'lens': {'disto_k3': [0.1, 0, 0]}}])
def test_zeros_are_not_asked_for_where_there_is_distortion(tmp_path, more):
    content = with_matrix([700, 702, 604, 186])
    del content['distortion_coefficients']
    with pytest.raises(InputError) as raised:
        read(tmp_path, content | more)
    assert raised.value.code == 'E-LENS-COEFFICIENTS'
    assert next(iter(more)).split('.')[0] in str(raised.value) or 'disto_k3' in str(raised.value)


@pytest.mark.parametrize(('d', 'model', 'code'), [
    ([0.02, -0.007, 0.1], 'plumb_bob', 'E-LENS-AMBIGUOUS'),
    ([0.02, -0.007, 0.1], 'rational_polynomial', 'E-LENS-AMBIGUOUS'),
    ([0.02, -0.007, 0.0, 0.0, 0.0, 0.3], 'rational_polynomial', 'E-LENS-COEFFICIENTS'),
    ([0.02, -0.007, 0.0], 'plumb_bob', ''), ([0.02, -0.007], 'plumb_bob', ''),
    ([0.02, -0.007, 0.0, 0.0, 0.0, 0.0], 'plumb_bob', ''),
    ([0.02, -0.007, 0.1], 'fisheye', '')])
def test_coefficients_are_counted(tmp_path, d, model, code):
    content = with_matrix([700, 702, 604, 186], d, distortion_model=model)
    if not code:
        assert read(tmp_path, content).camera.named['k2'] == -0.007
        return
    with pytest.raises(InputError) as raised:
        read(tmp_path, content)
    assert raised.value.code == code


INI_OF_TWO = '\n'.join(
    f'[{side}_CAM_HD]\nfx=700\nfy=702\ncx=604\ncy=186\nk1=0.02\nk2=-0.007\n{size}'
    for side, size in (('LEFT', 'width=1226\nheight = 370\n'), ('RIGHT', '')))


def test_the_sections_of_an_ini_file_are_cameras(tmp_path):
    path = tmp_path / 'SN1234.conf'
    path.write_text(f'; a factory file\n{INI_OF_TWO}\n[STEREO]\nBaseline=120\n')
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert raised.value.code == 'E-CAMERA-CHOICE' and 'STEREO' not in str(raised.value)
    assert load_camera(f'{path}:LEFT_CAM_HD').camera == WANTED
    with pytest.raises(InputError) as raised:
        load_camera(path, name='RIGHT_CAM_HD')
    assert raised.value.code == 'E-CALIBRATION-NO-SIZE'


@pytest.mark.parametrize(('name', 'text', 'code'), [
    ('a.conf', '[STEREO]\nBaseline=120\n', 'E-CALIBRATION-FORMAT'),
    ('a.txt', 'Results\n=====\n  a: [1 2\n b: x: y\n', 'E-CALIBRATION-FORMAT'),
    ('a.toml', '[cam]\nK = [[700, 0, 604],\n [0, 702, 186], [0, 0, 1]]\n',
     'E-CALIBRATION-FORMAT'),
    ('a.m', 'K = [700 0 604; 0 702 186; 0 0 1];\n', 'E-CALIBRATION-FORMAT'),
    ('a.json', '{"fx": 700,,}', 'E-JSON-INVALID'), ('a', '{"fx": 700,,}', 'E-JSON-INVALID'),
    ('a.yaml', 'camera_matrix: [\n', 'E-YAML-INVALID'),
    ('a.json', '{"value0": {"camera_type": "ds"}}', 'E-CALIBRATION-FORMAT'),
    ('results-cam.txt', 'Calibration results\n====\ncam0 (/image_raw):\n'
     '    distortion: [0.02 -0.007 0.1 0.1] +- [0.1 0.1 0.1 0.1]\n'
     '    projection: [700. 702. 604. 186.] +- [1. 1. 1. 1.]\n', 'E-KALIBR-RESULTS')])
def test_a_parser_s_message_is_for_a_file_of_its_format(tmp_path, name, text, code):
    with pytest.raises(InputError) as raised:
        read(tmp_path, text, name)
    assert raised.value.code == code
    assert 'use' in str(raised.value) and ('says: ds' in str(raised.value)) == ('"ds"' in text)


@pytest.mark.parametrize(('missing', 'zeros'), [
    (['k1'], '"k1": 0'), (['k2'], '"k2": 0'), (['k1', 'k2'], '"k1": 0, "k2": 0')])
def test_coefficients_that_are_missing_may_be_zeros(tmp_path, missing, zeros):
    data, path = {name: value for name, value in PLAIN.items() if name not in missing}, (
        tmp_path / 'camera.json')
    path.write_text(json.dumps(data))
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert raised.value.code == 'E-NO-DISTORTION' and f'write 0: {zeros}' in str(raised.value)
    # what it says to write is read
    path.write_text(json.dumps(data | json.loads(f'{{{zeros}}}')))
    assert all(load_camera(path).camera.named[name] == 0 for name in missing)
    path = tmp_path / 'camera.yaml'
    path.write_text('image_width: 640\nimage_height: 480\ncamera_matrix: [500, 0, 320, 0, 500, '
                    '240, 0, 0, 1]\n')
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert raised.value.code == 'E-NO-DISTORTION'
    path.write_text(f'{path.read_text()}{str(raised.value).partition("each: ")[2]}\n')
    assert not any(load_camera(path).camera.ros_distortion())


def test_a_model_that_colmap_wrote(tmp_path):
    model = pycolmap.Reconstruction()
    for number, lens in enumerate((BROWN, FISHEYE), 1):
        model.add_camera(pycolmap.Camera(
            camera_id=number, model=lens.colmap.name, width=SIZE[0], height=SIZE[1],
            params=lens.colmap.values(lens.params)))
    for name, write in (('text', model.write_text), ('binary', model.write_binary)):
        folder = tmp_path / name
        folder.mkdir()
        write(str(folder))
        with refused(InputError, 'E-CAMERA-CHOICE', '2 cameras'):
            load_camera(folder)
        for number, lens in ((1, BROWN), (2, FISHEYE)):
            read = load_camera(f'{folder}:{number}').camera
            assert type(read) is type(lens)
            np.testing.assert_allclose(read.params, lens.params, rtol=1e-12)
    path = tmp_path / 'binary' / 'cameras.bin'
    path.write_bytes(path.read_bytes()[:-3])
    with refused(InputError, 'E-COLMAP-BINARY', 'model_converter'):
        load_camera(path)


ECHO = """header:
  stamp:
    sec: 1727666393
    nanosec: 0
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
{d}: [-0.1, 1.0e-05, 0.001, -0.002, 0.3]
{k}: [500.0, 0.0, 320.0, 0.0, 501.5, 240.0, 0.0, 0.0, 1.0]
{r}: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
{p}: [500.0, 0.0, 320.0, 0.0, 0.0, 501.5, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""
ECHOES = [ECHO.format(d='d', k='k', r='r', p='p'), ECHO.format(d='D', k='K', r='R', p='P')]
INI = """# oST version 5.0 parameters


[image]

width
640

height
480

[narrow_stereo]

camera matrix
500.000000 0.000000 320.000000
0.000000 501.500000 240.000000
0.000000 0.000000 1.000000

distortion
-0.1 1e-05 0.001 -0.002 0.3

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000

projection
500.0 0.0 320.0 0.0
0.0 501.5 240.0 0.0
0.0 0.0 1.0 0.0

"""


@pytest.mark.parametrize('text', [*ECHOES, 2 * ECHOES[0], '# of a car\n---\n' + ECHOES[1]])
def test_a_camera_info_that_was_echoed_is_its_first_document(tmp_path, text):
    path = tmp_path / 'info.yaml'
    path.write_text(text)
    assert load_camera(path).camera == LENS5


@pytest.mark.parametrize('text', ECHOES)
@pytest.mark.parametrize(('old', 'new'), [
    ('binning_x: 0', 'binning_x: 4'), ('binning_y: 0', 'binning_y: 2'),
    ('  height: 0', '  height: 100'), ('x_offset: 0', 'x_offset: 8')])
def test_a_file_is_refused_where_the_message_is(tmp_path, text, old, new):
    path = tmp_path / 'info.yaml'
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert raised.value.code == 'E-CALIBRATION-PART'


def test_all_of_the_picture_is_no_part(tmp_path):
    path = tmp_path / 'info.yaml'
    path.write_text(ECHOES[0].replace('  height: 0', '  height: 480').replace(
        '  width: 0', '  width: 640').replace('binning_x: 0', 'binning_x: 1'))
    assert load_camera(path).camera == LENS5


@pytest.mark.parametrize('model', ["''", '""', 'none', 'None', 'pinhole', 'null', 'plumb_bob'])
@pytest.mark.parametrize('d', ['[]', '[0.0, 0.0, 0.0, 0.0, 0.0]', '[0, 0, 0, 0]'])
@pytest.mark.parametrize('r', ['[0, 0, 0, 0, 0, 0, 0, 0, 0]', '[]'])
def test_no_distortion_has_many_names(tmp_path, model, d, r):
    path = tmp_path / 'info.yaml'
    text = ECHOES[0].replace('plumb_bob', model).replace(
        '[-0.1, 1.0e-05, 0.001, -0.002, 0.3]', d).replace(
        '[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]', r)
    if model == 'null' and d == '[0, 0, 0, 0]':
        text = text.replace('distortion_model: null\n', '')
    path.write_text(text)
    found = load_with_faults(path)
    assert found.camera == Radial(SMALL, 500.0, 501.5, 320.0, 240.0) and not found.faults


def test_a_name_of_no_distortion_is_none_where_there_is_some(tmp_path):
    path = tmp_path / 'info.yaml'
    path.write_text(ECHOES[0].replace('plumb_bob', "''"))
    with refused(InputError, 'E-MODEL-DISTORTION', path):
        load_camera(path)


def test_a_file_without_distortion_may_leave_it_out(tmp_path):
    (tmp_path / 'a.json').write_text(json.dumps(
        {'fx': 500, 'fy': 501.5, 'cx': 320, 'cy': 240, 'width': 640, 'height': 480,
         'model': 'pinhole'}))
    (tmp_path / 'b.json').write_text(json.dumps(
        {'K': [[500, 0, 320], [0, 501.5, 240], [0, 0, 1]], 'dist': None,
         'image_shape': [480, 640, 3]}))
    for name in ('a.json', 'b.json'):
        assert load_camera(tmp_path / name).camera == Radial(SMALL, 500.0, 501.5, 320.0, 240.0)


def test_ros_writes_ini_files_too(tmp_path):
    path = tmp_path / 'ost.txt'
    for text in (INI, INI.replace('\n', '\r\n'), INI.replace('width\n640', 'width = 640'),
                 INI.partition('\n\n\n')[2]):
        path.write_text(text)
        found = load_with_faults(path)
        assert found.camera == LENS5 and not found.faults
    path.write_text(INI.replace('-0.1 1e-05 0.001 -0.002 0.3', '0.1 0.01 0 0'))
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert raised.value.code == 'E-LENS-AMBIGUOUS'
    path.write_text(INI.replace('-0.1 1e-05 0.001 -0.002 0.3', '0.1 0.01 0 0').replace(
        'distortion\n', 'distortion_model: equidistant\ndistortion\n'))
    assert load_camera(path).camera == Fisheye(SMALL, 500.0, 501.5, 320.0, 240.0, 0.1, 0.01)
    second = INI[INI.index('[narrow'):].replace('narrow_stereo', 'right').replace('501.5', '502.5')
    path.write_text(INI + second)
    assert load_camera(f'{path}:right').camera.fy == 502.5
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert raised.value.code == 'E-CAMERA-CHOICE'
    path.write_text('[image]\nwidth\n640\n[a]\ncamera matrix\n1 2 x\n')
    with refused(InputError, 'E-CALIBRATION-COUNT', 'ost.txt'):
        load_camera(path)


@pytest.mark.parametrize(('matrix', 'distortion', 'size'), [
    ('cameraMatrix', 'dist_coeffs', {'cameraResolution': [640, 480]}),
    ('intrinsic_matrix', 'distortion', {'imageSize': {'data': [640, 480]}}),
    ('camera_mtx', 'distCoefs', {'image_shape': [480, 640]}),
    ('K', 'distortion_params', {'shape': [480, 640, 3]}),
    ('Intrinsics', 'DistortionCoefficient', {'resolution': [640, 480]}),
    ('mtx', 'dist', {'img_w': 640, 'img_h': 480}), ('k', 'd', {'cols': 640, 'rows': 480})])
def test_one_thing_has_many_names(tmp_path, matrix, distortion, size):
    path = tmp_path / 'camera.json'
    path.write_text(json.dumps({
        matrix: [[500, 0, 320], [0, 501.5, 240], [0, 0, 1]],
        distortion: [[-0.1, 1e-05, 0.001, -0.002, 0.3]], **size}))
    assert load_camera(path).camera == LENS5


def test_opencvs_interactive_calibration(tmp_path):
    file = cv2.FileStorage(str(tmp_path / 'CamParams.xml'), cv2.FILE_STORAGE_WRITE)
    file.write('calibrationDate', 'Thu Nov 26')
    file.write('framesCount', 21)
    file.startWriteStruct('cameraResolution', cv2.FileNode_SEQ + cv2.FileNode_FLOW)
    file.write('', 640)
    file.write('', 480)
    file.endWriteStruct()
    file.write('cameraMatrix', LENS5.matrix)
    file.write('cameraMatrix_std_dev', np.ones((4, 1)))
    file.write('dist_coeffs', np.array([LENS5.ros_distortion()]))
    file.write('dist_coeffs_std_dev', np.ones((5, 1)))
    file.write('avg_reprojection_error', 0.3)
    file.release()
    assert load_camera(tmp_path / 'CamParams.xml').camera == LENS5


def test_euroc_s_sensor_yaml(tmp_path):
    path = tmp_path / 'sensor.yaml'
    path.write_text('sensor_type: camera\nresolution: [640, 480]\ncamera_model: pinhole\n'
                    'intrinsics: [500, 501.5, 320, 240]\n'
                    'distortion_model: radial-tangential\n'
                    'distortion_coefficients: [-0.1, 1.0e-05, 0.001, -0.002]\n')
    assert load_camera(path).camera == Brown(SMALL, 500.0, 501.5, 320.0, 240.0, -0.1, 1e-5, 0.001,
                                             -0.002)


@pytest.mark.parametrize(('given', 'cx', 'cy', 'exchanged'), [
    ((640, 480), 320, 240, False), ((480, 640), 320, 240, True), ((480, 640), 240, 320, False),
    ((370, 1226), 604, 186, True), ((1226, 370), 604, 186, False),
    # a crop whose centre is far off
    ((640, 480), 600, 60, False)])
def test_width_and_height_that_are_exchanged_are_told(tmp_path, given, cx, cy, exchanged):
    path = tmp_path / 'camera.json'
    path.write_text(json.dumps({'K': [[700, 0, cx], [0, 702, cy], [0, 0, 1]], 'dist': [0] * 5,
                                'image_size': given}))
    if exchanged:
        with pytest.raises(InputError) as raised:
            load_camera(path)
        assert raised.value.code == 'E-CALIBRATION-EXCHANGED'
    else:
        assert load_camera(path).image_size == given


def test_a_folder_without_a_calibration_says_what_to_give(tmp_path):
    with pytest.raises(InputError) as raised:
        load_camera(tmp_path)
    assert raised.value.code == 'E-CALIBRATION-FOLDER' and 'result.json' in str(raised.value)
    (tmp_path / 'calibration.yaml').write_text(OPENCV)
    assert load_camera(tmp_path).camera == FULL
    np.savez(tmp_path / 'a.npz', mtx=FULL.matrix, dist=np.array([FULL.ros_distortion()]),
             size=np.zeros(9999))
    with pytest.raises(InputError) as raised:
        load_camera(tmp_path / 'a.npz')
    assert raised.value.code == 'E-CALIBRATION-NO-SIZE' and 'image_width' in str(raised.value)
    (tmp_path / 'b.npz').write_bytes((tmp_path / 'a.npz').read_bytes()[:900])
    with pytest.raises(InputError) as raised:
        load_camera(tmp_path / 'b.npz')
    assert raised.value.code == 'E-CALIBRATION-NPZ'


@pytest.mark.parametrize('model', EACH_MODEL)
def test_camera_info_beside_a_bag_s_pictures(tmp_path, model):
    lens = EACH_MODEL[model]
    path = write_bag(tmp_path / 'bag', [*images(drive(3), '/front/image_raw'),
                                        ('/front/camera_info', START, info_of(lens)),
                                        ('/depth/camera_info', START, info_of(TRUTH))])
    read = load_camera(path)
    assert read.camera == lens and read.name == f'{path}:/front/camera_info'
    for name in ('/front/image_raw', '/front/camera_info', 'front/image_raw'):
        assert load_camera(path, name=name) == load_camera(f'{path}:{name}') == read
    assert load_camera(next(path.glob('*.mcap'))).camera == lens
    assert load_camera(path, name='/depth/camera_info').camera == TRUTH


def test_camera_info_of_ros_1(tmp_path):
    path = tmp_path / 'drive.bag'
    message = info_of(BROWN, ROS1)
    with Writer1(path) as writer:
        topic = writer.add_connection('/camera_info', message.__msgtype__, typestore=ROS1)
        writer.write(topic, START, ROS1.serialize_ros1(message, message.__msgtype__))
    assert load_camera(path).camera == BROWN


@pytest.mark.parametrize(('infos', 'code', 'value'), [
    ({}, '', 'camera_info'),
    ({'/a/camera_info': {}, '/b/camera_info': {}}, '', '/a/camera_info, /b/camera_info'),
    ({'/a/camera_info': {'binning_x': 2}}, 'E-CALIBRATION-PART', 'binning'),
    ({'/a/camera_info': {'k': np.zeros(9)}}, 'E-CALIBRATION-EMPTY', 'K[0]'),
    ({'/a/camera_info': {'d': np.array([0.1] * 12)}}, '', 'with 12 coefficients'),
])
def test_a_bag_whose_camera_info_is_not_clear_is_refused(tmp_path, infos, code, value):
    path = write_bag(tmp_path / 'bag', [
        *images(drive(2)), *((topic, START, info_of(TRUTH, **changes))
                             for topic, changes in infos.items())])
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert not code or raised.value.code == code
    assert value in str(raised.value)


class Opened:
    """A pickle that would make a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), 'w')


def hostile_npz(kind, path):
    small = {'fx': np.array(1.0)}
    if kind == 'pickled':
        np.savez(path, allow_pickle=True, K=np.array([Opened(path.with_name('made'))]), **small)
    elif kind == 'parts':
        np.savez(path, **{f'a{n}': np.array(n) for n in range(1100)})
    else:
        with zipfile.ZipFile(path, 'w', getattr(zipfile, kind)) as packed:
            packed.writestr('K.npy', bytes(2**23))


@pytest.mark.parametrize('kind', ['pickled', 'parts', 'ZIP_BZIP2', 'ZIP_LZMA', 'ZIP_STORED'])
def test_a_hostile_npz_is_one_line_and_runs_nothing(tmp_path, kind):
    hostile_npz(kind, tmp_path / 'a.npz')
    # a part that is too large is not read
    code = 'E-CALIBRATION-FORMAT' if kind == 'ZIP_STORED' else 'E-CALIBRATION-NPZ'
    with refused(InputError, code, 'a.npz'):
        load_camera(tmp_path / 'a.npz')
    assert [each.name for each in tmp_path.iterdir()] == ['a.npz']
