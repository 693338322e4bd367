# SPDX-License-Identifier: Apache-2.0
"""Two rigs of one car: which camera was moved, by name."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_rig import METRES, SIGMA
from made_rig import seen_rig as rig
from scipy.spatial.transform import Rotation

from dashcalib_ros.errors import Notice
from dashcalib_ros.rig.moved import changes
from dashcalib_ros.rig.placed import RigCalibration, not_placed, three


def moved(found):
    return [name for name, each in found.cameras.items() if each.moved]


def test_nothing_moved_is_right():
    for seed in range(10):
        found = changes(rig('left', 'rear', seed=seed), rig('left', 'rear', seed=seed + 50))
        assert found.answer == 'right' and not moved(found) and not found.exchanged


@pytest.mark.parametrize('name', ['front', 'left', 'rear'])
def test_a_camera_that_was_moved_is_named(name):
    found = changes(rig('left', 'rear', turned=name, seed=1), rig('left', 'rear'))
    assert found.answer == 'wrong' and moved(found) == [name] and not found.exchanged
    each = found.cameras[name]
    assert each.rotation_deg[1] == pytest.approx(1.0, abs=4 * each.rotation_sigma_deg[1])
    assert not any(other.perhaps for other in found.cameras.values())


def test_of_two_cameras_either_may_have_moved():
    found = changes(rig('rear', turned='rear', metric=False, seed=1), rig('rear'))
    assert found.answer == 'wrong' and not moved(found)
    assert all(each.perhaps for each in found.cameras.values())
    assert found.cameras['rear'].translation_m is None


def test_a_camera_that_was_shifted_is_named():
    now = rig('left', 'rear', seed=1)
    x, y, z = now.cameras['left'].translation_m
    now = replace(now, cameras={**now.cameras, 'left': replace(
        now.cameras['left'], translation_m=(x + 0.3, y, z))})
    assert moved(changes(now, rig('left', 'rear'))) == ['left']


@pytest.mark.parametrize('names', [('left', 'right'), ('left', 'right', 'rear')])
def test_cameras_that_were_exchanged_are_named(names):
    before, now = rig(*names), rig(*names, seed=1)
    now = replace(now, cameras={**now.cameras, 'left': now.cameras['right'],
                                'right': now.cameras['left']})
    found = changes(now, before)
    assert found.answer == 'wrong' and found.exchanged == ('left', 'right') and not moved(found)


def test_the_base_may_be_another_one_or_be_exchanged():
    now = rig('left', 'rear', seed=1)
    turn = Rotation.from_matrix(now.cameras['rear'].rotation)
    shift = np.array(now.cameras['rear'].translation_m)

    def against_rear(camera):
        own = Rotation.from_matrix(camera.rotation) * turn.inv()
        return replace(camera, rotation_deg=three(own.as_rotvec(degrees=True)),
                       translation_m=three(np.array(camera.translation_m) - own.apply(shift)),
                       rotation_sigma_deg=SIGMA, translation_sigma_m=METRES)

    other = {name: against_rear(camera) for name, camera in now.cameras.items()}
    assert changes(RigCalibration('rear', other), rig('left', 'rear')).answer == 'right'
    # the command had front=rear.mp4 rear=front.mp4
    swapped = {'front': other['rear'], 'left': other['left'], 'rear': other['front']}
    found = changes(RigCalibration('front', swapped), rig('left', 'rear'))
    assert found.exchanged == ('front', 'rear') and not moved(found)


def test_what_is_not_known_is_not_right():
    nowhere = not_placed('rear/result.json', Notice('E-RIG-OTHER-DRIVE', 'another drive'))
    now = rig('left', 'rear', seed=1)
    now = replace(now, cameras={**now.cameras, 'rear': nowhere})
    found = changes(now, rig('left', 'rear'))
    assert found.answer == 'cannot tell' and found.unknown == ('rear',) and not moved(found)
    assert changes(rig(), rig('left')).answer == 'cannot tell'
    dull = {name: replace(camera, rotation_sigma_deg=(2.0, 2.0, 2.0))
            for name, camera in rig('left', 'rear').cameras.items()}
    assert changes(RigCalibration('front', dull), rig('left', 'rear')).answer == 'cannot tell'
