#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The paper's ablation: what leaving the ego vehicle out of the picture is worth.

    python benchmark/ego_mask.py [--seeds 0 1 2] [--drives dashcam wide] [--out DIR]
                                 [--results]

Rendered drives behind bonnet, pillar and time stamp, each calibrated with the automatic mask,
without any, and with the renderer's own: what it paints over, and 1 % of the width around it, for
windows reach beyond the points they follow. DIR/ego_mask.json is written after each calibration,
and begun again where it ends; a table is printed at the end, and kept as DIR/ego_mask.md.
"""
from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from measure import (
    KEYS,
    commit,
    error_cells,
    keep_table,
    load,
    parser_with,
    save,
    summarised,
    table,
)

from dashcalib_ros import Calibrator, Config
from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.input import Frame

Mask = npt.NDArray[np.bool_]

LENSES = {
    'dashcam': Lens.of(960, 540, 75.0, -0.30, 0.10, (14.0, -9.0), 1.003),
    'wide': Lens.of(960, 540, 115.0, -0.22, 0.04, (-15.0, 9.0), 0.998),
}
AUTOMATIC, NONE, EXACT, WIDER = WAYS = ('automatic', 'none', 'exact', 'exact, 1 % wider')


def painted_over(drive: Drive) -> Mask:
    """Return (height, width): what the windscreen's picture hides in any of the frames."""
    hidden = np.zeros((drive.lens.height, drive.lens.width), bool)
    for stamp_ns in {drive.stamp_ns(index) // 10**9 * 10**9 for index in range(len(drive))}:
        for grey in (0.0, 255.0):
            picture = np.full(hidden.shape, grey, np.float32)
            drive.overlay.apply(picture, stamp_ns)
            hidden |= picture != grey
    return hidden


def grown(hidden: Mask, px: int) -> Mask:
    """Return the mask with a margin around what it hides."""
    square = np.ones((2 * px + 1, 2 * px + 1), np.uint8)
    return np.asarray(cv2.dilate(hidden.astype(np.uint8), square) > 0)


def calibrated(drive: Drive, frames: Sequence[Frame], hidden: Mask, way: str) -> dict[str, Any]:
    """Calibrate in one of the WAYS; return the errors, and how well the mask fits."""
    config = Config().replace({'mask.enabled': way == AUTOMATIC, 'seed': drive.spec.seed})
    given = {EXACT: ~hidden, WIDER: ~grown(hidden, drive.lens.width // 100)}.get(way)
    started = time.monotonic()
    with Calibrator(config, given) as calibrator:
        for frame in frames:
            calibrator.push(frame)
        result = calibrator.calibrate()
    left_out = np.zeros(hidden.shape, bool) if result.mask is None else ~result.mask
    return {'way': way, 'seconds': round(time.monotonic() - started, 1),
            'mask': {'hidden': hidden.mean(), 'left_out': left_out.mean(),
                     'covered': left_out[hidden].mean(),
                     'too_much': (left_out & ~grown(hidden, drive.lens.width // 50)).mean()},
            **summarised(result, drive.truth)}


def report(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return every drive and way, then the ways' medians over the drives, in Markdown."""
    percent = [f'{key} %' for key in KEYS]
    each = table(
        ['drive', 'mask', 'verdict', 'turns', *percent, 'worst error in sigmas',
         'of the vehicle left out %', 'of the picture wrongly %'],
        ([row['drive'], row['way'], row['verdict'], str(row['turns_used']), *error_cells(row),
          f'{max(map(abs, row["z"].values())):.1f}' if 'z' in row else '',
          f'{100 * row["mask"]["covered"]:.0f}', f'{100 * row["mask"]["too_much"]:.1f}']
         for row in rows.values()))
    medians = []
    for way in WAYS:
        of_way = [row for row in rows.values() if row['way'] == way]
        found = [row for row in of_way if 'percent' in row]
        cells = [f'{statistics.median(row["percent"][key] for row in found):.2f}' if found else ''
                 for key in KEYS]
        accepted = sum(row['verdict'] == 'accepted' for row in of_way)
        medians.append([way, f'{accepted} of {len(of_way)}', *cells])
    return each + '\n\n' + table(['mask', 'accepted', *(f'{key}, median' for key in percent)],
                                 medians)


def main() -> None:
    """Run what is asked for."""
    arguments = parser_with(__doc__, 'seeds', 'drives', drives=LENSES).parse_args()
    path = arguments.out / 'ego_mask.json'
    rows = load(path)
    for name in arguments.drives:
        for seed in arguments.seeds:
            wanted = {f'{name}, seed {seed}, {way}': way for way in WAYS}
            if wanted.keys() <= rows.keys():
                continue
            drive = Drive(LENSES[name], DriveSpec(seed=seed, bonnet=True, pillar=True,
                                                  timestamp=True))
            frames = list(drive.frames(processes=2))
            hidden = painted_over(drive)
            for key, way in wanted.items():
                if key not in rows:
                    rows[key] = {'drive': f'{name}, seed {seed}', 'commit': commit(),
                                 **calibrated(drive, frames, hidden, way)}
                    save(path, rows)
                    print(key, rows[key]['verdict'], *error_cells(rows[key]), flush=True)
    keep_table('ego_mask', report(rows), arguments, [row['commit'] for row in rows.values()])


if __name__ == '__main__':
    main()
