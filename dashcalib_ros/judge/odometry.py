"""How well a camera finds the car's true motion: the turns' rotations and scales beside poses.

The poses are of GPS/IMU, lidar or SLAM, in the format of KITTI, TUM or EuRoC, or a GPS track. The
turns' paths become files in TUM's format, which evo reads, and a plot.

Each turn is adjusted with each camera held, all alike. The angle of a turn's rotation is the same
in every frame that is fixed to the car: nothing has to be known of where the poses' sensor sits.
"""
from __future__ import annotations

import re
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.camera import Camera, Radial
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.errors import InputError
from dashcalib_ros.input.motion import Samples, in_seconds
from dashcalib_ros.judge.calibration import OPTICAL
from dashcalib_ros.limits import read_lines
from dashcalib_ros.reconstruct.scene import Scene

# keyframes with poses; a turn with fewer says nothing
LEAST_KEYFRAMES = 4


@dataclass(frozen=True)
class TurnPath:
    """Where a turn's keyframes were. rotations: (k, 3, 3) to the world; positions: (k, 3)."""

    rotations: Floats
    positions: Floats


@dataclass(frozen=True)
class TurnOdometry:
    """A turn as the poses and as each camera has it, at the same k keyframes.

    true: in metres; paths: by the camera's name, each in its own scale and frame. stamps_ns: (k,).
    """

    turn: TurnId
    stamps_ns: Ints
    true: TurnPath
    paths: Mapping[str, TurnPath]

    @property
    def angle_deg(self) -> float:
        """Return by how much the car truly turned from the first keyframe to the last."""
        return angle_deg(self.true.rotations)

    @property
    def length_m(self) -> float:
        """Return how far the car truly drove."""
        return length(self.true.positions)

    def rotation_deg(self, name: str) -> float:
        """Return by how much a camera misses the turn's angle."""
        return abs(angle_deg(self.paths[name].rotations) - self.angle_deg)

    def scale_drift(self, name: str) -> float:
        """Return by how much a camera's scale changes from the turn's first half to its second."""
        middle = len(self.stamps_ns) // 2
        first, second = (
            length(self.paths[name].positions[part]) / max(length(self.true.positions[part]),
                                                            1e-9)
            for part in (slice(0, middle + 1), slice(middle, None)))
        return second / max(first, 1e-12) - 1


@dataclass(frozen=True)
class Odometry:
    """All turns that have poses. names: of the cameras."""

    names: tuple[str, ...]
    turns: tuple[TurnOdometry, ...]

    def medians(self) -> dict[str, dict[str, float]]:
        """Return the medians over the turns, by what is measured and by the camera's name."""
        found: dict[str, dict[str, float]] = {
            'rotation_deg': {}, 'rotation_deg_per_100m': {}, 'scale_drift': {}}
        for name in self.names:
            rows = [(turn.rotation_deg(name),
                     100 * turn.rotation_deg(name) / max(turn.length_m, 1e-9),
                     abs(turn.scale_drift(name))) for turn in self.turns]
            for each, median in zip(found.values(), np.median(rows, axis=0), strict=True):
                each[name] = float(median)
        return found


def trivial_guess(image_size: tuple[int, int]) -> Camera:
    """Return what people assume of an unknown camera: f is the width, the centre in the middle."""
    return Radial.centred(image_size, float(image_size[0]))


def odometry(scenes: Sequence[Scene], cameras: Mapping[str, Camera], poses: Poses, config: Config
             ) -> Odometry:
    """Return what each camera makes of each turn.

    scenes: as solved. cameras: by name, of the scenes' pictures. Raises InputError where no turn
    has poses. Loads COLMAP.
    """
    found = [turn for scene in scenes
             if (turn := _turn(scene, cameras, poses, config)) is not None]
    if not found:
        raise InputError('E-NO-POSES-OF-TURNS',
                         'none of the turns has poses: use poses with the time stamps of the '
                         "drive, or KITTI's format with one line for each frame and no stamps")
    return Odometry(tuple(cameras), tuple(found))


def _turn(scene: Scene, cameras: Mapping[str, Camera], poses: Poses, config: Config
          ) -> TurnOdometry | None:
    from dashcalib_ros.solve.start import scene_with
    tracks = scene.tracks
    rotations, positions, known = poses.at(tracks.frames, tracks.stamps_ns)
    if known.sum() < LEAST_KEYFRAMES:
        return None
    held = {name: scene_with(camera, scene, config) for name, camera in cameras.items()}
    structures = {name: each.structure for name, each in held.items() if each is not None}
    if len(structures) < len(cameras):
        return None
    # the same keyframes for all
    common = np.logical_and.reduce([known, *(each.registered for each in structures.values())])
    if common.sum() < LEAST_KEYFRAMES:
        return None
    paths = {}
    for name, each in structures.items():
        turned = each.rotations[common].transpose(0, 2, 1)
        paths[name] = TurnPath(turned, -np.einsum('kij,kj->ki', turned, each.translations[common]))
    return TurnOdometry(scene.turn, tracks.stamps_ns[common],
                        TurnPath(rotations[common], positions[common]), paths)


def angle_deg(rotations: Floats) -> float:
    """Return the angle of the rotation from the first to the last of (k, 3, 3)."""
    from scipy.spatial.transform import Rotation
    return float(np.degrees(Rotation.from_matrix(rotations[0].T @ rotations[-1]).magnitude()))


def length(positions: Floats) -> float:
    """Return how long the way through positions (k, 3) is."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


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
    should know of them. longest_gap_s: between two, over which they are not interpolated.
    """

    rotations: Floats
    positions: Floats
    stamps_s: Floats | None = None
    warnings: tuple[str, ...] = ()
    longest_gap_s: float = LONGEST_GAP_S

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


TRUE = 'poses'
# px of a turn's panel, and its margin
PANEL, MARGIN = 320, 28
COLUMNS = 3
COLOURS = ('#d62728', '#1f77b4', '#7f7f7f', '#2ca02c', '#9467bd')


def path_files(found: Odometry) -> dict[str, str]:
    """Return texts by the names of their files: paths.svg, and for each turn and camera a .tum.

    TURN_poses.tum has the true path with the camera's orientation, so that evo can compare the
    others with it: evo_rpe tum turn_000094_poses.tum turn_000094_ours.tum --align --correct_scale
    """
    texts = {'paths.svg': paths_svg(found)}
    mounted = mounting(found)
    for turn in found.turns:
        true = TurnPath(turn.true.rotations @ mounted, turn.true.positions)
        for name, path in {TRUE: true, **turn.paths}.items():
            texts[f'turn_{turn.turn.number:06}_{name}.tum'] = _tum_text(turn, path)
    return texts


def mounting(found: Odometry) -> Floats:
    """Return (3, 3) the rotation from the camera to the frame of the poses (hand-eye).

    From the turns' rotations as the second camera has them, which is the drive's own.
    """
    from scipy.spatial.transform import Rotation
    name = found.names[min(1, len(found.names) - 1)]
    true, seen = (np.concatenate([_since_first(path) for path in paths]) for paths in (
        [turn.true for turn in found.turns], [turn.paths[name] for turn in found.turns]))
    rotation, _ = Rotation.align_vectors(true, seen)
    return np.asarray(rotation.as_matrix())


def _since_first(path: TurnPath) -> Floats:
    """Return (k - 1, 3) the rotation vectors since the first keyframe."""
    from scipy.spatial.transform import Rotation
    return np.asarray(Rotation.from_matrix(
        path.rotations[0].T @ path.rotations[1:]).as_rotvec())


def _tum_text(turn: TurnOdometry, path: TurnPath) -> str:
    from scipy.spatial.transform import Rotation
    quaternions = Rotation.from_matrix(path.rotations).as_quat()
    lines = []
    for stamp_ns, place, quaternion in zip(turn.stamps_ns.tolist(), path.positions, quaternions,
                                           strict=True):
        # as text: a float has too few digits for nanoseconds since 1970
        stamp = f'{stamp_ns // 10**9}.{stamp_ns % 10**9:09}'
        lines.append(' '.join([stamp, *(f'{value:.9f}' for value in (*place, *quaternion))]))
    return '\n'.join(lines) + '\n'


def paths_svg(found: Odometry) -> str:
    """Return a plot of each turn from above: the true path, and each camera's, fitted to it."""
    rows = -(-len(found.turns) // COLUMNS)
    columns = min(COLUMNS, len(found.turns))
    panels = ''.join(_panel(turn, found.names, n % COLUMNS * PANEL, n // COLUMNS * PANEL)
                     for n, turn in enumerate(found.turns))
    names = [('black', TRUE), *zip(COLOURS, found.names, strict=False)]
    legend = ''.join(
        f'<text x="{MARGIN + 150 * n}" y="{rows * PANEL + 18}" fill="{colour}">{escape(name)}'
        f'</text>' for n, (colour, name) in enumerate(names))
    width = max(columns * PANEL, MARGIN + 150 * len(names))
    return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {rows * PANEL + 28}" '
            f'font-family="sans-serif" font-size="13"><rect width="100%" height="100%" '
            f'fill="white"/>{panels}{legend}</svg>\n')


def _panel(turn: TurnOdometry, names: tuple[str, ...], left: int, top: int) -> str:
    true = turn.true.positions
    middle = true.mean(axis=0)
    # the ground is the plane in which the path extends most
    ground = np.linalg.svd(true - middle, full_matrices=False)[2][:2]
    flat = [(true - middle) @ ground.T, *(
        (_fitted(turn.paths[name].positions, true) - middle) @ ground.T for name in names)]
    extent = max(float(np.ptp(flat[0], axis=0).max()), 1e-9)
    scale = (PANEL - 2 * MARGIN) / extent
    centre = (flat[0].max(axis=0) + flat[0].min(axis=0)) / 2
    lines = ''.join(
        f'<polyline fill="none" stroke="{colour}" stroke-width="{width}" points="'
        + ' '.join(f'{left + PANEL / 2 + scale * (x - centre[0]):.1f},'
                   f'{top + PANEL / 2 + scale * (y - centre[1]):.1f}' for x, y in path) + '"/>'
        for colour, width, path in zip(('black', *COLOURS), (3, *[1.5] * len(names)), flat,
                                       strict=False))
    missed = ', '.join(f'{name} {turn.rotation_deg(name):.2f}°' for name in names)
    return (f'<text x="{left + 8}" y="{top + 16}">frame {turn.turn.number}: '
            f'{turn.angle_deg:.0f}°, {turn.length_m:.0f} m; missed by</text>'
            f'<text x="{left + 8}" y="{top + 32}">{escape(missed)}</text>{lines}')


def _fitted(path: Floats, true: Floats) -> Floats:
    """Return the path (k, 3) scaled, turned and moved onto the true one (Umeyama)."""
    from scipy.spatial.transform import Rotation
    own, other = path - path.mean(axis=0), true - true.mean(axis=0)
    turned = Rotation.align_vectors(other, own)[0].apply(own)
    scale = float((turned * other).sum()) / max(float((own**2).sum()), 1e-12)
    return np.asarray(scale * turned + true.mean(axis=0))
