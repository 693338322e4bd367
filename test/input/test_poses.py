# SPDX-License-Identifier: Apache-2.0
"""True poses from files, and those of a GPS track."""
from __future__ import annotations

import numpy as np
import pytest
from refused import refused
from synthetic import rotation

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.motion import Samples
from dashcalib_ros.input.poses import read_poses, track_poses

STAMPS = np.array([10.0, 10.5, 11.0])


def kitti(rotations, positions):
    table = np.concatenate([rotations, positions[:, :, None]], axis=2).reshape(-1, 12)
    return '\n'.join(' '.join(f'{value:.9e}' for value in row) for row in table)


def three():
    rotations = np.array([rotation(1, 0.2 * n) for n in range(3)])
    return rotations, np.array([[n, 0.0, 2.0 * n] for n in range(3)])


@pytest.mark.parametrize('before', ['', '0.1 '])
def test_kittis_poses_are_those_of_the_frames(tmp_path, before):
    rotations, positions = three()
    path = tmp_path / 'poses.txt'
    path.write_text('\n'.join(before + line for line in kitti(rotations, positions).split('\n')))
    poses = read_poses(path)
    found, places, known = poses.at(np.array([2, 0, 7]), np.zeros(3, np.int64))
    assert known.tolist() == [True, True, False]
    np.testing.assert_allclose(found[:2], rotations[[2, 0]], atol=1e-8)
    np.testing.assert_allclose(places[:2], positions[[2, 0]])


def test_tums_poses_are_interpolated_at_the_frames_stamps(tmp_path):
    path = tmp_path / 'poses.tum'
    path.write_text('# t x y z qx qy qz qw\n1700000010.0 0 0 0 0 0 0 1\n'
                    '1700000010.4 4 0 0 0 0.7071067811865476 0 0.7071067811865476\n'
                    '1700000020.0 5 0 0 0 0 0 1\n')
    stamps = np.array([1700000009900000000, 1700000010100000000, 1700000015000000000])
    found, places, known = read_poses(path).at(np.arange(3), stamps)
    # before the first pose, and in a gap of 10 s, nothing is known
    assert known.tolist() == [False, True, False]
    np.testing.assert_allclose(places[1], [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(found[1], rotation(1, np.pi / 8), atol=1e-6)


@pytest.mark.parametrize(('text', 'code'), [
    ('', 'E-POSES-FORMAT'), ('1 2 3\n4 5 6\n', 'E-POSES-FORMAT'),
    ('1 2\n' + '0 ' * 12 + '\n', 'E-POSES-FORMAT'),
    (f'{"1 " * 12}\n' * 2, 'E-POSES-ROTATION'), (f'{"a " * 12}\n' * 2, 'E-POSES-NUMBERS'),
    (f'{"nan " * 8}\n' * 2, 'E-POSES-NOT-FINITE'),
    ('2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n', 'E-POSES-ORDER'),
    ('1 0 0 0 0 0 0 0\n2 0 0 0 0 0 0 0\n', 'E-POSES-QUATERNION'),
    ('1 0 0 0 9 9 9 9\n2 0 0 0 9 9 9 9\n', 'E-POSES-QUATERNION'),
    ('1 1e300 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n', 'E-POSES-UNIT'),
    ('5e10 0 0 0 0 0 0 1\n6e10 0 0 0 0 0 0 1\n', 'E-STAMP-UNIT'),
    ('1e300 0 0 0 0 0 0 1\n2e300 0 0 0 0 0 0 1\n', 'E-STAMP-UNIT'),
    ('0 0 0 0 0 0 0 1\n1e300 0 0 0 0 0 0 1\n', 'E-STAMP-UNIT'),
    ('1 0 0 0 1e200 -1e200 0 1\n2 0 0 0 0 0 0 1\n', 'E-POSES-QUATERNION'),
    (f'{"1e300 -1e300 " * 6}\n' * 2, 'E-POSES-ROTATION'),
    ('-1e308 0 0 0 0 0 0 1\n1e308 0 0 0 0 0 0 1\n', 'E-STAMP-UNIT'),
    ('t x y z qx qy qz qw\n' * 2, 'E-POSES-NUMBERS')])
@pytest.mark.filterwarnings('error')
def test_what_is_no_file_of_poses_is_named(tmp_path, text, code):
    path = tmp_path / 'poses.txt'
    path.write_text(text)
    with refused(InputError, code, path):
        read_poses(path)


@pytest.mark.parametrize(('unit', 'digits', 'word'), [
    (1, 9, ''), (10**3, 6, 'milliseconds'), (10**6, 3, 'microseconds'), (10**9, 0, 'nanoseconds')])
def test_stamps_since_1970_may_be_of_any_unit_which_is_said(tmp_path, unit, digits, word):
    path = tmp_path / 'poses.txt'
    path.write_text(''.join(f'{(1403636580 + 0.25 * n) * unit:.{digits}f} {n} 0 0 0 0 0 1\n'
                            for n in range(5)))
    poses = read_poses(path)
    stamps = np.array([1403636580 * 10**9 + 375 * 10**6])
    _, places, known = poses.at(np.arange(1), stamps)
    assert known.all() and abs(places[0, 0] - 1.5) < 1e-5
    assert [word in str(line) for line in poses.warnings] == ([True] if word else [])


def test_nanoseconds_since_a_computer_was_started_are_no_milliseconds_since_1970(tmp_path):
    path = tmp_path / 'poses.txt'
    path.write_text(''.join(f'{5 * 10**12 + n * 10**8} 0 0 0 0 0 0 1\n' for n in range(5)))
    with refused(InputError, 'E-STAMP-UNIT', 'poses.txt'):
        read_poses(path)


def test_the_real_part_comes_first_where_the_head_says_so(tmp_path):
    turn = '0 0.7071067811865476 0 0.7071067811865476'
    first = '0.7071067811865476 0 0.7071067811865476 0'
    euroc = ('#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], '
             'q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1], ...\n')
    files = {
        'tum': ''.join(f'{n} 1 2 3 {turn}\n' for n in range(2)),
        'commas': 't,x,y,z,qx,qy,qz,qw\n' + ''.join(
            f'{n} 1 2 3 {turn}\n'.replace(' ', ',') for n in range(2)),
        'w': '# t x y z qw qx qy qz\n' + ''.join(f'{n} 1 2 3 {first}\n' for n in range(2)),
        'euroc.csv': euroc + ''.join(
            f'{1403636580 + n}000000000 1 2 3 {first}{" 0" * 9}\n'.replace(' ', ',')
            for n in range(2))}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        poses = read_poses(tmp_path / name)
        np.testing.assert_allclose(poses.rotations[1], rotation(1, np.pi / 2), atol=1e-6)
        np.testing.assert_allclose(poses.positions[1], [1, 2, 3])


def test_a_gps_track_has_headings_and_places():
    when = np.arange(0.0, 12.0, 0.2)
    heading = np.clip((when - 5.0) / 2, 0.0, 1.0) * np.pi / 2
    way = np.stack([np.cos(heading), np.sin(heading), 0 * when], axis=1)
    places = np.cumsum(2.0 * way, axis=0)
    poses = track_poses(Samples(when, places), 1_700_000_000.0)
    stamps = np.array([1_700_000_002_000_000_000, 1_700_000_009_000_000_000])
    turned, _, known = poses.at(np.arange(2), stamps)
    # the axes are a camera's: z points ahead, and the way from east to north is a left turn
    assert known.all()
    np.testing.assert_allclose(turned[0][:, 2], [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(turned[1][:, 2], [0.0, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(turned[1][:, 1], [0.0, 0.0, -1.0], atol=1e-6)


def test_a_gps_that_comes_once_a_second_has_headings_between():
    when = np.arange(0.0, 20.0, 1.0)
    poses = track_poses(Samples(when, np.stack([5 * when, 0 * when, 0 * when], axis=1)), 0.0)
    _, places, known = poses.at(np.arange(1), np.array([9_500_000_000]))
    assert known.all() and abs(places[0, 0] - 47.5) < 1e-6


@pytest.mark.parametrize(('places', 'code'), [
    (np.zeros((60, 3)), 'E-GPS-STANDS'), (np.zeros((3, 3)), 'E-GPS-TOO-SHORT')])
def test_a_track_without_headings_is_named(places, code):
    with pytest.raises(InputError) as caught:
        track_poses(Samples(0.2 * np.arange(len(places)), places), 0.0)
    assert caught.value.code == code
