"""overview.html: the fleet on one page, with links to each camera's report."""
from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import numpy as np

from dashcalib_ros.errors import shortened
from dashcalib_ros.fleet.tables import YEAR_S
from dashcalib_ros.report.charts import Axes, log_ticks, strokes, svg, text, ticks
from dashcalib_ros.report.files import REPORT
from dashcalib_ros.report.page import template
from dashcalib_ros.report.wording import optional

NAME = 'overview.html'
# cameras that are listed; the table has all
LISTED = 2000
# makes in the plot of focal lengths, and lines in that of drift
MAKES = 20
# sigmas; a camera drifts beyond so many
DRIFTS = 3
LEVELS = ('accepted', 'weak', 'refused')
YEAR_0 = 1970
# what a column has, where its name does not say it
TITLES = {
    'sigma %': 'one standard deviation of fx, in % of it', 'spread %': 'between cameras, robust',
    'sigma px': 'over the picture, the best rotation removed',
    'prior %': 'of the information about fx, from its make', 'clips': 'used of all',
    'turns': 'used', '% per year': 'change of fx'}

Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Section:
    """A part of the page; one without rows and figure is left out. figure: an SVG."""

    title: str
    head: Sequence[str] = ()
    rows: Sequence[Sequence[Any]] = ()
    figure: str = ''
    caption: str = ''
    note: str = ''


def overview_html(cameras: Rows, clips: Rows) -> str:
    """Return the page's text from the rows of both tables; texts from the input are escaped."""
    verdicts, statuses = (Counter(row[key] for row in rows)
                          for rows, key in ((cameras, 'verdict'), (clips, 'status')))
    sections = [
        Section('Clips', ('status', 'clips'), sorted(statuses.items())), _makes(cameras),
        _sigma_by_turns(cameras), _drift(cameras, clips),
        Section('In another mode than their make', ('camera', 'make', ''),
                [(_link(row), row['make'] or '', row['prior_note'])
                 for row in cameras if row['other_mode']]),
        _reasons('Clips that are not used', [
            (row['reason'], row['clip']) for row in clips
            if row['status'] in ('unreadable', 'left out', 'no scene')]),
        _reasons('Cameras that are not accepted', [
            (reason, row['camera']) for row in cameras if row['verdict'] != 'accepted'
            for reason in row['reasons']]),
        _listed(cameras)]
    return template('overview.html').render(
        cameras=len(cameras), clips=len(clips), titles=TITLES, sections=sections,
        hours=sum(row['seconds'] for row in clips) / 3600,
        verdicts=[(level, verdicts[level]) for level in LEVELS])


def _makes(cameras: Rows) -> Section:
    """Return each make's focal lengths: their middle and spread, and all of them in a plot."""
    makes: dict[str, list[Mapping[str, Any]]] = {}
    for row in cameras:
        if row['fx']:
            makes.setdefault(f'{row["make"] or "unknown"}, {row["width"]} px', []).append(row)
    rows = []
    for make, known in sorted(makes.items()):
        values = np.array([row['fx'] for row in known])
        middle = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - middle)))
        rows.append((make, len(known), f'{middle:.1f}', f'{100 * spread / middle:.2f}'))
    return Section('Focal lengths by make', ('make', 'cameras', 'median fx', 'spread %'), rows,
                   *_fx_by_make(makes) if rows else ())


def _fx_by_make(makes: Mapping[str, Rows]) -> tuple[str, str]:
    shown = sorted(makes, key=lambda make: (-len(makes[make]), make))[:MAKES]
    low, high = _ends([row['fx'] for make in shown for row in makes[make]])
    axes = Axes(900, 70 + 26 * len(shown), (low, high), (0.5 - len(shown), 0.5), left=190)
    parts = [axes.frame('fx, px', '', ticks(low, high), ())]
    for n, make in enumerate(sorted(shown)):
        parts.append(text(180, float(axes.down(-n)) + 4, shortened(make, 26), 'end'))
        parts.append(_dots(axes, [(row['fx'], -n, row['verdict']) for row in makes[make]]))
    return _figure('fx of each camera by make and image width', axes, parts)


def _sigma_by_turns(cameras: Rows) -> Section:
    title = 'What turns are worth'
    found = [(max(row['turns_used'], 1), 100 * row['sigma_fx'] / row['fx'], row['verdict'])
             for row in cameras if row['fx'] and row['sigma_fx']]
    if not found:
        return Section(title)
    x, y = _ends([turns for turns, _, _ in found]), _ends([sigma for _, sigma, _ in found])
    x, y = (max(x[0], 0.8), x[1]), (min(sigma for _, sigma, _ in found) / 1.3, y[1] * 1.2)
    axes = Axes(900, 320, x, y, log_x=True, log_y=True)
    parts = [axes.frame('turns used', 'sigma of fx, %', log_ticks(*x), log_ticks(*y)),
             _dots(axes, found)]
    return Section(title, (), (), *_figure('sigma of fx against the turns that were used', axes,
                                           parts))


def _drift(cameras: Rows, clips: Rows) -> Section:
    """Return what each dated clip alone says of fx, over time; lines: cameras that drift."""
    own = {row['camera']: row['fx'] for row in cameras if row['fx']}
    found = [(YEAR_0 + row['time'] / YEAR_S, 100 * (row['fx'] / own[row['camera']] - 1),
              row['camera']) for row in clips
             if row['time'] and row['fx'] and row['camera'] in own]
    if not found:
        return Section('Drift')
    x, y = _ends([year for year, _, _ in found]), _ends([off for _, off, _ in found])
    axes = Axes(900, 320, x, y)
    parts = [axes.frame('year', 'fx of a clip, % off its camera', ticks(*x), ticks(*y)),
             _dots(axes, [(year, off, '') for year, off, _ in found])]
    drifting = sorted((row for row in cameras if row['drift_sigma']
                       and abs(row['drift_percent_per_year']) > DRIFTS * row['drift_sigma']),
                      key=lambda row: -abs(row['drift_percent_per_year']))
    for row in drifting[:MAKES]:
        own_clips = np.array([each[:2] for each in found if each[2] == row['camera']])
        if len(own_clips):
            middle, off = own_clips.mean(axis=0)
            ends = np.array([own_clips[:, 0].min(), own_clips[:, 0].max()])
            line = off + row['drift_percent_per_year'] * (ends - middle)
            parts.append(strokes([axes.places(ends, line)], 'all-turns'))
    return Section(
        'Drift', ('camera', '% per year', 'sigma'),
        [(row['camera'], f'{row["drift_percent_per_year"]:+.2f}', f'{row["drift_sigma"]:.2f}')
         for row in drifting],
        *_figure(f'fx that each dated clip alone has; lines: cameras that drift by more than '
                 f'{DRIFTS} sigma', axes, parts))


def _ends(values: Sequence[float]) -> tuple[float, float]:
    """Return the ends of an axis that shows all values."""
    low, high = min(values), max(values)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def _dots(axes: Axes, found: Sequence[tuple[float, float, str]]) -> str:
    """Return (x, y, verdict) as dots, LISTED at the most, evenly chosen."""
    some = found[::-(-len(found) // LISTED)]
    return ''.join(
        f'<g class="{verdict}">' + strokes(axes.places(
            np.array([x for x, _, each in some if each == verdict], float),
            np.array([y for _, y, each in some if each == verdict], float))[:, None],
            'dot all' if verdict else 'dot own') + '</g>'
        for verdict in sorted({each for _, _, each in some}))


def _figure(caption: str, axes: Axes, parts: Sequence[str]) -> tuple[str, str]:
    return svg(axes.width, axes.height, caption, ''.join(parts)), caption


def _reasons(title: str, found: Iterable[tuple[str, str]]) -> Section:
    """Return how often each reason came; reasons that differ in numbers only are one."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for reason, name in found:
        plain = re.sub(r'\d+(\.\d+)?', 'N', reason.replace(name, '')) if name else reason
        groups.setdefault(plain, []).append((reason, name))
    ranked = sorted(groups.values(), key=lambda group: (-len(group), group[0]))
    return Section(title, ('reason', 'how many', 'such as'),
                   [(group[0][0], len(group), group[0][1]) for group in ranked[:50]])


def _listed(cameras: Rows) -> Section:
    rows = [(_link(row), row['make'] or '', row['verdict'], row['model'] or '-',
             optional(row['fx'], 1),
             '-' if row['fx'] is None else f'{100 * row["sigma_fx"] / row["fx"]:.2f}',
             optional(row['sigma_px'], 2),
             f'{100 * row["prior_share"]:.0f}' if row['prior_units'] else '-',
             f'{row["clips_used"]} of {row["clips"]}', row['turns_used'])
            for row in cameras[:LISTED]]
    more = len(cameras) - LISTED
    return Section('Cameras', ('camera', 'make', 'verdict', 'model', 'fx', 'sigma %', 'sigma px',
                               'prior %', 'clips', 'turns'), rows,
                   note=f'{more} more are in the table of cameras.' if more > 0 else '')


def _link(row: Mapping[str, Any]) -> str:
    """Return a camera's name, with a link to its report where there is one."""
    # loaded with jinja2, by who writes a page
    from markupsafe import Markup
    if row['verdict_alone'] == 'refused' and row['model'] is None and not row['width']:
        return str(row['camera'])
    return Markup('<a href="{}/{}">{}</a>').format(quote(row['folder']), REPORT, row['camera'])
