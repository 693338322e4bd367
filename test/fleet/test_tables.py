# SPDX-License-Identifier: Apache-2.0
"""The tables' rows: drift over time, texts of any kind, the overview."""
from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest
from browser import BROWSER, found_by_the_browser
from page_reader import Page

from dashcalib_ros.errors import Notice
from dashcalib_ros.fleet import tables
from dashcalib_ros.fleet.clips import ClipResult
from dashcalib_ros.fleet.manifest import Row
from dashcalib_ros.fleet.overview import duration, overview_html
from dashcalib_ros.fleet.solved import ClipShare
from dashcalib_ros.fleet.tables import (
    CAMERA_COLUMNS,
    CLIP_COLUMNS,
    clip_rows,
    failed_row,
    write_table,
)

START_S = 1.7e9


def rows_at(times_s, focal, sigma=2.0, degrees=None):
    result = ClipResult(file='x.npz', turns=1, scenes=1, seconds=10.0)
    degrees = [None] * len(times_s) if degrees is None else degrees
    clips = [(Row(n, f'{n}.mp4', f'/{n}.mp4', 'cam', time_s=time_s, temperature_c=each), result)
             for n, (time_s, each) in enumerate(zip(times_s, degrees, strict=True))]
    return clip_rows('cam', 'acme', clips, {
        f'{n}.mp4': ClipShare(1, fx=fx, fx_sigma=sigma) for n, fx in enumerate(focal)})


def drift_of(rows):
    row = failed_row('cam', 'acme', rows)
    return row['drift_percent_per_year'], row['drift_sigma']


def test_drift_over_time():
    years = np.linspace(0, 2, 40)
    noise = np.random.default_rng(0).normal(0, 2.0, 40)
    times = START_S + years * tables.YEAR_S
    drift, sigma = drift_of(rows_at(times, 1000 * (1 + 0.01 * years) + noise))
    assert abs(drift - 1.0) < 3 * sigma and 0.02 < sigma < 0.2
    # scatter beyond the clips' own sigmas counts
    assert drift_of(rows_at(times, 1000 + 10 * noise))[1] > 5 * sigma


def test_what_the_temperature_explains_is_no_drift():
    rng = np.random.default_rng(1)
    # from winter to summer
    years = np.linspace(0, 0.5, 40)
    degrees = 5 + 50 * years + rng.normal(0, 5, 40)
    times, noise = START_S + years * tables.YEAR_S, rng.normal(0, 1.0, 40)
    focal = 1000 * (1 + 0.0003 * (degrees - degrees.mean())) + noise
    without = failed_row('cam', '', rows_at(times, focal, 1.0))
    assert without['drift_percent_per_year'] > 5 * without['drift_sigma']
    assert without['percent_per_kelvin'] is None
    row = failed_row('cam', '', rows_at(times, focal, 1.0, degrees))
    assert abs(row['drift_percent_per_year']) < 3 * row['drift_sigma']
    assert abs(row['percent_per_kelvin'] - 0.03) < 3 * row['sigma_per_kelvin'] < 0.015
    # dots are drawn as at one temperature
    clips = rows_at(times, focal, 1.0, degrees)
    page = overview_html([{**row, 'verdict': 'accepted', 'fx': 1000.0, 'width': 1280,
                           'sigma_fx': 1.0, 'turns_used': 5}], clips)
    assert page.count('class="all-turns"') == 2 and '+0.03' in page
    line = tables.drift_of(clips)
    assert line.sigma_percent < line.at(line.year + 0.3)[1]
    assert line.at(line.year) == (0.0, line.sigma_percent)


@pytest.mark.parametrize('degrees', [np.full(9, 20.0), [20.0, 30.0] + [None] * 7])
def test_too_few_temperatures_explain_nothing(degrees):
    years = np.arange(9)
    row = failed_row('cam', '', rows_at(START_S + years * tables.YEAR_S, 1000.0 + years,
                                        1.0, degrees))
    assert row['percent_per_kelvin'] is None
    assert row['drift_percent_per_year'] == pytest.approx(0.1, rel=0.01)


def test_the_later_the_warmer_tells_neither():
    years = np.arange(9)
    assert drift_of(rows_at(START_S + years * tables.YEAR_S, 1000.0 + years, 1.0,
                            20.0 + years)) == (None, None)


@pytest.mark.parametrize('times', [[START_S] * 5, [0.0, 10.0, 20.0], [START_S, 2 * START_S]])
def test_without_dates_there_is_no_drift(times):
    assert drift_of(rows_at(times, [1000.0] * len(times))) == (None, None)


def test_a_row_that_cannot_be_read_does_not_take_the_place_of_another():
    bad, good, again = (Row(n, 'a.mp4', '/a.mp4', 'cam') for n in (1, 2, 3))
    read = ClipResult(file='x.npz', turns=1, scenes=1)
    rows = clip_rows('cam', '', [(bad, ClipResult('fps')), (good, read), (again, read)],
                     {'a.mp4': ClipShare(1)})
    assert [row['status'] for row in rows] == ['unreadable', 'used', 'left out']
    assert 'row 2' in rows[2]['reason'] and rows[2]['code'] == 'E-CLIP-REPEATED'


def test_texts_that_are_no_unicode_and_numbers_that_are_none(tmp_path, monkeypatch):
    parquet = pytest.importorskip('pyarrow.parquet')
    odd = 'b\udcff<script>.mp4'
    clips = clip_rows(odd, '', [(Row(1, odd, odd), ClipResult('is <b>bad</b>'))], {})
    cameras = [{**failed_row(odd, '', clips, 'why'), 'drift_sigma': float('nan')}]
    folder = str(tmp_path)
    tables.write_table(folder, 'clips', clips, CLIP_COLUMNS)
    tables.write_table(folder, 'cameras', cameras, CAMERA_COLUMNS)
    row, = parquet.read_table(tmp_path / 'cameras.parquet').to_pylist()
    assert row['camera'] == 'b?<script>.mp4' and row['drift_sigma'] is None
    assert row['reasons'] == ['why'] and row['verdict'] == 'refused'
    page = overview_html(cameras, clips)
    assert '<script>.mp4' not in page and '<b>bad' not in page
    monkeypatch.setattr('dashcalib_ros.fleet.tables.has', lambda name: None)
    assert tables.write_table(folder, 'clips', clips, CLIP_COLUMNS) == (
        'clips.jsonl', 'clips.csv')
    assert json.loads((tmp_path / 'clips.jsonl').read_text())['camera'] == 'b?<script>.mp4'
    with (tmp_path / 'cameras.csv').open(newline='') as stream:
        read, = csv.DictReader(stream)
    assert (read['camera'], read['fx'], read['reasons']) == ('b?<script>.mp4', '', 'why')


def test_a_spreadsheet_runs_no_text(tmp_path):
    bad = ["=cmd|'/c calc'!A1", '+1', '-cam', '@sum']
    good = ['cam=1', '', 'x-y', '\t=1', 'a\r=1', 'a\n=1']
    rows = [{'name': text, 'more': [text, 'and'], 'x': -1.5} for text in (*bad, *good)]
    write_table(str(tmp_path), 'out', rows, {'name': 'text', 'more': 'texts', 'x': 'real'})
    read = list(csv.DictReader((tmp_path / 'out.csv').read_text().splitlines()))
    plain = [*(f"'{text}" for text in bad), *good[:3], r'\t=1', r'a\r=1', r'a\n=1']
    assert [row['name'] for row in read] == plain
    assert [row['more'] for row in read] == [f'{text}; and' for text in plain]
    # numbers stay numbers
    assert {row['x'] for row in read} == {'-1.5'}


def drawn_fleet():
    """Return the overview of three cameras that were calibrated and one that was not."""
    times = START_S + np.arange(5) * tables.YEAR_S / 2
    clips = rows_at(times, 1000 * (1 + 0.05 * np.arange(5)), sigma=1.0)
    failed = failed_row('cam', 'acme', clips, 'failed')
    cameras = [{**failed, 'camera': name, 'camera_model': model, 'verdict': verdict, 'fx': fx,
                'width': 1280, 'sigma_fx': 5.0, 'turns_used': turns}
               for turns, (name, model, verdict, fx) in enumerate((
                   ('cam', 'acme', 'accepted', 1100.0), ('two', 'acme', 'weak', 1000.0),
                   ('<b>three', '', 'weak', 900.0)))]
    return overview_html([*cameras, {**failed, 'camera': 'none'}], clips)


@pytest.mark.skipif(BROWSER is None, reason='no chromium on the PATH')
@pytest.mark.parametrize('width', [1280, 390])
def test_nothing_of_the_overview_is_cut_in_a_browser(tmp_path, width):
    found = found_by_the_browser(tmp_path, drawn_fleet(), width)
    assert found.pop('texts') > 10
    assert not any(found.values()), found


def test_every_dot_of_the_overview_has_a_colour():
    """A dot whose class has no stroke in the style is there, but nobody sees it."""
    page = drawn_fleet()
    style, drawn = page.split('<body>')
    kinds = re.findall(r'<g class="(\w*)"><path class="dot (\w+)"', drawn)
    # fx by model (two and one verdicts), sigma by turns, and the clips of the camera that drifts
    assert len(kinds) == 2 + 1 + 2 + 1
    for verdict, kind in kinds:
        assert f'.dot.{kind} {{ stroke: var(--accent); }}' in style
        assert f'.{verdict} {{ --accent:' in style


def test_the_overview_groups_by_code():
    """Texts differ by names and numbers, in whatever language names are."""
    shares = {f'{n}.mp4': ClipShare.without(
        Notice('E-CLIP-REPEATED', f'shows the same as {"abc"[n]}.mp4')) for n in range(3)}
    read = ClipResult(file='x.npz', turns=1, scenes=1)
    clips = clip_rows('cam', '', [(Row(n, f'{n}.mp4', f'/{n}.mp4', 'cam'), read)
                                  for n in range(3)], shares)
    cameras = [{**failed_row(name, '', clips), 'reasons': [f'fx of {name} is known to {n} %', 'x'],
                'reason_codes': ['E-LARGE-SIGMA', f'E-{n}']} for n, name in enumerate('pqrs')]
    page = overview_html([*cameras, failed_row('t', '', clips, Notice('E-DIED', 'why'))], clips)
    rows = [re.findall('<td>(.*?)</td>', row) for row in re.findall('<tr>(.*?)</tr>', page)]
    counts = {row[0]: row[2] for row in rows if len(row) == 4}
    assert counts == {'E-CLIP-REPEATED': '3', 'E-LARGE-SIGMA': '4', 'E-DIED': '1',
                      **{f'E-{n}': '1' for n in range(4)}}


def test_clips_without_a_turn_are_listed():
    still = ClipResult(file='x.npz', seconds=10.0)
    clips = [(Row(n, f'{n}.mp4', f'/{n}.mp4', 'cam'), still) for n in range(12)]
    page = overview_html([], clip_rows('cam', '', clips, {}))
    assert all(f'{n}.mp4' in page for n in range(10)) and '11.mp4' not in page
    assert 'and 2 more' in page


@pytest.mark.parametrize(('seconds', 'text'), [
    (30.0, '30 s'), (240.0, '4 min'), (7000.0, '117 min'), (7200.0, '2.0 h')])
def test_short_totals_are_not_hours(seconds, text):
    assert duration(seconds) == text
    still = [{**row, 'seconds': seconds} for row in rows_at([START_S], [1000.0])]
    assert f'{text} of video' in overview_html([], still)


def test_the_overview_draws_the_fleet():
    page = drawn_fleet()
    assert Page(page).tags.count('svg') == 3
    # fx and sigma of three cameras, five clips, and the line of the one that drifts
    # with its sigma
    assert page.count('class="all-turns"') == 2 and page.count('h0') == 3 + 3 + 5
    for name in ('cameras', 'fx, px', 'sigma fx %', 'fx, % per year'):
        assert f'<button>{name}</button>' in page
    assert '<b>three' not in page and 'http' not in page.split('<body>')[1]
