# SPDX-License-Identifier: Apache-2.0
"""Every error and every warning has a code, and docs/messages.md lists all of them."""
from __future__ import annotations

import copy
import importlib.util
import pickle
import re
from pathlib import Path

import pytest

from dashcalib_ros.errors import Notice

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted([*ROOT.glob('*.md'), *(ROOT / 'docs').rglob('*.md')])
spec = importlib.util.spec_from_file_location('docs_messages', ROOT / 'docs' / 'messages.py')
docs = importlib.util.module_from_spec(spec)
spec.loader.exec_module(docs)


@pytest.fixture(scope='module')
def modules():
    return docs.trees()


def test_every_error_has_a_code(modules):
    assert docs.faults(modules) == []


def test_the_page_is_current(modules):
    assert docs.PAGE.read_text('utf-8') == docs.page(docs.messages(modules)), (
        'python docs/messages.py writes it')


def test_the_documents_name_codes_that_exist(modules):
    known = {code for code, _ in docs.messages(modules)}
    assert len(known) > 50
    for path in DOCUMENTS:
        named = re.findall(r'\bE-[A-Z0-9]+(?:-[A-Z0-9]+)*\b', path.read_text('utf-8'))
        assert set(named) <= known, path.name


@pytest.mark.parametrize(('line', 'fault'), [
    ("raise InputError('the file is empty')", True),
    ("raise InputError(f'E-FILE-{n}', 'the file is empty')", True),
    ("raise InputError('E-file', 'the file is empty')", True),
    ("raise InputError('E', 'the file is empty')", True),
    ('raise InputError', True),
    ('raise InputError()', True),
    ("x = errors.InputError(code, 'the file is empty')", True),
    ("raise InputError('E-FILE-EMPTY', 'the file is empty') from error", False),
    ("warnings.append(Notice('the file is empty'))", True),
    ("warnings += [Notice('E-FILE-EMPTY', 'the file is empty')]", False),
    ("return InputError(error.code, f'{name}: {error}')", False),
    ("raise ValueError('the file is empty')", False),
    ('raise', False)])
def test_an_error_without_a_code_is_noticed(tmp_path, line, fault):
    (tmp_path / 'module.py').write_text(
        'class Base(DashcalibError): pass\nclass InputError(errors.Base): pass\n'
        f'def f():\n    {line}\n')
    assert docs.faults(docs.trees(tmp_path)) == ['module.py:4'] * fault


def test_texts_are_shown_with_an_ellipsis_for_what_is_not_known(tmp_path):
    (tmp_path / 'module.py').write_text(
        "REMEDY = 'copy it ' f'again'\n"
        "InputError('E-B', f'{path} has {n}{m} of {a | b} ' f'images: {REMEDY}')\n"
        "Finding(level='weak', code='E-A', text='one ' + turn + (' turn' if n else ' bend'))\n"
        "InputError('E-C', text)\n"
        "Notice('E-D', f'{counted(n, \"image\")} skipped')\n")
    rows = docs.messages(docs.trees(tmp_path))
    assert rows == [('E-A', 'one … bend'), ('E-A', 'one … turn'),
                    ('E-B', '… has … of … images: copy it again'), ('E-C', '…'),
                    ('E-D', '… images skipped')]
    assert '| `E-C` | … |' in docs.page(rows)
    assert docs.page([('E-A', 'a | b')]).endswith('| `E-A` | a \\| b |\n')


def test_a_notice_is_its_text_and_keeps_its_code_in_a_copy():
    notice = Notice('E-RATE-ASSUMED', '10 Hz')
    for each in (notice, copy.deepcopy(notice), pickle.loads(pickle.dumps(notice))):
        assert (str(each), each.code) == ('10 Hz', 'E-RATE-ASSUMED')
