# SPDX-License-Identifier: Apache-2.0
"""Two cameras of one car: rendered, one ahead and one back, and made mountings."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_calibration import MOUNT, make_calibration
from scipy.spatial.transform import Rotation
from shared_drive import LENS, SPEC, calibrated

from dashcalib_ros.demo import Drive
from dashcalib_ros.errors import InputError
from dashcalib_ros.judge import TurnSummary
from dashcalib_ros.judge.rig import rig_of
from dashcalib_ros.report.lens import mounting_of
from dashcalib_ros.report.wording import mount_text, rig_texts

REAR = replace(MOUNT, yaw_left_deg=-178.0, pitch_up_deg=3.0, roll_right_deg=2.0,
               sigma={**MOUNT.sigma, 'roll_right_deg': 0.3})


@pytest.fixture(scope='module')
def two(shared_drive, shared_calibration):
    """The drive by a camera that looks ahead, and by one turned half about the vertical."""
    back = Drive(LENS, SPEC)
    back.ride = replace(back.ride, mount=np.diag([-1.0, -1.0, 1.0]) @ back.ride.mount)
    return [(shared_calibration, shared_drive.ride.mount),
            (calibrated(back.frames()), back.ride.mount)]


def test_each_camera_of_one_car_knows_where_it_looks(two):
    for found, true in two:
        assert found.verdict.level == 'accepted' and found.mount is not None
        off = np.degrees(Rotation.from_matrix(found.mount.rotation @ true.T).as_rotvec())
        sigma = found.mount.sigma
        assert abs(off[0]) < 3 * sigma['roll_right_deg'] and max(abs(off[1:])) < 0.5
        assert max(sigma['yaw_left_deg'], sigma['pitch_up_deg']) < 0.3
    assert [found.mount.rear for found, _ in two] == [False, True]
    assert 'comes from pixel' in mount_text(two[1][0].mount)


def test_two_cameras_of_one_drive_agree(two):
    (front, ahead), (rear, back) = two
    found = rig_of(front, rear)
    off = Rotation.from_matrix(np.array(found.rotation) @ (ahead.T @ back).T).magnitude()
    # roll is known to 0.6 degrees by each
    assert np.degrees(off) < 1.5
    degrees, sigma = found.angles['yaw_left_deg']
    assert abs(abs(degrees) - 180) < 3 * sigma < 1.0
    assert found.agrees and len(found.turns) == 2
    assert [turn.a_right_deg for turn in found.turns] == pytest.approx([-86, 80], abs=5)
    assert all(abs(turn.a_right_deg - turn.b_right_deg) < 2 for turn in found.turns)


def turned(*turns, mount=MOUNT):
    """Return a calibration with turns of (stamp, degrees to the right)."""
    return make_calibration(mount=mount, turns=tuple(
        TurnSummary(n, n, n, stamp_s, 0.05, 20, 20, True, right_deg=right_deg)
        for n, (stamp_s, right_deg) in enumerate(turns)))


def test_a_mirrored_picture_contradicts():
    found = rig_of(turned((10.0, 90.0), (60.0, -70.0)), turned((10.4, -88.0), (60.2, 72.0)))
    assert found.agrees is False and 'mirrored' in rig_texts(found)[1]
    # another window of the same turn is no contradiction
    assert rig_of(turned((10.0, 90.0)), turned((11.5, 60.0))).agrees


@pytest.mark.parametrize('other', [turned((20.0, 90.0)), turned((10.0, None)), turned()])
def test_without_a_common_turn_nothing_shows_one_drive(other):
    found = rig_of(turned((10.0, 90.0)), other)
    assert found.turns == () and found.agrees is None and 'nothing shows' in rig_texts(found)[1]


def test_the_relative_mounting_is_that_of_both():
    found = rig_of(turned(), turned(mount=REAR))
    np.testing.assert_allclose(MOUNT.rotation @ np.array(found.rotation), REAR.rotation,
                               atol=1e-12)
    # MOUNT does not know its roll
    assert set(found.angles) == {'yaw_left_deg', 'pitch_up_deg'}
    degrees, sigma = found.angles['yaw_left_deg']
    assert (abs(degrees), sigma) == pytest.approx((180.0, 0.1 * 2**0.5))
    assert found.angles['pitch_up_deg'][0] == pytest.approx(4.0)
    assert 'roll unknown' in rig_texts(found)[0]
    # across 180 degrees the short way counts
    near = replace(REAR, yaw_left_deg=179.9)
    assert REAR.apart(near)['yaw_left_deg'][0] == pytest.approx(2.1)


def test_without_a_mounting_there_is_no_rig():
    for pair in ((turned(), turned(mount=None)), (turned(mount=None), turned())):
        with pytest.raises(InputError) as raised:
            rig_of(*pair)
        assert raised.value.code == 'E-RIG-NO-MOUNTING'


def test_a_camera_that_looks_back_is_drawn_so():
    ahead, back = (mounting_of(make_calibration(mount=mount)) for mount in (MOUNT, REAR))
    assert 'from which the car comes' in back[2].caption
    for seen, turned_back in zip(ahead, back, strict=True):
        assert 'comes' not in seen.svg + seen.caption and seen.svg != turned_back.svg
    assert all('where the car comes from' in drawing.svg for drawing in back[:2])
