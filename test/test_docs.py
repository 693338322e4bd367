"""The documents name what is there."""
from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = ['README.md', 'CONTRIBUTING.md', 'CHANGELOG.md', 'docs/architecture.md',
             'docs/lessons.md', 'docs/node.md']


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


def test_the_changes_to_come_are_on_top():
    headings = re.findall(r'^## (.*)$', (ROOT / 'CHANGELOG.md').read_text(), re.MULTILINE)
    assert headings[0] == '[Unreleased]' and len(headings) > 1
