"""Videos: each picture's own time, whatever the container; turned, cut and hostile ones."""
from __future__ import annotations

import os
from pathlib import Path

import av
import numpy as np
import pytest
from made_drives import TIMES, fails, number, numbered, write_timed

from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.recorded import calibrate


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
    assert '10 images per second' in source.warnings[0]
    assert open_frames(path, fps=10).contradictions == ()
    assert open_frames([path, path], fps=30).contradictions


def test_a_video_without_times_needs_its_rate(tmp_path):
    path = write_timed(tmp_path / 'drive.h264')
    fails('give their rate with --fps', path)
    found = list(open_frames(path, fps=10))
    assert [frame.stamp_ns for frame in found] == [n * 100_000_000 for n in range(90)]
    assert [number(frame.image) for frame in found] == list(range(90))


def test_a_clock_that_begins_again(tmp_path):
    path = write_timed(tmp_path / 'drive.ts')
    path.write_bytes(path.read_bytes() * 2)
    source = open_frames(path)
    found = list(source)
    assert len(found) == 180 and np.all(np.diff([frame.stamp_ns for frame in found]) > 0)
    assert 'the clock was set back 1 times' in source.warnings[0]


@pytest.mark.parametrize('turn', [90, 180, 270])
def test_pictures_are_turned_as_the_file_says(tmp_path, turn):
    source = open_frames(write_timed(tmp_path / 'drive.mp4', TIMES[:3], turn=turn))
    frame = list(source)[-1]
    assert frame.size == source.size == ((160, 64) if turn == 180 else (64, 160))
    assert np.abs(np.rot90(numbered(2), turn // 90).astype(int) - frame.image).mean() < 3
    assert f'turn its pictures by {360 - turn} degrees' in source.warnings[0]


@pytest.mark.parametrize('suffix', ['.mkv', '.ts'])
def test_damage_within(tmp_path, suffix):
    path = write_timed(tmp_path / f'drive{suffix}', np.arange(300) / 30, between=0)
    data = bytearray(path.read_bytes())
    data[len(data) // 2:len(data) * 3 // 4] = bytes(len(data) * 3 // 4 - len(data) // 2)
    path.write_bytes(data)
    source = open_frames(path)
    assert 30 < len(list(source)) < 280 and 'are lost' in ''.join(source.warnings)


def test_scripts_that_name_other_files_are_no_video(tmp_path):
    write_timed(tmp_path / 'other.mp4', TIMES[:3])
    (tmp_path / 'drive.mp4').write_text('ffconcat version 1.0\nfile other.mp4\n')
    fails('no video that can be played', tmp_path / 'drive.mp4')


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
    assert 'says 10 images per second' in verdict.reasons[0] and len(verdict.reasons) == 2
    assert verdict.cures[0].startswith('leave --fps away')
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
