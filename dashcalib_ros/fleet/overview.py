# SPDX-License-Identifier: Apache-2.0
"""overview.html: the fleet on one page, with links to each camera's report."""
from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any
from urllib.parse import quote

import numpy as np

from dashcalib_ros.errors import shortened
from dashcalib_ros.fleet.tables import YEAR_S, drift_of
from dashcalib_ros.report.charts import Axes, log_ticks, strokes, svg, text, ticks
from dashcalib_ros.report.files import REPORT
from dashcalib_ros.report.page import template
from dashcalib_ros.report.wording import optional

NAME = 'overview.html'
# cameras that are listed; the table has all
LISTED = 2000
# camera models in the plot of focal lengths, and lines in that of drift
SHOWN = 20
# sigmas; a camera drifts beyond so many
DRIFTS = 3
# points of such a line
ENDS = 9
LEVELS = ('accepted', 'weak', 'refused')
YEAR_0 = 1970
# clips and cameras that are named in a row
NAMED = 10
# what a column has, where its name does not say it
TITLES = {
    'camera model': 'the column camera_model of the manifest',
    'spread %': 'robust standard deviation of fx between cameras, in % of it',
    'sigma fx %': 'standard deviation (sigma) of fx, in % of it',
    'sigma px': 'standard deviation over the picture, in px, the best rotation removed',
    'prior %': 'share of the information about fx that is from other units of the model',
    'clips used': 'of all clips of the camera', 'fx, % per year': 'change of fx with time',
    'sigma, % per year': 'standard deviation of that change',
    'fx, % per K': 'change of fx with the temperature',
    'sigma, % per K': 'standard deviation of that change'}

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
        _sigma_by_turns(cameras), _sigma_by_clips(cameras, clips), _drift(cameras, clips),
        Section('In another sensor mode than other cameras of their model',
                ('camera', 'camera model', 'why'),
                [(_link(row), row['camera_model'] or '', row['prior_note'])
                 for row in cameras if row['other_mode']]),
        _reasons('Clips that are not used', 'clips', [
            (row['code'], row['reason'], row['clip'] or f'row {row["row"]}')
            for row in clips if row['status'] != 'used']),
        _reasons('Cameras that are not accepted', 'cameras', [
            (code, reason, row['camera']) for row in cameras if row['verdict'] != 'accepted'
            for reason, code in zip_longest(row['reasons'], row['reason_codes'], fillvalue='')]),
        _reasons('No prior from the camera model', 'cameras', [
            ('', row['prior_note'], row['camera']) for row in cameras
            if row['verdict'] != 'accepted' and row['prior_note'] and not row['other_mode']]),
        _listed(cameras)]
    return template('overview.html').render(
        cameras=len(cameras), clips=len(clips), titles=TITLES, sections=sections,
        video=duration(sum(row['seconds'] for row in clips)),
        verdicts=[(level, verdicts[level]) for level in LEVELS])


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it."""
    if seconds < 120:
        return f'{seconds:.0f} s'
    return f'{seconds / 60:.0f} min' if seconds < 7200 else f'{seconds / 3600:.1f} h'


def _makes(cameras: Rows) -> Section:
    models: dict[str, list[Mapping[str, Any]]] = {}
    for row in cameras:
        if row['fx']:
            name = f'{row["camera_model"] or "unknown"}, {row["width"]} px'
            models.setdefault(name, []).append(row)
    rows = []
    for model, known in sorted(models.items()):
        values = np.array([row['fx'] for row in known])
        middle = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - middle)))
        rows.append((model, len(known), f'{middle:.1f}', f'{100 * spread / middle:.2f}'))
    return Section('Focal lengths by camera model',
                   ('camera model', 'cameras', 'median fx, px', 'spread %'), rows,
                   *_fx_by_camera_model(models) if rows else ())


def _fx_by_camera_model(models: Mapping[str, Rows]) -> tuple[str, str]:
    shown = sorted(models, key=lambda model: (-len(models[model]), model))[:SHOWN]
    low, high = _ends([row['fx'] for model in shown for row in models[model]])
    axes = Axes(900, 70 + 26 * len(shown), (low, high), (0.5 - len(shown), 0.5), left=190)
    parts = [axes.frame('fx, px', '', ticks(low, high), ())]
    for n, model in enumerate(sorted(shown)):
        parts.append(text(180, float(axes.down(-n)) + 4, shortened(model, 26), 'end'))
        parts.append(_dots(axes, [(row['fx'], -n, row['verdict']) for row in models[model]]))
    return _figure('fx of each camera, by camera model and image width', axes, parts)


def _sigma_by_turns(cameras: Rows) -> Section:
    title = 'Sigma of fx by number of turns'
    found = [(max(row['turns_used'], 1), 100 * row['sigma_fx'] / row['fx'], row['verdict'])
             for row in cameras if row['fx'] and row['sigma_fx']]
    if not found:
        return Section(title)
    x, y = _ends([turns for turns, _, _ in found]), _ends([sigma for _, sigma, _ in found])
    x, y = (max(x[0], 0.8), x[1]), (min(sigma for _, sigma, _ in found) / 1.3, y[1] * 1.2)
    axes = Axes(900, 320, x, y, log_x=True, log_y=True)
    parts = [axes.frame('turns used', 'sigma of fx, %', log_ticks(*x), log_ticks(*y)),
             _dots(axes, found)]
    return Section(title, (), (), *_figure(
        'standard deviation (sigma) of fx of each camera, by the number of its turns that are '
        'used', axes, parts))


def _sigma_by_clips(cameras: Rows, clips: Rows) -> Section:
    title, own = 'Sigma of fx, clip by clip', {row['camera']: row for row in cameras if row['fx']}
    lines: dict[str, list[float]] = {}
    for row in sorted(clips, key=lambda row: str(row['clip'])):
        if row['sigma_fx_so_far'] and row['camera'] in own:
            lines.setdefault(row['camera'], []).append(
                100 * row['sigma_fx_so_far'] / own[row['camera']]['fx'])
    lines = {name: values for name, values in lines.items() if len(values) > 1}
    if not lines:
        return Section(title)
    every = [value for values in lines.values() for value in values]
    x = 0.9, 1.1 * max(map(len, lines.values()))
    y = min(every) / 1.3, 1.3 * max(every)
    axes = Axes(900, 320, x, y, log_x=True, log_y=True)
    parts = [axes.frame('clips', 'sigma of fx, %', log_ticks(*x), log_ticks(*y))]
    for name in sorted(lines)[::-(-len(lines) // LISTED)]:
        steps = axes.places(np.arange(1.0, 1 + len(lines[name])), np.array(lines[name]))
        parts.append(f'<g class="{own[name]["verdict"]}">' + strokes([steps], 'all-turns')
                     + strokes(steps[:, None], 'dot all') + '</g>')
    return Section(title, (), (), *_figure(
        'sigma of fx of each camera with its first clip, its first two, and so on', axes, parts))


def _drift(cameras: Rows, clips: Rows) -> Section:
    own = {row['camera']: row for row in cameras if row['fx']}
    by_camera: dict[str, list[Mapping[str, Any]]] = {}
    for row in clips:
        by_camera.setdefault(row['camera'], []).append(row)
    lines = {name: line for name, those in by_camera.items()
             if name in own and (line := drift_of(those))}
    warm = {name for name, line in lines.items()
            if len(line.size) > 1 and abs(line.size[1]) > DRIFTS * line.sigma[1]}
    found = []
    for row in clips:
        name = row['camera']
        if row['time'] and row['fx'] and name in own:
            fx = row['fx']
            if name in warm and row['temperature_c'] is not None:
                line = lines[name]
                fx /= 1 + line.size[1] / 100 * (row['temperature_c'] - line.temperature_c)
            found.append((YEAR_0 + row['time'] / YEAR_S, 100 * (fx / own[name]['fx'] - 1), name))
    if not found:
        return Section('Drift')
    x, y = _ends([year for year, _, _ in found]), _ends([off for _, off, _ in found])
    axes = Axes(900, 320, x, y)
    parts = [axes.frame('year', 'fx of a clip, % off its camera', ticks(*x), ticks(*y)),
             _dots(axes, [(year, off, own[name]['verdict']) for year, off, name in found])]
    drifting = sorted((name for name, line in lines.items()
                       if name in warm or abs(line.size[0]) > DRIFTS * line.sigma[0]),
                      key=lambda name: -abs(lines[name].size[0]))
    for name in drifting[:SHOWN]:
        line = lines[name]
        years = [year for year, _, each in found if each == name]
        if not years:
            continue
        ends = np.linspace(min(years), max(years), ENDS)
        off, sigma = np.transpose([line.at(year - YEAR_0) for year in ends])
        off = off + 100 * (line.fx / own[name]['fx'] - 1)
        parts.append(strokes([axes.places(ends, off)], 'all-turns'))
        parts.append(strokes([axes.places(ends, off + each) for each in (sigma, -sigma)],
                             'all-turns', ' stroke-dasharray="3 4"'))
    rows = []
    for name in drifting:
        size, sigma = (tuple(f'{each:+.2g}' if n == 0 else f'{each:.2g}' for each in values)
                       for n, values in enumerate((lines[name].size, lines[name].sigma)))
        rows.append((name, size[0], sigma[0], *((size[1], sigma[1]) if size[1:] else ('-', '-'))))
    return Section(
        'Drift', ('camera', 'fx, % per year', 'sigma, % per year', 'fx, % per K',
                  'sigma, % per K'), rows,
        *_figure(f'dots: fx from each dated clip alone, at one temperature where fx follows it; '
                 f'lines: cameras whose fx drifts by more than {DRIFTS} sigma, with one sigma',
                 axes, parts))


def _ends(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def _dots(axes: Axes, found: Sequence[tuple[float, float, str]]) -> str:
    some = found[::-(-len(found) // LISTED)]
    return ''.join(
        f'<g class="{verdict}">' + strokes(axes.places(
            np.array([x for x, _, each in some if each == verdict], float),
            np.array([y for _, y, each in some if each == verdict], float))[:, None],
            'dot all') + '</g>'
        for verdict in sorted({each for _, _, each in some}))


def _figure(caption: str, axes: Axes, parts: Sequence[str]) -> tuple[str, str]:
    return svg(axes.width, axes.height, caption, ''.join(parts)), caption


def _reasons(title: str, what: str, found: Iterable[tuple[str, str, str]]) -> Section:
    groups: dict[str, list[tuple[str, str]]] = {}
    for code, reason, name in found:
        groups.setdefault(code or reason, []).append((reason.removesuffix(f' [{code}]'), name))
    ranked = sorted(groups.items(), key=lambda group: (-len(group[1]), group[0]))
    return Section(title, ('reason', 'the first', 'how many', what),
                   [(code, group[0][0], len(group), _names([name for _, name in group]))
                    for code, group in ranked])


def _names(names: Sequence[str]) -> str:
    more = len(names) - NAMED
    return ', '.join(names[:NAMED]) + (f' and {more} more' if more > 0 else '')


def _listed(cameras: Rows) -> Section:
    rows = [(_link(row), row['camera_model'] or '', row['verdict'], row['model'] or '-',
             optional(row['fx'], 1),
             '-' if row['fx'] is None else f'{100 * row["sigma_fx"] / row["fx"]:.2f}',
             optional(row['sigma_px'], 2),
             f'{100 * row["prior_share"]:.0f}' if row['prior_units'] else '-',
             f'{row["clips_used"]} of {row["clips"]}', row['turns_used'])
            for row in cameras[:LISTED]]
    more = len(cameras) - LISTED
    return Section('Cameras', ('camera', 'camera model', 'verdict', 'lens model', 'fx, px',
                               'sigma fx %', 'sigma px', 'prior %', 'clips used', 'turns used'),
                   rows, note=f'{more} more are in the table of cameras.' if more > 0 else '')


def _link(row: Mapping[str, Any]) -> str:
    # loaded with jinja2, by those who write a page
    from markupsafe import Markup
    if row['verdict_alone'] == 'refused' and row['model'] is None and not row['width']:
        return str(row['camera'])
    return Markup('<a href="{}/{}">{}</a>').format(quote(row['folder']), REPORT, row['camera'])
