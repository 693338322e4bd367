# SPDX-License-Identifier: Apache-2.0
"""Videos, folders and what is no drive; broken ones say what is wrong, in one line."""
from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_drives import (
    START,
    STEP,
    cut,
    drive,
    fails,
    image,
    images,
    picture,
    same,
    smooth,
    storage,
    write_bag,
    write_folder,
    write_video,
)
from refused import refused

from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.pipeline import Calibrator

SUFFIXES = ['.mcap', '.db3', '.bag', '.mp4', '.avi', '.mcap.zstd', '.db3.zstd']


@pytest.mark.parametrize('suffix, codec', [('.avi', 'MJPG'), ('.mp4', 'mp4v'), ('.mkv', 'MJPG')])
def test_videos(tmp_path, suffix, codec):
    frames = smooth()
    source = open_frames(write_video(tmp_path / f'drive{suffix}', frames, codec))
    assert source.count == 12
    assert source.topic is None
    for _ in range(2):
        found = list(source)
        assert [frame.stamp_ns for frame in found] == [index * 40_000_000 for index in range(12)]
        assert [frame.index for frame in found] == list(range(12))
        for one, other in zip(found, frames, strict=True):
            assert one.size == (64, 48)
            assert np.abs(one.image.astype(int) - other.image).max() <= 4
    assert source.warnings == ()
    assert [frame.stamp_ns for frame in open_frames(source.name, fps=10)][:2] == [0, STEP]


@pytest.mark.parametrize('names', ['{:04d}.png', '{}.png', 'left_{}.TIFF', 'x{}.bmp', '{}.pgm'])
def test_folders(tmp_path, names):
    frames = drive(12)
    folder = write_folder(tmp_path / 'images', frames, names)
    (folder / 'times.txt').write_text('0\n')
    (folder / '._0001.png').write_bytes(b'a file that macOS leaves about')
    source = open_frames(folder, fps=20)
    assert source.count == 12
    expected = [Frame(frame.index, frame.index * 50_000_000, frame.image) for frame in frames]
    same(list(source), expected)
    same(list(source), expected)
    assert source.warnings == ()


def test_a_folder_runs_at_ten_hertz_unless_told(tmp_path):
    source = open_frames(write_folder(tmp_path / 'images', drive(3)))
    assert [frame.stamp_ns for frame in source] == [0, STEP, 2 * STEP]
    assert [each.code for each in source.warnings] == ['E-RATE-ASSUMED']


def test_what_does_not_apply_is_said(tmp_path):
    folder = open_frames(write_folder(tmp_path / 'images', drive(3)), topic='/camera', fps=10)
    bag = open_frames(write_bag(tmp_path / 'bag', images(drive(3))), fps=5)
    video = open_frames(write_video(tmp_path / 'v.avi', smooth()), topic='/camera')
    assert [source.warnings[0].code for source in (folder, bag, video)] == [
        'E-TOPIC-IGNORED', 'E-FPS-IGNORED', 'E-TOPIC-IGNORED']
    assert [frame.stamp_ns for frame in bag] == [frame.stamp_ns for frame in drive(3)]


def test_frames_are_read_one_by_one(tmp_path):
    bag = write_bag(tmp_path / 'bag', images(drive(60, 320, 240)))
    source = open_frames(bag)
    opened = iter(source)
    assert next(opened).index == 0
    os.truncate(storage(bag), storage(bag).stat().st_size // 2)
    assert 10 < sum(1 for _ in opened) < 35  # the second half is read only now
    assert source.warnings[0].code == 'E-BAG-IMAGES-LOST'
    folder = open_frames(write_folder(tmp_path / 'images', drive(6)))
    opened = iter(folder)
    next(opened)
    (tmp_path / 'images' / '0004.png').write_bytes(b'junk')
    assert [frame.index for frame in opened] == [1, 2, 3, 5]


def test_importing_frames_is_light():
    code = ('import sys, dashcalib_ros.input; '
            'print([name for name in ("cv2", "rosbags", "mcap") if name in sys.modules])')
    found = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                           check=True, cwd=Path(__file__).parents[2])
    assert found.stdout == '[]\n'


def test_undecodable_images_are_skipped_and_counted(tmp_path):
    frames = drive(6)
    messages = [('/camera', frame.stamp_ns, picture(frame)) for frame in frames]
    messages[2][2].data = messages[2][2].data[:100]
    messages[4][2].data = np.zeros(0, np.uint8)
    source = open_frames(write_bag(tmp_path / 'bag', messages))
    assert [frame.index for frame in source] == [0, 1, 3, 5]
    assert source.warnings[0].code == 'E-IMAGES-UNDECODABLE'
    assert '2 undecodable images skipped (image 2: png image' in str(source.warnings[0])
    folder = write_folder(tmp_path / 'images', frames)
    cut(folder / '0003.png', 0.5)
    source = open_frames(folder, fps=10)
    assert [frame.index for frame in source] == [0, 1, 2, 4, 5]
    assert '1 undecodable image skipped (image 3: 0003.png' in str(source.warnings[0])


def test_nothing_decodable_is_an_error_that_says_why(tmp_path):
    bag = write_bag(tmp_path / 'bag', [
        ('/camera', frame.stamp_ns, image(frame, encoding='rgb565')) for frame in drive(3)])
    fails('E-IMAGE-ENCODING', bag, bag, 'image 0', 'rgb565', 'mono8')
    folder = tmp_path / 'images'
    folder.mkdir()
    (folder / '1.png').write_bytes(b'junk')
    fails('E-IMAGE-DAMAGED', folder, folder, 'image 0', '1.png')


def test_a_change_of_size_is_an_error(tmp_path):
    frames = [*drive(3), Frame(3, START + 3 * STEP, np.zeros((24, 32), np.uint8))]
    for path in (write_bag(tmp_path / 'bag', images(frames)),
                 write_folder(tmp_path / 'images', frames)):
        fails('E-IMAGE-SIZE-CHANGES', path, path, 'image 3', '32x24', '64x48')


@pytest.mark.parametrize('codec, suffix', [('mp4v', '.mp4'), ('MJPG', '.avi')])
def test_a_cut_video(tmp_path, codec, suffix):
    path = cut(write_video(tmp_path / f'drive{suffix}', drive(50), codec), 0.5)
    if suffix == '.mp4':  # its index is at the end
        fails('E-VIDEO-NO-INDEX', path)
    else:
        source = open_frames(path)
        found = len(list(source))
        assert 20 <= found <= 26
        if source.count != found:
            assert 'are lost' in str(source.warnings[0])


def test_paths_that_are_no_drive(tmp_path):
    fails('E-FILE-MISSING', tmp_path / 'missing.mcap', 'missing.mcap')
    fails('E-FILE-MISSING', tmp_path / 'missing' / 'deeper')
    (tmp_path / 'empty').mkdir()
    fails('E-FOLDER-EMPTY', tmp_path / 'empty')
    (tmp_path / 'texts').mkdir()
    (tmp_path / 'texts' / 'a.txt').write_text('hello')
    fails('E-FOLDER-NO-IMAGES', tmp_path / 'texts', 'a.txt')
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'metadata.yaml').write_text('a: 1')
    fails('E-BAG-NO-FILES', tmp_path / 'bag')
    fails('E-INPUT-UNKNOWN', tmp_path / 'texts' / 'a.txt')
    cv2.imwrite(str(tmp_path / 'one.png'), np.zeros((4, 4), np.uint8))
    fails('E-INPUT-SINGLE-IMAGE', tmp_path / 'one.png')


@pytest.mark.parametrize('suffix', SUFFIXES)
def test_empty_files(tmp_path, suffix):
    path = tmp_path / f'drive{suffix}'
    path.touch()
    fails('E-FILE-EMPTY', path, path)


@pytest.mark.parametrize('suffix', SUFFIXES)
@pytest.mark.parametrize('start', [b'', b'\x89MCAP0\r\n', b'SQLite format 3\0', b'#ROSBAG V2.0\n',
                                   b'\x28\xb5\x2f\xfd'])
def test_junk(tmp_path, suffix, start, capfd):
    junk = np.random.default_rng(3).integers(0, 256, 5000, np.uint8).tobytes()
    path = tmp_path / f'drive{suffix}'
    path.write_bytes(start + junk)
    with pytest.raises(InputError) as caught:
        open_frames(path)
    assert caught.value.code in ('E-BAG-NOT-A-RECORDING', 'E-BAG-DAMAGED', 'E-VIDEO-UNREADABLE')
    assert len(str(caught.value).splitlines()) == 1
    assert capfd.readouterr() == ('', '')


@pytest.mark.parametrize('fps', [0, -1, float('nan'), float('inf'), 1001])
def test_nonsense_rates(tmp_path, fps):
    fails('E-INPUT-FPS', write_folder(tmp_path / 'images', drive(2)), repr(fps), fps=fps)


@pytest.fixture
def nobody(tmp_path):
    """Give up root's power to read everything, and a place where others may look."""
    opened = [folder for folder in tmp_path.parents if folder.stat().st_uid == os.getuid()
              and len(folder.parts) > 2]
    modes = [(folder, folder.stat().st_mode) for folder in opened]
    for folder, mode in modes:
        folder.chmod(mode | 0o055)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    yield tmp_path
    os.seteuid(user)
    for folder, mode in modes:
        folder.chmod(mode)


@pytest.mark.skipif(not hasattr(os, 'geteuid'), reason='permissions are of POSIX')
@pytest.mark.parametrize('name', ['drive.mcap', 'drive.bag', 'drive.mp4', 'folder', 'bag/x.mcap'])
def test_what_may_not_be_read(tmp_path, name, request):
    tmp_path.chmod(0o755)
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    if name == 'folder':
        path.mkdir()
    else:
        path.write_bytes(b'x' * 100)
    path.chmod(0)
    request.getfixturevalue('nobody')
    fails('E-FILE-PERMISSION', path if '/' not in name else path.parent, path, 'chmod')


def test_odd_entries_of_a_folder_are_skipped_counted_and_named(tmp_path):
    frames = drive(6)
    folder = write_folder(tmp_path / 'images', frames)
    for index in (1, 2, 4):
        (folder / f'{index:04}.png').unlink()
    os.mkfifo(folder / '0001.png')
    (folder / '0002.png').symlink_to('nowhere')
    (folder / '0004.png').mkdir()
    os.mkfifo(folder / 'pipe.mcap')
    source = open_frames(folder, fps=10)
    assert [frame.index for frame in source] == [0, 3, 5]
    [warning] = source.warnings
    assert str(warning).startswith('3 undecodable images skipped (image 1: cannot read 0001.png: ')


@pytest.mark.parametrize('suffix', SUFFIXES)
@pytest.mark.parametrize('odd', ['pipe', 'device', 'link', 'folder'])
def test_drives_that_are_no_files(tmp_path, suffix, odd):
    path = tmp_path / f'drive{suffix}'
    if odd == 'pipe':
        os.mkfifo(path)
    elif odd == 'device':
        path.symlink_to('/dev/full')
    elif odd == 'link':
        path.symlink_to('nowhere')
    else:
        path.mkdir()
    codes = {'link': 'E-FILE-MISSING', 'folder': 'E-FOLDER-EMPTY'}
    fails(codes.get(odd, 'E-FILE-NOT-REGULAR'), path)


def test_a_video_of_too_many_pixels(tmp_path, monkeypatch):
    path = write_video(tmp_path / 'drive.avi', smooth())
    monkeypatch.setattr('dashcalib_ros.limits.PIXELS', 1000)
    fails('E-IMAGE-TOO-LARGE', path, '64x48')


def test_pictures_too_flat_to_be_a_cameras(tmp_path):
    flat = [Frame(0, 0, np.zeros((1, 4096), np.uint8))]
    source = open_frames(write_folder(tmp_path / 'images', flat), fps=10)
    with (refused(InputError, 'E-IMAGE-SHAPE', '4096x1'),
          Calibrator(Config()) as calibrator):
        calibrator.push(next(iter(source)))


def test_frames_of_a_folder_do_not_know_their_camera(tmp_path):
    source = open_frames(write_folder(tmp_path / 'images', drive(2)), fps=5)
    assert [frame.frame_id for frame in source] == ['', '']


def in_colour(count=12):
    """Make frames in colour: blue grows, red falls."""
    return [Frame(n, START + n * STEP, np.full((48, 64, 3), (20 + 15 * n, 90, 230 - 15 * n),
                                               np.uint8)) for n in range(count)]


@pytest.mark.parametrize('kind', ['folder', 'video', 'bag', 'joined', 'excerpt'])
def test_images_are_read_again_in_colour(tmp_path, kind):
    frames = in_colour()

    def video(name):
        writer = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter_fourcc(*'MJPG'), 25.0,
                                 (64, 48))
        for frame in frames:
            writer.write(frame.image)
        writer.release()
        return tmp_path / name

    source = {
        'folder': lambda: open_frames(write_folder(tmp_path / 'images', frames), fps=7.3),
        'video': lambda: open_frames(video('a.avi')),
        'bag': lambda: open_frames(write_bag(tmp_path / 'bag', [
            ('/camera', frame.stamp_ns, picture(frame)) for frame in frames])),
        'joined': lambda: open_frames([video('a.avi'), video('b.avi')]),
        'excerpt': lambda: open_frames(video('a.avi'), start_s=0.08)}[kind]()
    stamps = {frame.index: frame.stamp_ns for frame in source}
    wanted = {index: stamps[index] for index in list(stamps)[-1:2:-4]}
    found = source.in_colour(wanted)
    assert set(found) == set(wanted) and len(found) > 1
    for index, shown in found.items():
        assert np.abs(shown.astype(int) - frames[index % 12].image).max() < 9
    assert source.in_colour({}) == {}


def test_what_cannot_be_read_again_stays_as_it_is(tmp_path):
    folder = write_folder(tmp_path / 'images', in_colour(3))
    source = open_frames(folder, fps=10.0)
    stamps = {frame.index: frame.stamp_ns for frame in source}
    (folder / '0001.png').write_bytes(b'now it is broken')
    assert set(source.in_colour(stamps)) == {0, 2}


@pytest.mark.parametrize('stamp', [math.nan, math.inf, 2**64, None, '1'])
def test_a_stamp_that_is_none_is_refused(stamp):
    with refused(InputError, 'E-STAMP-INVALID', repr(stamp)):
        Frame(0, stamp, np.zeros((8, 8), np.uint8))
