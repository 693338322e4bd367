#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Videos of a variable rate: the readout that is found, and the times of the turns.

    python benchmark/variable_rate.py [--readouts 10 20 30] [--out DIR] [--results]

A rendered drive with a rolling shutter is filmed at 20, 15 and 8.3 Hz in stretches of 4 s, each
step up to 20 % longer or shorter, and written as H.264 with B-frames. It is calibrated by the
pictures' own times, and by its mean rate. Turns: how far their centres are from where the car is
halfway through the bend; those of the same drive at a steady 10 Hz are the level to reach.
"""
from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
from drives import BY_NAME, drive_of
from measure import complain, keep_table, parser_with, table

from dashcalib_ros import Config
from dashcalib_ros.demo import Drive
from dashcalib_ros.session import calibrate

PERIODS_S, STRETCH_S, JITTER = (0.050, 0.067, 0.120), 4.0, 0.2
TICK = Fraction(1, 90000)
Floats = npt.NDArray[np.float64]


def steady(drive: Drive) -> Floats:
    """Return the drive's own times."""
    return drive.times


def variable(drive: Drive) -> Floats:
    """Return times in s at which a phone might take pictures."""
    rng, times = np.random.default_rng(1), [0.0]
    while times[-1] < drive.times[-1]:
        period = PERIODS_S[int(times[-1] // STRETCH_S) % len(PERIODS_S)]
        times.append(times[-1] + period * rng.uniform(1 - JITTER, 1 + JITTER))
    return np.array(times[:-1])


def write(drive: Drive, times: Floats, path: Path) -> None:
    """Render a drive at these times into a video."""
    drive.times = times
    with av.open(str(path), 'w') as container:
        stream = container.add_stream('libx264', rate=30, options={'crf': '12'})
        stream.width, stream.height = drive.lens.width, drive.lens.height
        stream.pix_fmt, stream.time_base = 'yuv420p', TICK
        stream.codec_context.time_base = TICK
        for frame, time in zip(drive.frames(), times, strict=True):
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame.image), 'gray8')
            picture = picture.reformat(format='yuv420p')
            picture.pts, picture.time_base = round(time / TICK), TICK
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))


def row(name: str, path: Path, fps: float | None, centres_s: Sequence[float]) -> list[str]:
    """Calibrate a video; return a line of the table."""
    found = calibrate(path, fps=fps, config=Config(seed=0))
    shutter = found.rolling_shutter
    readout = f'{shutter.readout_ms:.1f} ± {shutter.sigma_ms:.1f}' if shutter else 'none'
    off = [min(abs(turn.stamp_s - centre) for turn in found.turns) for centre in centres_s]
    cells = [name, found.verdict.level, readout, f'{max(off):.2f}',
             f'{found.camera.fx:.1f}' if found.camera else '']
    complain(' '.join(cells))
    return cells


def main() -> None:
    """Write the videos, and a table."""
    parser = parser_with(__doc__)
    parser.add_argument('--readouts', nargs='+', type=int, default=[10, 20, 30])
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for readout in args.readouts:
        drive = drive_of(BY_NAME[f'rolling shutter {readout} ms'], 0)
        centres_s = [center / drive.spec.rate for center in drive.turn_centers]
        for kind in (steady, variable):
            times, path = kind(drive), args.out / f'{kind.__name__}_{readout}.mp4'
            if not path.exists():
                write(drive, times, path.with_suffix('.part.mp4'))
                path.with_suffix('.part.mp4').rename(path)
            name = f'{readout} ms, {kind.__name__} rate'
            rows.append(row(name, path, None, centres_s))
        mean = (len(times) - 1) / float(times[-1])
        rows.append(row(f'{name}, by its mean', path, mean, centres_s))
    keep_table('variable_rate', table(
        ['video', 'verdict', 'readout, ms', 'turns off by, s', 'fx'], rows), args)


if __name__ == '__main__':
    main()
