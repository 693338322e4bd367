"""report.html: the calibration on one page, without references to other files."""
from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np

from dashcalib_ros.judgement import Calibration
from dashcalib_ros.report.figures import magnitude_svg, mask_data_uri
from dashcalib_ros.report.result import plain_values
from dashcalib_ros.report.wording import (
    ADVICE,
    TURN_COLUMNS,
    parameter_rows,
    picture_text,
    shutter_text,
    stabiliser_text,
    stored_text,
    turn_row,
)

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1f2430; background: #fff; max-width: 58rem;
  margin: 2.5rem auto; padding: 0 1.25rem; }
h1 { font-size: 1.15rem; font-weight: 600; margin: 0 0 .75rem; }
h2 { font-size: 1.05rem; margin: 2.2rem 0 .6rem; }
.verdict { border-left: .5rem solid; padding: .7rem 1.1rem; background: #f6f7f9; }
.verdict strong { font-size: 2rem; line-height: 1.2; }
.verdict ul { margin: .4rem 0 0; padding-left: 1.2rem; }
.accepted { border-color: #1a7f4b; } .accepted strong { color: #1a7f4b; }
.weak { border-color: #b26a00; } .weak strong { color: #b26a00; }
.refused { border-color: #b3261e; } .refused strong { color: #b3261e; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; color: #555c6b; font-size: .85rem; }
th, td { padding: .3rem 1.1rem .3rem 0; border-bottom: 1px solid #e3e6eb; vertical-align: top; }
td.number, th.number { text-align: right; }
img, svg.plot { max-width: 100%; height: auto; }
img { border: 1px solid #c9ced8; }
svg.plot text { font: 11px system-ui, sans-serif; fill: #555c6b; }
.mid { text-anchor: middle; } .end { text-anchor: end; }
.grid { stroke: #e3e6eb; } .signal { fill: none; stroke: #24527a; stroke-width: 1.3; }
.used { stroke: #1a7f4b; stroke-width: 2; }
.unused { stroke: #9aa1ad; stroke-width: 2; stroke-dasharray: 4 3; }
pre { white-space: pre-wrap; overflow-wrap: anywhere; font-size: .85rem; }
.note { color: #555c6b; font-size: .9rem; max-width: 44rem; }
"""


def report_html(calibration: Calibration) -> str:
    """Return the page's text; all text from the input is escaped."""
    c = calibration
    title = f'Calibration of {c.input_name}' if c.input_name else 'Calibration'
    parts = [
        f'<h1>{escape(title)}</h1>', _verdict(c), _parameters(c),
        _listed('Warnings', c.warnings), _turns(c), _plot(c), _mask(c), _drive(c),
        _details('Details', c.details), _details('Configuration', c.config.flat()),
        _details('Versions', c.versions)]
    return ('<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<title>{escape(title)}: {c.verdict.level}</title>\n<style>{STYLE}</style>\n'
            '</head>\n<body>\n' + '\n'.join(filter(None, parts)) + '\n</body>\n</html>\n')


def _verdict(c: Calibration) -> str:
    level = c.verdict.level
    reasons = ''.join(f'<li>{escape(reason)}</li>' for reason in c.verdict.reasons)
    return (f'<section class="verdict {level}"><strong>{level}</strong><br>{ADVICE[level]}'
            + (f'<ul>{reasons}</ul>' if reasons else '') + '</section>')


def _parameters(c: Calibration) -> str:
    if c.camera is None:
        return ''
    rows = parameter_rows(c)
    size = f'{c.image_size[0]} × {c.image_size[1]} px'
    return (f'<h2>Parameters</h2>{_table(("parameter", "value", "sigma", "relative"), rows)}'
            f'<p class="note">For images of {size}, full size; {c.camera.model} model, '
            f'{c.camera.ros_model} in ROS, P: {c.config.rectified}; '
            "the first pixel's centre is (0, 0), as in ROS and OpenCV.</p>")


def _turns(c: Calibration) -> str:
    if not c.turns:
        return ''
    return f'<h2>Turns</h2>{_table(TURN_COLUMNS, [turn_row(turn) for turn in c.turns])}'


def _plot(c: Calibration) -> str:
    if c.magnitudes is None:
        return ''
    plot = magnitude_svg(c.magnitudes, c.turns)
    return plot and (f'<h2>The drive</h2>{plot}<p class="note">Green: turns used. Dashed: turns '
                     'found and not used. The numbers are their frames.</p>')


def _mask(c: Calibration) -> str:
    if c.mask is None:
        return ''
    share = 100 * (1 - float(np.mean(c.mask)))
    return (f'<h2>Ego vehicle</h2><img alt="mask" src="{mask_data_uri(c.mask)}">'
            f'<p class="note">Black ({share:.1f} % of the picture) moves with the camera and is '
            'not used.</p>')


def _drive(c: Calibration) -> str:
    rows = [('frames', str(c.frames))]
    if c.stored_turns:
        rows.append(('earlier drives', stored_text(c.stored_turns)))
    if c.reprojection_error_px is not None:
        rows.append(('reprojection error', f'{c.reprojection_error_px:.3f} px'))
    if c.sigma_px is not None:
        rows.append(('sigma', picture_text(c.sigma_px)))
    if c.rolling_shutter is not None:
        rows.append(('shutter', shutter_text(c.rolling_shutter)))
    if c.stabiliser is not None:
        rows.append(('stabiliser', stabiliser_text(c.stabiliser)))
    rows += [(f'time: {name}', f'{seconds:.1f} s') for name, seconds in c.timing.items()]
    return f'<h2>Run</h2>{_table(("", ""), rows)}'


def _listed(title: str, lines: Iterable[str]) -> str:
    items = ''.join(f'<li>{escape(line)}</li>' for line in lines)
    return items and f'<h2>{title}</h2><ul>{items}</ul>'


def _details(title: str, values: dict[str, Any]) -> str:
    if not values:
        return ''
    text = '\n'.join(f'{key}: {value if isinstance(value, str) else json.dumps(value)}'
                     for key, value in plain_values(values).items())
    return f'<h2>{title}</h2><pre>{escape(text)}</pre>'


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def cells(tag: str, texts: Sequence[str]) -> str:
        return '<tr>' + ''.join(
            f'<{tag}{"" if i == 0 else " class=number"}>{escape(text)}</{tag}>'
            for i, text in enumerate(texts)) + '</tr>'

    header = f'<thead>{cells("th", head)}</thead>' if any(head) else ''
    body = ''.join(cells('td', row) for row in rows)
    return f'<div class="scroll"><table>{header}<tbody>{body}</tbody></table></div>'
