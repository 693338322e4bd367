# SPDX-License-Identifier: Apache-2.0
"""Two rigs of one car: which camera was moved, by name."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dashcalib_ros.errors import Notice
from dashcalib_ros.rig.moved import changes
from dashcalib_ros.rig.placed import PlacedCamera, RigCalibration, base_camera, not_placed, three

SIGMA, METRES = (0.06, 0.08, 0.04), (0.02, 0.5, 0.02)
PLACES = {'left': ((1.0, 70.0, -2.0), (-0.5, 0.2, 1.0)),
          'right': ((3.0, -75.0, 1.0), (0.6, 0.1, 1.1)),
          'rear': ((2.0, 177.5, 1.5), (0.3, -0.2, -2.0))}


def rig(*names, turned=None, by=(0.0, 1.0, 0.0), metric=True, seed=0):
    """Return front and others; turned: the camera that sits otherwise, by degrees in its axes."""
    rng, cameras = np.random.default_rng(seed), {'front': base_camera('front/result.json')}
    by_base = Rotation.from_rotvec(by if turned == 'front' else (0, 0, 0), degrees=True)
    for name in names:
        vector, shift = PLACES[name]
        own = Rotation.from_rotvec(by if turned == name else (0, 0, 0), degrees=True)
        noise = Rotation.from_rotvec(np.array(SIGMA) * rng.normal(size=3), degrees=True)
        turn = noise * own * Rotation.from_rotvec(vector, degrees=True) * by_base.inv()
        moved = own.apply(shift) + np.array(METRES) * rng.normal(size=3)
        cameras[name] = PlacedCamera(
            f'{name}/result.json', 'accepted', three(turn.as_rotvec(degrees=True)), SIGMA,
            three(moved) if metric else None, METRES if metric else None, 0.0, 0.001)
    return RigCalibration('front', cameras)


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
