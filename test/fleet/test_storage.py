# SPDX-License-Identifier: Apache-2.0
"""Files here and in memory:// are whole or absent, and clips are copied, never mounted."""
from __future__ import annotations

import errno
import os
import sys

import pytest
from refused import refused

from dashcalib_ros.errors import ConfigError, InputError, OutputError
from dashcalib_ros.fleet import storage
from dashcalib_ros.fleet.manifest import read_manifest
from dashcalib_ros.input.inputs import named_like, open_frames


@pytest.fixture(params=['path', 'memory'])
def place(request, tmp_path, monkeypatch):
    if request.param == 'path':
        return str(tmp_path / 'out')
    fsspec = pytest.importorskip('fsspec')
    monkeypatch.setattr(storage, 'SCHEMES', (*storage.SCHEMES, 'memory'))
    fsspec.filesystem('memory').store.clear()
    return 'memory://bucket/out'


def test_files_are_written_read_and_removed(place):
    file = f'{place}/a/b.txt'
    assert storage.read(file) is None and storage.stamp(file) is None
    storage.write(file, b'one')
    storage.write(file, b'other')
    assert storage.read(file) == b'other'
    assert [name.rpartition('/')[2] for name in storage.listed(f'{place}/a')] == ['b.txt']
    with refused(InputError, 'E-FILE-TOO-LARGE', 'b.txt'):
        storage.read(file, limit=3)
    before = storage.stamp(file)
    storage.write(file, b'longer than that')
    assert before and storage.stamp(file) != before
    storage.remove(file)
    storage.remove(file)
    assert storage.read(file) is None and storage.stamp(file) is None


def test_a_clip_is_copied_to_scratch_and_the_copy_removed(place):
    storage.write(f'{place}/clip.mp4', b'video')
    with storage.local_copy(f'{place}/clip.mp4') as path:
        assert path.read_bytes() == b'video' and path.name == 'clip.mp4'
    assert path.exists() != storage.is_url(place)
    if storage.is_url(place):
        assert not path.parent.exists()
        with (refused(InputError, 'E-ADDRESS-UNREADABLE', 'gone.mp4'),
              storage.local_copy(f'{place}/gone.mp4')):
            pass


def test_names_are_relative_to_their_folder():
    assert storage.joined('/data', 'a/b.mp4') == '/data/a/b.mp4'
    assert storage.joined('s3://bucket/x', 'b.mp4') == 's3://bucket/x/b.mp4'
    assert storage.joined('/data', 's3://bucket/b.mp4') == 's3://bucket/b.mp4'
    assert storage.joined('/data', '/b.mp4') == '/b.mp4'


def test_a_full_disk_leaves_nothing_half_written(tmp_path, monkeypatch):
    file = str(tmp_path / 'a.txt')
    storage.write(file, b'before')

    def full(handle):
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr('os.fsync', full)
    with refused(OutputError, 'E-DISK-FULL'):
        storage.write(file, b'after')
    assert [path.name for path in tmp_path.iterdir()] == ['a.txt']
    assert storage.read(file) == b'before'


def test_an_output_that_is_no_folder(tmp_path):
    (tmp_path / 'file').write_bytes(b'')
    with refused(OutputError, 'E-OUTPUT-NOT-WRITABLE', tmp_path / 'file' / 'a.txt'):
        storage.write(str(tmp_path / 'file' / 'a.txt'), b'')


def test_addresses_say_which_extra_they_need(monkeypatch):
    monkeypatch.setitem(sys.modules, 'fsspec', None)
    with refused(ConfigError, 'E-EXTRA-NOT-INSTALLED', 's3://', 'fsspec', '[fleet]'):
        storage.stamp('s3://bucket/clip.mp4')


def test_an_address_whose_library_is_not_there_is_refused(monkeypatch):
    pytest.importorskip('fsspec')
    monkeypatch.setattr(storage, 'SCHEMES', ('nosuch',))
    with refused(InputError, 'E-ADDRESS-UNKNOWN', 'nosuch://***@bucket/clip.mp4') as caught:
        storage.read('nosuch://user:secret@bucket/clip.mp4')
    assert 'secret' not in str(caught.value)


def test_a_clip_has_only_so_many_files(tmp_path, monkeypatch):
    for name in ('0.png', '1.png', '2.png'):
        (tmp_path / name).touch()
    monkeypatch.setattr(storage, 'CLIP_FILES', 3)
    assert len(storage.clip_files(tmp_path)) == 3
    (tmp_path / '3.png').touch()
    with refused(InputError, 'E-CLIP-TOO-LARGE', tmp_path):
        storage.clip_files(tmp_path)


def test_a_stamp_is_of_all_files_of_a_folder(place):
    for name in ('clip/0.png', 'clip/bag/1.mcap'):
        storage.write(f'{place}/{name}', b'one')
    stamps = [storage.stamp(f'{place}/clip')]
    for name in ('clip/0.png', 'clip/bag/1.mcap', 'clip/2.png'):
        storage.write(f'{place}/{name}', b'another')
        stamps.append(storage.stamp(f'{place}/clip'))
    assert len(set(stamps)) == 4 and None not in stamps
    assert storage.stamp(f'{place}/gone') is None


def test_what_is_no_regular_file_is_not_read(tmp_path):
    os.mkfifo(tmp_path / 'm.csv')
    for place in ('m.csv', 'm.jsonl', 'm.parquet'):
        if place != 'm.csv':
            (tmp_path / place).symlink_to('/dev/zero')
        with refused(InputError, 'E-FILE-NOT-REGULAR'):
            read_manifest(str(tmp_path / place))


def test_a_pattern_ends_where_links_lead_upwards(tmp_path):
    for name in ('a', 'b', 'c', '.hidden'):
        (tmp_path / name).mkdir()
        (tmp_path / name / '1.mp4').write_bytes(b'')
        for up in range(4):
            (tmp_path / name / f'up{up}').symlink_to('..')
    found = storage.listed(f'{tmp_path}/**/*.mp4')
    assert [name.removeprefix(f'{tmp_path}/') for name in found] == [
        'a/1.mp4', 'b/1.mp4', 'c/1.mp4']
    with refused(InputError, 'E-FILE-EMPTY'):
        open_frames(f'{tmp_path}/**/*.mp4')
    assert len(list(named_like(f'{tmp_path}/.hid*/*'))) == 5


@pytest.mark.parametrize('address', [
    'nosuch://bucket/clip.mp4', 'file:///dev/zero', 'github://user:secret@/clip.mp4',
    'zip://x::/data/clips.zip', 'zip://x::https://host/clips.zip', 's3://b/x::file:///etc/hosts',
    'https://host/file:///etc/hosts', 'simplecache://s3://bucket/clip.mp4', 'ftp://host/a.mp4',
    'reference://::file:///etc/hosts', 'dir://x', 'tar://a', 'data://,x', 'local:///etc/hosts'])
@pytest.mark.parametrize('use', [
    storage.stamp, storage.read, storage.listed, storage.is_folder,
    lambda place: storage.write(place, b''), lambda place: storage.local_copy(place).__enter__()])
def test_only_stores_are_opened(monkeypatch, address, use):
    # not even a file system is made
    monkeypatch.setitem(sys.modules, 'fsspec', None)
    with refused(InputError, 'E-ADDRESS-REFUSED') as caught:
        use(address)
    assert 'secret' not in str(caught.value)


@pytest.mark.parametrize(('place', 'shown'), [
    ('/data/a?b#c@d.mp4', None), ('s3://bucket/a@b.mp4', None), ('http://host:8080/a@b/c', None),
    ('abfs://container@account.dfs.core.windows.net/a.mp4', None),
    ('https://user:secret@host/a.mp4', 'https://***@host/a.mp4'),
    ('https://secret@host:80/a.mp4', 'https://***@host:80/a.mp4'),
    ('https://user:s@secret@host/a.mp4', 'https://***@host/a.mp4'),
    ('https://user:sec?ret@host/a.mp4', 'https://***@host/a.mp4'),
    ('s3://KEY:sec/ret@bucket/a.mp4', 's3://***@bucket/a.mp4'),
    ('S3://KEY:secret@bucket/a.mp4', 'S3://***@bucket/a.mp4'),
    ('az://c:secret@account/a.mp4', 'az://***@account/a.mp4'),
    ('az://c@x::s3://KEY:secret@bucket/a.mp4', 'az://c@x::s3://***@bucket/a.mp4'),
    ('zip://x::s3://KEY:secret@bucket/a.mp4', 'zip://***@bucket/a.mp4')])
def test_what_is_shown_of_an_address_has_no_credentials(place, shown):
    assert storage.masked(place) == (shown or place)


def test_signatures_are_hidden_and_clips_stay_apart():
    one, other = (storage.masked(f'https://host/get?id={n}&sig=secret') for n in (1, 2))
    assert one.startswith('https://host/get?***') and one != other and 'secret' not in one


def test_a_library_s_error_does_not_show_credentials(monkeypatch):
    fsspec = pytest.importorskip('fsspec')
    monkeypatch.setattr(storage, 'SCHEMES', ('memory',))

    def denied(self, path, *arguments, **options):
        raise PermissionError(f'403 for {path} of user:secret')
    for name in ('info', 'pipe_file', 'cat_file', 'ls', 'isdir'):
        monkeypatch.setattr(fsspec.get_filesystem_class('memory'), name, denied)
    for use in (storage.stamp, storage.read, storage.listed, storage.is_folder,
                lambda place: storage.write(place, b'')):
        for place in ('memory://user:secret@bucket/a.mp4', 'memory://bucket/a?sig=secret'):
            with pytest.raises((InputError, OutputError)) as caught:
                use(place)
            assert 'secret' not in str(caught.value) and 'PermissionError' in str(caught.value)


def test_what_a_killed_process_left_of_a_file_goes_with_the_next(tmp_path):
    left = tmp_path / 'deep' / '.a.npz.0123abcd.tmp'
    left.parent.mkdir()
    left.touch()
    storage.write(str(tmp_path / 'deep' / 'a.npz'), b'whole')
    assert [path.name for path in left.parent.iterdir()] == ['a.npz']
