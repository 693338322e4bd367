# SPDX-License-Identifier: Apache-2.0
"""What comes in from outside has one budget: odd files, bottomless texts, bombs."""
from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
import yaml
from refused import refused

from dashcalib_ros.errors import InputError
from dashcalib_ros.limits import (
    YAML_BYTES,
    check_file,
    parse_json,
    parse_yaml,
    read_file,
    read_text,
)


def odd_files(folder):
    """Make one of each kind of entry that is no regular file."""
    os.mkfifo(folder / 'pipe')
    (folder / 'link').symlink_to(folder / 'nothing')
    (folder / 'folder').mkdir()
    (folder / 'device').symlink_to('/dev/full')
    made = socket.socket(socket.AF_UNIX)
    made.bind(str(folder / 'socket'))
    made.close()
    odd = 'E-FILE-NOT-REGULAR'
    return {'pipe': odd, 'link': 'E-FILE-MISSING', 'folder': odd, 'device': odd, 'socket': odd}


def test_only_regular_files_are_opened(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, code in odd_files(Path()).items():
        for read in (lambda path: read_file(path, 100), lambda path: read_text(path, 100)):
            with refused(InputError, code, f'cannot read {name}: '):
                read(Path(name))
        with pytest.raises((InputError, FileNotFoundError)):
            check_file(Path(name))
    Path('file').write_text('content')
    assert read_text(Path('file'), 7) == 'content'


def test_what_is_read_ends(tmp_path):
    path = tmp_path / 'file'
    with path.open('wb') as file:
        file.truncate(2**40)
    with refused(InputError, 'E-FILE-TOO-LARGE', '1 MB'):
        read_file(path, 2**20)
    with refused(InputError, 'E-FILE-TOO-LARGE', '0 MB'):
        read_file(Path('/proc/self/status'), 10)  # which says that it has no bytes
    with refused(InputError, 'E-FILE-MISSING', 'the mask x'):
        read_file(tmp_path / 'x', 10, 'the mask x')
    with refused(InputError, 'E-FILE-MISSING'):
        read_file(Path('a\0b'), 10)
    with refused(InputError, 'E-FILE-UNREADABLE', 'the mask x'):
        read_file(tmp_path / ('x' * 300), 10, 'the mask x')
    path.write_bytes(b'\xff\xfe\0')
    with refused(InputError, 'E-FILE-NOT-TEXT', path):
        read_text(path, 10)


def laughs(levels=9, merged=False):
    """Return the YAML of a billion laughs: each line has ten of the line before."""
    lines = ['a0: &a0 {k0: lol, j0: lol}' if merged else 'a0: &a0 [lol, lol]']
    for level in range(1, levels + 1):
        again = ', '.join([f'*a{level - 1}'] * 10)
        lines.append(f'a{level}: &a{level} {{<<: [{again}]}}' if merged
                     else f'a{level}: &a{level} [{again}]')
    return '\n'.join(lines)


@pytest.mark.parametrize('text', [
    laughs(), laughs(merged=True), '[' * 5000, '{a: ' * 5000, '- ' * 5000 + 'a', '&a [*a]',
    '&a {b: *a}', '*a', 'fx: ' + '7' * 400, 'fx: ' + '7' * 5000, 'fx: 0x' + 'f' * 5000,
    'fx: -1' + '_0' * 400, 'a: ' + '1:' * 5000 + '1', f'!!int "{"7" * 400}"', '!!int ""',
    '!!float x', '!!timestamp x', '!!bool x', '{[a]: 1}', '2001-99-99', '!!python/name:os.system',
    '\0', '][', 'a: b: c', '[' + '1, ' * YAML_BYTES, '[' + '1, ' * 300_001 + ']'])
def test_hostile_yaml_is_one_line(text):
    with pytest.raises(InputError) as caught:
        parse_yaml(text, 'the text')
    assert len(str(caught.value).splitlines()) == 1 and str(caught.value).startswith('the text')
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize('text', [
    'a: [1, 2.5, x]\nb: {c: null}', '', 'a: &x [1, 2]\nb: *x', 'a: &x {k: 1}\nb: {<<: *x, l: 2}',
    'x: 0001', 'x: 1e-05', 'words: ' + 'many words ' * 100, 'digits: ' + '5 words ' * 100])
def test_ordinary_yaml_is_what_it_was(text):
    assert parse_yaml(text, 'the text') == yaml.safe_load(text)


def test_the_line_of_a_mistake_is_told():
    with refused(InputError, 'E-YAML-INVALID', 'the text', 'at line 3'):
        parse_yaml('a: 1\nb: 2\nc: [', 'the text')


@pytest.mark.parametrize('text', ['[' * 100_000, '{"fx": ' + '7' * 5000 + '}', '{', ''])
def test_hostile_json_is_one_line(text):
    with refused(InputError, 'E-JSON-INVALID', 'the text'):
        parse_json(text, 'the text')
