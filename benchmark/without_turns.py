#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What pieces of real drives without a sharp turn know of the focal length.

    python benchmark/without_turns.py [--data DIR] [--seconds S] [--drives NAME ...] [--results]

Each drive is cut into pieces of so many seconds; a piece with a turn of 20 degrees or more is left
out. Each piece is calibrated twice, without knowing anything and with known.stabiliser=no.
--results writes the table into benchmark/results/without_turns.md.
"""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from measure import isolated, keep_table, parser_with, table

from dashcalib_ros import Config, calibrate

# input, images per second of folders, and the truth of fx with its sigma, px
DRIVES = {'kitti03': ('bag', None, 718.2, 1.8), 'kitti07': ('images', 9.65, 701.9, 1.4),
          'kitti_raw': ('images', 9.7, 981.5, 3.0)}
# degrees
SHARP = 20.0


def piece(data: Path, name: str, start_s: float, seconds: float, stabiliser: str
          ) -> dict[str, Any]:
    """Calibrate one piece (in a process of its own)."""
    place, fps, _, _ = DRIVES[name]
    found = calibrate(data / name / place, fps=fps, start_s=start_s, duration_s=seconds,
                      config=Config.of({'known.stabiliser': stabiliser}))
    yaws = [turn.yaw_deg for turn in found.turns if turn.yaw_deg is not None]
    sigma = (found.sigma or {}).get('fx', np.nan)
    return {'verdict': found.verdict.level, 'yaw': max(yaws, default=0.0), 'scenes': len(yaws),
            'fx': np.nan if found.camera is None else found.camera.fx, 'sigma': float(sigma)}


def main() -> None:
    """Calibrate all pieces and print the table."""
    parser = parser_with(__doc__, 'data', 'drives', drives=DRIVES)
    parser.set_defaults(data=Path('data'))
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--pieces', type=int, default=8, help='of each drive, at most')
    args = parser.parse_args()
    rows, off = [], {'': list[float](), 'no': list[float]()}
    for name in args.drives:
        _, _, fx, fx_sigma = DRIVES[name]
        for n in range(args.pieces):
            for stabiliser in off:
                done = isolated(piece, args.data, name, n * args.seconds, args.seconds, stabiliser)
                # a drive may be over
                found = done.value
                if done.failure or found['yaw'] >= SHARP or not found['scenes']:
                    continue
                apart = (found['fx'] - fx) / float(np.hypot(found['sigma'], fx_sigma))
                off[stabiliser] += [apart] if np.isfinite(apart) else []
                rows.append([name, f'{n * args.seconds:.0f}', stabiliser or 'not known',
                             f'{found["scenes"]}', f'{found["yaw"]:.0f}', found['verdict'],
                             f'{found["fx"]:.1f} ± {found["sigma"]:.1f}',
                             f'{100 * (found["fx"] / fx - 1):+.1f}', f'{apart:+.1f}'])
                print(*rows[-1], flush=True)
    text = table(['drive', 'from s', 'stabiliser', 'stretches', 'largest yaw °', 'verdict', 'fx',
                  'off %', 'off in sigmas'], rows)
    for stabiliser, errors in off.items():
        text += (f'\n\nStabiliser {stabiliser or "not known"}: {len(errors)} numbers, '
                 f'{np.sqrt(np.mean(np.square(errors))) if errors else np.nan:.2f} sigmas RMS, '
                 f'{sum(abs(error) > 2 for error in errors)} beyond 2, '
                 f'{sum(abs(error) > 3 for error in errors)} beyond 3.')
    keep_table('without_turns', text, args)


if __name__ == '__main__':
    main()
