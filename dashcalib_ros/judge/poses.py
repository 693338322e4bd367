"""True poses of a drive, from GPS/IMU, lidar or SLAM: KITTI's format, TUM's, or a GPS track."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.errors import InputError
from dashcalib_ros.input.motion import Samples
from dashcalib_ros.limits import read_text

# of a file of poses: an hour at 100 Hz
POSES_BYTES = 2**26
# values in a line; KITTI's 12 may have a time before them, which is not used
KITTI, KITTI_TIMED, TUM = 12, 13, 8
# s between two poses; over more they are not interpolated
LONGEST_GAP_S = 0.5
# s to either side, over which a track has a heading; m in that time, with less it stands
COURSE_S, STANDING_M = 1.0, 2.0
# of a rotation matrix; KITTI rounds them to 7 digits
NOT_A_ROTATION = 1e-2


@dataclass(frozen=True)
class Poses:
    """Poses of a vehicle, or of anything that is fixed to the camera.

    rotations: (n, 3, 3) to the world; positions: (n, 3) in metres. stamps_s: (n,) ascending, or
    None where the poses are those of the input's frames, one by one.
    """

    rotations: Floats
    positions: Floats
    stamps_s: Floats | None = None

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
        known = np.asarray(inside & (own[after] - own[after - 1] <= LONGEST_GAP_S), bool)
        held = np.clip(wanted, own[0], own[-1])
        share = ((held - own[after - 1]) / (own[after] - own[after - 1]))[:, None]
        positions = self.positions[after - 1] * (1 - share) + self.positions[after] * share
        rotations = Slerp(own, Rotation.from_matrix(self.rotations))(held).as_matrix()
        return np.asarray(rotations), np.asarray(positions), known


def read_poses(path: Path) -> Poses:
    """Read poses in KITTI's format (12 numbers a line) or TUM's (t x y z qx qy qz qw).

    Raises InputError for anything else.
    """
    lines = [line for line in read_text(path, POSES_BYTES, f'the poses {path}').splitlines()
             if line.strip() and not line.lstrip().startswith('#')]
    counts = {len(line.split()) for line in lines}
    if len(counts) != 1 or not counts <= {KITTI, KITTI_TIMED, TUM} or len(lines) < 2:
        raise InputError(f"{path} has no poses in KITTI's format (12 numbers a line, one line for "
                         f"each frame) nor in TUM's (t x y z qx qy qz qw)")
    try:
        table = np.array([[float(value) for value in line.split()] for line in lines])
    except ValueError as error:
        raise InputError(f'{path} has a line that is not all numbers: {error}') from error
    if not np.isfinite(table).all():
        raise InputError(f'{path} has numbers that are not finite; leave these poses out')
    return _tum(table, path) if counts == {TUM} else _kitti(table[:, -KITTI:], path)


def track_poses(position: Samples, start_s: float) -> Poses:
    """Return the poses of a GPS track: its headings and places; it knows neither pitch nor roll.

    position: m, east, north and up; stamps in s since the drive's first image, which was at
    start_s. The heading is that of the way, a second to either side. Raises InputError where the
    track is shorter.
    """
    from scipy.spatial.transform import Rotation
    stamps, places = position.stamps_s, position.values
    inside = stamps[(stamps >= stamps[0] + COURSE_S) & (stamps <= stamps[-1] - COURSE_S)]
    if len(inside) < 2:
        raise InputError('the GPS track is too short for headings: record it during the drive')

    def at(when: Floats) -> Floats:
        return np.stack([np.interp(when, stamps, column) for column in places.T], axis=1)

    way = at(inside + COURSE_S) - at(inside - COURSE_S)
    heading = np.arctan2(way[:, 1], way[:, 0])
    # one that stands has no heading: it keeps the one before
    moves = np.linalg.norm(way[:, :2], axis=1) > STANDING_M
    if not moves.any():
        raise InputError('the GPS track does not move: record it during the drive')
    last = np.maximum.accumulate(np.where(moves, np.arange(len(moves)), int(np.argmax(moves))))
    # to the world (east, north, up), from axes as a camera's: right, down, ahead
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turned = Rotation.from_rotvec(heading[last][:, None] * [0.0, 0.0, 1.0]).as_matrix() @ axes
    return Poses(np.asarray(turned), at(inside), inside + start_s)


def _kitti(table: Floats, path: Path) -> Poses:
    poses = table.reshape(-1, 3, 4)
    rotations = poses[:, :, :3]
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max()
    if off > NOT_A_ROTATION or (np.linalg.det(rotations) < 0).any():
        raise InputError(f'{path} has matrices that are no rotations: are they 3x4, row by row?')
    return Poses(rotations, poses[:, :, 3])


def _tum(table: Floats, path: Path) -> Poses:
    from scipy.spatial.transform import Rotation
    stamps, quaternions = table[:, 0], table[:, 4:]
    if not (np.diff(stamps) > 0).all():
        raise InputError(f'{path}: the stamps of the poses do not ascend; sort them')
    if (np.linalg.norm(quaternions, axis=1) < 0.5).any():
        raise InputError(f'{path} has quaternions that are no rotations: is the order t x y z qx '
                         f'qy qz qw?')
    return Poses(Rotation.from_quat(quaternions).as_matrix(), table[:, 1:4], stamps)
