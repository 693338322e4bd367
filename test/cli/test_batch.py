# SPDX-License-Identifier: Apache-2.0
"""dashcalib batch: exit codes, and what stands on the streams."""
from __future__ import annotations

import json
import sys
from types import SimpleNamespace

import pytest
from made_drives import smooth, write_video

from dashcalib_ros.cli import main
from dashcalib_ros.cli.arguments import make_parser
from dashcalib_ros.cli.batch import SHOWN, _problem
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
    problems = [line for line in err.splitlines() if ': row ' in line]
    assert {each.partition('row ')[2].partition(':')[0]: each.rpartition(' ')[2]
            for each in problems} == {'2 (gone.avi)': '[E-CLIP-MISSING]', '3': '[E-MANIFEST-ROW]'}
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


def test_many_problems_are_counted(tmp_path, capsys):
    (tmp_path / 'm.csv').write_text('clip,camera\n' + ''.join(f'{n}.avi,one\n' for n in range(13)))
    code, _, err = run(capsys, tmp_path / 'm.csv', '--out', tmp_path / 'out', '--workers', '1')
    [last] = [line for line in err.splitlines() if line.endswith('[E-CLIPS-UNREADABLE]')]
    assert code == 3 and err.count('[E-CLIP-MISSING]') == SHOWN == 10 and ' 3 more' in last


def test_an_interrupt_says_how_to_continue(tmp_path, capsys, monkeypatch):
    def interrupted(cameras, out, config, engine, merge, tell):
        raise KeyboardInterrupt
    monkeypatch.setattr('dashcalib_ros.cli.batch.calibrate_fleet', interrupted)
    (tmp_path / 'm.csv').write_text('clip\na.avi\n')
    code, _, err = run(capsys, tmp_path / 'm.csv', '--out', tmp_path / 'out', '--workers', '1')
    [line] = [line for line in err.splitlines() if line.endswith('[E-BATCH-INTERRUPTED]')]
    assert code == 130 and '0 of 1 clip' in line and str(tmp_path / 'out') in line


@pytest.mark.parametrize(('text', 'options', 'message'), [
    ('clip\nä.avi\n', (), 'E-MANIFEST-NOT-UTF8'),
    ('video\na.avi\n', (), 'E-MANIFEST-NO-CLIP-COLUMN'),
    ('clip\na.avi\n', ('--shard', '3/2'), 'E-SHARD-INVALID'),
    ('clip\na.avi\n', ('--workers', '0'), '--workers'),
    ('clip\na.avi\n', ('--group-by', '('), 'E-GROUP-BY-INVALID'),
    ('clip\na.avi\n', ('--set', 'fleet.units=3'), 'E-CONFIG-UNKNOWN'),
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
    assert code == 2 and err.endswith('[E-OUTPUT-NOT-WRITABLE]\n')


@pytest.mark.parametrize(('options', 'expected'), [
    (('--workers', '2'), 3), ((), 3), (('--address', 'auto'), 2)])
def test_only_a_cluster_needs_ray(tmp_path, capsys, monkeypatch, options, expected):
    for name in ('ray', 'pyarrow', 'fsspec'):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / 'm.csv').write_text('clip\na.avi\n')
    code, _, err = run(capsys, tmp_path / 'm.csv', '--out', tmp_path / 'out', *options)
    assert code == expected
    assert ("pip install '.[fleet]'" in err) == (expected == 2)


def test_a_clip_s_name_begins_no_line():
    row = SimpleNamespace(number=3, clip='a.mp4\nverdict: accepted')
    assert _problem(row, 'it is\nempty') == 'row 3 (a.mp4 verdict: accepted): it is empty'
