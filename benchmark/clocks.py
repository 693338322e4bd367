#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How well the offsets of sensors' clocks are found: recorded drives, with their stamps shifted.

    python benchmark/clocks.py --data data [--results]
"""
from __future__ import annotations

from collections.abc import Sequence

from measure import keep_table, parser_with, table
from motion import asked, real

from dashcalib_ros.config import Config
from dashcalib_ros.input.motion import SensorStream
from dashcalib_ros.input.poses import Poses
from dashcalib_ros.judge.calibration import Witness
from dashcalib_ros.judge.witnesses import clock_of_poses

# s by which stamps are shifted
PUT_IN = (-0.2, -0.1, -0.04, 0.0, 0.04, 0.1, 0.2)


def _late(said: Witness | None) -> str:
    return ('' if said is None or said.time_offset_s is None or said.time_sigma_s is None else
            f'{1e3 * said.time_offset_s:+.1f} ± {1e3 * said.time_sigma_s:.1f}')


def _beyond(found: Sequence[Witness | None], own_s: float = 0.0) -> int:
    """Return how many are not within 2 sigma. own_s: by which the recorded stamps are late."""
    return sum(said is None or said.time_offset_s is None or said.time_sigma_s is None
               or abs(said.time_offset_s - own_s - late_s) > 2 * said.time_sigma_s
               for late_s, said in zip(PUT_IN, found, strict=True))


def main() -> None:
    """Measure."""
    parser = parser_with(__doc__, 'data')
    args = parser.parse_args()
    if args.data is None:
        parser.error('--data is needed: the recorded drives')
    rows, beyond, by_itself = [], 0, 0

    def add(name: str, sensor: str, said: Sequence[Witness | None]) -> None:
        nonlocal beyond, by_itself
        rows.append([name, sensor, *map(_late, said)])
        beyond += _beyond(said)
        as_recorded = said[PUT_IN.index(0.0)]
        by_itself += _beyond(said, (as_recorded and as_recorded.time_offset_s) or 0.0)

    for drive, stream in real(args.data):
        if drive.poses is not None:
            # the sensors of such a drive are made of its poses
            add(drive.name, 'poses', [clock_of_poses(drive.solution, Poses(
                drive.poses.rotations, drive.poses.places,
                drive.poses.times + late_s + drive.start_s), Config()) for late_s in PUT_IN])
            continue
        for name, each in (('all of it', stream),
                           ('positions alone', SensorStream(position=stream.position)),
                           ('speeds alone', SensorStream(speed=stream.speed))):
            answers = [asked(drive, each.shifted(late_s)).witnesses for late_s in PUT_IN]
            for kind in ('gyro', 'gps', 'odometry'):
                said = [getattr(answer, kind) for answer in answers]
                if any(said):
                    add(drive.name, f'{name}: {kind}', said)
    text = table(['drive', 'sensor', *(f'{1e3 * late_s:+.0f} ms' for late_s in PUT_IN)], rows)
    keep_table('clocks', f'{text}\n\nBeyond 2 sigma of what was put in, or not found: {beyond} of '
               f'{len(rows) * len(PUT_IN)}; from what the same sensor has without a shift: '
               f'{by_itself}.', args)


if __name__ == '__main__':
    main()
