# SPDX-License-Identifier: Apache-2.0
"""What is half-written when a process is killed: the next one removes it, and nothing else."""
from __future__ import annotations

import os
import subprocess
import sys

import pytest

from dashcalib_ros import whole_files
from dashcalib_ros.whole_files import remove_leftovers, temporary_folder

# a process that is in the middle of it
HOLDER = """
import sys, time
from pathlib import Path
from dashcalib_ros.whole_files import prepared, temporary_folder
folder = Path(sys.argv[1])
with temporary_folder(folder) as inside, prepared(folder, {'camera.yaml': b'half'}):
    (inside / 'bag').mkdir()
    (inside / 'bag' / 'bag_0.mcap').write_bytes(b'half')
    print('ready', flush=True)
    time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path):
    """A process that has a folder and a file half-written; the test kills it."""
    process = subprocess.Popen([sys.executable, '-c', HOLDER, str(tmp_path)], text=True,
                               stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == 'ready\n'
    yield process
    process.kill()
    process.communicate()


def sweep(folder):
    remove_leftovers(folder)
    remove_leftovers(folder, ('camera.yaml',))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_a_living_process_writes_stays_and_what_a_killed_one_left_goes(holder, tmp_path):
    sweep(tmp_path)
    assert len(names(tmp_path)) == 2
    holder.kill()
    holder.wait()
    with temporary_folder(tmp_path) as inside:
        assert [name for name in names(tmp_path) if 'yaml' not in name] == [inside.name]
    sweep(tmp_path)
    assert names(tmp_path) == []


def test_what_another_user_left_stays(holder, tmp_path, monkeypatch):
    holder.kill()
    holder.wait()
    before = names(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(whole_files.os, 'geteuid', lambda: os.getuid() + 1)
        sweep(tmp_path)
    assert names(tmp_path) == before
    sweep(tmp_path)
    assert names(tmp_path) == []


def test_what_only_looks_like_ours_stays(tmp_path):
    data = tmp_path / 'data'
    data.mkdir()
    (data / 'kept').touch()
    (tmp_path / '.dashcalib.0123abcd.tmp').symlink_to(data)
    for name in ('dashcalib.0123abcd.tmp', '.dashcalib.0123abcd', '.dashcalib.0123.tmp',
                 '.other.0123abcd.tmp'):
        (tmp_path / name).mkdir()
    os.mkfifo(tmp_path / '.dashcalib.89abcdef.tmp')
    before = names(tmp_path)
    sweep(tmp_path)
    assert names(tmp_path) == before and (data / 'kept').exists()


def test_folders_are_made_on_the_way_and_removed_unless_they_are_used(tmp_path):
    place = tmp_path / 'a' / 'b'
    with temporary_folder(place) as inside:
        (inside / 'half').touch()
    assert names(tmp_path) == []
    with temporary_folder(place) as inside:
        (inside / 'bag').mkdir()
        (inside / 'bag').rename(place / 'bag')
    assert names(place) == ['bag']


def test_a_folder_that_is_swept_before_it_is_locked_is_made_again(tmp_path, monkeypatch):
    real, made = whole_files.fcntl.flock, []

    def flock(handle, how):
        if not made:
            [path] = tmp_path.iterdir()
            made.append(path)
            path.rmdir()
        real(handle, how)

    monkeypatch.setattr(whole_files.fcntl, 'flock', flock)
    with temporary_folder(tmp_path) as inside:
        assert inside.is_dir() and inside != made[0]
