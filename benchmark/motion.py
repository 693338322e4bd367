# SPDX-License-Identifier: Apache-2.0
"""What a gyro and GPS say about fx: rendered drives, and real ones with poses or sensors.

    python benchmark/motion.py [--data data] [--seeds 1 2 3] [--single 20] [--towns 40] [--results]

A gyro is made from true poses: 100 Hz, 0.1 deg/s/sqrt(Hz), bias 0.2 deg/s, 40 ms late, mounted at
any angle; called calibrated to 0.1 %. A better one has 0.01 deg/s/sqrt(Hz), and 0.03 %.
"""
from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from drives import pictures_of
from measure import complain, keep_table, parser_with, table
from scipy.spatial.transform import Rotation, RotationSpline
from solving import with_camera
from towns import town

from dashcalib_ros.arrays import Floats
from dashcalib_ros.config import Config
from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.demo.vehicle import MARGIN_S
from dashcalib_ros.input import Frame
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.input.motion import Samples, SensorStream, local_metres
from dashcalib_ros.judge.gyro_scale import scale_by_gps
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.judge.witnesses import SensorComparison, compare_sensors
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.solve.start import scene_with

DENSITY_DEG, BIAS_DEG, LATE_S, RATE_HZ = 0.1, 0.2, 0.04, 100.0
LENS = Lens.of(960, 540, 75.0, -0.30, 0.10, (14.0, -9.0), 1.003)
CALIBRATED = 0.001
# of another gyro, that is not cheap; tracks of GPS for each drive
BETTER_DEG, BETTER, TRACKS = 0.01, 0.0003, 5


@dataclasses.dataclass(frozen=True)
class Poses:
    """A camera's true poses. times: (n,) s; rotations: (n, 3, 3) to the world; places: (n, 3)."""

    times: Floats
    rotations: Floats
    places: Floats


def gyro(poses: Poses, seed: int, density_deg: float = DENSITY_DEG) -> SensorStream:
    """Return what a gyro measures."""
    rng, times = np.random.default_rng(seed), poses.times
    when = np.arange(times[0], times[-1], 1 / RATE_HZ)
    spline = RotationSpline(times, Rotation.from_matrix(poses.rotations))
    half = 0.5 / RATE_HZ
    middle = np.clip(when, times[0] + half, times[-1] - half)
    rates = (spline(middle - half).inv() * spline(middle + half)).as_rotvec() * RATE_HZ
    mounting = Rotation.random(random_state=seed)
    noise = rng.standard_normal(rates.shape) * density_deg * np.sqrt(RATE_HZ)
    bias = BIAS_DEG * rng.standard_normal(3) / np.sqrt(3)
    return SensorStream(rate=Samples(
        when + LATE_S, mounting.apply(rates) + np.radians(bias + noise)))


@dataclasses.dataclass(frozen=True)
class Driven:
    """A drive that was solved by pictures alone. truth: fx, px. poses: None where not known."""

    name: str
    solution: Solution
    start_s: float
    verdict: str
    truth: float
    poses: Poses | None = None

    def off(self, solution: Solution) -> str:
        """Return by how much fx is off, and its sigma, %."""
        return (f'{100 * (solution.camera.fx / self.truth - 1):+.2f} ± '
                f'{100 * solution.sigma[0] / solution.camera.fx:.2f}')


def rendered(name: str, seed: int, turns: int, cache: Path) -> Driven:
    """Return a rendered drive with its true poses."""
    drive = Drive(LENS, DriveSpec(seed=seed, turns=turns))
    times = np.arange(-0.9, drive.times[-1] + 0.9, 0.005)
    poses = [drive.ride.camera_at(np.array([time + MARGIN_S])) for time in times]
    return Driven(name, *solved(pictures_of(drive, cache)), LENS.fx, Poses(
        times, *(np.concatenate(each) for each in zip(*poses, strict=True))))


def solved(frames: Iterable[Frame]) -> tuple[Solution, float, str]:
    """Return a drive's solution, the stamp of its first image, and its verdict."""
    with Calibrator(Config(workers=1)) as calibrator:
        for frame in frames:
            calibrator.push(frame)
        found = calibrator.calibrate()
        assert calibrator.solution is not None
        return calibrator.solution, found.start_s, found.verdict.level


def asked(drive: Driven, stream: SensorStream, solution: Solution | None = None,
          scale_sigma: float = CALIBRATED) -> SensorComparison:
    """Ask the sensors of a drive, of its own solution or another one."""
    config = Config().replace({'motion.gyro_scale_sigma': scale_sigma})
    return compare_sensors(solution or drive.solution, stream, drive.start_s, config)


def scaled(stream: SensorStream, scale: float) -> SensorStream:
    """Return the same of a gyro that is so many times too fast, without GPS."""
    assert stream.rate is not None
    return SensorStream(rate=Samples(stream.rate.stamps_s, scale * stream.rate.values))


def row(drive: Driven, stream: SensorStream, sensor: str = 'gyro',
        scale_sigma: float = CALIBRATED) -> Iterator[list[str]]:
    """Yield what the sensors say, calibrated, and what the result is with that."""
    found = asked(drive, stream, scale_sigma=scale_sigma)
    for line in found.unused:
        complain(f'{drive.name}: {line}')
    informed = found.solution or drive.solution
    verdict = judge(informed, Config().verdict, witnesses=found.witnesses).level
    for kind, said in (('gyro', found.witnesses.gyro), ('GPS', found.witnesses.gps)):
        if said is None or said.fx_percent is None:
            continue
        own = 100 * (drive.solution.camera.fx / drive.truth - 1)
        time = ('' if said.time_offset_s is None or said.time_sigma_s is None else
                f'{1e3 * said.time_offset_s:.1f} ± {1e3 * said.time_sigma_s:.1f}')
        yield [f'{drive.name}, {sensor if kind == "gyro" else kind}', time,
               f'{said.scale:.4f} ± {said.scale_sigma:.4f}',
               f'{drive.off(drive.solution)}, {drive.verdict}',
               f'{own + said.fx_percent:+.2f} ± {said.fx_sigma_percent:.2f}',
               f'{drive.off(informed)}, {verdict}']


def harm(drive: Driven, stream: SensorStream) -> list[str]:
    """Return what sensors do that are off, and what they say about a camera that is."""
    solution = drive.solution
    unknown = asked(drive, scaled(stream, 1.03), scale_sigma=Config().motion.gyro_scale_sigma)
    assert unknown.solution is not None
    moved = abs(unknown.solution.camera.fx - solution.camera.fx) / solution.sigma[0]
    camera = solution.camera.with_focal(1.02 * solution.camera.fx)
    scenes = [scene_with(camera, scene, Config()) for scene in solution.scenes]
    longer = dataclasses.replace(with_camera(solution, camera), scenes=tuple(
        each for each in scenes if each is not None))
    said = [found.witnesses.gyro for found in (
        asked(drive, scaled(stream, 1.03)), asked(drive, scaled(stream, 1.0), longer))]
    told = ['' if each is None or each.fx_percent is None or each.fx_sigma_percent is None else
            f'{abs(each.fx_percent) / each.fx_sigma_percent:.1f} sigma'
            f'{"" if each.agrees else ", contradiction"}' for each in said]
    by_gps = []
    for jumps in (0.0, 0.05):
        found = [] if drive.poses is None else [
            asked(drive, SensorStream(position=fixes(drive.poses, 1.0, 3.0, jumps, seed)))
            for seed in range(TRACKS)]
        assert all(each.solution is solution for each in found)
        agree = [each.witnesses.gps.agrees for each in found if each.witnesses.gps is not None
                 and each.witnesses.gps.fx_percent is not None]
        by_gps.append(f'{len(agree)}, {agree.count(False)}')
    return [drive.name, f'{moved:.2f}', *told, *by_gps]


def made_gyro(drive: Driven, noise: int, scale: float = 1.0) -> SensorStream:
    """Return the gyro of a single turn, so many times too fast. noise: which one."""
    assert drive.poses is not None
    seed = int(drive.name.rpartition(' ')[2])
    return scaled(gyro(drive.poses, seed + 1000 * noise), scale)


def stated(singles: Sequence[Driven]) -> str:
    """Return how many single turns are accepted with gyros that are called calibrated."""
    lines = []
    for name, gyros in (('right, 4 noises', [(noise, 1.0) for noise in range(4)]),
                        ('3 % wrong, 2 noises', [(noise, scale) for noise in range(2)
                                                 for scale in (0.97, 1.03)])):
        accepted = []
        for drive in singles:
            for noise, scale in gyros:
                found = asked(drive, made_gyro(drive, noise, scale))
                used = found.solution
                if used is not None and used is not drive.solution and judge(
                        used, Config().verdict, witnesses=found.witnesses).level == 'accepted':
                    accepted.append((used.camera.fx - drive.truth) / used.sigma[0])
        lines.append([name, f'{len(accepted)} of {len(gyros) * len(singles)}',
                      str(sum(abs(each) > 2 for each in accepted))])
    return table(['one turn, gyro called calibrated', 'used and accepted',
                  'of these, beyond 2 sigma'], lines)


def fixes(poses: Poses, rate_hz: float, noise_m: float, jumps: float, seed: int) -> Samples:
    """Return what GPS measures. jumps: share of the fixes that are off by 30 m."""
    rng = np.random.default_rng(seed)
    times = np.arange(poses.times[0], poses.times[-1], 1 / rate_hz)
    places = Samples(poses.times, poses.places).at(times)
    noise = noise_m + 30 * (rng.random((len(times), 1)) < jumps)
    return Samples(times, places + noise * rng.standard_normal(places.shape))


def pictures(folder: Path, stamps: Iterable[float]) -> Iterator[Frame]:
    """Yield a folder's frames with these stamps, s."""
    for index, (file, stamp) in enumerate(zip(sorted((folder / 'images').iterdir()), stamps,
                                              strict=True)):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        yield Frame(index, round(stamp * 1e9), np.asarray(image, np.uint8))


def columns_of(path: Path) -> dict[str, Floats]:
    """Return the columns of a CSV."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(line[name]) for line in rows]) for name in rows[0]}


TOWNS: dict[str, dict[str, float]] = {
    '10 Hz, 2 cm': {'noise_m': 0.02, 'rate_hz': 10.0}, '1 Hz, 0.5 m': {},
    '1 Hz, 3 m': {'noise_m': 3.0}, '1 Hz, 3 m, 30 turns': {'noise_m': 3.0, 'turns': 30},
    '1 Hz, 0.5 m, 5 % jump by 30 m': {'jumps': 0.05}, '1 Hz, 0.5 m, 0.4 s late': {'late_s': 0.4}}


def towns(count: int) -> str:
    """Return how well GPS knows a gyro's scale: drives of 12 turns on paper, 2 % off."""
    lines = []
    for name, given in TOWNS.items():
        found = [scale_by_gps(*town(seed, scale=1.02, **given)) for seed in range(count)]
        known = np.array([each for each in found if each is not None])
        off = (known[:, 0] - 1.02) / known[:, 1]
        lines.append([name, f'{len(known)} of {count}', f'{100 * np.median(known[:, 1]):.2f}',
                      f'{np.sqrt(np.mean(off**2)):.2f}, {np.abs(off).max():.1f}'])
    return table(['GPS, a gyro that is 2 % off', 'answers', 'sigma, %',
                  'error over sigma: RMS, largest'], lines)


def main() -> None:
    parser = parser_with(__doc__, 'data', 'seeds', 'cache', seeds=[1, 2, 3])
    parser.add_argument('--towns', type=int, default=40, help='drives on paper for GPS and gyro')
    parser.add_argument('--single', type=int, default=20, help='single turns that are rendered')
    parser.set_defaults(cache=Path('measured/pictures'))
    args = parser.parse_args()
    drives, lines = [], []
    for seed in args.seeds:
        drive = rendered(f'rendered {seed}', seed, 5, args.cache)
        assert drive.poses is not None
        drives.append((drive, gyro(drive.poses, seed)))
        lines += [*row(*drives[-1]),
                  *row(drive, gyro(drive.poses, seed, BETTER_DEG), 'a better gyro', BETTER),
                  *row(drive, SensorStream(position=fixes(drive.poses, 5.0, 0.02, 0.0, seed)))]
    singles = [rendered(f'one turn {seed}', seed, 1, args.cache)
               for seed in range(100, 100 + args.single)]
    for drive in singles:
        lines += row(drive, made_gyro(drive, 0))
    for drive, stream in real(args.data) if args.data else ():
        lines += row(drive, stream)
        drives.append((drive, stream))
    keep_table('motion', '\n\n'.join([
        table(['drive', 'offset, ms', 'scale', 'fx by pictures, %', 'by it alone, %',
               'the result, %'], lines),
        table(['drive', 'gyro 3 % wrong: fx moves by, sigma', 'called calibrated',
               'a camera 2 % too long', f'{TRACKS} tracks of 1 Hz, 3 m: speak, contradict',
               'and jumps'], [harm(*each) for each in drives]),
        *([stated(singles)] if singles else []),
        *([towns(args.towns)] if args.towns else [])]), args)


def real(data: Path) -> Iterator[tuple[Driven, SensorStream]]:
    """Yield real drives, solved, with gyros made of their poses, or their own sensors."""
    poses = np.loadtxt(data / 'kitti03' / 'poses.txt')[:, 1:].reshape(-1, 3, 4)
    # the bag has its images at 10 Hz, and a pose for each of them
    made = poses_of(np.arange(len(poses)) / 10, poses)
    yield Driven('kitti03', *solved(open_frames(data / 'kitti03' / 'bag')), 718.2, made), gyro(
        made, 1)
    folder = data / 'kitti07'
    own = columns_of(folder / 'odom.csv')
    when, own_m = own['stamp_s'], np.stack([own[name] for name in ('z_m', 'x_m', 'y_m')], axis=1)
    made = poses_of(when, np.loadtxt(folder / 'poses.txt').reshape(-1, 3, 4))
    rates = np.stack([own[f'{name}_rad_s'] for name in ('wx', 'wy', 'wz')], axis=1)
    drive = Driven('kitti07', *solved(pictures(folder, when)), 701.9, made)
    yield drive, gyro(made, 1)
    yield dataclasses.replace(drive, name='kitti07, odometry', poses=None), SensorStream(
        rate=Samples(when, rates), speed=Samples(when, own['speed_m_s'][:, None]),
        position=Samples(when, own_m * [1.0, -1.0, -1.0]))
    folder = data / 'kitti_raw'
    when, own = columns_of(folder / 'images.csv')['stamp_s'], columns_of(folder / 'oxts.csv')
    yield Driven('kitti_raw', *solved(pictures(folder, when)), 984.2439), SensorStream(
        rate=Samples(own['stamp_s'], np.stack([own[name] for name in ('wx', 'wy', 'wz')], axis=1)),
        speed=Samples(own['stamp_s'], own['vf'][:, None]),
        position=Samples(own['stamp_s'], local_metres(own['lat'], own['lon'], own['alt'])))


def poses_of(times: Floats, poses: Floats) -> Poses:
    """Return poses of KITTI, (n, 3, 4), whose y points down."""
    return Poses(times, poses[:, :, :3], poses[:, [0, 2, 1], 3])


if __name__ == '__main__':
    main()
