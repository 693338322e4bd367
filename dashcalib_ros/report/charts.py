# SPDX-License-Identifier: Apache-2.0
"""SVG, the little of it that the report needs, and its plot of the drive; style.css has colours.

Pictures become data URIs.
"""
from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.judge import TurnSummary

PLOT_WIDTH, PLOT_HEIGHT = 900, 250  # px of the plot
ROW, NUMBERS_APART = 16, 24  # px; of the turns' numbers, and how far apart two in one row must be
MASK_WIDTH = 640  # px; enough for the details of a mask
JPEG_QUALITY = 78
MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500)


@dataclass(frozen=True)
class Axes:
    """A plot's frame. width, height: of the drawing, px; x, y: the values at its edges.

    left, right, top, bottom: margins, px. log_x, log_y: logarithmic.
    """

    width: int
    height: int
    x: tuple[float, float]
    y: tuple[float, float]
    left: int = 52
    right: int = 14
    top: int = 24
    bottom: int = 40
    log_x: bool = False
    log_y: bool = False

    def across(self, x: float | Floats) -> Floats:
        """Return where values lie from left to right, px."""
        share = _share(x, self.x, self.log_x)
        return self.left + share * (self.width - self.left - self.right)

    def down(self, y: float | Floats) -> Floats:
        """Return where values lie from top to bottom, px."""
        share = _share(y, self.y, self.log_y)
        return self.height - self.bottom - share * (self.height - self.top - self.bottom)

    def places(self, x: Floats, y: Floats) -> Floats:
        """Return (n, 2) where points lie, px."""
        return np.column_stack([self.across(x), self.down(y)])

    def frame(self, x_label: str, y_label: str, x_ticks: Sequence[float],
              y_ticks: Sequence[float]) -> str:
        """Return the grid, its numbers and both labels: above the plot, and below its end."""
        low, right = self.height - self.bottom, self.width - self.right
        parts = [text(self.left - 40, 13, y_label, 'label'),
                 text(right, self.height - 5, x_label, 'label end')]
        for value in y_ticks:
            y = float(self.down(value))
            parts.append(line(self.left, y, right, y, 'grid')
                         + text(self.left - 6, y + 4, f'{value:.4g}', 'end'))
        for value in x_ticks:
            x = float(self.across(value))
            parts.append(line(x, low, x, low + 4, 'grid')
                         + text(x, low + 17, f'{value:.6g}', 'mid'))
        return ''.join(parts)


def svg(width: float, height: float, label: str, content: str, kind: str = 'plot') -> str:
    """Return a drawing of this size. label: for those who cannot see it."""
    return (f'<svg class="{kind}" viewBox="0 0 {width:g} {height:g}" role="img" '
            f'aria-label="{escape(label)}">{content}</svg>')


def text(x: float, y: float, content: str, kind: str = '') -> str:
    """Return a text; kind: its classes."""
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}">{escape(content)}</text>'


def line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    """Return a straight line."""
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def strokes(lines: Iterable[Floats], kind: str, more: str = '') -> str:
    """Return one path of lines, each through points (n, 2); one of a single point is a dot.

    more: attributes of the path.
    """
    return f'<path class="{kind}"{more} d="{outline(lines)}"/>'


def outline(lines: Iterable[Floats]) -> str:
    """Return the d of such a path."""
    return ''.join('M' + 'L'.join(f'{x:.1f} {y:.1f}' for x, y in points)
                   + 'h0' * (len(points) == 1) for points in lines)


def arrows(starts: Floats, moves: Floats, kind: str) -> str:
    """Return one path of lines from points (n, 2) by moves (n, 2)."""
    return strokes(np.stack([starts, starts + moves], 1), kind)


def picture(href: str, width: float, height: float, more: str = '') -> str:
    """Return an image that fills a drawing of this size."""
    return (f'<image href="{href}" width="{width:g}" height="{height:g}" '
            f'preserveAspectRatio="none"{more}/>')


def mask_over(mask_id: str | None, width: float, height: float) -> str:
    """Return the page's mask over a drawing of this size; '' where there is none."""
    return '' if mask_id is None else (
        f'<svg width="{width:g}" height="{height:g}" viewBox="0 0 100 100" '
        f'preserveAspectRatio="none"><use href="#{mask_id}"/></svg>')


def magnification(moves: Floats, longest: float) -> int:
    """Return how many times as long moves (n, 2) may be drawn, so that nine of ten fit."""
    long = float(np.quantile(np.linalg.norm(moves, axis=1), 0.9)) if len(moves) else 0.0
    return max((times for times in MAGNIFICATIONS if times * long <= longest), default=1)


def ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Return round numbers from low to high, about as many as wanted."""
    if not high > low:
        return [low]
    raw = (high - low) / wanted
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [n * step for n in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return round numbers from low to high for a logarithmic axis."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1, 2, 3, 4, 5, 6, 8) if high / low < 6 else (1, 2, 5) if high / low < 200 else (1,)
    return [m * 10.0**n for n in powers for m in steps if low <= m * 10.0**n <= high]


def _share(value: float | Floats, ends: tuple[float, float], log: bool) -> Floats:
    low, high = ends
    if log:
        value, low, high = np.log(value), math.log(low), math.log(high)
    return np.asarray((value - low) / max(high - low, 1e-300), np.float64)


def magnitude_svg(magnitudes: Floats, turns: Sequence[TurnSummary],
                  start_s: float | None = None, spans: Iterable[tuple[float, float, float]] = ()
                  ) -> str:
    """Plot the turning magnitude over time, turns marked by their number, from 1.

    spans: stamps, s, between which something counts, and its share of all information about fx:
    so high a bar of the plot's height.

    magnitudes: as in Calibration; '' when there is nothing to plot. start_s: stamp of the drive's
    start, by default the first one here. Gaps (NaN: standing) stay gaps. However long the drive,
    no more than four points per column of pixels are drawn, its extremes among them.
    """
    finite = np.asarray(np.isfinite(magnitudes).all(-1))
    if finite.sum() < 2:
        return ''
    start = float(magnitudes[finite, 0].min()) if start_s is None else start_s
    seconds = magnitudes[:, 0] - start
    ends = float(seconds[finite].min()), float(seconds[finite].max())
    ends = min(ends[0], 0.0) if ends[0] < 0.2 * ends[1] else ends[0], max(ends[1], ends[0] + 1e-9)
    peak = max(float(magnitudes[finite, 1].max()) * 1.1, 1e-9)
    axes = Axes(PLOT_WIDTH, PLOT_HEIGHT, ends, (0.0, peak))
    marks = [(n, turn, float(axes.across(turn.stamp_s - start)))
             for n, turn in enumerate(turns, 1)]
    marks = [mark for mark in marks if axes.left <= mark[2] <= PLOT_WIDTH - axes.right]
    rows = _rows([x for _, _, x in marks])
    axes = Axes(PLOT_WIDTH, PLOT_HEIGHT + ROW * max(rows, default=0), ends, (0.0, peak),
                top=40 + ROW * max(rows, default=0))
    lines = strokes(_pieces(axes.places(seconds, magnitudes[:, 1]), finite), 'signal')
    found = ''.join(_mark(n, turn, x, row, axes)
                    for (n, turn, x), row in zip(marks, rows, strict=True))
    found = ''.join(_bar(begin_s - start, end_s - start, share, axes)
                    for begin_s, end_s, share in spans) + found
    frame = axes.frame('s since the start', 'turning magnitude, of the picture’s width',
                       ticks(*ends, 10), ticks(0.0, peak, 4))
    return svg(axes.width, axes.height, 'turning magnitude over time', frame + found + lines)


def data_uri(image: npt.NDArray[Any], kind: Literal['jpeg', 'png'] = 'jpeg') -> str:
    """Return an image (h, w), (h, w, 3) BGR, as a PNG also (h, w, 4) BGRA, as a data URI."""
    import cv2
    _, data = cv2.imencode(f'.{kind}', image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
                           if kind == 'jpeg' else [])
    return f'data:image/{kind};base64,' + base64.b64encode(data.tobytes()).decode('ascii')


def mask_data_uri(mask: Mask) -> str:
    """Return the mask as a PNG data URI: clear where it is used, tinted on the ego vehicle."""
    step = max(1, -(-mask.shape[1] // MASK_WIDTH))
    tint = np.zeros((*mask[::step, ::step].shape, 4), np.uint8)
    tint[~mask[::step, ::step]] = 255, 90, 150, 110
    return data_uri(tint, 'png')


def _bar(begin_s: float, end_s: float, share: float, axes: Axes) -> str:
    left, right = (float(axes.across(each)) for each in (begin_s, end_s))
    high = min(max(share, 0.0), 1.0) * (axes.height - axes.top - axes.bottom)
    return (f'<rect class="band" x="{left:.1f}" y="{axes.height - axes.bottom - high:.1f}" '
            f'width="{max(right - left, 1.0):.1f}" height="{high:.1f}"/>')


def _mark(number: int, turn: TurnSummary, x: float, row: int, axes: Axes) -> str:
    kind = 'used' if turn.used else 'unused'
    y = axes.top - 6 - ROW * row
    return (line(x, y + 4, x, axes.height - axes.bottom, kind)
            + text(x, y, str(number), f'mid number {kind}-text'))


def _rows(places: Sequence[float]) -> list[int]:
    """Return a row for each label at these places, so that no two of a row touch."""
    ends: list[float] = []
    rows = []
    for x in places:
        row = next((n for n, end in enumerate(ends) if abs(x - end) >= NUMBERS_APART), len(ends))
        ends[row:row + 1] = [x]
        rows.append(row)
    return rows


def _pieces(xy: Floats, finite: Mask) -> list[Floats]:
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
