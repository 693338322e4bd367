# SPDX-License-Identifier: Apache-2.0
"""The mounting as URDF and as a static transform, by the rules of both."""
from __future__ import annotations

import shlex
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from made_calibration import MOUNT, TRUTH, make_calibration
from scipy.spatial.transform import Rotation

from dashcalib_ros.errors import ConfigError, Notice
from dashcalib_ros.formats import calibration_yaml, export, load_camera, result_json
from dashcalib_ros.judge.calibration import OPTICAL
from dashcalib_ros.report import NamedCamera

ROLLED = replace(MOUNT, yaw_left_deg=-178.5, roll_right_deg=-4.0)


def joints(text):
    """Return the parent, place and rotation (3, 3) of each child, by URDF's rule."""
    found = {}
    for joint in ElementTree.fromstring(text).findall('joint'):
        assert joint.get('type') == 'fixed'
        xyz, rpy = ([float(value) for value in joint.find('origin').get(key).split()]
                    for key in ('xyz', 'rpy'))
        # about the fixed axes: x, then y, then z
        found[joint.find('child').get('link')] = (
            joint.find('parent').get('link'), xyz, Rotation.from_euler('xyz', rpy).as_matrix())
    return found


@pytest.mark.parametrize('mount', [MOUNT, ROLLED, replace(MOUNT, height_m=None)])
def test_urdf_has_the_rotation_of_the_mounting(mount):
    text = export(NamedCamera('given', TRUTH, mount=mount), 'urdf')
    found = joints(text)
    base, place, turned = found['camera_link']
    assert base == 'base_link' and place == [0, 0, mount.height_m or 0]
    link, origin, optical = found['camera_optical_frame']
    assert link == 'camera_link' and origin == [0, 0, 0]
    # REP-103: from optical axes to those of the link
    np.testing.assert_allclose(optical, OPTICAL, atol=1e-8)
    np.testing.assert_allclose(turned @ optical, mount.rotation, atol=1e-8)
    links = {each.get('name') for each in ElementTree.fromstring(text).findall('link')}
    assert links == {'base_link', 'camera_link', 'camera_optical_frame'}


def test_a_comment_has_the_standard_deviations_and_what_is_not_known():
    comment = export(NamedCamera('given', TRUTH, mount=MOUNT), 'urdf').split('-->')[0]
    assert '2.000, standard deviation 0.100' in comment
    assert '1.400, standard deviation 0.030' in comment
    assert 'roll to the right: not known' in comment and 'x and y are not known' in comment


@pytest.mark.parametrize('mount', [MOUNT, ROLLED])
def test_the_static_transform_is_the_same(mount):
    words = shlex.split(export(NamedCamera('given', TRUTH, mount=mount), 'tf'))
    assert words[:4] == ['ros2', 'run', 'tf2_ros', 'static_transform_publisher']
    given = dict(zip(words[4::2], words[5::2], strict=True))
    assert (given['--frame-id'], given['--child-frame-id']) == ('base_link',
                                                                'camera_optical_frame')
    turned = Rotation.from_quat([float(given[f'--q{axis}']) for axis in 'xyzw'])
    np.testing.assert_allclose(turned.as_matrix(), mount.rotation, atol=1e-8)
    assert [float(given[f'--{axis}']) for axis in 'xyz'] == [0, 0, 1.4]


def test_an_unknown_height_is_not_written():
    text = export(NamedCamera('given', TRUTH, mount=replace(MOUNT, height_m=None)), 'tf')
    words = shlex.split(text, comments=True)
    assert words[0] == 'ros2' and '--x' in words and '--z' not in words
    assert text.startswith('#') and '--z' in text.splitlines()[0]


@pytest.mark.parametrize(('path', 'name'), [
    ('front/result.json', 'front'), ('left side/calibration.yaml', 'left_side'),
    ('rear--1.yaml', 'rear__1'), ('calibration/result.json', 'camera')])
def test_frames_have_the_name_of_the_folder_or_the_file(path, name, tmp_path):
    place = tmp_path / path
    place.parent.mkdir(exist_ok=True)
    odd = Notice('', 'a --> b, <c> & \x01\n--d-')
    found = make_calibration(mount=replace(MOUNT, reasons=(odd,)))
    place.write_text(result_json(found) if path.endswith('json') else calibration_yaml(found))
    assert set(joints(export(load_camera(place), 'urdf'))) == {
        f'{name}_link', f'{name}_optical_frame'}


@pytest.mark.parametrize('kind', ['urdf', 'tf'])
def test_without_a_mounting_it_is_refused(kind):
    with pytest.raises(ConfigError) as raised:
        export(TRUTH, kind)
    assert raised.value.code == 'E-EXPORT-NO-MOUNTING'


@pytest.mark.parametrize('name', ['base/result.json', 'base.yaml'])
def test_no_link_is_its_own_parent(name):
    found = NamedCamera(name, TRUTH, mount=MOUNT)
    root = ElementTree.fromstring(export(found, 'urdf'))
    links = [each.get('name') for each in root.findall('link')]
    assert links == ['base_link', 'base_camera_link', 'base_camera_optical_frame']
    assert all(parent != child for child, (parent, *_) in joints(export(found, 'urdf')).items())
    assert 'base_camera_optical_frame' in export(found, 'tf')
