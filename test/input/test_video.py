# SPDX-License-Identifier: Apache-2.0
"""Videos: each picture's own time, whatever the container; turned, cut and hostile ones."""
from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition
from made_calibration import make_calibration
from made_drives import TIMES, fails, number, numbered, write_timed
from refused import refused

from dashcalib_ros.camera import Radial
from dashcalib_ros.errors import InputError
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.input.video import FramePicture
from dashcalib_ros.session import calibrate, with_source


def cut_at(path, target, start_s):
    """Copy what comes after a time, as video cutters do: from the key picture before it on."""
    with av.open(str(path)) as source, av.open(str(target), 'w') as result:
        stream = source.streams.video[0]
        copied = result.add_stream_from_template(stream)
        start = int(start_s / stream.time_base)
        source.seek(start, stream=stream)
        for packet in source.demux(stream):
            if packet.dts is not None:
                packet.stream = copied
                packet.pts, packet.dts = packet.pts - start, packet.dts - start
                result.mux(packet)
    return target


def check(source, first=0, times=TIMES):
    """Check that each picture has its own time, counted from the first one; return them."""
    found = list(source)
    shown = np.array([number(frame.image) for frame in found])
    stamps = np.array([frame.stamp_ns for frame in found]) / 1e9
    assert shown[0] == first and np.all(np.diff(shown) == 1)
    np.testing.assert_allclose(stamps - stamps[0], times[shown] - times[first], atol=1e-3)
    return found


@pytest.mark.parametrize('between', [0, 3])
@pytest.mark.parametrize('suffix', ['.mp4', '.mov', '.mkv', '.ts', '.flv'])
def test_each_picture_has_its_own_time(tmp_path, suffix, between):
    source = open_frames(write_timed(tmp_path / f'drive{suffix}', start=5.0, between=between))
    found = check(source)
    assert len(found) == 90 and found[0].stamp_ns == 0 and source.warnings == ()


def test_edit_lists_fragments_and_cut_ends(tmp_path):
    whole = write_timed(tmp_path / 'whole.mp4')
    source = open_frames(cut_at(whole, tmp_path / 'cut.mp4', 1.5))
    check(source, first=38)  # the edit list hides those before
    assert source.warnings == ()
    fragments = write_timed(tmp_path / 'f.mp4', movflags='frag_keyframe+empty_moov')
    fragments.write_bytes(fragments.read_bytes()[:-3000])
    assert 30 < len(check(open_frames(fragments))) < 90


@pytest.mark.parametrize('suffix', ['.mp4', '.mkv', '.ts'])
def test_an_excerpt_has_the_same_indices_and_times(tmp_path, suffix):
    path = write_timed(tmp_path / f'drive{suffix}')
    every = list(open_frames(path))
    for start in (0.01, 1.4, 3.0):
        part = list(open_frames(path, start_s=start, duration_s=1.0))
        assert part and [(frame.index, frame.stamp_ns) for frame in part] == [
            (frame.index, frame.stamp_ns) for frame in every
            if start <= frame.stamp_ns / 1e9 < part[0].stamp_ns / 1e9 + 1.0]
        check(part, first=part[0].index)
    part = list(open_frames(path, fps=10, start_s=4.0))
    assert [frame.index for frame in part] == list(range(40, 90)) == [
        number(frame.image) for frame in part]


def test_a_given_rate_replaces_the_times(tmp_path):
    path = write_timed(tmp_path / 'drive.mp4', np.arange(30) / 10)
    source = open_frames(path, fps=30)
    assert [frame.stamp_ns for frame in source] == [round(n * 1e9 / 30) for n in range(30)]
    # what hides the cause of all that follows comes first
    assert source.contradictions and source.warnings[0] == source.contradictions[0]
    assert source.warnings[0].code == 'E-INPUT-CONTRADICTED'
    assert open_frames(path, fps=10).contradictions == ()
    assert open_frames([path, path], fps=30).contradictions


def test_a_video_without_times_needs_its_rate(tmp_path):
    path = write_timed(tmp_path / 'drive.h264')
    fails('E-VIDEO-NO-TIMES', path, '--fps')
    found = list(open_frames(path, fps=10))
    assert [frame.stamp_ns for frame in found] == [n * 100_000_000 for n in range(90)]
    assert [number(frame.image) for frame in found] == list(range(90))


def test_a_clock_that_begins_again(tmp_path):
    path = write_timed(tmp_path / 'drive.ts')
    path.write_bytes(path.read_bytes() * 2)
    source = open_frames(path)
    found = list(source)
    assert len(found) == 180 and np.all(np.diff([frame.stamp_ns for frame in found]) > 0)
    assert source.warnings[0].code == 'E-STAMP-SET-BACK'


@pytest.mark.parametrize('turn', [90, 180, 270])
def test_pictures_are_turned_as_the_file_says(tmp_path, turn):
    source = open_frames(write_timed(tmp_path / 'drive.mp4', TIMES[:3], turn=turn))
    frame = list(source)[-1]
    assert frame.size == source.size == ((160, 64) if turn == 180 else (64, 160))
    assert np.abs(np.rot90(numbered(2), turn // 90).astype(int) - frame.image).mean() < 3
    assert source.warnings[0].code == 'E-IMAGES-ROTATED'
    assert f'{360 - turn} degrees' in str(source.warnings[0])


@pytest.mark.parametrize('suffix', ['.mkv', '.ts'])
def test_damage_within(tmp_path, suffix):
    path = write_timed(tmp_path / f'drive{suffix}', np.arange(300) / 30, between=0)
    data = bytearray(path.read_bytes())
    data[len(data) // 2:len(data) * 3 // 4] = bytes(len(data) * 3 // 4 - len(data) // 2)
    path.write_bytes(data)
    source = open_frames(path)
    assert 30 < len(list(source)) < 280
    assert 'E-VIDEO-TRUNCATED' in [each.code for each in source.warnings]


def test_scripts_that_name_other_files_are_no_video(tmp_path):
    write_timed(tmp_path / 'other.mp4', TIMES[:3])
    (tmp_path / 'drive.mp4').write_text('ffconcat version 1.0\nfile other.mp4\n')
    fails('E-VIDEO-UNREADABLE', tmp_path / 'drive.mp4')


def test_odd_names(tmp_path):
    for name in (b'\xff\xfe.mp4', b'a:b%03d.mp4', b'http:x.mp4'):
        path = Path(os.fsdecode(os.fsencode(tmp_path) + b'/' + name))
        assert len(list(open_frames(write_timed(tmp_path / 'x.mp4', TIMES[:3]).rename(path)))) == 3


def test_held_pictures_keep_no_threads(tmp_path):
    before = len(list(Path('/proc/self/task').iterdir()))
    held = list(open_frames(write_timed(tmp_path / 'drive.mp4')))
    assert len(held) == 90 and len(list(Path('/proc/self/task').iterdir())) < before + 10


def test_a_contradicted_video_is_the_first_reason(tmp_path):
    path = write_timed(tmp_path / 'drive.mp4', np.arange(30) / 10)
    verdict = calibrate(path, fps=30).verdict
    assert verdict.codes[0] == 'E-INPUT-CONTRADICTED' and len(verdict.reasons) == 2
    assert verdict.remedies[0].startswith('omit --fps')
    assert len(calibrate(path).verdict.reasons) == 1


@pytest.mark.parametrize('kind', ['yuv420p', 'yuvj420p', 'yuv422p10le', 'gray', 'bgr0'])
def test_every_kind_of_pixels_has_the_full_range(tmp_path, kind):
    image = np.arange(64 * 160, dtype=np.uint8).reshape(64, 160) // 16 * 17
    path = tmp_path / 'drive.mkv'
    with av.open(str(path), 'w') as container:
        stream = container.add_stream('ffv1' if 'j' not in kind else 'mjpeg', rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 64, kind
        for _ in range(2):
            frame = av.VideoFrame.from_ndarray(image, format='gray8').reformat(format=kind)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    found = next(iter(open_frames(path))).image
    assert np.abs(found.astype(int) - image).mean() < 4


@pytest.mark.parametrize(('aspect', 'turn', 'size'), [
    ((4, 3), 0, (213, 64)), ((1, 2), 0, (160, 128)), ((4, 3), 90, (64, 213)),
    ((2, 1), 180, (320, 64))])
def test_pixels_that_are_not_square(tmp_path, aspect, turn, size):
    plain = list(open_frames(write_timed(tmp_path / 'plain.mp4', TIMES[:5], turn=turn)))
    source = open_frames(write_timed(tmp_path / 'drive.mp4', TIMES[:5], turn=turn, aspect=aspect))
    assert source.size == size and source.stored_size == plain[0].size
    for frame, before in zip(source, plain, strict=True):
        assert frame.size == size
        there = cv2.resize(frame.image, before.size, interpolation=cv2.INTER_AREA)
        assert np.abs(there.astype(float) - before.image).mean() < 4
    stored = f'{plain[0].size[0]}x{plain[0].size[1]}'
    assert source.warnings[0].code == 'E-PIXELS-NOT-SQUARE'
    assert stored in str(source.warnings[0]) and f'{size[0]}x{size[1]}' in str(source.warnings[0])
    assert source.in_colour({2: source.length_ns // 2})[2].shape[:2] == size[::-1]
    assert [frame.size for frame in open_frames([tmp_path / 'drive.mp4'] * 2)] == [size] * 10


@pytest.mark.parametrize(('aspect', 'said'), [(None, ()), ((1, 1), ()), ((404, 405), ()),
                                              ((5, 1), ('E-PIXELS-ASSUMED-SQUARE',))])
def test_pixels_that_are_taken_as_square(tmp_path, aspect, said):
    source = open_frames(write_timed(tmp_path / 'drive.mp4', TIMES[:5], aspect=aspect))
    assert source.size == (160, 64) and source.stored_size is None
    assert tuple(each.code for each in source.warnings) == said
    camera = Radial((160, 64), 120.0, 120.0, 79.5, 31.5)
    assert source.shown(camera) is camera and source.stored(camera) is None


def test_a_camera_of_stretched_pictures_is_told_for_the_stored_ones(tmp_path):
    """A point of the world is in both at the same place of the picture."""
    path = write_timed(tmp_path / 'drive.mp4', TIMES[:5], aspect=(2, 1))
    for source in (open_frames(path), open_frames([path] * 2), open_frames(path, duration_s=0.1)):
        shown = Radial((320, 64), 240.0, 241.0, 158.0, 30.0, -0.2, 0.03)
        stored = source.stored(shown)
        point = np.array([[0.3, 0.1, 1.0]])
        there, here = shown.project(point)[0], stored.project(point)[0]
        np.testing.assert_allclose((there + 0.5) / (320, 64), (here + 0.5) / (160, 64))
        assert stored.fx == 120.0 and stored.fy == 241.0
        np.testing.assert_allclose(source.shown(stored).params, shown.params)
    calibration = replace(make_calibration(), camera=shown, image_size=(320, 64))
    said = with_source(calibration, open_frames(path)).warnings[-1]
    assert said.code == 'E-PIXELS-STORED' and '160x64' in str(said)
    assert 'fx 120.00, fy 241.00, cx 78.75, cy 30.00' in str(said)


def test_pixels_that_nothing_converts_are_named():
    with refused(InputError, 'E-VIDEO-UNDECODABLE'):
        FramePicture()(av.VideoFrame(64, 48, 'gray32le'))


def write_streams(path, shades, thumbnail=False):
    """Write a video with a stream of 10 plain pictures of each shade, and perhaps a thumbnail."""
    with av.open(str(path), 'w') as container:
        streams = []
        for n, _ in enumerate(shades):
            stream = container.add_stream('libx264', rate=10)
            stream.width, stream.height, stream.pix_fmt = 64 + 32 * n, 48, 'yuv420p'
            streams.append(stream)
        if thumbnail:
            cover = container.add_stream('mjpeg', rate=10)
            cover.width, cover.height, cover.pix_fmt = 640, 480, 'yuvj420p'
            cover.disposition = Disposition.attached_pic
            container.mux(cover.encode(av.VideoFrame(640, 480, 'yuvj420p')))
        for _ in range(10):
            for stream, shade in zip(streams, shades, strict=True):
                image = np.full((stream.height, stream.width), shade, np.uint8)
                frame = av.VideoFrame.from_ndarray(image, format='gray8')
                container.mux(stream.encode(frame.reformat(format='yuv420p')))
        for stream in streams:
            container.mux(stream.encode(None))
    return path


def test_a_video_of_two_cameras(tmp_path):
    path = write_streams(tmp_path / 'drive.mp4', (40, 200))
    source = open_frames(path)
    [said] = source.warnings
    assert said.code == 'E-VIDEO-STREAMS' and '(1: 64x48, 2: 96x48)' in str(said)
    taken = int(re.search(r'stream (.) is used', str(said))[1])
    assert next(iter(source)).size == (32 + 32 * taken, 48)
    for chosen, shade in (('1', 40), ('2', 200)):
        source = open_frames(path, topic=chosen)
        found = list(source)
        assert len(found) == 10 and source.warnings == ()
        assert all(abs(frame.image.mean() - shade) < 3 for frame in found)
        assert len(list(open_frames(path, topic=chosen, start_s=0.45))) == 5
    for other in ('0', '3', '/camera', '9' * 5000, '-1'):
        fails('E-VIDEO-STREAM', path, '1: 64x48', '--stream', topic=other)


def test_a_thumbnail_is_no_camera(tmp_path):
    path = write_streams(tmp_path / 'drive.mp4', (40,), thumbnail=True)
    source = open_frames(path)
    assert source.warnings == () and len(list(source)) == 10
    assert open_frames(path, topic='1').warnings == ()
    fails('E-VIDEO-STREAM', path, topic='2')
    assert open_frames(path, topic='/camera').warnings[0].code == 'E-TOPIC-IGNORED'
