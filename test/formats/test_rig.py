# SPDX-License-Identifier: Apache-2.0
"""rig.json: what is written is read back, and the contract of its keys."""
from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pycolmap
import pytest
import yaml
from made_calibration import EACH_MODEL, MOUNT, TRUTH, calibration_of, make_calibration
from made_rig import front_left_rear
from scipy.spatial.transform import Rotation

from dashcalib_ros.camera.rotation import OPTICAL
from dashcalib_ros.errors import ConfigError, InputError, Notice
from dashcalib_ros.formats import calibrators, photogrammetry
from dashcalib_ros.formats.rig import RIG_FORMATS, load_rig, placed_cameras, rig_json
from dashcalib_ros.rig.placed import (
    PlacedCamera,
    Visible,
)

SURE = ('accepted', 'accepted', 'accepted')
RIG = front_left_rear(PlacedCamera(
    'left/result.json', 'accepted', (1.0, 70.0, -2.0), (0.05, 0.06, 0.04), (0.5, 0.0, -0.2),
    (0.02, 1.0, 0.02), 0.03, 0.001,
    Visible(SURE, ('accepted', 'not visible', 'accepted'), 'accepted'),
    (Notice('E-RIG-TRANSLATION', 'no height'),)), 'another drive')


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


# the others of the same car: a camera that looks back, and one without metres
BACK = PlacedCamera('rear/result.json', 'weak', (2.0, 177.5, 1.5), (0.05, 0.06, 0.04),
                    (0.3, -0.2, -2.0), (0.02, 0.5, 0.02))
LEFT = (1.0, 70.0, -2.0)


def poses(camera):
    """Return (4, 4) from the base's optical axes to a camera's."""
    found = np.eye(4)
    found[:3, :3] = Rotation.from_rotvec(camera.rotation_deg, degrees=True).as_matrix()
    found[:3, 3] = camera.translation_m or 0.0
    return found


def placed(mount=MOUNT, **cameras):
    """Return a rig of front, left and rear, and its cameras as files have them."""
    rig = replace(RIG, cameras={**RIG.cameras, 'rear': BACK} | cameras)
    calibrations = {name: make_calibration(mount=mount) for name in rig.cameras}
    calibrations['left'] = calibration_of(EACH_MODEL['brown'])
    return rig, placed_cameras(rig, calibrations)


@pytest.mark.parametrize('mount', [MOUNT, None])
def test_urdf_and_transforms_have_each_camera_where_it_sits(mount):
    rig, found = placed(mount)
    root = ElementTree.fromstring(RIG_FORMATS['rig.urdf'](found))
    steps = {}
    for joint in root.findall('joint'):
        xyz, rpy = ([float(value) for value in joint.find('origin').get(key).split()]
                    for key in ('xyz', 'rpy'))
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_euler('xyz', rpy).as_matrix(), xyz
        steps[joint.find('child').get('link')] = joint.find('parent').get('link'), step
    links = {each.get('name') for each in root.findall('link')}
    assert links == {*steps, 'base_link' if mount else 'front_optical_frame'}
    for line in RIG_FORMATS['static_transforms.sh'](found).splitlines():
        if line.startswith('ros2'):
            words = shlex.split(line)
            value = dict(zip(words[4::2], words[5::2], strict=False))
            parent, step = steps[value['--child-frame-id']]
            assert value['--frame-id'] == parent
            turn = Rotation.from_quat([float(value[f'--q{axis}']) for axis in 'xyzw'])
            np.testing.assert_allclose(turn.as_matrix(), step[:3, :3], atol=1e-7)
            np.testing.assert_allclose([float(value[f'--{axis}']) for axis in 'xyz'],
                                       step[:3, 3], atol=1e-7)
    for name in ('left', 'rear'):
        parent, step = steps[f'{name}_optical_frame']
        assert parent == 'front_optical_frame'
        np.testing.assert_allclose(step @ poses(rig.cameras[name]), np.eye(4), atol=1e-7)
    if mount:
        np.testing.assert_allclose(steps['front_optical_frame'][1][:3, :3], mount.rotation,
                                   atol=1e-7)


def test_kalibr_has_the_chain():
    nowhere = replace(BACK, translation_m=None, translation_sigma_m=None)
    rig, found = placed(rear=nowhere)
    with pytest.raises(ConfigError):
        # Kalibr has no k3
        RIG_FORMATS['camchain.yaml'](found)
    found[1] = replace(found[1], camera=EACH_MODEL['fisheye'])
    text = RIG_FORMATS['camchain.yaml'](found)
    data = yaml.safe_load(text)
    read = {name: read() for name, read in calibrators.kalibr(data, Path('camchain.yaml')).items()}
    assert list(read) == ['cam0', 'cam1', 'cam2'] and read['cam0'].params == pytest.approx(
        TRUTH.widened().params[:len(read['cam0'].params)])
    chain = np.eye(4)
    for number, name in enumerate(('front', 'left', 'rear')):
        each = data[f'cam{number}']
        assert each['rostopic'] == f'/{name}/image_raw'
        chain = np.array(each.get('T_cn_cnm1', np.eye(4))) @ chain
        np.testing.assert_allclose(chain, poses(rig.cameras[name]), atol=1e-9)
    assert '# rear' in text and '# left' not in text


def test_colmap_reads_the_rig(tmp_path):
    nowhere = replace(BACK, translation_m=None, translation_sigma_m=None)
    rig, found = placed()
    for name, cameras in (('with', found), ('without', placed(rear=nowhere)[1])):
        (tmp_path / name).write_text(RIG_FORMATS['rig_config.json'](cameras))
    [read] = pycolmap.read_rig_config(tmp_path / 'with')
    assert [each.image_prefix for each in read.cameras] == ['front/', 'left/', 'rear/']
    assert [each.ref_sensor for each in read.cameras] == [True, False, False]
    for each, name in zip(read.cameras[1:], ('left', 'rear'), strict=True):
        np.testing.assert_allclose(each.cam_from_rig.matrix(), poses(rig.cameras[name])[:3],
                                   atol=1e-9)
    # COLMAP's pixels begin at the first one's corner
    assert read.cameras[0].camera.params[2] == pytest.approx(TRUTH.cx + 0.5)
    [read] = pycolmap.read_rig_config(tmp_path / 'without')
    assert read.cameras[2].cam_from_rig is None and read.cameras[1].cam_from_rig is not None


def test_nerfstudio_has_a_frame_of_each_camera():
    rig, found = placed()
    data = json.loads(RIG_FORMATS['transforms.json'](found))
    read = photogrammetry.nerfstudio(data, Path('transforms.json'))
    assert list(read) == ['front/', 'left/', 'rear/']
    assert read['left/']().cx == pytest.approx(EACH_MODEL['brown'].cx)
    for frame, name in zip(data['frames'], ('front', 'left', 'rear'), strict=True):
        pose = np.array(frame['transform_matrix'])
        # nerfstudio's cameras look along -z, y upwards; the car's z is upwards
        sight, centre = -pose[:3, 2], pose[:3, 3]
        own = np.linalg.inv(poses(rig.cameras[name]))
        np.testing.assert_allclose(sight, MOUNT.rotation @ own[:3, 2], atol=1e-9)
        np.testing.assert_allclose(centre, MOUNT.rotation @ own[:3, 3], atol=1e-9)
        assert pose[2, 1] > 0.9 and np.linalg.det(pose) == pytest.approx(1.0)
    assert -data['frames'][2]['transform_matrix'][0][2] < -0.9


def test_what_a_program_cannot_have_is_no_file_of_it():
    rig, _ = placed()
    lenses = {'front': TRUTH, 'left': EACH_MODEL['fisheye'], 'rear': TRUTH}
    mixed = placed_cameras(rig, {name: calibration_of(lens) for name, lens in lenses.items()})
    none = placed_cameras(rig, {name: make_calibration('refused') for name in lenses})
    for name, cameras, code in (('transforms.json', mixed, 'E-RIG-MIXED'),
                                ('camchain.yaml', none, 'E-RIG-NO-LENS'),
                                ('rig_config.json', none, 'E-RIG-NO-LENS')):
        with pytest.raises(ConfigError) as raised:
            RIG_FORMATS[name](cameras)
        assert raised.value.code == code
    # places need no lens; without a mounting the base looks ahead
    assert RIG_FORMATS['rig.urdf'](none).count('<joint') == 2
    frame = json.loads(RIG_FORMATS['transforms.json'](
        [replace(each, camera=TRUTH) for each in mixed]))['frames'][0]
    np.testing.assert_allclose(np.array(frame['transform_matrix'])[:3, :3],
                               OPTICAL @ np.diag([1, -1, -1]))


def test_a_camera_without_a_place_is_in_no_file():
    found = placed_cameras(RIG, {name: make_calibration() for name in RIG.cameras})
    assert [each.name for each in found] == ['front', 'left']
