"""The output folder: whole files only, and no wrong calibration where a driver would load it."""
from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path

import pytest
import yaml
from test_report_result import TRUTH, make_calibration

from dashcalib_ros.errors import OutputError
from dashcalib_ros.report import check_writable, output_folder, write_results, write_text


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_an_accepted_calibration_is_written(tmp_path):
    written = write_results(make_calibration(), tmp_path / 'a' / 'b')
    folder = tmp_path / 'a' / 'b'
    assert names(folder) == ['calibration.yaml', 'report.html', 'result.json']
    assert sorted(written) == sorted(folder.iterdir())
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


def test_an_accepted_one_takes_the_stale_weak_file_away(tmp_path):
    write_results(make_calibration('weak'), tmp_path)
    write_results(make_calibration(), tmp_path)
    assert names(tmp_path) == ['calibration.yaml', 'report.html', 'result.json']


@pytest.mark.parametrize('failing', [1, 2, 3])
def test_a_full_disk_changes_nothing(tmp_path, monkeypatch, failing):
    write_results(make_calibration('weak'), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    calls = []

    def full(handle):
        calls.append(handle)
        if len(calls) == failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(os, 'fsync', full)
    with pytest.raises(OutputError, match=r'No space left.*free some space'):
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
    (tmp_path / 'report.html').mkdir()
    with pytest.raises(OutputError, match=r'report\.html.*move it'):
        write_results(make_calibration(), tmp_path)
    assert names(tmp_path) == ['report.html']


def test_a_file_where_the_folder_should_be(tmp_path):
    (tmp_path / 'out').write_text('I was here')
    with pytest.raises(OutputError, match='choose another output folder'):
        check_writable(tmp_path / 'out')
    with pytest.raises(OutputError, match='choose another output folder'):
        check_writable(tmp_path / 'out' / 'deeper')
    assert (tmp_path / 'out').read_text() == 'I was here'


def test_a_place_that_may_not_be_written(tmp_path, monkeypatch):
    def refuse(self, *args, **options):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))
    monkeypatch.setattr(Path, 'open', refuse)
    with pytest.raises(OutputError, match='you may write to'):
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
