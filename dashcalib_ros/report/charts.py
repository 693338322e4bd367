"""SVG, the little of it that the report's plots need; colours are in style.css."""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from dashcalib_ros.arrays import Floats


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


def polyline(xy: Floats, kind: str) -> str:
    """Return a line through points (n, 2)."""
    points = ' '.join(f'{x:.1f},{y:.1f}' for x, y in xy)
    return f'<polyline class="{kind}" points="{points}"/>'


def dots(xy: Floats, kind: str) -> str:
    """Return one path of round dots at points (n, 2), as large as its stroke is wide."""
    return f'<path class="{kind}" d="{"".join(f"M{x:.1f} {y:.1f}h0" for x, y in xy)}"/>'


def segments(starts: Floats, moves: Floats, kind: str) -> str:
    """Return one path of separate lines from points (n, 2) by moves (n, 2)."""
    parts = (f'M{x:.1f} {y:.1f}l{dx:.1f} {dy:.1f}'
             for (x, y), (dx, dy) in zip(starts, moves, strict=True))
    return f'<path class="{kind}" d="{"".join(parts)}"/>'


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
