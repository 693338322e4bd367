#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How the camera sits on the car: what is found beside the truth.

    python benchmark/mount.py [--data DIR] [--cache DIR] [--seeds N ...] [--out DIR] [--results]

Rendered: seven lenses, mounted by up to 4 degrees in each angle, 300 m of straights, a body that
sways, leans and dives; one of them on a hill, and on a crowned road. Real: KITTI 03 and 07 beside
the direction of travel of their poses, which have an error of their own (the sensor is elsewhere),
and the nominal height of 1.65 m. All with the car's true speed.

The poses have the axes of the camera that KITTI ships. Its centre is not ours: 5 px turn the axes
by 0.4 degrees, and move nothing in the pictures. So the direction of the poses becomes a pixel by
KITTI's camera, and that pixel's ray by ours is the truth.
"""
from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from drives import (
    DEMO,
    KITTI_RAW,
    NARROW,
    PINHOLE,
    SHIFTED,
    STREET,
    VGA,
    WIDE,
    Setting,
    drive_of,
    pictures_of,
)
from measure import (
    commit,
    complain,
    done,
    isolated,
    keep_table,
    load,
    parser_with,
    save,
    table,
)
from scipy.spatial.transform import Rotation

from dashcalib_ros import Calibrator, Config, open_frames
from dashcalib_ros.arrays import Floats, plain_values
from dashcalib_ros.demo import Drive, DriveSpec
from dashcalib_ros.demo.drive import AnyLens
from dashcalib_ros.demo.parallel import render_parallel
from dashcalib_ros.demo.town import Town
from dashcalib_ros.demo.vehicle import MARGIN_S
from dashcalib_ros.input import Frame
from dashcalib_ros.input.motion import Samples, SensorStream
from dashcalib_ros.input.poses import read_poses

# m; wider rectangles are the surroundings
FAR_M = 100.0


@dataclass(frozen=True)
class RoadSpec(DriveSpec):
    """A drive on a road that is not level.

    slope_percent: the whole town lies on a hill that falls so much along the first street. The
    frame of the world lies in the road: what is upright leans the other way.
    crown_percent: the road falls so much from its middle to the right. The car in the right lane
    leans so, against the plane of its path and against what is upright; the drawn road is flat.
    """

    slope_percent: float = 0.0
    crown_percent: float = 0.0


class OnRoad(Drive):
    """A drive on such a road."""

    spec: RoadSpec

    def __init__(self, lens: AnyLens, spec: RoadSpec) -> None:
        super().__init__(lens, spec)
        lean = math.atan(spec.crown_percent / 100.0)
        self.ride = replace(self.ride, roll=self.ride.roll + lean)

    @cached_property
    def town(self) -> Town:
        """Return the town, each of its rectangles but the ground leaning about its own foot."""
        town = super().town
        quads = town.quads
        lean = Rotation.from_euler('y', -math.atan(self.spec.slope_percent / 100.0)).as_matrix()
        middle = quads.origin + (quads.right + quads.down) / 2
        foot = np.where([True, True, False], middle, 0.0)
        # the ground, and what is far away all round
        stays = (middle[:, 2] < 0.05) | (np.linalg.norm(quads.right, axis=1) > FAR_M)
        leans = ~stays[:, None]
        return replace(town, quads=replace(
            quads, origin=np.where(leans, foot + (quads.origin - foot) @ lean.T, quads.origin),
            right=np.where(leans, quads.right @ lean.T, quads.right),
            down=np.where(leans, quads.down @ lean.T, quads.down)))

    def frames(self, first: int = 0, last: int | None = None,
               processes: int = 1) -> Iterator[Frame]:
        """Yield frames as a drive does, from processes that know this road."""
        end = len(self) if last is None else min(last, len(self))
        if processes > 1:
            return render_parallel(partial(OnRoad, self.lens, self.spec), first, end, processes)
        return super().frames(first, end)


LENSES = {'demo': DEMO, 'KITTI raw': KITTI_RAW, '48 deg': NARROW, 'no distortion': PINHOLE,
          'off-centre': SHIFTED, '640x480': VGA, '115 deg': WIDE}
SPEC = replace(STREET, straight_m=50.0, lead_m=50.0, mount_deg=4.0)
ROADS = {'hill, 6 %': {'slope_percent': 6.0}, 'crown, 2 %': {'crown_percent': 2.0}}
ANGLES = ('yaw_left_deg', 'pitch_up_deg', 'roll_right_deg')
# images between two poses of a direction of travel; degrees a second; m
APART, STRAIGHT, LEAST_M = 4, 2.0, 1.2
# s from image to image: KITTI 03's bag has 10 a second, KITTI itself 9.65
FRAME_S, NOMINAL_M = {'kitti03': 0.1, 'kitti07': 0.1036}, 1.65


def found(frames: Any, config: Config, speed: SensorStream, travel: Floats | None = None
          ) -> dict[str, Any]:
    """Calibrate; return the mount and the lens's verdict.

    travel: (2,) the pixel towards which the car drives; given, the truth is that pixel's ray.
    """
    with Calibrator(config) as calibrator:
        calibrator.sense(speed)
        for frame in frames:
            calibrator.push(frame)
        result = calibrator.calibrate()
    values = {'lens': result.verdict.level, 'mount': plain_values(result.mount)}
    if travel is not None and result.camera is not None:
        x, y, z = result.camera.rays(travel)
        values['truth'] = dict(zip(ANGLES, np.degrees([np.arctan2(x, z), np.arcsin(y)]).tolist(),
                                   strict=False))
    return values


def speed_of(times: Floats, positions: Floats) -> SensorStream:
    """Return the speed. times: (n,) s since the first image; positions: (n, 3) m."""
    way = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(times)
    return SensorStream(speed=Samples((times[1:] + times[:-1]) / 2, way[:, None]))


def true_angles(drive: Drive) -> dict[str, float]:
    """Return the angles of a rendered drive's mounting, degrees."""
    mounted = drive.ride.mount
    ahead, up = mounted[:, 2], mounted.T[:, 2]
    return dict(zip(ANGLES, np.degrees([np.arctan2(ahead[1], ahead[0]), np.arcsin(ahead[2]),
                                        np.arctan2(-up[0], -up[1])]).tolist(), strict=True))


def by_poses(folder: Path) -> tuple[Floats, SensorStream]:
    """Return the pixel (2,) towards which the poses drive on straights, and the speed."""
    poses, shipped = read_poses(folder / 'poses.txt'), load(folder / 'truth.json')
    frame_s = FRAME_S[folder.name]
    half = poses.rotations[APART // 2:len(poses.rotations) - APART + APART // 2]
    way = poses.positions[APART:] - poses.positions[:-APART]
    length = np.linalg.norm(way, axis=1)
    ahead = np.einsum('nji,nj->ni', half, way) / np.maximum(length, 1e-9)[:, None]
    turned = np.einsum('nji,njk->nik', poses.rotations[:-APART], poses.rotations[APART:])
    rate = np.degrees(np.arcsin(turned[:, 0, 2])) / (APART * frame_s)
    straight = (np.abs(rate) < STRAIGHT) & (length > LEAST_M)
    slopes = np.median(ahead[straight, :2] / ahead[straight, 2:], axis=0)
    focal, centre = (np.array([shipped[name] for name in names])
                     for names in (('fx', 'fy'), ('cx', 'cy')))
    return (focal * slopes + centre,
            speed_of(np.arange(len(poses.positions)) * np.float64(frame_s), poses.positions))


def summary(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the tables."""
    lines, offs, ratios = [], [], []
    for name, row in rows.items():
        mount, truth = row.get('mount'), row.get('truth', {})
        if mount is None:
            lines.append([name, row.get('lens', 'failed'), *[''] * 7])
            continue
        cells = []
        for key in ANGLES:
            value, sigma = mount[key], mount['sigma'][key]
            if key in truth and value is not None:
                off = value - truth[key]
                cells.append(f'{off:+.2f} ({sigma:.2f})')
                if row['rendered']:
                    offs.append(abs(off))
                    ratios.append(abs(off) / sigma)
            else:
                cells.append('' if value is None else f'({value:+.2f})')
        height = mount['height_m']
        true_height = truth.get('height_m', NOMINAL_M)
        lines.append([name, row['lens'], mount['verdict'], *cells, f'{mount["straight_m"]:.0f}',
                      '' if height is None else f'{height:.3f} ({mount["sigma"]["height_m"]:.3f})',
                      '' if height is None else f'{100 * (height / true_height - 1):+.1f}'])
    text = table(['drive', 'lens', 'mount', 'yaw off, ° (σ)', 'pitch off', 'roll off',
                  'straight m', 'height m (σ)', 'off, %'], lines)
    if offs:
        text = (f'Rendered, {len(offs)} angles: median {np.median(offs):.3f}°, worst '
                f'{max(offs):.2f}°, within 2σ {np.mean(np.array(ratios) <= 2):.0%}, median of '
                f'|error| / σ {np.median(ratios):.2f}.\n\n{text}')
    return text


def main() -> None:
    """Measure."""
    arguments = parser_with(__doc__, 'data', 'cache', 'seeds', 'again').parse_args()
    path = arguments.out / 'mount.json'
    rows = load(path)

    def keep(name: str, outcome: Any, rendered: bool, truth: Mapping[str, float]) -> None:
        rows[name] = {'commit': commit(), 'rendered': rendered, 'truth': truth,
                      **(outcome.value or {'verdict': 'failed', 'reasons': [outcome.failure]})}
        save(path, rows)
        complain(f'{name}: {rows[name]}')

    with TemporaryDirectory() as passing:
        for name in FRAME_S if arguments.data else ():
            if done(rows.get(name)) and not arguments.again:
                continue
            folder = arguments.data / name
            travel, speed = by_poses(folder)
            pictures = open_frames(folder / ('bag' if name == 'kitti03' else 'images'),
                                   fps=None if name == 'kitti03' else 1 / FRAME_S[name])
            keep(name, isolated(found, pictures, Config(), speed, travel), False, {})
        for seed in arguments.seeds:
            drives = {name: drive_of(Setting(f'mount, {name}', lens, SPEC), seed)
                      for name, lens in LENSES.items()}
            lens, spec = drives['demo'].lens, drives['demo'].spec
            drives |= {name: OnRoad(lens, RoadSpec(**vars(spec) | road))
                       for name, road in ROADS.items()}
            for each, drive in drives.items():
                name = f'{each}, seed {seed}'
                if done(rows.get(name)) and not arguments.again:
                    continue
                rendered = pictures_of(drive, arguments.cache or Path(passing))
                truth = {**true_angles(drive), 'height_m': drive.spec.height_m}
                times = np.arange(0.0, drive.times[-1], 0.01)
                speed = speed_of(times, drive.ride.camera_at(times + MARGIN_S)[1])
                keep(name, isolated(found, rendered, Config(seed=seed), speed), True, truth)
    keep_table('mount', summary(rows), arguments, [row['commit'] for row in rows.values()])


if __name__ == '__main__':
    main()
