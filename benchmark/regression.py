#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Do two versions of the code give the same numbers? Six drives, bit for bit.

    python benchmark/regression.py --data DIR [--cache DIR] [--against FILE] --out FILE

Calibrates KITTI 03, the demo drive and four rendered settings, and writes what each result says:
verdict, reasons, intrinsics, sigma and turns, at full precision, and the seconds and memory each
took. --against: a file that another version wrote; every difference is listed, in sigmas of the
older result where there are any, and the exit code is 1 if there is one.
"""
from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from drives import BY_NAME, drive_of, pictures_of
from measure import Outcome, calibrate, commit, isolated, load, save

from dashcalib_ros import Config, open_frames
from dashcalib_ros.demo import demo_drive
from dashcalib_ros.formats import result_dict
from dashcalib_ros.input import Frame

SETTINGS = ('rolling shutter 20 ms', 'dashcam: bonnet, text', 'one turn', 'turning on the spot')
COMPARED = ('verdict', 'reasons', 'intrinsics', 'sigma', 'turns', 'frames',
            'reprojection_error_px', 'rolling_shutter', 'warnings')


def measured(frames: Iterable[Frame]) -> dict[str, Any]:
    """Calibrate a drive (in a process of its own) and return what the result says."""
    calibration, seconds = calibrate(frames, Config())
    result = result_dict(calibration)
    return {**{key: result[key] for key in COMPARED}, 'seconds': seconds}


def recorded(path: Path) -> dict[str, Any]:
    """Calibrate a recorded drive (in a process of its own)."""
    return measured(open_frames(path))


def row_of(outcome: Outcome) -> dict[str, Any]:
    """Return a drive's row: its result, or why there is none, and what it cost."""
    found = outcome.value or {'verdict': 'failed', 'reasons': [outcome.failure]}
    return {**found, 'peak_mb': round(outcome.peak_mb)}


def differences(new: Mapping[str, Any], old: Mapping[str, Any]) -> list[str]:
    """Return a line for each thing in which two rows differ."""
    lines = []
    for key in COMPARED:
        if new.get(key) == old.get(key):
            continue
        # of one camera model
        alike = (key in ('intrinsics', 'sigma') and new.get(key) and old.get(key)
                 and new[key].keys() == old[key].keys())
        if key == 'intrinsics' and alike:
            lines += [f'{name}: {value!r}, was {old[key][name]!r} '
                      f'({(value - old[key][name]) / old["sigma"][name]:+.2g} sigma)'
                      for name, value in new[key].items() if value != old[key][name]]
        elif key == 'sigma' and alike:
            lines += [f'sigma of {name}: {100 * (value / old[key][name] - 1):+.2g} %'
                      for name, value in new[key].items()
                      if not math.isclose(value, old[key][name], rel_tol=0, abs_tol=0)]
        else:
            lines.append(f'{key}: {new.get(key)!r}, was {old.get(key)!r}')
    return lines


def main() -> int:
    """Measure, write, compare."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--data', type=Path, help='a folder with kitti03/')
    parser.add_argument('--cache', type=Path, default=Path('measured/pictures'),
                        help='where rendered pictures are kept')
    parser.add_argument('--against', type=Path, help='what another version wrote')
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--only', nargs='+', help='part of the drives\' names')
    args = parser.parse_args()
    drives: dict[str, Any] = {'demo': demo_drive(0)}
    drives |= {name: drive_of(BY_NAME[name], 0) for name in SETTINGS}
    names = ([] if args.data is None else ['kitti03']) + list(drives)
    if args.only:
        names = [name for name in names if any(part in name for part in args.only)]
    rows: dict[str, Any] = {}
    for name in names:
        if name == 'kitti03':
            outcome = isolated(recorded, args.data / 'kitti03' / 'bag')
        else:
            outcome = isolated(measured, pictures_of(drives[name], args.cache))
        rows[name] = row_of(outcome)
        save(args.out, {'commit': commit(), 'drives': rows})
        print(f'{name}: {rows[name]["verdict"]}, {outcome.seconds:.1f} s, '
              f'{outcome.peak_mb:.0f} MB', flush=True)
    if args.against is None:
        return 0
    old = load(args.against)['drives']
    # what was written once is what was read again: floats survive JSON
    new = json.loads(json.dumps(rows))
    found = {name: differences(new[name], old[name]) for name in names if name in old}
    for name, lines in found.items():
        print(f'{name}: ' + ('the same' if not lines else '\n  '.join(['differs', *lines])))
    return int(any(found.values()))


if __name__ == '__main__':
    sys.exit(main())
