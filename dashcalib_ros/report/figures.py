"""The drive's plot, and pictures as data URIs."""
from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.judge import TurnSummary
from dashcalib_ros.report.charts import Axes, line, polyline, svg, text, ticks

WIDTH, HEIGHT = 900, 250  # px of the plot
ROW, APART = 16, 24  # px; of the turns' numbers, and how far apart two in one row must be
MASK_WIDTH = 640  # px; enough for the details of a mask
JPEG_QUALITY = 78


def magnitude_svg(magnitudes: Floats, turns: Sequence[TurnSummary],
                  start_s: float | None = None) -> str:
    """Plot the turning magnitude over time, turns marked by their number, from 1.

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
    axes = Axes(WIDTH, HEIGHT, ends, (0.0, peak))
    marks = [(n, turn, float(axes.across(turn.stamp_s - start)))
             for n, turn in enumerate(turns, 1)]
    marks = [mark for mark in marks if axes.left <= mark[2] <= WIDTH - axes.right]
    rows = _rows([x for _, _, x in marks])
    axes = Axes(WIDTH, HEIGHT + ROW * max(rows, default=0), ends, (0.0, peak),
                top=40 + ROW * max(rows, default=0))
    lines = ''.join(polyline(part, 'signal') for part in _pieces(
        np.column_stack([axes.across(seconds), axes.down(magnitudes[:, 1])]), finite))
    found = ''.join(_mark(n, turn, x, row, axes)
                    for (n, turn, x), row in zip(marks, rows, strict=True))
    frame = axes.frame('s since the start', 'turning magnitude, of the picture’s width',
                       ticks(*ends, 10), ticks(0.0, peak, 4))
    return svg(axes.width, axes.height, 'turning magnitude over time', frame + found + lines)


def jpeg_data_uri(image: npt.NDArray[Any]) -> str:
    """Return an image (h, w) or (h, w, 3) BGR as a JPEG data URI."""
    import cv2
    _, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return 'data:image/jpeg;base64,' + base64.b64encode(data.tobytes()).decode('ascii')


def png_data_uri(image: npt.NDArray[Any]) -> str:
    """Return an image (h, w), (h, w, 3) BGR or (h, w, 4) BGRA as a PNG data URI."""
    import cv2
    _, data = cv2.imencode('.png', image)
    return 'data:image/png;base64,' + base64.b64encode(data.tobytes()).decode('ascii')


def mask_data_uri(mask: Mask) -> str:
    """Return the mask as a PNG data URI: clear where it is used, tinted on the ego vehicle."""
    step = max(1, -(-mask.shape[1] // MASK_WIDTH))
    tint = np.zeros((*mask[::step, ::step].shape, 4), np.uint8)
    tint[~mask[::step, ::step]] = 255, 90, 150, 110
    return png_data_uri(tint)


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
        row = next((n for n, end in enumerate(ends) if abs(x - end) >= APART), len(ends))
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
