"""The documents name what is there."""
from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / 'test' / 'benchmark'))
from documents import TABLES, write_table  # noqa: E402 (benchmarks are no package)

DOCUMENTS = ['README.md', 'CONTRIBUTING.md', 'CHANGELOG.md',
             *sorted(str(path.relative_to(ROOT)) for path in (ROOT / 'docs').rglob('*.md'))]


def test_the_architecture_has_every_room():
    text = (ROOT / 'docs' / 'architecture.md').read_text()
    rooms = {path.stem for path in (ROOT / 'dashcalib_ros').iterdir()
             if not path.stem.startswith('__') and path.suffix in ('', '.py')}
    assert {room for room in rooms if not re.search(rf'\| .*`{room}/?`.* \|', text)} == set()


@pytest.mark.parametrize('name', DOCUMENTS)
def test_links_lead_somewhere(name):
    document = ROOT / name
    links = re.findall(r'\]\(([^)#]+)\)', document.read_text())
    for link in links:
        assert link.startswith('http') or (document.parent / link).exists(), link


def test_the_files_that_contributors_are_sent_to_exist():
    text = (ROOT / 'CONTRIBUTING.md').read_text()
    for name in re.findall(r'`([a-z_]+\.py)`', text):
        assert [*(ROOT / 'test').rglob(name), *(ROOT / 'dashcalib_ros').rglob(name)], name


def test_the_newest_changes_are_on_top_with_their_date():
    headings = re.findall(r'^## (.*)$', (ROOT / 'CHANGELOG.md').read_text(), re.MULTILINE)
    assert headings[0] == '[Unreleased]'
    assert all(re.fullmatch(r'\[\d+\.\d+\.\d+\]( - \d{4}-\d\d-\d\d)?', each)
               for each in headings[1:])


def test_the_readme_is_short():
    lines = (ROOT / 'README.md').read_text().splitlines()
    assert len(lines) <= 110
    text = [line for line in lines if not line.startswith(('|', 'python3 -m venv', 'ros2 run'))]
    assert [line for line in text if len(line) > 110] == []


def test_each_figure_of_the_readme_names_its_commit():
    figures = (ROOT / 'README.md').read_text().partition('\n## Figures')[2].partition('\n## ')[0]
    rows = [line for line in figures.splitlines() if line.startswith('| ')][1:]
    assert len(rows) == 7
    for row in rows:
        assert re.search(
            r'\| \[[0-9a-f]{7}(, [0-9a-f]{7})*\]\(docs/(notebook/)?\w+\.md[^)]*\) \|$', row), row


def test_the_commits_of_figures_are_in_the_history():
    shallow = subprocess.run(['git', 'rev-parse', '--is-shallow-repository'], cwd=ROOT,
                             capture_output=True, text=True)
    if shallow.stdout.strip() != 'false':
        pytest.skip('no complete git history here')
    texts = ''.join(path.read_text() for path in (ROOT / 'README.md', *ROOT.glob('docs/**/*.md')))
    named = sorted(set(re.findall(r'(?<![\w.])[0-9a-f]{7}(?![\w.])', texts)) - {'accepted'})
    named = [name for name in named if re.search('[0-9]', name) and re.search('[a-f]', name)]
    known = subprocess.run(['git', 'cat-file', '--batch-check=%(objecttype)'], cwd=ROOT, text=True,
                           input='\n'.join(named) + '\n', capture_output=True).stdout.split('\n')
    missing = [name for name, kind in zip(named, known, strict=False) if kind != 'commit']
    assert len(named) > 10 and missing == []


def test_each_table_has_its_place_and_its_benchmark():
    texts = ''.join((ROOT / name).read_text() for name in DOCUMENTS)
    assert set(re.findall('<!-- table: (.*?) -->', texts)) == set(TABLES)
    for name, document in TABLES.items():
        assert f'<!-- end: {name} -->' in (ROOT / 'docs' / 'notebook' / document).read_text()
        assert any(f"write_table('{name}'" in path.read_text()
                   for path in (ROOT / 'test' / 'benchmark').glob('*.py')), name


def test_a_benchmark_replaces_its_table_and_nothing_else(tmp_path):
    path = tmp_path / TABLES['speed']
    path.write_text('before\n<!-- table: speed -->\nold\n<!-- end: speed -->\nafter\n')
    assert write_table('speed', '| new \\1 |\n', ['b', 'a', 'b'], tmp_path) == path
    text = path.read_text()
    assert re.fullmatch(r'before\n<!-- table: speed -->\nMeasured at a, b, on \d+ cores\.\n\n'
                        r'\| new \\1 \|\n\n<!-- end: speed -->\nafter\n', text)
    path.write_text('no place')
    with pytest.raises(ValueError, match='0 places'):
        write_table('speed', 'text', ['a'], tmp_path)


@pytest.mark.parametrize('name', DOCUMENTS)
def test_documents_name_no_place_of_one_machine(name):
    assert re.findall(r'(?:/tmp/|/work/|/root/)\S*', (ROOT / name).read_text()) in (
        [], ['/root/.ros"'])
