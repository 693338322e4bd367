# SPDX-License-Identifier: Apache-2.0
"""Several files of one camera as one drive, and parts of a drive."""
from __future__ import annotations

import itertools
import sys

import cv2
import numpy as np
import pytest
from made_drives import (
    START,
    STEP,
    TIMES,
    drive,
    fails,
    images,
    same,
    smooth,
    storage,
    write_bag,
    write_folder,
    write_timed,
    write_video,
)
from refused import refused

from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.inputs import open_frames


def videos(folder, count=3, codec='MJPG', suffix='.avi'):
    """Write a drive of 12 pictures a file, named so that text order is not theirs."""
    folder.mkdir()
    return [write_video(folder / f'clip{9 + part}{suffix}', [
        Frame(frame.index, 0, frame.image + np.uint8(part)) for frame in smooth()], codec)
        for part in range(count)]


def brightness(frames):
    return [round(float(frame.image.mean())) for frame in frames]


@pytest.mark.parametrize('how', ['folder', 'pattern', 'list'])
def test_videos_are_one_drive(tmp_path, how):
    paths = videos(tmp_path / 'clips')
    source = open_frames({'folder': tmp_path / 'clips', 'pattern': str(tmp_path / 'clips/*.avi'),
                          'list': paths}[how])
    assert source.count == 36 and source.name == f'{paths[0]} and 2 more'
    for _ in range(2):
        found = list(source)
        assert [frame.index for frame in found] == list(range(36))
        assert [frame.stamp_ns for frame in found] == [index * 40_000_000 for index in range(36)]
        # whether they follow each other directly is not known
        assert [frame.index for frame in found if frame.perhaps_after_gap] == [12, 24]
        assert not any(frame.after_gap for frame in found)
        assert np.allclose(brightness(found),
                           [20 + 15 * (n % 12) + n // 12 for n in range(36)], atol=1)
    said = f'{tmp_path}/clips/*.avi' if how == 'pattern' else f'{tmp_path}/clips'
    assert [*map(str, source.warnings)] == ([] if how == 'list' else [
        f'{said}: 3 files, ordered by name: clip9.avi, clip10.avi, clip11.avi'])


NAMES = {
    'GoPro': ('GX010001', 'GX020001', 'GX010002'),
    'old GoPro': ('GOPR0001', 'GP010001', 'GOPR0002'),
    'DJI': ('DJI_20230115123456_0009_D', 'DJI_20230115124456_0010_D', 'DJI_20230116000000_0001_D'),
    'Garmin': ('GRMN0009', 'GRMN0010', 'GRMN0101'),
    'Viofo': ('2023_0115_123456_0009F', '2023_0115_123556_0010PF', '2023_0115_123656_0011F'),
    'BlackVue': ('20230115_123456_NF', '20230115_123556_EF', '20230115_123656_NF'),
    'Insta360': ('VID_20230115_123456_00_009', 'VID_20230115_123456_00_010',
                 'VID_20230115_130000_00_001')}


@pytest.mark.parametrize('maker', NAMES)
def test_files_in_the_order_of_the_camera(tmp_path, maker):
    paths = videos(tmp_path / 'clips')
    for path, name in zip(paths, NAMES[maker], strict=True):
        path.rename(path.with_name(f'{name}.avi'))
    source = open_frames(tmp_path / 'clips')
    assert [round(each) % 15 for each in brightness(source)[::12]] == [5, 6, 7]
    names = f'{".avi, ".join(NAMES[maker])}.avi'
    assert f'by {maker.split()[-1]} names: {names}' in str(source.warnings[0])
    given = sorted((tmp_path / 'clips').iterdir(), reverse=True)
    [warning] = open_frames(given).warnings
    assert warning.code == 'E-FILES-AS-GIVEN' and names in str(warning)


def test_files_in_the_order_of_their_times(tmp_path):
    videos(tmp_path / 'clips')
    for name, minute in (('b', 1), ('c', 0), ('a', 2)):
        write_timed(tmp_path / f'{name}.mp4', TIMES[:3],
                    created=f'2023-01-15T12:3{minute}:00.000000Z')
    assert 'time of recording: c.mp4, b.mp4, a.mp4' in str(open_frames(
        str(tmp_path / '*.mp4')).warnings[0])
    write_timed(tmp_path / 'b.mp4', TIMES[:3], created='2023-01-15T12:30:00.000000Z')
    assert 'name: a.mp4, b.mp4, c.mp4' in str(open_frames(
        str(tmp_path / '*.mp4')).warnings[0])


def test_front_and_rear_are_not_one_camera(tmp_path):
    for path, name in zip(videos(tmp_path / 'clips'), 'FRF', strict=True):
        path.rename(path.with_name(f'20230115_12345{path.stem[-1]}_N{name}.avi'))
    fails('E-INPUT-SEVERAL-CAMERAS', tmp_path / 'clips', '2 cameras')
    assert len(open_frames(str(tmp_path / 'clips/*F.avi')).warnings) == 1


TWO_CAMERAS = {
    'Tesla': ('2026-01-31_10-00-00-front', '2026-01-31_10-00-00-left_repeater',
              '2026-01-31_10-01-00-front', '2026-01-31_10-01-00-left_repeater'),
    '70mai': ('NO20260131-100000-000123F', 'NO20260131-100000-000123B'),
    'Thinkware': ('REC_2026_01_31_10_00_00_F', 'REC_2026_01_31_10_00_00_R'),
    'Nextbase': ('260131_100000_001_FH', '260131_100000_001_RH'),
    'Vantrue': ('20260131_100000_0001_N_A', '20260131_100000_0002_N_B'),
    'BlackVue': ('20260131_100000_NF', '20260131_100000_NR'),
    'Viofo': ('2026_0131_100000_000001F', '2026_0131_100000_000002R'),
    'Insta360': ('VID_20260131_100000_00_001', 'VID_20260131_100000_10_001'),
    'words': ('drive-front', 'drive-back'), 'letters': ('drive_f', 'drive_r'),
    'channels': ('20260131_CH1', '20260131_CH2'), 'channels before': ('ch01_31', 'ch02_31'),
    'folders': ('Front/NO20260131-100000-000123F', 'Back/NO20260131-100000-000123B'),
    'cameras': ('cam0-run', 'cam1-run'), 'only the rear one': ('20260131', '20260131_R'),
    'nuScenes': ('CAM_FRONT_LEFT', 'CAM_FRONT_RIGHT')}


def link_as(names, folder, suffix):
    """Give one video many names."""
    folder.mkdir()
    video = write_video(folder.parent / f'one{suffix}', smooth())
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / f'{name}{suffix}').hardlink_to(video)
    return folder


@pytest.mark.parametrize('maker', TWO_CAMERAS)
def test_two_cameras_of_one_car_are_not_one_drive(tmp_path, maker):
    folder = link_as(TWO_CAMERAS[maker], tmp_path / 'clips', '.avi')
    fails('E-INPUT-SEVERAL-CAMERAS', folder / '*/*' if maker == 'folders' else folder,
          '2 cameras', 'pattern')
    first, second = (next(folder.glob(f'{name}.avi')) for name in TWO_CAMERAS[maker][:2])
    assert open_frames(first).count == 12
    # who names them means them
    assert open_frames([first, second]).count == 24


@pytest.mark.parametrize('names', [
    'abcdef', ('drive_a', 'drive_b', 'drive_c', 'drive_f'), ('2026_f', '2027_f'),
    ('front_1', 'front_2'), ('backup', 'frontier'), ('cam1_a', 'cam1_b'),
    ('one_front', 'two_back'),
    ('drive', 'drive_b'), ('camera 2026', 'camera 2027'), ('leftover', 'rightmost')])
def test_parts_of_a_drive_are_not_taken_for_cameras(tmp_path, names):
    assert open_frames(link_as(names, tmp_path / 'clips', '.avi')).count == 12 * len(names)


def test_pictures_of_two_cameras_in_one_folder(tmp_path):
    for names in (('front_0001', 'back_0001'), ('0001_L', '0001_R'), ('1-cam0', '1-cam1')):
        folder = tmp_path / names[0]
        folder.mkdir()
        for name in names:
            cv2.imwrite(str(folder / f'{name}.png'), np.zeros((48, 64), np.uint8))
        fails('E-INPUT-SEVERAL-CAMERAS', folder, '2 cameras', *names, fps=10)
        (folder / f'{names[1]}.png').unlink()
        assert open_frames(folder, fps=10).count == 1


def test_bags_of_two_cameras_in_one_folder(tmp_path):
    (tmp_path / 'bags').mkdir()
    for name in ('front_0', 'rear_0'):
        storage(write_bag(tmp_path / name, images(drive(3)))).rename(
            tmp_path / f'bags/{name}.mcap')
    fails('E-INPUT-SEVERAL-CAMERAS', tmp_path / 'bags', '2 cameras', 'rear_0.mcap')
    assert open_frames(tmp_path / 'bags/rear_0.mcap').count == 3


def test_previews_beside_videos_are_left_alone(tmp_path):
    small = write_video(tmp_path / 'small.mp4', smooth(width=32, height=24), 'mp4v')
    (tmp_path / 'clips').mkdir()
    for name in ('GX010001', 'GX020001'):
        write_video(tmp_path / f'clips/{name}.MP4', smooth(), 'mp4v')
        (tmp_path / f'clips/GL{name[2:]}.LRV').hardlink_to(small)
    for where in (tmp_path / 'clips', str(tmp_path / 'clips/*')):
        assert open_frames(where).count == 24
    assert open_frames(str(tmp_path / 'clips/*.LRV')).count == 24


def test_the_order_of_the_command_line_counts(tmp_path):
    paths = videos(tmp_path / 'clips', 2)
    assert np.allclose(brightness(open_frames(paths[::-1]))[:12],
                       [21 + 15 * n for n in range(12)], atol=1)
    assert brightness(open_frames(paths[:1])) == brightness(open_frames(paths[0]))


def test_a_folder_with_thumbnails_beside_its_videos(tmp_path):
    videos(tmp_path / 'clips')
    for name in ('clip9', 'clip10'):
        cv2.imwrite(str(tmp_path / f'clips/{name}.jpg'), np.zeros((4, 4), np.uint8))
    source = open_frames(tmp_path / 'clips')
    assert source.count == 36 and source.warnings[0].code == 'E-FILES-OTHER'
    assert '2 other files' in str(source.warnings[0])
    assert len(open_frames(str(tmp_path / 'clips/clip*')).warnings) == 2
    for index in range(9):
        cv2.imwrite(str(tmp_path / f'clips/{index}.jpg'), np.zeros((4, 4), np.uint8))
    assert open_frames(tmp_path / 'clips', fps=10).count == 11  # as before there were several


def test_split_bags_go_on_where_their_stamps_do(tmp_path):
    frames = drive(30)
    for part in range(3):
        write_bag(tmp_path / f'bags/{9 - part}', images(frames[10 * part:10 * part + 10]))
    source = open_frames(tmp_path / 'bags')  # by time, not by name
    found = list(source)
    same(found, frames)
    assert not any(frame.after_gap for frame in found)


def test_bags_that_do_not_go_on(tmp_path):
    frames = drive(20)
    early = write_bag(tmp_path / '1', images(frames[:10]))
    late = write_bag(tmp_path / '2', [('/camera', frame.stamp_ns, message) for frame, (
        _, _, message) in zip(frames[10:], images([Frame(
            frame.index, frame.stamp_ns + 10**12, frame.image) for frame in frames[10:]]),
        strict=True)])
    found = list(open_frames([early, late]))
    assert [frame.index for frame in found if frame.after_gap] == [10]
    assert found[10].stamp_ns == START + 10 * STEP + 10**12
    found = list(open_frames([late, early]))  # time goes on although the stamps go back
    assert [frame.index for frame in found if frame.after_gap] == [10]
    assert found[10].stamp_ns - found[9].stamp_ns == STEP


def test_a_bag_after_a_video(tmp_path):
    video = write_video(tmp_path / '1.avi', smooth(), fps=25)
    bag = write_bag(tmp_path / '2', images(drive(5)))
    found = list(open_frames([video, bag, video]))
    assert [frame.index for frame in found if frame.perhaps_after_gap] == [12, 17]
    assert not any(frame.after_gap for frame in found)
    steps = np.diff([frame.stamp_ns for frame in found])
    assert set(steps[:12]) == {40_000_000} and set(steps[12:17]) == {STEP}


def test_one_that_cannot_be_read_is_left_out(tmp_path):
    paths = videos(tmp_path / 'clips')
    paths[0].write_bytes(b'junk' * 999)
    (tmp_path / 'clips' / 'clip99.mp4').touch()
    source = open_frames(tmp_path / 'clips')
    assert [frame.index for frame in source] == list(range(24))
    assert [frame.perhaps_after_gap for frame in source].index(True) == 12
    assert [each.code for each in source.warnings] == [
        'E-FILES-ORDERED', 'E-FILE-SKIPPED', 'E-FILE-SKIPPED']
    assert 'clip10.avi, clip11.avi' in str(source.warnings[0])
    assert str(paths[0]) in str(source.warnings[1]) and 'clip99.mp4' in str(source.warnings[2])
    source = open_frames([tmp_path / 'missing.mp4', paths[1]])
    assert len(list(source)) == 12 and source.warnings[0].code == 'E-FILE-SKIPPED'
    assert 'missing.mp4' in str(source.warnings[0])


def test_none_that_can_be_read(tmp_path):
    for name in ('a.mp4', 'b.mp4', 'c.mcap', 'd.mcap'):
        (tmp_path / name).write_bytes(b'junk' * 999)
    line = fails('E-VIDEO-UNREADABLE', [tmp_path / f'{name}' for name in (
        'a.mp4', 'b.mp4', 'c.mcap', 'd.mcap')], 'a.mp4', 'b.mp4', 'c.mcap', 'd.mcap')
    # each reason once
    assert line.count('ffmpeg') == 1
    line = fails('E-BAG-NOT-A-RECORDING', tmp_path, 'c.mcap', 'd.mcap')
    fails('E-INPUT-NO-MATCH', str(tmp_path / '*.avi'), tmp_path / '*.avi')
    if sys.version_info < (3, 13):  # which takes any pattern
        fails('E-INPUT-PATTERN', str(tmp_path / '**.avi'), tmp_path / '**.avi')
    fails('E-INPUT-MISSING', [])


def segments(tmp_path, numbers):
    """Write videos of one name in numbered folders, each of another brightness."""
    found = []
    for number in numbers:
        folder = tmp_path / f'route--{number}'
        folder.mkdir()
        found.append(write_video(folder / 'road.avi', [
            Frame(n, 0, np.full((48, 64), 40 + 5 * number, np.uint8)) for n in range(4)]))
    return found


@pytest.mark.parametrize('how', ['pattern', 'shell'])
def test_segments_of_one_name_are_told_by_their_folders(tmp_path, how):
    paths = segments(tmp_path, (0, 2, 10))
    source = open_frames(str(tmp_path / 'route--*/road.avi') if how == 'pattern' else
                         sorted(map(str, paths)))
    assert np.allclose(brightness(source)[::4], [40, 50, 90], atol=1)
    [warning] = source.warnings
    assert warning.code == 'E-FILES-ORDERED'
    assert 'route--0, route--2, route--10' in str(warning)
    assert 'road' not in str(warning).split(': ', 1)[1]
    assert 'route--1, route--3' in str(warning) and 'route--9' in str(warning)


def test_an_order_that_is_not_alphabetical_is_kept(tmp_path):
    zero, two, ten = segments(tmp_path, (0, 2, 10))
    source = open_frames([ten, zero, two])
    assert np.allclose(brightness(source)[::4], [90, 40, 50], atol=1)
    assert source.warnings == ()


@pytest.mark.parametrize('numbers', [(0, 1, 2), (10, 20, 30), (0, 25)])
def test_numbers_that_may_have_no_others_between_them_are_no_gap(tmp_path, numbers):
    segments(tmp_path, numbers)
    [warning] = open_frames(str(tmp_path / 'route--*/road.avi')).warnings
    assert 'missing' not in str(warning)


def test_one_that_breaks_while_it_is_read(tmp_path):
    paths = videos(tmp_path / 'clips')
    source = open_frames(paths)
    paths[1].unlink()
    assert [frame.index for frame in source] == list(range(24))
    assert [each.code for each in source.warnings] == ['E-FILE-SKIPPED']
    assert str(paths[1]) in str(source.warnings[0])


def test_sizes_must_agree(tmp_path):
    one = write_video(tmp_path / '1.avi', smooth())
    other = write_video(tmp_path / '2.avi', smooth(width=96))
    with refused(InputError, 'E-IMAGE-SIZE-CHANGES', '2.avi has 96x48', '1.avi has 64x48'):
        open_frames([one, other])  # at once, not after an hour
    folder = write_folder(tmp_path / 'images', drive(3, 32, 24))
    fails('E-IMAGE-SIZE-CHANGES', [one, folder], f'{folder}: image 12 has 32x24', '64x48', fps=10)


def test_undecodable_images_are_told_by_their_file(tmp_path):
    folders = [write_folder(tmp_path / name, drive(3)) for name in 'ab']
    (folders[1] / '0001.png').write_bytes(b'junk')
    source = open_frames(folders, fps=10)
    assert [frame.index for frame in source] == [0, 1, 2, 3, 5]
    assert source.warnings[0].code == 'E-IMAGES-UNDECODABLE'
    assert f'{folders[1]}: image 4: ' in str(source.warnings[0])


def test_an_undecodable_first_image_leaves_the_question_to_the_next(tmp_path):
    folders = [write_folder(tmp_path / name, drive(3)) for name in 'ab']
    (folders[1] / '0000.png').write_bytes(b'junk')
    found = list(open_frames(folders, fps=10))
    assert [frame.index for frame in found] == [0, 1, 2, 4, 5]
    assert [frame.index for frame in found if frame.perhaps_after_gap] == [4]


def test_what_all_files_say_is_said_once(tmp_path):
    folders = [write_folder(tmp_path / name, drive(3)) for name in 'abc']
    warning, = open_frames(folders).warnings
    assert warning.code == 'E-RATE-ASSUMED' and 'and 2 more like it' in str(warning)


@pytest.mark.parametrize('text, code, remedy', [
    ('rtsp://10.0.0.2:554/stream1', 'E-INPUT-STREAM', 'ffmpeg -i rtsp'),
    ('http://10.0.0.2/video', 'E-INPUT-STREAM', 'ffmpeg -i http'),
    ('/dev/video0', 'E-INPUT-LIVE-CAMERA', 'v4l2_camera'),
    (['/dev/video12', 'a.mp4'], 'E-INPUT-LIVE-CAMERA', 'ffmpeg -f v4l2')])
def test_live_cameras_are_answered_with_what_to_do(text, code, remedy):
    fails(code, text, remedy, 'calibrator')


# -- a part of a drive ---------------------------------------------------------------------------

def seconds(path, **part):
    return [frame.index for frame in open_frames(path, fps=10, **part)]


@pytest.mark.parametrize('kind', ['bag', 'video', 'mp4', 'folder', 'videos', 'bags', 'folders'])
def test_parts_of_a_drive(tmp_path, kind):
    frames = drive(36)
    if kind in ('bag', 'folder', 'bags', 'folders'):
        write = {'b': lambda path, part: write_bag(path, images(part)),
                 'f': write_folder}[kind[0]]
        cuts = [0, 36] if kind in ('bag', 'folder') else [0, 12, 24, 36]
        path = [write(tmp_path / str(n), frames[n:m])
                for n, m in itertools.pairwise(cuts)]
    elif kind == 'videos':
        path = videos(tmp_path / 'clips')
    else:
        path = write_video(tmp_path / ('v.mp4' if kind == 'mp4' else 'v.avi'), frames,
                           'mp4v' if kind == 'mp4' else 'MJPG')
    whole = list(open_frames(path, fps=10))
    assert len(whole) == 36
    for start, duration in ((0.0, 1.0), (0.35, 1.2), (1.2, 0.1), (1.15, 0.2), (1.5, None),
                            (2.75, 9.0)):
        part = list(open_frames(path, fps=10, start_s=start, duration_s=duration))
        first = int(np.ceil(start * 10))
        last = 36 if duration is None else min(36, first + round(duration * 10))
        same(part, whole[first:last], first)
    fails('E-INPUT-START-LATE', path, '9 s', fps=10, start_s=9.0)


@pytest.mark.parametrize('part', [{'start_s': -1}, {'start_s': float('nan')}, {'duration_s': 0},
                                  {'duration_s': float('inf')}, {'fps': 0}])
def test_parts_that_there_are_not(tmp_path, part):
    [(name, value)] = part.items()
    with refused(InputError, f'E-INPUT-{name.removesuffix("_s").upper()}', repr(value)):
        open_frames(tmp_path, **part)


def test_a_part_knows_how_much_it_is(tmp_path):
    path = write_video(tmp_path / 'v.avi', smooth(), fps=10)
    assert open_frames(path, start_s=0.5).count == 7
    assert open_frames(path, start_s=0.5, duration_s=0.2).count == 2
    assert open_frames(path, start_s=0.5).warnings == ()
    cut = write_bag(tmp_path / 'bag', images(drive(60, 320, 240)))
    data = storage(cut).read_bytes()
    storage(cut).write_bytes(data[:len(data) // 2])
    source = open_frames(cut, start_s=0.3)
    assert 3 < len(list(source)) < 35 and source.warnings[0].code == 'E-BAG-IMAGES-LOST'
