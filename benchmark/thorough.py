#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What all stretches of a drive add to its turns, behind a windscreen.

    python benchmark/thorough.py [--seeds 6001 6004] [--out DIR] [--results] [--again]

The random dashcams of population.py on longer drives: their streets get straights between the
turns, which --thorough uses. DIR/thorough has the scenes and a result for each seed.
"""
from __future__ import annotations

import os
from dataclasses import replace

from measure import done, keep_table, load, parser_with
from population import cameras, drive_of, groups, run
from wide import WideDrive

from dashcalib_ros import Config
from dashcalib_ros.demo import Drive
from dashcalib_ros.workers.worker import THREAD_VARIABLES

# m; straights of population.py are shorter than the shortest stretch
STRAIGHT_M, LEAD_M = 160.0, 120.0
# of population.py's, those behind glass
BEHIND_GLASS = (6001, 6002, 6004, 6012, 6014, 7001, 7006)


def with_straights(seed: int) -> Drive:
    """Return the drive of a seed, longer."""
    drive = drive_of(seed)
    spec = replace(drive.spec, straight_m=STRAIGHT_M, lead_m=LEAD_M)
    return type(drive)(drive.wide_lens if isinstance(drive, WideDrive) else drive.lens, spec)


def main() -> None:
    """Measure."""
    # processes that start from here inherit it: an inline calibrator needs one thread
    os.environ.update({**dict.fromkeys(THREAD_VARIABLES, '1'), 'GLOG_minloglevel': '2'})
    args = parser_with(__doc__, 'seeds', 'again', seeds=BEHIND_GLASS).parse_args()
    folder = args.out / 'thorough'
    folder.mkdir(parents=True, exist_ok=True)
    for seed in args.seeds:
        run(seed, folder, 'all', args.again, Config.of({'turns.thorough': True}), with_straights)
    rows = [row for seed in args.seeds if done(row := load(folder / f'{seed}.json'))]
    keep_table('thorough', f'{groups(rows)}\n\n{cameras(rows)}', args,
               [row['commit'] for row in rows])


if __name__ == '__main__':
    main()
