# SPDX-License-Identifier: Apache-2.0
"""The documents name what is there."""
from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# not in the source distribution
BENCHMARK = ROOT / 'benchmark'
DOCUMENTS = ['README.md', 'CONTRIBUTING.md', 'CHANGELOG.md', 'SECURITY.md',
             *sorted(str(path.relative_to(ROOT)) for folder in ('docs', 'benchmark')
                     for path in (ROOT / folder).rglob('*.md'))]


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
        target = (document.parent / link).resolve()
        assert (link.startswith('http') or target.exists()
                or (target.is_relative_to(BENCHMARK) and not BENCHMARK.exists())), link


def test_the_site_is_built_without_a_warning(tmp_path):
    """Warnings are links and anchors that lead nowhere, and names that have no docstring."""
    for library in ('material', 'mkdocstrings', 'mike', 'latex2mathml'):
        pytest.importorskip(library, reason='no mkdocs-material: pip install the docs extra')
    if not BENCHMARK.exists():
        pytest.skip('the source distribution lacks documents of the site')
    done = subprocess.run([sys.executable, '-m', 'mkdocs', 'build', '--strict', '--site-dir',
                           str(tmp_path / 'site')], cwd=ROOT, capture_output=True, text=True,
                          timeout=200)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / 'site' / 'docs' / 'api' / 'index.html').read_text()
    assert 'open_frames' in page
    assert (tmp_path / 'site' / 'docs' / 'how_it_works' / 'index.html').read_text().count('<math')
    assert list((tmp_path / 'site' / 'assets' / 'stylesheets').glob('*.css'))


def test_the_files_that_contributors_are_sent_to_exist():
    if not BENCHMARK.exists():
        pytest.skip('the source distribution has no benchmarks')
    text = (ROOT / 'CONTRIBUTING.md').read_text()
    for name in re.findall(r'`([a-z_]+\.py)`', text):
        assert any(any((ROOT / folder).rglob(name))
                   for folder in ('test', 'testing', 'dashcalib_ros', 'benchmark')), name


def test_the_newest_changes_are_on_top_with_their_date():
    headings = re.findall(r'^## (.*)$', (ROOT / 'CHANGELOG.md').read_text(), re.MULTILINE)
    assert headings[0] == '[Unreleased]'
    assert all(re.fullmatch(r'\[\d+\.\d+\.\d+\]( - \d{4}-\d\d-\d\d)?', each)
               for each in headings[1:])


def test_the_commits_of_figures_are_in_the_history():
    shallow = subprocess.run(['git', 'rev-parse', '--is-shallow-repository'], cwd=ROOT,
                             capture_output=True, text=True)
    if shallow.stdout.strip() != 'false':
        pytest.skip('no complete git history here')
    texts = ''.join((ROOT / name).read_text() for name in DOCUMENTS)
    named = sorted(set(re.findall(r'(?<![\w.])[0-9a-f]{7}(?![\w.])', texts)) - {'accepted'})
    named = [name for name in named if re.search('[0-9]', name) and re.search('[a-f]', name)]
    known = subprocess.run(['git', 'cat-file', '--batch-check=%(objecttype)'], cwd=ROOT, text=True,
                           input='\n'.join(named) + '\n', capture_output=True).stdout.split('\n')
    missing = [name for name, kind in zip(named, known, strict=False) if kind != 'commit']
    assert len(named) > 10 and missing == []


@pytest.mark.parametrize('name', DOCUMENTS)
def test_documents_name_no_place_of_one_machine(name):
    assert re.findall(r'(?:/tmp/|/work/|/root/)\S*', (ROOT / name).read_text()) in (
        [], ['/root/.ros"'])
