"""What a gyro and GPS say of fx: rendered drives, and real ones with poses or sensors.

    python test/benchmark/motion.py --data data
    python test/benchmark/motion.py --towns 40

A gyro is made from true poses: 100 Hz, 0.1 deg/s/sqrt(Hz), bias 0.2 deg/s, 40 ms late, mounted at
any angle.
"""
from __future__ import annotations

import argparse
import csv
import dataclasses
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np
from made_motion import town
from scipy.spatial.transform import Rotation, RotationSpline

from dashcalib_ros.arrays import Floats
from dashcalib_ros.calibrator import Calibrator
from dashcalib_ros.config import Config
from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.demo.drive import MARGIN_S
from dashcalib_ros.input import Frame
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.input.motion import Samples, SensorStream, local_metres
from dashcalib_ros.judge.gyro_scale import scale_by_gps
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.judge.witnesses import ask_sensors
from dashcalib_ros.solve.fitting import scene_with
from dashcalib_ros.solve.solution import Solution

DENSITY_DEG, BIAS_DEG, LATE_S, RATE_HZ = 0.1, 0.2, 0.04, 100.0
LENS = Lens.of(960, 540, 75.0, -0.30, 0.10, (14.0, -9.0), 1.003)
CALIBRATED = 0.001


def gyro(times: Floats, rotations: Floats, seed: int, scale: float = 1.0) -> SensorStream:
    """Return what a gyro measures. times: (n,) s; rotations: (n, 3, 3) camera to world."""
    rng = np.random.default_rng(seed)
    when = np.arange(times[0], times[-1], 1 / RATE_HZ)
    spline = RotationSpline(times, Rotation.from_matrix(rotations))
    half = 0.5 / RATE_HZ
    middle = np.clip(when, times[0] + half, times[-1] - half)
    rates = (spline(middle - half).inv() * spline(middle + half)).as_rotvec() * RATE_HZ
    mounting = Rotation.random(random_state=seed)
    noise = rng.standard_normal(rates.shape) * DENSITY_DEG * np.sqrt(RATE_HZ)
    bias = BIAS_DEG * rng.standard_normal(3) / np.sqrt(3)
    return SensorStream(rate=Samples(
        when + LATE_S, scale * mounting.apply(rates) + np.radians(bias + noise)))


def rendered(seed: int, turns: int = 5) -> tuple[Iterable[Frame], SensorStream, Floats]:
    """Return the frames of a rendered drive, its gyro, and its true positions by time (n, 4)."""
    drive = Drive(LENS, DriveSpec(seed=seed, turns=turns))
    times = np.arange(-0.9, drive.times[-1] + 0.9, 0.005)
    poses = [drive.ride.camera_at(np.array([time + MARGIN_S])) for time in times]
    places = np.column_stack([times, np.concatenate([place for _, place in poses])])
    return drive.frames(), gyro(times, np.concatenate([turn for turn, _ in poses]), seed), places


def solved(frames: Iterable[Frame]) -> tuple[Solution, float, str]:
    """Return a drive's solution, the stamp of its first image, and its verdict."""
    with Calibrator(Config(threads=1)) as calibrator:
        for frame in frames:
            calibrator.push(frame)
        found = calibrator.calibrate()
        assert calibrator.solution is not None
        return calibrator.solution, found.start_s, found.verdict.level


def row(name: str, solution: Solution, start_s: float, stream: SensorStream, truth: float,
        verdict: str) -> None:
    """Print what the gyro says, calibrated and not, and of a camera that is 2 % off."""
    config = Config().replace({'motion.gyro_scale_sigma': CALIBRATED})
    asked = ask_sensors(solution, stream, start_s, config)
    witnesses = asked.witnesses
    for line in asked.unused:
        print(f'{name}: {line}')
    own = 100 * (solution.camera.fx / truth - 1)
    for sensor, said in (('gyro', witnesses.gyro), ('gps', witnesses.gps)):
        if said is None:
            print(f'| {name} | {sensor} | nothing to say |')
            continue
        time = ('' if said.time_offset_s is None or said.time_sigma_s is None else
                f'{1e3 * said.time_offset_s:.1f} ± {1e3 * said.time_sigma_s:.1f}')
        print(f'| {name} | {sensor} | {verdict} | {time} | {said.scale:.4f} ± '
              f'{said.scale_sigma:.4f} | {own:+.2f} ± '
              f'{100 * solution.sigma[0] / solution.camera.fx:.2f} | '
              f'{own + said.fx_percent:+.2f} ± {said.fx_sigma_percent:.2f} | {said.agrees} |')
    informed = asked.solution
    if informed is not None and informed.alone is not None:
        print(f'  as information: {100 * (informed.camera.fx / truth - 1):+.2f} ± '
              f'{100 * informed.sigma[0] / informed.camera.fx:.2f} %, '
              f'{judge(informed, config.verdict, witnesses=witnesses).level}', flush=True)
    camera = solution.camera.with_focal(1.02 * solution.camera.fx)
    scenes = [scene_with(camera, scene, Config()) for scene in solution.scenes]
    off = ask_sensors(dataclasses.replace(
        solution, camera=camera, scenes=tuple(each for each in scenes if each is not None)),
        dataclasses.replace(stream, position=None), start_s, config).witnesses
    if off.gyro is not None:
        print(f'  2 % too long: asked for {off.gyro.fx_percent:+.2f} ± '
              f'{off.gyro.fx_sigma_percent:.2f} %, '
              f'{abs(off.gyro.fx_percent) / off.gyro.fx_sigma_percent:.1f} sigma', flush=True)


def pictures(folder: Path, stamps: Iterable[float]) -> Iterator[Frame]:
    """Yield a folder's frames with these stamps, s."""
    for index, (file, stamp) in enumerate(zip(sorted((folder / 'images').iterdir()), stamps,
                                              strict=True)):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        yield Frame(index, round(stamp * 1e9), np.asarray(image, np.uint8))


def table(path: Path) -> dict[str, Floats]:
    """Return the columns of a CSV."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(line[name]) for line in rows]) for name in rows[0]}


TOWNS: dict[str, dict[str, float]] = {
    '10 Hz, 2 cm': {'noise_m': 0.02, 'rate_hz': 10.0}, '1 Hz, 0.5 m': {},
    '1 Hz, 3 m': {'noise_m': 3.0}, '1 Hz, 3 m, 30 turns': {'noise_m': 3.0, 'turns': 30},
    '1 Hz, 0.5 m, 5 % jump by 30 m': {'jumps': 0.05}, '1 Hz, 0.5 m, 0.4 s late': {'late_s': 0.4}}


def towns(count: int) -> None:
    """Print how well GPS knows a gyro's scale: drives of 12 turns on paper, 2 % off."""
    print('| GPS | answers | sigma, % | error over sigma: RMS, largest |\n|---|---|---|---|')
    for name, given in TOWNS.items():
        found = [scale_by_gps(*town(seed, scale=1.02, **given)) for seed in range(count)]
        known = np.array([each for each in found if each is not None])
        off = (known[:, 0] - 1.02) / known[:, 1]
        print(f'| {name} | {len(known)} of {count} | {100 * np.median(known[:, 1]):.2f} | '
              f'{np.sqrt(np.mean(off**2)):.2f}, {np.abs(off).max():.1f} |')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--towns', type=int, default=0, help='drives on paper for GPS and gyro')
    parser.add_argument('--data', type=Path)
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--single', type=int, default=0, help='single turns that are rendered')
    args = parser.parse_args()
    if args.towns:
        towns(args.towns)
        return
    print('| drive | sensor | verdict | offset ms | scale | fx by pictures, % | by it, % | agrees '
          '|\n|---|---|---|---|---|---|---|---|')
    for seed in range(1, args.seeds + 1):
        frames, stream, places = rendered(seed)
        solution, start_s, verdict = solved(frames)
        rng = np.random.default_rng(seed)
        for name, step, noise in (('5 Hz, 2 cm', 40, 0.02), ('1 Hz, 3 m', 200, 3.0)):
            fixes = places[::step]
            noisy = fixes[:, 1:] + noise * rng.standard_normal((len(fixes), 3))
            row(f'rendered {seed}, GPS {name}', solution, start_s,
                dataclasses.replace(stream, position=Samples(fixes[:, 0], noisy)), LENS.fx,
                verdict)
    for seed in range(100, 100 + args.single):
        frames, stream, _ = rendered(seed, 1)
        solution, start_s, verdict = solved(frames)
        row(f'one turn {seed}', solution, start_s, stream, LENS.fx, verdict)
    if args.data is None:
        return
    solution, start_s, verdict = solved(open_frames(args.data / 'kitti03' / 'bag'))
    poses = np.loadtxt(args.data / 'kitti03' / 'poses.txt')
    # the bag has its images at 10 Hz, and a pose for each of them
    when = np.arange(len(poses)) / 10
    row('kitti03', solution, start_s, gyro(when, poses[:, 1:].reshape(-1, 3, 4)[:, :, :3], 1),
        718.2, verdict)
    folder = args.data / 'kitti07'
    when = table(folder / 'odom.csv')['stamp_s']
    solution, start_s, verdict = solved(pictures(folder, when))
    poses = np.loadtxt(folder / 'poses.txt').reshape(-1, 3, 4)
    row('kitti07', solution, start_s, gyro(when, poses[:, :, :3], 1), 701.9, verdict)
    folder = args.data / 'kitti_raw'
    solution, start_s, verdict = solved(pictures(folder, table(folder / 'images.csv')['stamp_s']))
    own = table(folder / 'oxts.csv')
    row('kitti_raw, its own IMU and GPS', solution, start_s, SensorStream(
        rate=Samples(own['stamp_s'], np.stack([own[name] for name in ('wx', 'wy', 'wz')], axis=1)),
        position=Samples(own['stamp_s'], local_metres(own['lat'], own['lon'], own['alt']))),
        984.2439, verdict)


if __name__ == '__main__':
    main()
