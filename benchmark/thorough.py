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
from pathlib import Path

from measure import commit, complain, done, isolated, keep_table, load, parser_with, save
from population import cameras, drive_of, groups, measured, reconstructed, save_case
from wide import WideDrive

from dashcalib_ros import Config
from dashcalib_ros.workers.worker import THREAD_VARIABLES

# m; straights of population.py are shorter than the shortest stretch
STRAIGHT_M, LEAD_M = 160.0, 120.0
# of population.py's, those behind glass
BEHIND_GLASS = (6001, 6002, 6004, 6012, 6014, 7001, 7006)


def _write_case(seed: int, path: Path) -> None:
    drive = drive_of(seed)
    spec = replace(drive.spec, straight_m=STRAIGHT_M, lead_m=LEAD_M)
    lens = drive.wide_lens if isinstance(drive, WideDrive) else drive.lens
    save_case(reconstructed(type(drive)(lens, spec), Config.of({'turns.thorough': True})), path)


def main() -> None:
    """Measure."""
    # processes that start from here inherit it: an inline calibrator needs one thread
    os.environ.update({**dict.fromkeys(THREAD_VARIABLES, '1'), 'GLOG_minloglevel': '2'})
    args = parser_with(__doc__, 'seeds', 'again', seeds=BEHIND_GLASS).parse_args()
    folder = args.out / 'thorough'
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in args.seeds:
        scenes, result = folder / f'{seed}.scenes.pkl', folder / f'{seed}.json'
        if args.again or not done(load(result) or None):
            made = None if scenes.exists() else isolated(_write_case, seed, scenes)
            outcome = made if made and made.failure else isolated(measured, scenes)
            row = outcome.value or {'verdict': 'failed', 'reasons': [outcome.failure]}
            save(result, {'seed': seed, 'commit': commit(), **row})
            complain(f'{seed}: {row["verdict"]}')
        rows.append(load(result))
    rows = [row for row in rows if done(row)]
    keep_table('thorough', f'{groups(rows)}\n\n{cameras(rows)}', args,
               [row['commit'] for row in rows])


if __name__ == '__main__':
    main()
