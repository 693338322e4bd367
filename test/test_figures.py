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
from figures import (  # noqa: E402
    FIGURES,
    PARTS,
    README,
    Figure,
    cell,
    cited,
    commits_of,
    table_of,
    with_commits,
)


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
    # the front page says it in ten lines
    assert 0 < len(rows) <= 10
    for row in rows:
        assert any(figure.pattern.search(row) for figure in FIGURES if figure.page == README), row


@pytest.mark.parametrize('page', sorted({figure.page for figure in FIGURES}))
def test_a_cited_commit_is_one_of_the_table_beside_it(page):
    text = (ROOT / page).read_text('utf-8')
    found = re.findall(r'\[([0-9a-f]{7}(?:, [0-9a-f]{7})*|\d+ commits)\]\((?:\.\./)?benchmark/'
                       r'results/(\w+)\.md\)', text)
    assert found
    for commits, table in found:
        assert commits == cited(table_of(table)), f'{table}: python -m benchmark figures'


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
    said = with_commits(figure.with_figures(f'It says fx 3.1 px, at [1111111]{link}.'))
    assert said == f'It says fx 700.5 ± 1.5 px, at [0123abc, 4567def]{link}.'
    assert with_commits(figure.with_figures(said)) == said
    assert cited('Measured at 0123abc, 1234bcd, 2345cde.') == '0123abc, 1234bcd, 2345cde'
    assert cited('Measured at 0123abc, 1234bcd, 2345cde, 3456def.') == '4 commits'
    for wrong in (Figure('page', 'fy #', 'made', figure.sources),
                  Figure('page', 'fx # and #', 'made', figure.sources),
                  Figure('page', 'fx # px', 'made', (cell('two', 'fx, px'),))):
        with pytest.raises(ValueError):
            wrong.with_figures(said)


def test_what_scripts_write_is_read_as_what_was_copied_by_hand(tmp_path, monkeypatch):
    """The places do not change when a table that was copied by hand is measured again."""
    from fleet import report
    from measure import table
    from population import summary
    monkeypatch.setattr(figures, 'RESULTS', tmp_path)
    row = {'verdict': 'accepted', 'glass_px': 0.0, 'readout_ms': 10.0, 'truth_model': 'radial',
           'rays_px': 0.31, 'camera_px': 0.4, 'sigma_px': 0.5, 'percent': {'fx': 0.1},
           'error': {'fx': 0.6}, 'truth': {'fx': 600.0}, 'z': {'fx': 1.4, 'cx': 0.2, 'cy': 1.6},
           'shutter_ms': 10.2, 'shutter_sigma_ms': 0.05, 'named': [], 'seed': 1, 'rate': 10.0,
           'size': (640, 480), 'model': 'radial', 'reasons': []}
    glass = {**row, 'glass_px': 1.0, 'verdict': 'weak', 'readout_ms': 0.0}
    units = [{'zoom': 1, 'alone': 0.02, 'sigma_alone': 0.02, 'with': 0.01, 'sigma': 0.01,
              'prior': True}]
    written = {
        'population': (summary([row, glass, row]),
                       [['2', '2', '0', '1', '0', '33.3', '100.0'], ['0.31', '0.31'],
                        ['2.0', '0', '2'], ['1.6']]),
        'fleet': (report({'prior': [{'seed': 1, 'units': units}]}),
                  [['1', '1', '2.00', '1.00']]),
        'held_out': ('1 of 2 accepted drives, 7 of 10 turns within σ0 + σ1.', [['7', '10']]),
        'check': (table(['calibration', 'right', 'differs', 'wrong', 'cannot tell', 'found', 'px'],
                        [['truth', '5', '1', '2', '3', '', '0.2'],
                         ['fx +', '0', '0', '9', '2', '8 of 9', '5'],
                         ['k1 +', '0', '0', '9', '2', '7 of 9', '5']]),
                  [['11', '2', '8', '9', '7', '9']]),
        'node_drive': ('| **KITTI 03** | accepted |\n| fx | 714.5123 ± 1.3, reference 717.1456, '
                       'difference -0.4 % |', [['714.5', '717.1']])}
    for name, (text, expected) in written.items():
        seen = [[number for source in figure.sources for number in source(text)]
                for figure in FIGURES if figure.table == name]
        assert [numbers for n, numbers in enumerate(seen) if numbers not in seen[:n]] == expected
