# SPDX-License-Identifier: Apache-2.0
"""Camera files of SLAM programs and data sets: their own readers, and files as published."""
from __future__ import annotations

import json
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import cv2
import numpy as np
import pyarrow
import pycolmap
import pytest
import yaml
from made_calibration import EACH_MODEL, MOUNT, TRUTH
from pyarrow import feather, parquet
from refused import refused

from dashcalib_ros.camera import Brown, Fisheye, Radial, Rational
from dashcalib_ros.cli import main
from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.formats import export, load_camera
from dashcalib_ros.formats.load import load_pair
from dashcalib_ros.report import NamedCamera

POINTS = np.array([[0.1, -0.05, 1.0], [-0.5, 0.1, 1.0], [0.6, 0.12, 1.0], [0.0, 0.0, 1.0]])
PINHOLES = {name: lens for name, lens in EACH_MODEL.items() if name != 'fisheye'}


def seen(view, d, fisheye=False):
    """Return where OpenCV sees POINTS."""
    fx, fy, cx, cy = view
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return project(POINTS[:, None], np.zeros(3), np.zeros(3),
                   np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(d, float)
                   )[0].reshape(-1, 2)


def storage(lens, kind, folder):
    """Return an export as cv2.FileStorage opens it."""
    path = folder / 'camera.yaml'
    path.write_text(export(lens, kind))
    return cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)


def numbers(node, *keys):
    return [node.getNode(key).real() for key in keys]


@pytest.mark.parametrize('model', ['radial', 'brown', 'fisheye'])
def test_orb_slam_s_settings(model, tmp_path):
    lens, file = EACH_MODEL[model], storage(EACH_MODEL[model], 'orbslam', tmp_path)
    # Settings.cc: a real number or an int, and k3 only where it is
    fisheye = file.getNode('Camera.type').string() == 'KannalaBrandt8'
    keys = ['k1', 'k2', 'k3', 'k4'] if fisheye else ['k1', 'k2', 'p1', 'p2', 'k3']
    view, d = (numbers(file, *(f'Camera1.{key}' for key in each))
               for each in (('fx', 'fy', 'cx', 'cy'), keys))
    np.testing.assert_allclose(seen(view, d, fisheye), lens.project(POINTS), atol=1e-6)
    assert numbers(file, 'Camera.width', 'Camera.height') == [1242, 375]
    assert file.getNode('Camera.width').isInt() and file.getNode('Camera1.p1').isReal() != fisheye


@pytest.mark.parametrize('model', EACH_MODEL)
def test_camodocal_s_file(model, tmp_path):
    lens, file = EACH_MODEL[model], storage(EACH_MODEL[model], 'vins', tmp_path)
    kind = file.getNode('model_type').string()
    assert kind == {'radial': 'PINHOLE', 'fisheye': 'KANNALA_BRANDT'}.get(model, 'PINHOLE_FULL')
    view, d = file.getNode('projection_parameters'), file.getNode('distortion_parameters')
    if kind == 'KANNALA_BRANDT':
        got = seen(numbers(view, 'mu', 'mv', 'u0', 'v0'), numbers(view, 'k2', 'k3', 'k4', 'k5'),
                   True)
    else:
        more = ('k3', 'k4', 'k5', 'k6') if kind == 'PINHOLE_FULL' else ()
        got = seen(numbers(view, 'fx', 'fy', 'cx', 'cy'),
                   numbers(d, 'k1', 'k2', 'p1', 'p2', *more))
    np.testing.assert_allclose(got, lens.project(POINTS), atol=1e-6)
    assert numbers(file, 'image_width', 'image_height') == [1242, 375]


@pytest.mark.parametrize('model', ['radial', 'fisheye'])
def test_openvins_file(model, tmp_path):
    file = storage(EACH_MODEL[model], 'openvins', tmp_path)
    camera = file.getNode('cam0')
    view, d, size = ([each.at(n).real() for n in range(each.size())] for each in map(
        camera.getNode, ('intrinsics', 'distortion_coeffs', 'resolution')))
    fisheye = camera.getNode('distortion_model').string() == 'equidistant'
    np.testing.assert_allclose(seen(view, d, fisheye), EACH_MODEL[model].project(POINTS),
                               atol=1e-6)
    assert size == [1242, 375] and fisheye == (model == 'fisheye')
    assert camera.getNode('T_imu_cam').size() == 4


@pytest.mark.parametrize('model', ['radial', 'brown', 'fisheye'])
def test_stella_s_camera(model):
    data = yaml.safe_load(export(EACH_MODEL[model], 'stella'))['Camera']
    fisheye = data['model'] == 'fisheye'
    keys = ('k1', 'k2', 'k3', 'k4') if fisheye else ('k1', 'k2', 'p1', 'p2', 'k3')
    np.testing.assert_allclose(
        seen([data[key] for key in ('fx', 'fy', 'cx', 'cy')], [data[key] for key in keys],
             fisheye), EACH_MODEL[model].project(POINTS), atol=1e-6)
    assert (data['cols'], data['rows'], data['setup']) == (1242, 375, 'monocular')


@pytest.mark.parametrize('model', PINHOLES)
def test_droid_s_line_is_what_it_undistorts_with(model, tmp_path):
    path = tmp_path / 'calib.txt'
    path.write_text(export(PINHOLES[model], 'droid'))
    calib = np.loadtxt(path, delimiter=' ')
    np.testing.assert_allclose(seen(calib[:4], calib[4:]), PINHOLES[model].project(POINTS),
                               atol=1e-6)


@pytest.mark.parametrize('model', EACH_MODEL)
def test_colmap_s_database(model, tmp_path):
    lens, path = EACH_MODEL[model], tmp_path / 'database.db'
    path.write_bytes(export(lens, 'colmap-db'))
    folder = tmp_path / 'images'
    folder.mkdir()
    for number in range(2):
        cv2.imwrite(str(folder / f'{number}.png'), np.full((375, 1242), 100, np.uint8))
    options = pycolmap.ImageReaderOptions()
    options.existing_camera_id = 1
    pycolmap.import_images(path, folder, options=options)
    database = pycolmap.Database.open(path)
    (camera,), found = database.read_all_cameras(), database.read_all_images()
    database.close()
    np.testing.assert_allclose(camera.img_from_cam(POINTS) - 0.5, lens.project(POINTS), atol=1e-6)
    assert camera.has_prior_focal_length and [each.camera_id for each in found] == [1, 1]
    # and now that COLMAP has written the rest of it
    assert load_camera(path).camera == lens


@pytest.mark.parametrize('content', [b'', b'SQLite format 3\0' + bytes(500), b'no database'])
def test_a_database_without_cameras_is_one_line(content, tmp_path):
    path = tmp_path / 'database.db'
    path.write_bytes(content)
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert raised.value.code == 'E-COLMAP-BINARY'


@pytest.mark.parametrize('model', ['radial', 'brown', 'fisheye'])
def test_metashape_s_formula(model):
    """Of its manual: u = w / 2 + cx + x' f + x' b1, with the first pixel's corner at 0."""
    lens = EACH_MODEL[model]
    root = ElementTree.fromstring(export(lens, 'metashape'))
    value = {each.tag: each.text for each in root}
    get = {key: float(value.get(key, 0)) for key in (
        'f', 'cx', 'cy', 'b1', 'k1', 'k2', 'k3', 'k4', 'p1', 'p2', 'width', 'height')}
    x, y = POINTS[:, 0], POINTS[:, 1]
    if value['projection'] == 'fisheye':
        r = np.hypot(x, y)
        scale = np.where(r > 0, np.arctan(r) / np.maximum(r, 1e-12), 1)
        x, y = x * scale, y * scale
    r2 = x * x + y * y
    scale = 1 + r2 * (get['k1'] + r2 * (get['k2'] + r2 * (get['k3'] + r2 * get['k4'])))
    xd = x * scale + get['p1'] * (r2 + 2 * x * x) + 2 * get['p2'] * x * y
    yd = y * scale + get['p2'] * (r2 + 2 * y * y) + 2 * get['p1'] * x * y
    u = get['width'] / 2 + get['cx'] + xd * (get['f'] + get['b1'])
    v = get['height'] / 2 + get['cy'] + yd * get['f']
    np.testing.assert_allclose(np.stack([u, v], 1) - 0.5, lens.project(POINTS), atol=1e-6)


@pytest.mark.parametrize('model', ['radial', 'brown'])
def test_matlab_counts_from_one(model):
    struct, lens = json.loads(export(EACH_MODEL[model], 'matlab')), EACH_MODEL[model]
    assert struct['ImageSize'] == [375, 1242]
    k1, k2, k3 = struct['RadialDistortion']
    d = [k1, k2, *struct['TangentialDistortion'], k3]
    # cameraIntrinsicsToOpenCV subtracts 1
    view = [*struct['FocalLength'], *(each - 1 for each in struct['PrincipalPoint'])]
    np.testing.assert_allclose(seen(view, d), lens.project(POINTS), atol=1e-6)
    np.testing.assert_array_equal(np.transpose(struct['IntrinsicMatrix']), struct['K'])


def test_calibration_tools_take_autoware_s_file(tmp_path):
    """As camera_model.py's from_dict() reads it."""
    data = yaml.safe_load(export(EACH_MODEL['brown'], 'autoware').partition('---')[2])
    k, d = (np.reshape(each['data'], (each['rows'], each['cols'])) for each in (
        data['camera_matrix'], data['distortion_coefficients']))
    np.testing.assert_allclose(
        cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), k, d)[0].reshape(-1, 2),
        EACH_MODEL['brown'].project(POINTS), atol=1e-6)
    assert (data['image_width'], data['image_height']) == (1242, 375)


def test_vision_pilot_s_homography(tmp_path):
    """As gen_carla_homography.py has it: pixel to the road, metres ahead and to the left."""
    ideal = TRUTH.without_distortion()
    with pytest.raises(ConfigError) as raised:
        export(ideal, 'vision_pilot')
    assert raised.value.code == 'E-EXPORT-NO-MOUNTING'
    with pytest.raises(ConfigError) as raised:
        export(NamedCamera('a', ideal, mount=replace(MOUNT, height_m=None)), 'vision_pilot')
    assert raised.value.code == 'E-EXPORT-NO-HEIGHT'
    for mount in (MOUNT, replace(MOUNT, yaw_left_deg=0.0, pitch_up_deg=0.0, roll_right_deg=3.0)):
        file = storage(NamedCamera('a', ideal, mount=mount), 'vision_pilot', tmp_path)
        h = file.getNode('H').mat()
        road = np.array([[8.0, 0, 0], [20, 3, 0], [20, -3, 0], [60, 1, 0]])
        pixels = ideal.project((road - [0, 0, mount.height_m]) @ mount.rotation)
        found = cv2.perspectiveTransform(pixels[None], h)[0]
        np.testing.assert_allclose(found, road[:, :2], atol=1e-6)


# files as they are published, and what they mean
EUROC = [458.654, 457.296, 367.215, 248.375]
EUROC_D = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
EUROC_LENS = Brown((752, 480), *EUROC, *EUROC_D, 0.0)
FISHEYE = Fisheye((752, 480), 463.3, 461.9, 361.5, 231.1, -0.0028, 0.024, -0.043, 0.031)
ORB2 = """%YAML:1.0

# Camera Parameters. Adjust them!
Camera.fx: 718.856
Camera.fy: 718.856
Camera.cx: 607.1928
Camera.cy: 185.2157

Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0

Camera.fps: 10.0
Camera.RGB: 1
"""
KITTI_00 = Radial((1241, 376), 718.856, 718.856, 607.1928, 185.2157)
VINS = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: camera
image_width: 752
image_height: 480
projection_parameters:
   k2: -0.0028
   k3: 0.024
   k4: -0.043
   k5: 0.031
   mu: 463.3
   mv: 461.9
   u0: 361.5
   v0: 231.1
"""
STELLA = """# EuRoC
Camera:
  name: "EuRoC monocular"
  setup: "monocular"
  model: "perspective"
  fx: 458.654
  fy: 457.296
  cx: 367.215
  cy: 248.375
  k1: -0.28340811
  k2: 0.07395907
  p1: 0.00019359
  p2: 1.76187114e-05
  k3: 0.0
  fps: 20.0
  cols: 752
  rows: 480
Preprocessing:
  min_size: 800
"""
SVO = f"""label: "Euroc"
cameras:
- camera:
    label: cam0
    image_height: 480
    image_width: 752
    type: pinhole
    intrinsics:
      cols: 1
      rows: 4
      data: {EUROC}
    distortion:
      type: radial-tangential
      parameters:
        cols: 1
        rows: 4
        data: {EUROC_D}
imu_params:
  g: 9.8082
"""
VIKIT = """cam0:
  cam_model: PinholeEquidistant
  cam_width: 752
  cam_height: 480
  cam_fx: 463.3
  cam_fy: 461.9
  cam_cx: 361.5
  cam_cy: 231.1
  cam_d0: -0.0028
  cam_d1: 0.024
  cam_d2: -0.043
  cam_d3: 0.031
"""
MATLAB = json.dumps({
    'ImageSize': [480, 752], 'Skew': 0, 'EstimateSkew': False,
    'IntrinsicMatrix': [[458.654, 0, 0], [0, 457.296, 0], [368.215, 249.375, 1]],
    'RadialDistortion': EUROC_D[:2], 'TangentialDistortion': EUROC_D[2:],
    'RotationVectors': [[0.1, 0.2, 0.3]], 'WorldUnits': 'mm'})
METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk><sensors>
 <sensor id="0" label="front" type="frame">
  <calibration type="frame" class="initial"><resolution width="752" height="480"/><f>450</f>
  </calibration>
  <calibration type="frame" class="adjusted"><resolution width="752" height="480"/>
   <f>457.296</f><cx>-8.285</cx><cy>8.875</cy><b1>1.358</b1><k1>-0.28340811</k1>
   <k2>0.07395907</k2><p1>1.76187114e-05</p1><p2>0.00019359</p2></calibration>
 </sensor></sensors></chunk></document>
"""
KITTI_RAW = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_00: 1.392000e+03 5.120000e+02
K_00: 9.842439e+02 0.000000e+00 6.900000e+02 0.000000e+00 9.808141e+02 2.331966e+02 0 0 1
D_00: -3.728755e-01 2.037299e-01 2.219027e-03 1.383707e-03 -7.233722e-02
R_00: 1 0 0 0 1 0 0 0 1
S_rect_00: 1.242000e+03 3.750000e+02
P_rect_00: 7.215377e+02 0 6.095593e+02 0 0 7.215377e+02 1.728540e+02 0 0 0 1 0
S_01: 1.392000e+03 5.120000e+02
K_01: 9.895267e+02 0 7.020000e+02 0 9.878386e+02 2.455590e+02 0 0 1
D_01: -3.644661e-01 1.790019e-01 1.148107e-03 -6.298563e-04 -5.314062e-02
S_rect_01: 1.242000e+03 3.750000e+02
P_rect_01: 7.215377e+02 0 6.095593e+02 -3.875744e+02 0 7.215377e+02 1.728540e+02 0 0 0 1 0
"""
RAW = Brown((1392, 512), 984.2439, 980.8141, 690.0, 233.1966, -0.3728755, 0.2037299, 0.002219027,
            0.001383707, -0.07233722)
RECTIFIED = Radial((1242, 375), 721.5377, 721.5377, 609.5593, 172.854)
ODOMETRY = """P0: 7.188560e+02 0 6.071928e+02 0 0 7.188560e+02 1.852157e+02 0 0 0 1 0
P1: 7.188560e+02 0 6.071928e+02 -3.861448e+02 0 7.188560e+02 1.852157e+02 0 0 0 1 0
Tr: 4.2e-04 -9.9e-01 -8.0e-03 -1.1e-02 -7.2e-03 8.0e-03 -9.9e-01 -5.4e-02 9.9e-01 4.8e-04 0 -0.29
"""
NUSCENES = [
    {'token': 'a1', 'sensor_token': 's1', 'translation': [0, 0, 0], 'rotation': [1, 0, 0, 0],
     'camera_intrinsic': []},
    {'token': 'a2', 'sensor_token': 's2', 'translation': [1.7, 0, 1.5], 'rotation': [1, 0, 0, 0],
     'camera_intrinsic': [[1266.4, 0, 816.3], [0, 1266.4, 491.5], [0, 0, 1]]},
    {'token': 'a3', 'sensor_token': 's2', 'translation': [1.7, 0, 1.5], 'rotation': [1, 0, 0, 0],
     'camera_intrinsic': [[1252.8, 0, 826.6], [0, 1252.8, 470.0], [0, 0, 1]]}]
FRONT = Radial((1600, 900), 1266.4, 1266.4, 816.3, 491.5)
ARGOVERSE = {'camera_data_': [{'key': 'image_raw_ring_front_center', 'value': {
    'focal_length_x_px_': 1392.1, 'focal_length_y_px_': 1392.1, 'focal_center_x_px_': 980.2,
    'focal_center_y_px_': 604.4, 'skew_': 0, 'distortion_coefficients_': [-0.17, 0.12, -0.028]}}]}
WAYMO = {'name': 'FRONT', 'intrinsic': [2055.6, 2055.6, 939.7, 641.1, 0.03, -0.34, 0.001, -0.0003,
                                        0.0], 'width': 1920, 'height': 1280}
WAYMO_LENS = Brown((1920, 1280), 2055.6, 2055.6, 939.7, 641.1, 0.03, -0.34, 0.001, -0.0003, 0.0)
CITYSCAPES = {'extrinsic': {'baseline': 0.209313, 'pitch': 0.038, 'roll': 0.0, 'x': 1.7, 'y': 0.1,
                            'yaw': -0.0195, 'z': 1.22},
              'intrinsic': {'fx': 2262.52, 'fy': 2265.30, 'u0': 1096.98, 'v0': 513.137}}
A2D2 = {'cameras': {'front_center': {
    'CamMatrix': [[1687.33, 0, 965.43], [0, 1783.10, 684.26], [0, 0, 1]],
    'CamMatrixOriginal': [[1646.7, 0, 967.0], [0, 1646.9, 700.0], [0, 0, 1]],
    'Distortion': [[-0.35, 0.2, -0.0001, 0.0002, -0.07]], 'Lens': 'Telecam',
    'Resolution': [1920, 1208], 'tstamp_delay': 0}}}
COMMA = """
@dataclass(frozen=True)
class CameraConfig:
  width: int

_neo_config = DeviceCameraConfig(CameraConfig(1164, 874, 910.0), CameraConfig(816, 612, 650.0), x)
_os_fisheye = CameraConfig(2688 // 2, 1520 // 2, 567.0 / 4 * 3)
"""


@pytest.mark.parametrize(('text', 'name', 'size', 'wanted'), [
    (ORB2, None, (1241, 376), KITTI_00), (VINS, None, None, FISHEYE),
    (STELLA, None, None, EUROC_LENS), (SVO, None, None, EUROC_LENS), (SVO, '0', None, EUROC_LENS),
    (VIKIT, None, None, FISHEYE), (MATLAB, None, None, EUROC_LENS),
    (METASHAPE, None, None, EUROC_LENS),
    (' '.join(map(repr, EUROC + EUROC_D)), None, (752, 480), EUROC_LENS),
    ('718.856 718.856 607.1928 185.2157\n', None, (1241, 376), KITTI_00),
    (KITTI_RAW, 'raw_00', None, RAW), (KITTI_RAW, 'rect_00', None, RECTIFIED),
    (KITTI_RAW, '00', (1392, 512), RAW), (KITTI_RAW, '00', (1242, 375), RECTIFIED),
    (ODOMETRY, 'P0', (1241, 376), KITTI_00), (ODOMETRY, '0', (1241, 376), KITTI_00),
    (json.dumps(NUSCENES), 'a2', (1600, 900), FRONT),
    (json.dumps(ARGOVERSE), 'ring_front_center', (1920, 1200),
     Radial((1920, 1200), 1392.1, 1392.1, 980.2, 604.4)),
    (json.dumps(WAYMO), None, None, WAYMO_LENS), (json.dumps([WAYMO]), 'FRONT', None, WAYMO_LENS),
    (json.dumps({'intrinsic': WAYMO['intrinsic']}), None, (1920, 1280), WAYMO_LENS),
    (json.dumps(CITYSCAPES), None, None,
     Radial((2048, 1024), 2262.52, 2265.3, 1096.98, 513.137)),
    (json.dumps(A2D2), 'front_center', None, Brown(
        (1920, 1208), 1646.7, 1646.9, 967.0, 700.0, -0.35, 0.2, -0.0001, 0.0002, -0.07)),
    (json.dumps(A2D2), 'front_center/undistorted', None,
     Radial((1920, 1208), 1687.33, 1783.1, 965.43, 684.26)),
    (COMMA, 'neo_config', None, Radial((1164, 874), 910.0, 910.0, 582.0, 437.0)),
    (COMMA, 'os_fisheye', None, Radial((1344, 760), 425.25, 425.25, 672.0, 380.0))])
def test_a_file_as_it_is_published(text, name, size, wanted, tmp_path):
    path = tmp_path / 'calib'
    path.write_text(text)
    if size is not None:
        with pytest.raises(InputError) as raised:
            load_camera(path, name=name)
        assert raised.value.code == 'E-CALIBRATION-NO-SIZE'
    found = load_camera(path if name is None else f'{path}:{name}', image_size=size).camera
    np.testing.assert_allclose(found.params, wanted.params[:len(found.params)], rtol=1e-12)
    assert found.image_size == wanted.image_size and not any(wanted.params[len(found.params):])


def test_nuscenes_channels_are_beside_the_cameras(tmp_path):
    path = tmp_path / 'calibrated_sensor.json'
    path.write_text(json.dumps(NUSCENES))
    (tmp_path / 'sensor.json').write_text(json.dumps([
        {'token': 's1', 'channel': 'LIDAR_TOP'}, {'token': 's2', 'channel': 'CAM_FRONT'}]))
    assert load_camera(path, name='CAM_FRONT/1', image_size=(1600, 900)).camera == FRONT
    path.write_text(json.dumps(NUSCENES[:2]))
    assert load_camera(path, name='CAM_FRONT', image_size=(1600, 900)).camera == FRONT


def test_tables_of_argoverse_2_and_waymo(tmp_path, monkeypatch):
    feather.write_feather(pyarrow.table({
        'sensor_name': ['ring_front_center'], 'fx_px': [1782.7], 'fy_px': [1782.7],
        'cx_px': [776.8], 'cy_px': [1023.9], 'k1': [-0.24], 'k2': [-0.21], 'k3': [0.32],
        'height_px': [2048], 'width_px': [1550]}), str(tmp_path / 'intrinsics.feather'))
    # its pictures have no distortion any more
    assert load_camera(tmp_path / 'intrinsics.feather').camera == Radial(
        (1550, 2048), 1782.7, 1782.7, 776.8, 1023.9)
    start = '[CameraCalibrationComponent]'
    names = ('f_u', 'f_v', 'c_u', 'c_v', 'k1', 'k2', 'p1', 'p2', 'k3')
    parquet.write_table(pyarrow.table({
        'key.segment_context_name': ['1'], 'key.camera_name': [1],
        **{f'{start}.intrinsic.{name}': [value] for name, value in
           zip(names, WAYMO['intrinsic'], strict=True)},
        f'{start}.width': [1920], f'{start}.height': [1280]}), tmp_path / 'camera.parquet')
    assert load_camera(f'{tmp_path / "camera.parquet"}:FRONT').camera.params.tolist() == (
        load_camera(tmp_path / 'camera.parquet').camera.params.tolist()) == (
        WAYMO_LENS.params[:len(load_camera(tmp_path / 'camera.parquet').camera.params)].tolist())
    (tmp_path / 'a.parquet').write_bytes(b'PAR1 no')
    with refused(InputError, 'E-CALIBRATION-TABLE', 'a.parquet'):
        load_camera(tmp_path / 'a.parquet')
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    with refused(InputError, 'E-CALIBRATION-ARROW', 'a.parquet'):
        load_camera(tmp_path / 'a.parquet')


def test_vipe_s_intrinsics_are_of_all_frames(tmp_path):
    path, rows = tmp_path / 'drive.npz', np.tile(np.float32([700, 701, 640.5, 360]), (2000, 1))
    np.savez(path, data=rows, inds=np.arange(2000))
    assert load_camera(path, image_size=(1280, 720)).camera == Radial(
        (1280, 720), 700.0, 701.0, 640.5, 360.0)
    (tmp_path / 'drive_camera.txt').write_text('0: MEI\n1: MEI\n')
    with pytest.raises(InputError) as raised:
        load_camera(path, image_size=(1280, 720))
    assert raised.value.code == 'E-LENS-MODEL'
    (tmp_path / 'drive_camera.txt').unlink()
    rows[7] += 1
    np.savez(path, data=rows, inds=np.arange(2000))
    with pytest.raises(InputError) as raised:
        load_camera(path, image_size=(1280, 720))
    assert raised.value.code == 'E-CALIBRATION-VARIES'


def test_one_of_two_files_may_lack_the_size(tmp_path):
    (tmp_path / 'calib.txt').write_text(ODOMETRY)
    (tmp_path / 'mine.json').write_text(json.dumps({
        'fx': 719, 'fy': 719, 'cx': 607, 'cy': 185, 'k1': 0, 'k2': 0, 'width': 1241,
        'height': 376}))
    given = (f'{tmp_path / "calib.txt"}:0', tmp_path / 'mine.json')
    for pair in (given, given[::-1]):
        assert {each.image_size for each in load_pair(*pair)} == {(1241, 376)}
    with pytest.raises(InputError) as raised:
        load_pair(given[0], given[0])
    assert raised.value.code == 'E-CALIBRATION-NO-SIZE'


def test_check_takes_the_size_of_the_pictures(tmp_path, capsys):
    folder = tmp_path / 'image_00' / 'data'
    folder.mkdir(parents=True)
    for number in range(3):
        cv2.imwrite(str(folder / f'{number:010}.png'), np.full((375, 1242), 100, np.uint8))
    path = tmp_path / 'calib_cam_to_cam.txt'
    path.write_text(KITTI_RAW)
    # too short a drive to tell
    assert main(['check', f'{path}:00', str(folder), '--json']) == 3
    assert json.loads(capsys.readouterr().out)['answer'] == 'cannot tell'
    assert main(['export', f'{path}:00', '--to', 'ros']) == 2
    assert 'rect_00' in capsys.readouterr().err
    assert main(['export', f'{path}:rect_00', '--to', 'opencv']) == 0


# a lens that ROS has not, and a point of the picture with its ray by its authors' formula
SIZE = (752, 480)
KALIBR_OMNI = {'cam0': {
    'camera_model': 'omni', 'intrinsics': [1.2, 700.0, 701.0, 370.0, 235.0],
    'distortion_model': 'radtan', 'distortion_coeffs': [-0.05, 0.01, 0.001, -0.001],
    'resolution': list(SIZE)}}
KALIBR_DS = {'cam0': {
    'camera_model': 'ds', 'intrinsics': [-0.2, 0.57, 300.0, 301.0, 370.0, 235.0],
    'distortion_model': 'none', 'distortion_coeffs': [], 'resolution': list(SIZE)}}
KALIBR_EUCM = {'cam0': {**KALIBR_DS['cam0'], 'camera_model': 'eucm',
                        'intrinsics': [0.6, 1.1, 350.0, 351.0, 370.0, 235.0]}}
KALIBR_FOV = {'cam0': {**KALIBR_DS['cam0'], 'camera_model': 'pinhole', 'distortion_model': 'fov',
                       'distortion_coeffs': [0.93], 'intrinsics': [350.0, 351.0, 370.0, 235.0]}}
MEI = """%YAML:1.0
---
model_type: MEI
image_width: 752
image_height: 480
mirror_parameters:
   xi: 1.2
distortion_parameters:
   k1: -0.05
   k2: 0.01
   p1: 0.001
   p2: -0.001
projection_parameters:
   gamma1: 700.
   gamma2: 701.
   u0: 370.
   v0: 235.
"""
DIVISION = STELLA.replace('perspective', 'radial_division').replace('k1:', 'distortion:')
OCAM = {'ImageSize': [480, 752], 'MappingCoefficients': [350.0, -9e-4, 0, 0],
        'DistortionCenter': [371.0, 236.0], 'StretchMatrix': [[1, 0], [0, 1]]}


def omni(points):
    """Return the pixels that Kalibr's omni and camodocal's MEI have, by Mei's formula."""
    x, y, z = (points / np.linalg.norm(points, axis=1, keepdims=True)).T
    x, y = x / (z + 1.2), y / (z + 1.2)
    r2 = x * x + y * y
    scale = 1 - 0.05 * r2 + 0.01 * r2 * r2
    return np.stack([
        700 * (x * scale + 2 * 0.001 * x * y - 0.001 * (r2 + 2 * x * x)) + 370,
        701 * (y * scale + 0.001 * (r2 + 2 * y * y) - 2 * 0.001 * x * y) + 235], 1)


def double_sphere(points):
    """Return the pixels by the formula of Usenko et al."""
    x, y, z = points.T
    d1 = np.sqrt(x * x + y * y + z * z)
    d2 = np.sqrt(x * x + y * y + (-0.2 * d1 + z)**2)
    down = 0.57 * d2 + 0.43 * (-0.2 * d1 + z)
    return np.stack([300 * x / down + 370, 301 * y / down + 235], 1)


def colmap(model, *params):
    camera = pycolmap.Camera(model=model, width=752, height=480,
                             params=[350.0, 351.0, 370.5, 235.5, *params])
    return lambda points: camera.img_from_cam(points) - 0.5


def division(points):
    """Return the pixels whose undistorted places stella_vslam has at the points."""
    lens = colmap('DIVISION', -0.28340811)
    return (lens(points) - [370, 235]) / [350, 351] * EUROC[:2] + EUROC[2:]


def scaramuzza(points):
    """Return the pixels of which MATLAB says the points: (u, v, 350 - 9e-4 (u^2 + v^2))."""
    x, y, z = points.T
    r = np.hypot(x, y)
    rho = (-z / r + np.sqrt((z / r)**2 + 4 * 9e-4 * 350)) / (2 * 9e-4)
    return np.stack([x / r * rho + 370, y / r * rho + 235], 1)


CASES = {
    'kalibr omni': (yaml.safe_dump(KALIBR_OMNI), omni), 'camodocal mei': (MEI, omni),
    'kalibr ds': (yaml.safe_dump(KALIBR_DS), double_sphere),
    'kalibr eucm': (yaml.safe_dump(KALIBR_EUCM), colmap('EUCM', 0.6, 1.1)),
    'kalibr fov': (yaml.safe_dump(KALIBR_FOV), colmap('FOV', 0.93)),
    'stella division': (DIVISION, division),
    'matlab fisheye': (json.dumps(OCAM), scaramuzza),
    **{f'colmap {model}': (f'1 {model} 752 480 350 351 370.5 235.5 {" ".join(map(str, params))}',
                           colmap(model, *params))
       for model, params in (
           ('FOV', (0.93,)), ('EUCM', (0.6, 1.1)), ('DIVISION', (-0.15,)),
           ('THIN_PRISM_FISHEYE', (0.01, 0.002, 0.001, -0.001, 0.001, 0.0005, 0.002, 0.001)))}}


@pytest.mark.parametrize('case', CASES)
def test_the_nearest_camera_says_by_how_much_it_is_off(case, tmp_path, capsys):
    text, project = CASES[case]
    path = tmp_path / 'calib'
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert raised.value.code == 'E-LENS-MODEL'
    found = load_camera(path, nearest=True)
    (notice,) = found.warnings
    assert notice.code == 'E-LENS-NEAREST' and found.image_size == SIZE
    rms, worst = (float(each.split()[-1]) for each in str(notice).split(' px')[:2])
    # by the program's own formula, over the rays that the picture has
    u, v = np.meshgrid(np.linspace(0, 751, 40), np.linspace(0, 479, 30))
    pixels = np.stack([u.ravel(), v.ravel()], 1)
    rays = found.camera.rays(pixels)
    off = np.linalg.norm(project(rays) - pixels, axis=1)
    assert np.sqrt(np.mean(off**2)) < 1.3 * rms + 0.01 and off.max() < 2 * worst + 0.02
    assert rms < 0.5
    assert main(['export', str(path), '--nearest', '--to', 'ros']) == 0
    assert 'px RMS' in capsys.readouterr().err


def test_a_lens_of_ours_needs_no_nearest_one(tmp_path):
    (tmp_path / 'calib').write_text(STELLA)
    plain, same = (load_camera(tmp_path / 'calib', nearest=nearest) for nearest in (False, True))
    assert plain == same and not same.warnings


def test_eight_and_more_coefficients(tmp_path):
    """Eight are a model of ROS; of twelve, thin prisms are not."""
    data = {'camera_matrix': [[500, 0, 370], [0, 500, 235], [0, 0, 1]], 'image_size': list(SIZE)}
    d = [-0.1, 0.01, 0.001, -0.001, 0.003, 0.02, -0.003, 0.001]
    path = tmp_path / 'a.json'
    path.write_text(json.dumps({**data, 'dist_coeffs': d}))
    assert isinstance(load_camera(path).camera, Rational)
    prisms = [*d, 0.002, 0.0, 0.001, 0.0]
    path.write_text(json.dumps({**data, 'dist_coeffs': prisms}))
    with pytest.raises(InputError) as raised:
        load_camera(path)
    assert raised.value.code == 'E-LENS-MODEL'
    camera = load_camera(path, nearest=True).camera
    rays = camera.rays(np.array([[370.0, 235.0], [700.0, 400.0]]))
    exact = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera_matrix(data),
                              np.array(prisms))[0].reshape(-1, 2)
    np.testing.assert_allclose(exact, [[370, 235], [700, 400]], atol=2)


def camera_matrix(data):
    return np.array(data['camera_matrix'], float)
