# SPDX-License-Identifier: Apache-2.0
"""README.md and docs/ say what the tables of benchmark/results/ say, and name their commits."""
from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / 'benchmark'
if not FOLDER.is_dir():
    pytest.skip('the source distribution has no benchmarks', allow_module_level=True)
sys.path.append(str(FOLDER))
import figures  # noqa: E402 (benchmarks are no package)
from figures import FIGURES, PARTS, README, Figure, cell, commits_of, table_of  # noqa: E402


@pytest.mark.parametrize('figure', FIGURES, ids=lambda figure: f'{figure.page} {figure.table}')
def test_a_page_says_what_its_table_says(figure):
    text = (ROOT / figure.page).read_text('utf-8')
    assert figure.with_figures(text) == text


def test_the_list_of_parts_is_that_of_the_runner():
    listed = subprocess.run([sys.executable, '-m', 'benchmark', '--list'], cwd=ROOT, check=True,
                            capture_output=True, text=True).stdout
    text = (FOLDER / 'README.md').read_text('utf-8')
    assert f'{PARTS[0]}\n{listed.strip()}\n{PARTS[1]}' in text


def test_each_row_of_the_front_page_is_taken_from_a_table():
    text = (ROOT / README).read_text('utf-8').partition('\n## Figures')[2].partition('\n## ')[0]
    rows = [line for line in text.splitlines() if line.startswith('| ')][1:]
    assert len(rows) == 10
    for row in rows:
        assert any(figure.pattern.search(row) for figure in FIGURES if figure.page == README), row


@pytest.mark.parametrize('page', sorted({figure.page for figure in FIGURES}))
def test_a_cited_commit_is_one_of_the_table_beside_it(page):
    text = (ROOT / page).read_text('utf-8')
    cited = re.findall(r'\[([0-9a-f]{7}(?:, [0-9a-f]{7})*)\]\((?:\.\./)?benchmark/'
                       r'results/(\w+)\.md\)', text)
    assert cited
    for commits, table in cited:
        assert commits == commits_of(table_of(table)), table


def test_the_tables_are_from_commits_of_this_repository():
    shallow = subprocess.run(['git', 'rev-parse', '--is-shallow-repository'], cwd=ROOT,
                             capture_output=True, text=True)
    if shallow.stdout.strip() != 'false':
        pytest.skip('no complete git history here')
    for table in {figure.table for figure in FIGURES}:
        for commit in filter(None, commits_of(table_of(table)).split(', ')):
            done = subprocess.run(['git', 'merge-base', '--is-ancestor', commit, 'HEAD'], cwd=ROOT,
                                  capture_output=True, text=True)
            assert done.returncode == 0, f'{table}.md: {commit}: {done.stderr}'


def test_figures_are_put_where_they_belong(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, 'RESULTS', tmp_path)
    (tmp_path / 'made.md').write_text(
        '<!-- table -->\nMeasured at 0123abc, 4567def; by hand.\n\n| drive | fx, px |\n'
        '|---|---|\n| one | 700.5 ± 1.5, 2 |\n<!-- end -->\n')
    figure = Figure('page', 'fx # px, at @.', 'made', (cell('one', 'fx, px'),))
    link = '(benchmark/results/made.md)'
    said = figure.with_figures(f'It says fx 3.1 px, at [1111111]{link}.')
    assert said == f'It says fx 700.5 ± 1.5 px, at [0123abc, 4567def]{link}.'
    assert figure.with_figures(said) == said
    for wrong in (Figure('page', 'fy #', 'made', figure.sources),
                  Figure('page', 'fx # and #', 'made', figure.sources),
                  Figure('page', 'fx # px', 'made', (cell('two', 'fx, px'),))):
        with pytest.raises(ValueError):
            wrong.with_figures(said)
