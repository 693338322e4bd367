# SPDX-License-Identifier: Apache-2.0
"""dashcalib batch: exit codes, and what stands on the streams."""
from __future__ import annotations

import json
import sys

import pytest
from made_drives import smooth, write_video

from dashcalib_ros.cli import main
from dashcalib_ros.cli.arguments import make_parser
from dashcalib_ros.cli.drive import read_config
from dashcalib_ros.config import Config


def run(capsys, *arguments):
    code = main(['batch', *map(str, arguments)])
    out, err = capsys.readouterr()
    assert 'Traceback' not in err
    return code, out, err


def test_the_number_of_its_processes_is_no_setting():
    args = make_parser().parse_args(['batch', 'x.csv', '--out', 'y', '--workers', '3'])
    assert args.workers == 3 and read_config(args) == Config()


def test_a_fleet_is_calibrated_here_and_nothing_is_done_twice(tmp_path, capsys):
    (tmp_path / 'clips').mkdir()
    write_video(tmp_path / 'clips' / 'a.avi', smooth(), fps=10.0)
    manifest, out = tmp_path / 'm.csv', tmp_path / 'out'
    manifest.write_text('clip,camera\nclips/a.avi,one\ngone.avi,two\nclips/a.avi,one,7\n')
    code, text, err = run(capsys, manifest, '--out', out, '--workers', '1')
    # refused: there is no turn
    assert code == 3
    assert 'one: refused' in text and '2 cameras: 0 accepted, 0 weak, 2 refused' in text
    assert 'row 2 (gone.avi): there is no such file' in err and 'row 3' in err
    assert json.loads((out / 'effort.json').read_text())['clips_read'] == 2
    assert (out / 'overview.html').exists() and not list(out.rglob('.writable'))
    before = (out / 'overview.html').read_bytes()
    code, text, err = run(capsys, manifest, '--out', out, '--workers', '1', '--json')
    found = json.loads(text)
    assert code == 3 and found['cameras'] == {'one': 'refused', 'two': 'refused'}
    assert {each['row'] for each in found['not_read']} == {2, 3} and found['files']
    assert '2 cameras: ' in err
    _, text, _ = run(capsys, manifest, '--out', out, '--shard', '1/1')
    assert 'one: refused' not in text
    run(capsys, manifest, '--out', out, '--workers', '1')
    assert (out / 'overview.html').read_bytes() == before


@pytest.mark.parametrize(('text', 'options', 'message'), [
    ('clip\nä.avi\n', (), 'not UTF-8'), ('video\na.avi\n', (), 'no column clip'),
    ('clip\na.avi\n', ('--shard', '3/2'), '--shard must be like 1/8'),
    ('clip\na.avi\n', ('--workers', '0'), '--workers'),
    ('clip\na.avi\n', ('--group-by', '('), 'E-GROUP-BY-INVALID'),
    ('clip\na.avi\n', ('--set', 'fleet.units=3'), 'did you mean'),
    ('clip\na.avi\n', ('--workers', '1', '--shard', '1/2'), 'not allowed with')])
def test_bad_manifests_and_usage_are_one_line(tmp_path, capsys, text, options, message):
    (tmp_path / 'm.csv').write_bytes(text.encode('latin-1'))
    code, out, err = run(capsys, tmp_path / 'm.csv', '--out', tmp_path / 'out', *options)
    assert code == 2 and not out and message in err and len(err.splitlines()) == 1
    assert not (tmp_path / 'out').exists()


def test_an_output_that_cannot_be_written(tmp_path, capsys):
    (tmp_path / 'm.csv').write_text('clip\na.avi\n')
    (tmp_path / 'out').write_text('a file')
    code, _, err = run(capsys, tmp_path / 'm.csv', '--out', tmp_path / 'out', '--workers', '1')
    assert code == 2 and 'choose an output folder' in err


@pytest.mark.parametrize(('options', 'expected'), [
    (('--workers', '2'), 3), ((), 3), (('--address', 'auto'), 2)])
def test_only_a_cluster_needs_ray(tmp_path, capsys, monkeypatch, options, expected):
    for name in ('ray', 'pyarrow', 'fsspec'):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / 'm.csv').write_text('clip\na.avi\n')
    code, _, err = run(capsys, tmp_path / 'm.csv', '--out', tmp_path / 'out', *options)
    assert code == expected
    assert ("pip install '.[fleet]'" in err) == (expected == 2)
