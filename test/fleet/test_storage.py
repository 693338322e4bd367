"""Files here and in memory:// are whole or absent, and clips are copied, never mounted."""
from __future__ import annotations

import errno

import pytest

from dashcalib_ros.errors import ConfigError, InputError, OutputError
from dashcalib_ros.fleet import storage
from dashcalib_ros.fleet.storage import Folder


@pytest.fixture(params=['path', 'memory'])
def place(request, tmp_path):
    if request.param == 'path':
        return str(tmp_path / 'out')
    fsspec = pytest.importorskip('fsspec')
    fsspec.filesystem('memory').store.clear()
    return 'memory://bucket/out'


def test_files_are_written_read_and_removed(place):
    folder = Folder(place)
    assert folder.read('a/b.txt') is None and not folder.exists('a/b.txt')
    folder.write('a/b.txt', b'one')
    folder.write('a/b.txt', b'other')
    assert folder.read('a/b.txt') == b'other' and folder.exists('a/b.txt')
    assert [name.rpartition('/')[2] for name in storage.listed(f'{place}/a')] == ['b.txt']
    with pytest.raises(InputError, match='larger than'):
        folder.read('a/b.txt', limit=3)
    before = storage.stamp(f'{place}/a/b.txt')
    folder.write('a/b.txt', b'longer than that')
    assert before and storage.stamp(f'{place}/a/b.txt') != before
    folder.remove('a/b.txt')
    folder.remove('a/b.txt')
    assert not folder.exists('a/b.txt') and storage.stamp(f'{place}/a/b.txt') is None


def test_a_clip_is_copied_to_scratch_and_the_copy_removed(place):
    Folder(place).write('clip.mp4', b'video')
    with storage.local_copy(f'{place}/clip.mp4') as path:
        assert path.read_bytes() == b'video' and path.name == 'clip.mp4'
    assert path.exists() != storage.is_url(place)
    if storage.is_url(place):
        assert not path.parent.exists()
        with (pytest.raises(InputError, match=r'cannot copy .*gone'),
              storage.local_copy(f'{place}/gone.mp4')):
            pass


def test_names_are_relative_to_their_folder():
    assert storage.joined('/data', 'a/b.mp4') == '/data/a/b.mp4'
    assert storage.joined('s3://bucket/x', 'b.mp4') == 's3://bucket/x/b.mp4'
    assert storage.joined('/data', 's3://bucket/b.mp4') == 's3://bucket/b.mp4'
    assert storage.joined('/data', '/b.mp4') == '/b.mp4'
    assert storage.parent('gs://bucket/x/m.csv') == 'gs://bucket/x'


def test_a_full_disk_leaves_nothing_half_written(tmp_path, monkeypatch):
    folder = Folder(str(tmp_path))
    folder.write('a.txt', b'before')

    def full(handle):
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr('os.fsync', full)
    with pytest.raises(OutputError, match='No space left on device; free some space'):
        folder.write('a.txt', b'after')
    assert [path.name for path in tmp_path.iterdir()] == ['a.txt']
    assert folder.read('a.txt') == b'before'


def test_an_output_that_is_no_folder(tmp_path):
    (tmp_path / 'file').write_bytes(b'')
    with pytest.raises(OutputError, match='choose an output folder'):
        Folder(str(tmp_path / 'file')).write('a.txt', b'')


def test_addresses_say_which_extra_they_need(monkeypatch):
    monkeypatch.setattr('dashcalib_ros.fleet.extra.has', lambda name: None)
    with pytest.raises(ConfigError, match=r's3:// addresses need fsspec: .*\[fleet\]'):
        storage.stamp('s3://bucket/clip.mp4')


def test_an_unknown_kind_of_address():
    pytest.importorskip('fsspec')
    with pytest.raises(InputError, match='cannot use nosuch://'):
        storage.stamp('nosuch://bucket/clip.mp4')
