# SPDX-License-Identifier: Apache-2.0
"""What a file is tells its content first, its name second."""
from __future__ import annotations

import os

import cv2
import numpy as np
import pytest
from made_drives import (
    TIMES,
    drive,
    fails,
    images,
    same,
    smooth,
    storage,
    suffix,
    write_bag,
    write_ros1,
    write_timed,
    write_video,
)
from refused import refused
from rosbags.rosbag2 import StoragePlugin

from dashcalib_ros.errors import InputError
from dashcalib_ros.formats import load_camera
from dashcalib_ros.input.inputs import fits_bag, is_video, open_frames

ODD = ('VID_20260701_101010_00_001.insv', 'drive.dav', 'drive', 'drive.mp4.part', 'drive.mcap',
       'drive.jpg.bak')


@pytest.mark.parametrize('container', ['.mp4', '.mov', '.mkv', '.webm', '.avi', '.ts', '.m2ts',
                                       '.mpg', '.flv', '.asf'])
def test_videos_under_any_name(tmp_path, container):
    codecs = {'.avi': 'MJPG', '.mpg': 'mpg1', '.asf': 'MJPG', '.webm': 'VP80'}
    if container in codecs:
        whole = write_video(tmp_path / f'whole{container}', smooth(), codecs[container])
    else:
        whole = write_timed(tmp_path / f'whole{container}', TIMES[:12])
    expected = list(open_frames(whole))
    for name in ODD:
        path = tmp_path / name
        path.unlink(missing_ok=True)
        path.hardlink_to(whole)
        assert is_video(path) and not fits_bag(path)
        same(list(open_frames(path)), expected)


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_bags_under_any_name(tmp_path, plugin):
    frames = drive(5)
    whole = storage(write_bag(tmp_path / 'bag', images(frames), plugin))
    for name in (f'drive.{suffix(plugin)}.bak', 'drive', 'drive.mp4'):
        path = tmp_path / name
        path.hardlink_to(whole)
        assert fits_bag(path) and not is_video(path)
        same(list(open_frames(path)), frames)
    old = write_ros1(tmp_path / 'old.mkv', frames)
    assert len(list(open_frames(old))) == 5


def test_a_folder_of_videos_under_a_maker_s_suffix(tmp_path):
    for n in (1, 2):
        write_timed(tmp_path / f'{n}.mp4', TIMES[:12]).rename(
            tmp_path / f'VID_20260701_10101{n}_00_00{n}.insv')
        (tmp_path / f'{n}.txt').write_text('notes')
    source = open_frames(tmp_path)
    assert source.count == 24 and 'by Insta360 names' in str(source.warnings[0])
    assert open_frames(str(tmp_path / '*')).count == 24


@pytest.mark.parametrize('head', [b'\0\0\0\x18ftypheic', b'\0\0\0\x18ftypM4A ',
                                  b'RIFF....WAVEfmt ', b'G', b'', b'\xff\xd8\xff\xe0'])
def test_what_only_begins_like_a_video_is_none(tmp_path, head):
    path = tmp_path / 'file.xyz'
    path.write_bytes(head + bytes(1000))
    assert not is_video(path) and not fits_bag(path)
    fails('E-INPUT-UNKNOWN', path)
    # its name says otherwise
    path = path.rename(tmp_path / 'file.mp4')
    fails('E-VIDEO-UNREADABLE', path)


def test_a_pipe_is_not_read(tmp_path):
    for name in ('pipe', 'pipe.insv'):
        os.mkfifo(tmp_path / name)
        assert not fits_bag(tmp_path / name)
        fails('E-FILE-NOT-REGULAR', tmp_path / name)


def test_pictures_are_not_looked_into(tmp_path, monkeypatch):
    """A folder of 1,000 files opens as quickly as it is listed."""
    for n in range(5):
        cv2.imwrite(str(tmp_path / f'{n}.png'), np.zeros((4, 4), np.uint8))
    (tmp_path / 'notes').touch()
    looked = []
    monkeypatch.setattr('dashcalib_ros.input.inputs._head',
                        lambda path: looked.append(path.name) or b'')
    assert open_frames(tmp_path, fps=10).count == 5
    assert set(looked) == {'notes'}


def test_a_calibration_that_is_a_bag_is_known_by_its_content(tmp_path):
    whole = storage(write_bag(tmp_path / 'bag', images(drive(3))))
    path = whole.rename(tmp_path / 'camera.yaml')
    with refused(InputError, 'E-BAG-CAMERA-INFO', path):
        load_camera(path)
