"""overview.html: the fleet on one page, with links to each camera's report."""
from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

import numpy as np

from dashcalib_ros.errors import shortened
from dashcalib_ros.fleet.tables import YEAR_S
from dashcalib_ros.report.charts import Axes, dots, log_ticks, polyline, svg, text, ticks
from dashcalib_ros.report.files import REPORT
from dashcalib_ros.report.page import page_style

NAME = 'overview.html'
# cameras that are listed; the table has all
LISTED = 2000
# makes in the plot of focal lengths, and lines in that of drift
MAKES = 20
# sigmas; a camera drifts beyond so many
DRIFTS = 3
LEVELS = ('accepted', 'weak', 'refused')
YEAR_0 = 1970
STYLE = '''
.verdicts { display: flex; gap: 2px; }
.verdicts span { background: var(--accent); color: var(--paper); padding: .3rem .5rem;
  min-width: fit-content; white-space: nowrap; }
th button { all: unset; cursor: pointer; }
th button:focus-visible { outline: 2px solid var(--line); }
th[aria-sort=ascending] button::after { content: " \\2191"; }
th[aria-sort=descending] button::after { content: " \\2193"; }
'''
# a click on a column's name sorts by it: numbers first, by size
SORTING = '''
document.addEventListener('click', event => {
  const head = event.target.closest('th'), body = head?.closest('table').tBodies[0];
  if (!body || !event.target.closest('button')) return;
  const up = head.getAttribute('aria-sort') !== 'ascending', place = head.cellIndex;
  for (const other of head.parentNode.cells) other.removeAttribute('aria-sort');
  head.setAttribute('aria-sort', up ? 'ascending' : 'descending');
  const of = row => row.cells[place].textContent, size = text => parseFloat(text);
  const compare = (a, b) => isNaN(size(a)) || isNaN(size(b))
    ? isNaN(size(a)) - isNaN(size(b)) || a.localeCompare(b) : size(a) - size(b);
  body.append(...[...body.rows].sort((a, b) => (up ? 1 : -1) * compare(of(a), of(b))));
});
'''
# what a column has, where its name does not say it
TITLES = {
    'sigma %': 'one standard deviation of fx, in % of it', 'spread %': 'between cameras, robust',
    'sigma px': 'over the picture, the best rotation removed',
    'prior %': 'of the information about fx, from its make', 'clips': 'used of all',
    'turns': 'used', '% per year': 'change of fx'}

Rows = Sequence[Mapping[str, Any]]


def overview_html(cameras: Rows, clips: Rows) -> str:
    """Return the page's text from the rows of both tables; texts from the input are escaped."""
    parts = [_counts(cameras, clips), _makes(cameras), _sigma_by_turns(cameras),
             _drift(cameras, clips), _outliers(cameras),
             _reasons('Clips that are not used', [
                 (row['reason'], row['clip']) for row in clips
                 if row['status'] in ('unreadable', 'left out', 'no scene')]),
             _reasons('Cameras that are not accepted', [
                 (reason, row['camera']) for row in cameras if row['verdict'] != 'accepted'
                 for reason in row['reasons']]),
             _listed(cameras)]
    return ('<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<title>{len(cameras)} cameras</title>\n<style>{page_style()}{STYLE}</style>\n'
            '</head>\n<body>\n'
            + '\n'.join(filter(None, parts))
            + f'\n<script>{SORTING}</script>\n</body>\n</html>\n')


def _counts(cameras: Rows, clips: Rows) -> str:
    verdicts, statuses = (Counter(row[key] for row in rows)
                          for rows, key in ((cameras, 'verdict'), (clips, 'status')))
    hours = sum(row['seconds'] for row in clips) / 3600
    widths = ''.join(f'<span class="{level}" style="flex: {verdicts[level]}">'
                     f'{verdicts[level]} {level}</span>' for level in LEVELS if verdicts[level])
    return (f'<h1>{len(cameras)} cameras, {len(clips)} clips, {hours:.1f} hours of video</h1>'
            f'<h2>Verdicts</h2><p class="verdicts">{widths}</p>'
            f'<h2>Clips</h2>' + _table(('status', 'clips'), sorted(statuses.items())))


def _makes(cameras: Rows) -> str:
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
    return '<h2>Focal lengths by make</h2>' + _table(
        ('make', 'cameras', 'median fx', 'spread %'), rows) + _fx_by_make(makes) if rows else ''


def _fx_by_make(makes: Mapping[str, Rows]) -> str:
    shown = sorted(makes, key=lambda make: (-len(makes[make]), make))[:MAKES]
    low, high = _ends([row['fx'] for make in shown for row in makes[make]])
    axes = Axes(900, 70 + 26 * len(shown), (low, high), (0.5 - len(shown), 0.5), left=190)
    parts = [axes.frame('fx, px', '', ticks(low, high), ())]
    for n, make in enumerate(sorted(shown)):
        parts.append(text(180, float(axes.down(-n)) + 4, shortened(make, 26), 'end'))
        parts.append(_dots(axes, [(row['fx'], -n, row['verdict']) for row in makes[make]]))
    return _figure('fx of each camera by make and image width', axes, parts)


def _sigma_by_turns(cameras: Rows) -> str:
    found = [(max(row['turns_used'], 1), 100 * row['sigma_fx'] / row['fx'], row['verdict'])
             for row in cameras if row['fx'] and row['sigma_fx']]
    if not found:
        return ''
    x, y = _ends([turns for turns, _, _ in found]), _ends([sigma for _, sigma, _ in found])
    x, y = (max(x[0], 0.8), x[1]), (min(sigma for _, sigma, _ in found) / 1.3, y[1] * 1.2)
    axes = Axes(900, 320, x, y, log_x=True, log_y=True)
    parts = [axes.frame('turns used', 'sigma of fx, %', log_ticks(*x), log_ticks(*y)),
             _dots(axes, found)]
    return '<h2>What turns are worth</h2>' + _figure(
        'sigma of fx against the turns that were used', axes, parts)


def _drift(cameras: Rows, clips: Rows) -> str:
    """Return what each dated clip alone says of fx, over time; lines: cameras that drift."""
    own = {row['camera']: row['fx'] for row in cameras if row['fx']}
    found = [(YEAR_0 + row['time'] / YEAR_S, 100 * (row['fx'] / own[row['camera']] - 1),
              row['camera']) for row in clips
             if row['time'] and row['fx'] and row['camera'] in own]
    if not found:
        return ''
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
            parts.append(polyline(np.column_stack([axes.across(ends), axes.down(line)]),
                                  'all-turns'))
    return '<h2>Drift</h2>' + _figure(
        'fx that each dated clip alone has; lines: cameras that drift by more than '
        f'{DRIFTS} sigma', axes, parts) + _table(
            ('camera', '% per year', 'sigma'),
            [(row['camera'], f'{row["drift_percent_per_year"]:+.2f}',
              f'{row["drift_sigma"]:.2f}') for row in drifting])


def _ends(values: Sequence[float]) -> tuple[float, float]:
    """Return the ends of an axis that shows all values."""
    low, high = min(values), max(values)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def _dots(axes: Axes, found: Sequence[tuple[float, float, str]]) -> str:
    """Return (x, y, verdict) as dots, LISTED at the most, evenly chosen."""
    some = found[::-(-len(found) // LISTED)]
    return ''.join(
        f'<g class="{verdict}">' + dots(np.column_stack([
            axes.across(np.array([x for x, _, each in some if each == verdict], float)),
            axes.down(np.array([y for _, y, each in some if each == verdict], float))]),
            'dot all' if verdict else 'dot own') + '</g>'
        for verdict in sorted({each for _, _, each in some}))


def _figure(title: str, axes: Axes, parts: Sequence[str]) -> str:
    return (f'<figure class="scroll wide">{svg(axes.width, axes.height, title, "".join(parts))}'
            f'<figcaption>{escape(title)}</figcaption></figure>')


def _outliers(cameras: Rows) -> str:
    rows = [(_link(row), escape(row['make'] or ''), escape(row['prior_note']))
            for row in cameras if row['other_mode']]
    return '<h2>In another mode than their make</h2>' + _table(
        ('camera', 'make', ''), rows, raw=True) if rows else ''


def _reasons(title: str, found: Iterable[tuple[str, str]]) -> str:
    """Return how often each reason came; reasons that differ in numbers only are one."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for reason, name in found:
        plain = re.sub(r'\d+(\.\d+)?', 'N', reason.replace(name, '')) if name else reason
        groups.setdefault(plain, []).append((reason, name))
    ranked = sorted(groups.values(), key=lambda group: (-len(group), group[0]))
    return f'<h2>{title}</h2>' + _table(
        ('reason', 'how many', 'such as'),
        [(group[0][0], str(len(group)), group[0][1]) for group in ranked[:50]]) if ranked else ''


def _listed(cameras: Rows) -> str:
    rows = []
    for row in cameras[:LISTED]:
        known = row['fx'] is not None
        rows.append((
            _link(row), escape(row['make'] or ''), row['verdict'], row['model'] or '-',
            f'{row["fx"]:.1f}' if known else '-',
            f'{100 * row["sigma_fx"] / row["fx"]:.2f}' if known else '-',
            f'{row["sigma_px"]:.2f}' if row['sigma_px'] is not None else '-',
            f'{100 * row["prior_share"]:.0f}' if row['prior_units'] else '-',
            f'{row["clips_used"]} of {row["clips"]}', str(row['turns_used'])))
    more = len(cameras) - LISTED
    return '<h2>Cameras</h2>' + _table(
        ('camera', 'make', 'verdict', 'model', 'fx', 'sigma %', 'sigma px', 'prior %', 'clips',
         'turns'), rows, raw=True) + (
        f'<p class="note">{more} more are in the table of cameras.</p>' if more > 0 else '')


def _link(row: Mapping[str, Any]) -> str:
    name = escape(row['camera'])
    if row['verdict_alone'] == 'refused' and row['model'] is None and not row['width']:
        return name
    return f'<a href="{quote(row["folder"])}/{REPORT}">{name}</a>'


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]], raw: bool = False) -> str:
    """Return a table; raw: the cells are HTML already."""
    def line(tag: str, texts: Sequence[Any], plain: bool) -> str:
        return '<tr>' + ''.join(f'<{tag}>{escape(str(text)) if plain else text}</{tag}>'
                                for text in texts) + '</tr>'

    body = ''.join(line('td', row, not raw) for row in rows)
    names = ''.join(f'<th title="{escape(TITLES.get(name, name))}"><button>{escape(name)}'
                    f'</button></th>' for name in head)
    return (f'<div class="scroll wide"><table><thead><tr>{names}</tr></thead>'
            f'<tbody>{body}</tbody></table></div>') if body else ''
