# SPDX-License-Identifier: Apache-2.0
"""Recordings whose recorder was killed: all that was written is read, or what is lost is said."""
from __future__ import annotations

import shutil
import sqlite3

import pytest
from made_drives import (
    cut,
    drive,
    fails,
    images,
    same,
    storage,
    write_bag,
    write_mcap,
    write_ros1,
    write_timed,
)
from refused import refused
from rosbags.rosbag2 import StoragePlugin

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.bag_write import check_bag
from dashcalib_ros.input.inputs import open_frames

FRAMES = drive(20)


def killed(tmp_path, mode, change):
    """Return a bag's file as a killed recorder leaves it, beside its journal.

    mode: of the journal. change: SQL that was under way.
    """
    whole = storage(write_bag(tmp_path / 'whole', images(FRAMES), StoragePlugin.SQLITE3))
    folder = tmp_path / 'dead'
    folder.mkdir()
    database = sqlite3.connect(whole, isolation_level=None)
    database.execute(f'PRAGMA journal_mode = {mode}')
    database.execute('PRAGMA wal_autocheckpoint = 0')
    database.execute('PRAGMA cache_size = 1')
    for statement in change:
        database.execute(statement)
    for each in whole.parent.glob(f'{whole.name}*'):
        if not each.name.endswith('-shm'):
            shutil.copy(each, folder)
    database.close()
    return folder / whole.name


def test_messages_that_are_in_the_write_ahead_log_are_read(tmp_path):
    """Half of them were moved there by SQLite itself, as when a recorder writes them."""
    file = killed(tmp_path, 'WAL', (
        'CREATE TABLE later AS SELECT * FROM messages WHERE id > 10',
        'DELETE FROM messages WHERE id > 10', 'PRAGMA wal_checkpoint(TRUNCATE)',
        'INSERT INTO messages SELECT * FROM later'))
    before = {path.name: path.read_bytes() for path in file.parent.iterdir()}
    assert set(before) == {file.name, f'{file.name}-wal'}
    for path in (file, file.parent):
        source = open_frames(path)
        assert source.count == 20
        same(list(source), FRAMES)
        assert f'{file.name}-wal' in str(source.warnings[-1])
    # nothing is written to a recording
    assert {path.name: path.read_bytes() for path in file.parent.iterdir()} == before
    with refused(InputError, 'E-BAG-DAMAGED', f'{file.name} was not closed', 'mcap recover'):
        check_bag(file, '/camera', tmp_path / 'out')
    file.with_name(f'{file.name}-wal').unlink()
    assert len(list(open_frames(file))) == 10


def test_what_a_rollback_journal_takes_back_is_read(tmp_path):
    file = killed(tmp_path, 'DELETE', ('BEGIN', 'DELETE FROM messages WHERE id > 3'))
    assert file.with_name(f'{file.name}-journal').stat().st_size
    source = open_frames(file)
    same(list(source), FRAMES)
    assert f'{file.name}-journal' in str(source.warnings[-1])


@pytest.mark.parametrize('spoil', [lambda data: bytes(len(data)), lambda data: data[:40],
                                   lambda data: data[::-1]])
def test_a_log_that_is_damaged_is_said(tmp_path, spoil):
    file = killed(tmp_path, 'WAL', ('DELETE FROM messages WHERE id > 10',))
    log = file.with_name(f'{file.name}-wal')
    log.write_bytes(spoil(log.read_bytes()))
    source = open_frames(file)
    same(list(source), FRAMES)
    assert log.name in str(source.warnings[-1]) and '20 images' in str(source.warnings[-1])
    assert 'lost images is unknown' in str(source.warnings[-1])


def test_a_log_without_room_for_a_copy(tmp_path, monkeypatch):
    file = killed(tmp_path, 'WAL', ('DELETE FROM messages WHERE id > 10',))
    monkeypatch.setattr('dashcalib_ros.input.bag_read.FREE_BYTES', 2**60)
    fails('E-DISK-FULL', file, file.name, 'TMPDIR', 'sqlite3')


@pytest.mark.parametrize('name', ['drive.mcap', 'drive.mcap.active'])
@pytest.mark.parametrize('chunks', [True, False])
def test_an_mcap_without_its_end(tmp_path, name, chunks):
    whole = write_mcap(tmp_path / 'whole.mcap', FRAMES, use_chunking=chunks, chunk_size=5000)
    half = cut(whole, 0.5, tmp_path / name)
    source = open_frames(half)
    found = list(source)
    assert 5 < len(found) < 15
    same(found, FRAMES[:len(found)])
    assert 'lost images is unknown' in str(source.warnings[-1])


def test_an_active_bag_of_ros1(tmp_path):
    whole = write_ros1(tmp_path / 'whole.bag', FRAMES)
    half = cut(whole, 0.5, tmp_path / 'drive.bag.active')
    source = open_frames(half)
    assert 5 < len(list(source)) < 15
    assert 'lost images is unknown' in str(source.warnings[-1])


def boxes(path):
    """Return the names of an MP4's boxes and where each begins."""
    data, at, found = path.read_bytes(), 0, {}
    while at < len(data):
        found[data[at + 4:at + 8]] = at
        at += int.from_bytes(data[at:at + 4], 'big')
    return found


@pytest.mark.parametrize('suffix', ['.mp4', '.mov'])
def test_a_video_that_was_not_closed_is_named(tmp_path, suffix):
    whole = write_timed(tmp_path / f'whole{suffix}')
    found = boxes(whole)
    assert found[b'moov'] > found[b'mdat']
    dead = tmp_path / f'dead{suffix}'
    dead.write_bytes(whole.read_bytes()[:found[b'moov']])
    fails('E-VIDEO-NO-INDEX', dead, 'moov', 'untrunc')
    # a recorder that was killed has not written how long the pictures are
    data = bytearray(dead.read_bytes())
    data[found[b'mdat']:found[b'mdat'] + 4] = bytes(4)
    dead.write_bytes(data)
    fails('E-VIDEO-NO-INDEX', dead)
    # a copy that ends early may lack more than that
    dead.write_bytes(data[:found[b'mdat'] + 2000])
    fails('E-VIDEO-NO-INDEX', dead)
