"""overview.html: the fleet on one page, with links to each camera's report."""
from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

import numpy as np

from dashcalib_ros.report.files import REPORT
from dashcalib_ros.report.page import page_style

NAME = 'overview.html'
# cameras that are listed; the table has all
LISTED = 2000
# bars of a histogram, px of its height
BARS, HEIGHT = 40, 90

Rows = Sequence[Mapping[str, Any]]


def overview_html(cameras: Rows, clips: Rows) -> str:
    """Return the page's text from the rows of both tables; texts from the input are escaped."""
    parts = [_counts(cameras, clips), _makes(cameras), _outliers(cameras),
             _reasons('Clips that are not used', [
                 (row['reason'], row['clip']) for row in clips
                 if row['status'] in ('unreadable', 'left out', 'no scene')]),
             _reasons('Cameras that are not accepted', [
                 (reason, row['camera']) for row in cameras if row['verdict'] != 'accepted'
                 for reason in row['reasons']]),
             _listed(cameras)]
    return ('<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<title>{len(cameras)} cameras</title>\n<style>{page_style()}</style>\n</head>\n'
            '<body>\n'
            + '\n'.join(filter(None, parts)) + '\n</body>\n</html>\n')


def _counts(cameras: Rows, clips: Rows) -> str:
    verdicts, statuses = (Counter(row[key] for row in rows)
                          for rows, key in ((cameras, 'verdict'), (clips, 'status')))
    hours = sum(row['seconds'] for row in clips) / 3600
    return (f'<h1>{len(cameras)} cameras, {len(clips)} clips, {hours:.1f} hours of video</h1>'
            + _table(('', 'cameras'), sorted(verdicts.items()))
            + _table(('', 'clips'), sorted(statuses.items())))


def _makes(cameras: Rows) -> str:
    """Return each make's focal lengths: their middle, their spread, a histogram."""
    makes: dict[tuple[str, int], list[float]] = {}
    for row in cameras:
        if row['fx'] is not None:
            makes.setdefault((row['make'] or '', row['width']), []).append(row['fx'])
    if not makes:
        return ''
    rows = []
    for (make, width), values in sorted(makes.items()):
        middle = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(np.array(values) - middle)))
        rows.append((escape(make) or 'unknown', str(width), str(len(values)), f'{middle:.1f}',
                     f'{100 * spread / middle:.2f}', _histogram(np.array(values))))
    return '<h2>Focal lengths</h2>' + _table(
        ('make', 'width', 'cameras', 'median fx', 'spread %', 'fx'), rows, raw=True)


def _histogram(values: np.ndarray[Any, np.dtype[Any]]) -> str:
    low, high = float(values.min()), float(values.max())
    if high <= low:
        return f'{low:.1f}'
    counts, _ = np.histogram(values, BARS, (low, high))
    bars = ''.join(
        f'<rect x="{7 * n}" y="{HEIGHT - height:.0f}" width="6" height="{height:.0f}" '
        f'fill="var(--line)"/>' for n, height in enumerate(HEIGHT * counts / counts.max()))
    return (f'<svg class="plot" style="width: {7 * BARS}px; height: {HEIGHT + 14}px">{bars}'
            f'<text x="0" y="{HEIGHT + 12}">{low:.0f}</text><text class="end" x="{7 * BARS}" '
            f'y="{HEIGHT + 12}">{high:.0f}</text></svg>')


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
    return (f'<div class="scroll"><table><thead>{line("th", head, True)}</thead>'
            f'<tbody>{body}</tbody></table></div>')
