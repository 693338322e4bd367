# SPDX-License-Identifier: Apache-2.0
"""Poses of a vehicle: of GPS/IMU, lidar or SLAM (KITTI, TUM, EuRoC), or of a GPS track."""
from __future__ import annotations

import re
from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.camera.rotation import OPTICAL
from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.input.motion import Samples, in_seconds
from dashcalib_ros.limits import read_lines

# of a file of poses: an hour at 100 Hz
POSES_BYTES = 2**26
# values in a line; KITTI's 12 may have a time before them, which is not used; EuRoC's have speeds
# and biases behind them
POSE_COLUMNS = KITTI, KITTI_TIMED, TUM, EUROC = 12, 13, 8, 17
# a head that names the real part of the quaternions first, as EuRoC's does
REAL_FIRST = re.compile(r'q\w*w\b.*q\w*x\b', re.IGNORECASE)
# m; UTM counts up to ten million
FARTHEST_M = 1e9
# s between two poses; over more they are not interpolated. A track's headings are smoothed over
# longer anyway, and GPS comes once a second
LONGEST_GAP_S, TRACK_GAP_S = 0.5, 1.5
# s to either side, over which a track has a heading; m in that time, with less it stands
COURSE_S, STANDING_M = 1.0, 2.0
# of a rotation matrix; KITTI rounds them to 7 digits
NOT_A_ROTATION = 1e-2


@dataclass(frozen=True)
class Poses:
    """Poses of a vehicle, or of anything that is fixed to the camera.

    rotations: (n, 3, 3) to the world; positions: (n, 3) in metres. stamps_s: (n,) ascending, or
    None where the poses are those of the input's frames, one by one. warnings: what the user
    should know about them. longest_gap_s: between two, over which they are not interpolated.
    """

    rotations: Floats
    positions: Floats
    stamps_s: Floats | None = None
    warnings: tuple[Notice, ...] = ()
    longest_gap_s: float = LONGEST_GAP_S

    @property
    def of_track(self) -> bool:
        """Return whether the headings are those of a GPS track's way."""
        return self.longest_gap_s == TRACK_GAP_S

    def at(self, frames: Ints, stamps_ns: Ints) -> tuple[Floats, Floats, Mask]:
        """Return rotations (k, 3, 3), positions (k, 3) and which of them are known (k,).

        frames: (k,) indices of the input's frames; stamps_ns: (k,) when they were taken.
        """
        if self.stamps_s is None:
            known = np.asarray(frames < len(self.positions), bool)
            rows = np.where(known, frames, 0)
            return self.rotations[rows], self.positions[rows], known
        from scipy.spatial.transform import Rotation, Slerp
        # nanoseconds since 1970 do not fit a float: differences do
        start = int(self.stamps_s[0])
        own = self.stamps_s - start
        wanted = (np.asarray(stamps_ns) - start * 10**9) / 1e9
        after = np.clip(np.searchsorted(own, wanted), 1, len(own) - 1)
        inside = (wanted >= own[0]) & (wanted <= own[-1])
        known = np.asarray(inside & (own[after] - own[after - 1] <= self.longest_gap_s), bool)
        held = np.clip(wanted, own[0], own[-1])
        rotations = Slerp(own, Rotation.from_matrix(self.rotations))(held).as_matrix()
        return np.asarray(rotations), Samples(own, self.positions).at(held), known


def read_poses(path: Path) -> Poses:
    """Read poses as KITTI (12 numbers a line), TUM (t x y z qx qy qz qw) or EuRoC writes them.

    Between them are spaces or commas. Raises InputError for anything else.
    """
    values, columns, heads = array('d'), 0, ''
    for line in read_lines(path, POSES_BYTES, f'the poses {path}'):
        cells = line.replace(',', ' ').split()
        if not cells or cells[0].startswith('#'):
            heads += line
            continue
        try:
            row = [float(cell) for cell in cells]
        except ValueError as error:
            if not columns and not heads:
                heads = line
                continue
            if len(cells) in POSE_COLUMNS:
                raise InputError('E-POSES-NUMBERS', f'{path} has a line that is not all numbers: '
                                 f'{error}; remove or correct it') from error
            raise _no_poses(path) from error
        columns = columns or len(row)
        if columns not in POSE_COLUMNS or len(row) != columns:
            raise _no_poses(path)
        values.extend(row)
    if len(values) < 2 * max(columns, 1):
        raise _no_poses(path)
    table = np.array(values).reshape(-1, columns)
    if not np.isfinite(table).all():
        raise InputError('E-POSES-NOT-FINITE',
                         f'{path} has numbers that are not finite; remove these poses')
    if columns in (KITTI, KITTI_TIMED):
        return _kitti(table[:, -KITTI:], path)
    if columns == EUROC or REAL_FIRST.search(heads):
        table[:, 4:8] = table[:, [5, 6, 7, 4]]
    return _tum(table[:, :TUM], path)


def _no_poses(path: Path) -> InputError:
    return InputError('E-POSES-FORMAT',
                      f"{path} has no poses in KITTI's format (12 numbers a line, one line for "
                      f"each frame), in TUM's (t x y z qx qy qz qw) or in EuRoC's, and no header "
                      f"with stamp_s, latitude and longitude: use one of these")


def track_poses(position: Samples, start_s: float) -> Poses:
    """Return the poses of a GPS track: its headings and places; it knows neither pitch nor roll.

    position: m, east, north and up; stamps in s since the drive's first image, which was at
    start_s. The heading is that of the way, a second to either side. Raises InputError where the
    track is shorter.
    """
    from scipy.spatial.transform import Rotation
    stamps = position.stamps_s
    inside = stamps[(stamps >= stamps[0] + COURSE_S) & (stamps <= stamps[-1] - COURSE_S)]
    if len(inside) < 2:
        raise InputError('E-GPS-TOO-SHORT',
                         'the GPS track is too short for headings: record it during the drive')
    way = position.at(inside + COURSE_S) - position.at(inside - COURSE_S)
    heading = np.arctan2(way[:, 1], way[:, 0])
    # one that stands has no heading: it keeps the one before
    moves = np.linalg.norm(way[:, :2], axis=1) > STANDING_M
    if not moves.any():
        raise InputError('E-GPS-STANDS',
                         'the GPS track does not move: record it during the drive')
    last = np.maximum.accumulate(np.where(moves, np.arange(len(moves)), int(np.argmax(moves))))
    # to the world (east, north, up), from axes as a camera's
    turned = Rotation.from_rotvec(heading[last][:, None] * [0.0, 0.0, 1.0]).as_matrix() @ OPTICAL
    return Poses(np.asarray(turned), position.at(inside), inside + start_s,
                 longest_gap_s=TRACK_GAP_S)


def _kitti(table: Floats, path: Path) -> Poses:
    poses = table.reshape(-1, 3, 4)
    rotations = poses[:, :, :3]
    with np.errstate(all='ignore'):
        off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max()
    # NaN is none, either
    if not off <= NOT_A_ROTATION or (np.linalg.det(rotations) < 0).any():
        raise InputError('E-POSES-ROTATION', f'{path} has matrices that are not rotations: write '
                         f'each as 3x4, row by row')
    return Poses(rotations, _places(poses[:, :, 3], path))


def _places(positions: Floats, path: Path) -> Floats:
    farthest = np.abs(positions).max()
    if farthest > FARTHEST_M:
        raise InputError('E-POSES-UNIT',
                         f'{path} has a position {farthest:.4g} m away; write metres')
    return positions


def _tum(table: Floats, path: Path) -> Poses:
    from scipy.spatial.transform import Rotation
    (stamps, warnings), quaternions = in_seconds(table[:, 0], str(path)), table[:, 4:]
    if not (np.diff(stamps) > 0).all():
        raise InputError('E-POSES-ORDER',
                         f'{path}: the time stamps of the poses do not increase; sort them')
    with np.errstate(all='ignore'):
        lengths = np.linalg.norm(quaternions, axis=1)
    if (np.abs(lengths - 1) > 0.5).any():
        raise InputError('E-POSES-QUATERNION', f'{path} has quaternions that are not rotations: '
                         f'write t x y z qx qy qz qw')
    return Poses(Rotation.from_quat(quaternions).as_matrix(), _places(table[:, 1:4], path), stamps,
                 warnings)
