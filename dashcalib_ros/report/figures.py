"""Pictures of the report, without a plotting library: an SVG plot and a PNG of the mask."""
from __future__ import annotations

import base64
import math
import struct
import zlib
from collections.abc import Sequence

import numpy as np

from dashcalib_ros.arrays import Floats, GreyImage, Mask
from dashcalib_ros.judgement import TurnSummary

WIDTH, HEIGHT = 900, 260  # px of the plot
LEFT, RIGHT, TOP, BOTTOM = 56, 12, 22, 40  # px of margin
MASK_WIDTH = 640  # px; enough for the details of a mask


def magnitude_svg(magnitudes: Floats,
                  turns: Sequence[TurnSummary]) -> str:
    """Plot the turning magnitude over time, turns marked; '' when there is nothing to plot.

    magnitudes: as in Calibration. Gaps (NaN: standing) stay gaps. However long the drive, no
    more than four points per column of pixels are drawn, its extremes among them.
    """
    finite = np.asarray(np.isfinite(magnitudes).all(-1))
    if finite.sum() < 2:
        return ''
    start = float(magnitudes[finite, 0].min())
    span = max(float(magnitudes[finite, 0].max()) - start, 1e-9)
    peak = max(float(magnitudes[finite, 1].max()) * 1.1, 1e-9)
    x = LEFT + (magnitudes[:, 0] - start) / span * (WIDTH - LEFT - RIGHT)
    y = HEIGHT - BOTTOM - magnitudes[:, 1] / peak * (HEIGHT - TOP - BOTTOM)
    lines = ''.join(f'<polyline class="signal" points="{_points(part)}"/>'
                    for part in _pieces(np.column_stack([x, y]), finite))

    def across(stamp: float) -> float:
        return LEFT + (stamp - start) / span * (WIDTH - LEFT - RIGHT)

    marks = ''.join(_mark(turn, across(turn.stamp_s)) for turn in turns)
    return (f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
            f'aria-label="turning magnitude over time">{_axes(span, peak)}{marks}{lines}</svg>')


def mask_data_uri(mask: Mask) -> str:
    """Return the mask as a PNG data URI: white is used, black is the ego vehicle."""
    step = max(1, math.ceil(mask.shape[1] / MASK_WIDTH))
    grey = np.where(mask[::step, ::step], 255, 0).astype(np.uint8)
    return 'data:image/png;base64,' + base64.b64encode(png(grey)).decode('ascii')


def png(grey: GreyImage) -> bytes:
    """Encode an 8-bit grey image as PNG."""
    height, width = grey.shape
    rows = np.zeros((height, width + 1), np.uint8)  # the leading 0: no filter
    rows[:, 1:] = grey
    header = struct.pack('>IIBBBBB', width, height, 8, 0, 0, 0, 0)
    return (b'\x89PNG\r\n\x1a\n' + _chunk(b'IHDR', header)
            + _chunk(b'IDAT', zlib.compress(rows.tobytes(), 9)) + _chunk(b'IEND', b''))


def ticks(top: float, wanted: int = 6) -> list[float]:
    """Return round numbers from 0 to top, about as many as wanted."""
    raw = top / wanted
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= raw * 0.999)
    return [i * step for i in range(int(top / step + 1e-9) + 1)]


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack('>I', len(data)) + kind + data + struct.pack('>I', zlib.crc32(kind + data))


def _axes(span: float, peak: float) -> str:
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    parts = [f'<text class="title" x="{LEFT}" y="14">turning magnitude, of the image width</text>',
             f'<text class="end" x="{right}" y="{HEIGHT - 4}">time in s</text>']
    for value in ticks(peak, 4):
        y = bottom - value / peak * (bottom - TOP)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>'
                     f'<text class="end" x="{LEFT - 6}" y="{y + 4:.1f}">{value:.3g}</text>')
    for value in ticks(span, 10):
        x = LEFT + value / span * (right - LEFT)
        parts.append(f'<text class="mid" x="{x:.1f}" y="{bottom + 16}">{value:.4g}</text>')
    return ''.join(parts)


def _mark(turn: TurnSummary, x: float) -> str:
    if not LEFT <= x <= WIDTH - RIGHT:
        return ''
    kind = 'used' if turn.used else 'unused'
    return (f'<line class="{kind}" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>'
            f'<text class="mid" x="{x:.1f}" y="{TOP - 4}">{turn.center}</text>')


def _pieces(xy: Floats,
            finite: Mask) -> list[Floats]:
    """Cut at gaps, and thin each piece to its extremes per column of pixels."""
    edges = np.flatnonzero(np.diff(finite.astype(np.int8))) + 1
    pieces = [part for part, ok in zip(np.split(xy, edges), np.split(finite, edges), strict=True)
              if len(part) and ok[0]]
    return [_thin(part) for part in pieces]


def _thin(xy: Floats) -> Floats:
    columns = np.flatnonzero(np.diff(xy[:, 0].astype(np.int64))) + 1
    if len(xy) < 4 * (len(columns) + 1):
        return xy
    starts = np.concatenate([[0], columns])
    keep = {int(i) for start, part in zip(starts, np.split(xy[:, 1], columns), strict=True)
            for i in (start, start + part.argmin(), start + part.argmax(), start + len(part) - 1)}
    return xy[sorted(keep)]


def _points(xy: Floats) -> str:
    return ' '.join(f'{x:.1f},{y:.1f}' for x, y in xy)
