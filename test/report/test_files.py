# SPDX-License-Identifier: Apache-2.0
"""The output folder: whole files only, and no wrong calibration where a driver would load it."""
from __future__ import annotations

import errno
import json
import os
import re
import resource
import stat
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml
from made_calibration import TRUTH, make_calibration
from refused import refused

from dashcalib_ros.errors import OutputError
from dashcalib_ros.formats import load_camera
from dashcalib_ros.report import (
    NamedCamera,
    check_writable,
    output_folder,
    set_aside,
    write_results,
    write_text,
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_an_accepted_calibration_is_written(tmp_path):
    written = write_results(make_calibration(), tmp_path / 'a' / 'b')
    folder = tmp_path / 'a' / 'b'
    assert names(folder) == ['calibration.yaml', 'report.html', 'result.json']
    assert sorted(written.files) == sorted(folder.iterdir())
    document = yaml.safe_load((folder / 'calibration.yaml').read_text())
    assert document['camera_matrix']['data'][0] == TRUTH.fx
    assert json.loads((folder / 'result.json').read_text())['verdict'] == 'accepted'


def test_files_get_the_permissions_that_new_files_have(tmp_path):
    (tmp_path / 'plain').touch()
    write_results(make_calibration(), tmp_path)
    wanted = stat.S_IMODE((tmp_path / 'plain').stat().st_mode)
    assert stat.S_IMODE((tmp_path / 'calibration.yaml').stat().st_mode) == wanted


def test_a_weak_one_sets_the_old_calibration_aside(tmp_path):
    write_results(make_calibration(), tmp_path)
    old = (tmp_path / 'calibration.yaml').read_text()
    write_results(make_calibration('weak'), tmp_path)
    assert names(tmp_path) == ['calibration.previous.yaml', 'calibration.weak.yaml',
                               'report.html', 'result.json']
    assert (tmp_path / 'calibration.previous.yaml').read_text() == old


def test_a_refused_one_leaves_nothing_to_load(tmp_path):
    write_results(make_calibration(), tmp_path)
    write_results(make_calibration('weak'), tmp_path)
    write_results(make_calibration('refused'), tmp_path)
    assert names(tmp_path) == ['calibration.previous.yaml', 'report.html', 'result.json']


def test_what_was_set_aside_is_told_and_no_earlier_one_is_overwritten(tmp_path):
    texts = []
    for level in ('weak', 'refused', 'weak'):
        assert write_results(make_calibration(), tmp_path, created=level).set_aside is None
        texts.append((tmp_path / 'calibration.yaml').read_text() + f'# {level}\n')
        (tmp_path / 'calibration.yaml').write_text(texts[-1])
        number = '' if len(texts) == 1 else f'.{len(texts)}'
        backup = tmp_path / f'calibration.previous{number}.yaml'
        assert write_results(make_calibration(level), tmp_path).set_aside == backup
    assert [(tmp_path / f'calibration.previous{number}.yaml').read_text()
            for number in ('', '.2', '.3')] == texts
    assert write_results(make_calibration('refused'), tmp_path).set_aside is None


@pytest.mark.parametrize('theirs', [b'camera_matrix: theirs\n', b'\xff\x00', b''])
def test_a_calibration_of_another_program_is_never_overwritten(tmp_path, theirs):
    (tmp_path / 'calibration.yaml').write_bytes(theirs)
    written = write_results(make_calibration(), tmp_path)
    assert written.set_aside == tmp_path / 'calibration.previous.yaml'
    assert written.set_aside.read_bytes() == theirs
    assert load_camera(tmp_path / 'calibration.yaml').verdict == 'accepted'
    assert write_results(make_calibration(), tmp_path).set_aside is None


def test_a_folder_of_that_name_is_left_alone_by_a_refused_run(tmp_path):
    (tmp_path / 'calibration.yaml').mkdir()
    assert write_results(make_calibration('refused'), tmp_path).set_aside is None
    assert names(tmp_path) == ['calibration.yaml', 'report.html', 'result.json']


def test_setting_aside_reports_what_it_did(tmp_path):
    assert set_aside(tmp_path / 'none.yaml') is None
    assert set_aside(tmp_path / 'none' / 'none.yaml') is None
    (tmp_path / 'camera').write_text('no suffix')
    assert set_aside(tmp_path / 'camera') == tmp_path / 'camera.previous'


def test_what_cannot_be_moved_is_an_error_and_leaves_no_empty_backup(tmp_path, monkeypatch):
    def refuse(self, target):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))
    (tmp_path / 'camera.yaml').write_text('x')
    monkeypatch.setattr(Path, 'replace', refuse)
    with refused(OutputError, 'E-FILE-NOT-MOVED', 'camera.yaml'):
        set_aside(tmp_path / 'camera.yaml')
    assert names(tmp_path) == ['camera.yaml']


KILLED = '''
import os, sys
from dashcalib_ros.report import write_text
os.fsync = lambda handle: os._exit(9)
write_text(sys.argv[1], 'half')
'''


@pytest.mark.parametrize('begin', [check_writable, lambda folder: write_results(
    make_calibration(), folder)], ids=['run', 'batch'])
def test_the_next_run_removes_what_a_killed_one_left_and_nothing_else(tmp_path, begin):
    killed = subprocess.run([sys.executable, '-c', KILLED, tmp_path / 'result.json'])
    assert killed.returncode == 9
    left, = names(tmp_path)
    assert re.fullmatch(r'\.result\.json\.[0-9a-f]{8}\.tmp', left)
    others = ['.other.json.0123abcd.tmp', '.result.json.tmp', '.result.json.0123abcz.tmp']
    for name in others:
        (tmp_path / name).touch()
    begin(tmp_path)
    assert [name for name in names(tmp_path) if name[0] == '.'] == sorted(others)


def test_temporary_files_of_a_process_that_lives_are_kept(tmp_path, monkeypatch):
    """Two runs into one folder: one begins while the other writes."""
    seen = []

    def begin_another(handle):
        check = 'import sys; from dashcalib_ros.report import check_writable as c; c(sys.argv[1])'
        subprocess.run([sys.executable, '-c', check, tmp_path], check=True)
        seen.append(names(tmp_path))
    monkeypatch.setattr(os, 'fsync', begin_another)
    write_text(tmp_path / 'truth.json', 'whole')
    assert len(seen[0]) == 1
    assert names(tmp_path) == ['truth.json']


def test_an_accepted_one_takes_the_stale_weak_file_away(tmp_path):
    write_results(make_calibration('weak'), tmp_path)
    write_results(make_calibration(), tmp_path)
    assert names(tmp_path) == ['calibration.yaml', 'report.html', 'result.json']


@pytest.mark.parametrize('failing', [1, 2])
def test_a_full_disk_changes_nothing(tmp_path, monkeypatch, failing):
    write_results(make_calibration('weak'), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    calls = []

    def full(handle):
        calls.append(handle)
        if len(calls) == failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(os, 'fsync', full)
    with refused(OutputError, 'E-DISK-FULL'):
        write_results(make_calibration(), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_ctrl_c_while_writing_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(handle):
        raise KeyboardInterrupt
    monkeypatch.setattr(os, 'fsync', interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_results(make_calibration(), tmp_path)
    assert names(tmp_path) == []


def test_a_folder_in_the_way_is_told_and_nothing_is_written(tmp_path):
    (tmp_path / 'result.json').mkdir()
    with refused(OutputError, 'E-NAME-TAKEN'):
        write_results(make_calibration(), tmp_path)
    assert names(tmp_path) == ['result.json']


@contextmanager
def room_for(size):
    """Let no file become larger than so many bytes, as `ulimit -f` does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_report_that_does_not_fit_costs_itself_only(tmp_path):
    write_results(make_calibration('weak'), tmp_path)
    with room_for(20_000):
        written = write_results(make_calibration(), tmp_path)
    # nor is that of the result before it there
    assert names(tmp_path) == ['calibration.yaml', 'result.json']
    assert sorted(written.files) == sorted(tmp_path.iterdir())
    assert [each.code for each in written.lost] == ['E-REPORT-NOT-WRITTEN']
    assert load_camera(tmp_path / 'calibration.yaml').camera == TRUTH
    with room_for(100), refused(OutputError, 'E-DISK-FULL'):
        write_results(make_calibration(), tmp_path)


def test_a_report_whose_name_is_taken_costs_itself_only(tmp_path):
    (tmp_path / 'report.html').mkdir()
    written = write_results(make_calibration(), tmp_path)
    assert [each.code for each in written.lost] == ['E-REPORT-NOT-WRITTEN']
    assert names(tmp_path) == ['calibration.yaml', 'report.html', 'result.json']


def broken(*arguments, **options):
    raise IndexError('list index out of range')


@pytest.mark.parametrize('part', [
    'page._snippets', 'page.uncertainty_of', 'page.slider_of', 'page.magnitude_svg',
    'page.turn_sections', 'page.evidence_of', 'page.field_of', 'page.mounting_of',
    'page.compare', 'page.next_steps', 'files.report_html'])
def test_a_part_of_the_report_that_fails_costs_itself_only(tmp_path, monkeypatch, part):
    monkeypatch.setattr(f'dashcalib_ros.report.{part}', broken)
    truth = NamedCamera('truth', TRUTH)
    written = write_results(make_calibration(), tmp_path, truth=truth)
    assert [each.code for each in written.lost] == ['E-PART-MISSING']
    whole = part in ('page.next_steps', 'files.report_html')
    assert names(tmp_path) == ['calibration.yaml', *['report.html'] * (not whole), 'result.json']
    assert whole or 'list index out of range' in (tmp_path / 'report.html').read_text()
    assert json.loads((tmp_path / 'result.json').read_text())['intrinsics']['fx'] == TRUTH.fx


@pytest.mark.parametrize('level', ['accepted', 'weak', 'refused'])
def test_a_weak_calibration_of_another_program_is_kept(tmp_path, level):
    theirs = b'camera_matrix: theirs\n'
    (tmp_path / 'calibration.weak.yaml').write_bytes(theirs)
    written = write_results(make_calibration(level), tmp_path)
    kept = written.set_aside or tmp_path / 'calibration.weak.yaml'
    assert kept.read_bytes() == theirs
    assert (kept.name == 'calibration.weak.previous.yaml') == (level == 'weak')


def test_a_file_where_the_folder_should_be(tmp_path):
    (tmp_path / 'out').write_text('I was here')
    for folder in (tmp_path / 'out', tmp_path / 'out' / 'deeper'):
        with refused(OutputError, 'E-NAME-TAKEN', folder):
            check_writable(folder)
    assert (tmp_path / 'out').read_text() == 'I was here'


@pytest.mark.parametrize(('number', 'code'), [
    (errno.EACCES, 'E-NOT-WRITABLE'), (errno.EIO, 'E-CANNOT-WRITE')])
def test_a_place_that_may_not_be_written(tmp_path, monkeypatch, number, code):
    def refuse(self, *args, **options):
        raise OSError(number, os.strerror(number), str(self))
    monkeypatch.setattr(Path, 'open', refuse)
    with refused(OutputError, code, tmp_path):
        check_writable(tmp_path)


def test_checking_leaves_an_empty_folder(tmp_path):
    check_writable(tmp_path / 'new' / 'folder')
    assert names(tmp_path / 'new' / 'folder') == []


def test_a_folder_made_for_nothing_is_taken_away_again(tmp_path):
    with pytest.raises(RuntimeError), output_folder(tmp_path / 'new'):
        raise RuntimeError
    assert names(tmp_path) == []
    (tmp_path / 'old').mkdir()
    with pytest.raises(RuntimeError), output_folder(tmp_path / 'old'):
        raise RuntimeError
    assert names(tmp_path) == ['old']


def test_one_text_is_replaced_whole(tmp_path):
    write_text(tmp_path / 'truth.json', 'one')
    write_text(tmp_path / 'truth.json', 'two')
    assert (tmp_path / 'truth.json').read_text() == 'two'
    assert names(tmp_path) == ['truth.json']
