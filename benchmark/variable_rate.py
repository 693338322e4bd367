#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Videos of a variable rate, and stamps of arrival: readout, times of the turns, focal lengths.

    python benchmark/variable_rate.py [--readouts 10 20 30] [--out DIR] [--results]

A rendered drive with a rolling shutter is filmed at 20, 15 and 8.3 Hz in stretches of 4 s, each
step up to 20 % longer or shorter, and written as H.264 with B-frames. It is calibrated by the
pictures' own times, and by its mean rate. *Arrival*: taken at a steady 10 Hz, and stamped with so
many ms (RMS) of jitter. Turns: how far their centres are from where the car is halfway through the
bend; those of the same drive at a steady 10 Hz are the level to reach.
"""
from __future__ import annotations

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


def variable(drive: Drive) -> Floats:
    """Return times in s at which a phone might take pictures."""
    rng, times = np.random.default_rng(1), [0.0]
    while times[-1] < drive.times[-1]:
        period = PERIODS_S[int(times[-1] // STRETCH_S) % len(PERIODS_S)]
        times.append(times[-1] + period * rng.uniform(1 - JITTER, 1 + JITTER))
    return np.array(times[:-1])


def arrival(drive: Drive, jitter_ms: float) -> Floats:
    """Return the drive's own times as stamped when images arrive."""
    rng, period = np.random.default_rng(1), 1 / drive.spec.rate
    late = rng.normal(0.0, jitter_ms / 1e3, len(drive.times))
    return np.asarray(period + drive.times + late.clip(-0.45 * period, 0.45 * period))


def write(drive: Drive, times: Floats, stamps_s: Floats, path: Path) -> None:
    """Render a drive at these times into a video with such stamps."""
    drive.times = times
    with av.open(str(path), 'w') as container:
        stream = container.add_stream('libx264', rate=30, options={'crf': '12'})
        stream.width, stream.height = drive.lens.width, drive.lens.height
        stream.pix_fmt, stream.time_base = 'yuv420p', TICK
        stream.codec_context.time_base = TICK
        for frame, stamp_s in zip(drive.frames(), stamps_s, strict=True):
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame.image), 'gray8')
            picture = picture.reformat(format='yuv420p')
            picture.pts, picture.time_base = round(stamp_s / TICK), TICK
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))


def row(name: str, path: Path, fps: float | None, drive: Drive) -> list[str]:
    """Calibrate a video; return a line of the table."""
    centres_s = [center / drive.spec.rate for center in drive.turn_centers]
    found = calibrate(path, fps=fps, config=Config(seed=0))
    shutter = found.rolling_shutter
    readout = f'{shutter.readout_ms:.1f} ± {shutter.sigma_ms:.1f}' if shutter else 'none'
    off = [min(abs(turn.stamp_s - centre) for turn in found.turns) for centre in centres_s]
    cells = [name, found.verdict.level, readout, f'{max(off):.2f}']
    for key in ('fx', 'fy'):
        error = (getattr(found.camera, key, np.nan) / drive.truth[key] - 1) * 100
        sigma = (found.sigma or {}).get(key, np.nan) / drive.truth[key] * 100
        cells.append(f'{error:+.2f} ± {sigma:.2f}')
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
        own = drive.times
        kinds = {'steady rate': (own, own),
                 **{f'arrival, {jitter} ms': (own, arrival(drive, jitter)) for jitter in (3, 10)},
                 'variable rate': (variable(drive), variable(drive))}
        for kind, (times, stamps_s) in kinds.items():
            path = args.out / f'{kind}, {readout} ms.mp4'
            if not path.exists():
                write(drive, times, stamps_s, path.with_suffix('.part.mp4'))
                path.with_suffix('.part.mp4').rename(path)
            rows.append(row(f'{readout} ms, {kind}', path, None, drive))
        mean = (len(times) - 1) / float(times[-1])
        rows.append(row(f'{readout} ms, {kind}, by its mean', path, mean, drive))
    keep_table('variable_rate', table(
        ['video', 'verdict', 'readout, ms', 'turns off by, s', 'fx off, %', 'fy off, %'], rows),
        args)


if __name__ == '__main__':
    main()
