# SPDX-License-Identifier: Apache-2.0
"""Gathering: a pure function of a clip's content and the settings."""
from __future__ import annotations

import os
from dataclasses import replace

import pytest
from fleet_made import CONFIG, clip_of, written
from made_drives import smooth, write_folder, write_video
from refused import refused

from dashcalib_ros.detect.turn import is_turn
from dashcalib_ros.errors import InputError
from dashcalib_ros.fleet import clips
from dashcalib_ros.fleet.clips import content_hash, gather, gather_clip, settings_hash
from dashcalib_ros.fleet.manifest import Row
from dashcalib_ros.input import Frame
from dashcalib_ros.store.scene_file import decoded, encoded


def test_the_content_and_the_settings_are_the_identity(tmp_path):
    one = write_video(tmp_path / 'one.avi', smooth())
    other = tmp_path / 'other.avi'
    other.write_bytes(one.read_bytes())
    assert content_hash(one) == content_hash(other)
    other.write_bytes(one.read_bytes() + b' ')
    assert content_hash(one) != content_hash(other)
    folder = write_folder(tmp_path / 'images', smooth(4))
    before = content_hash(folder)
    (folder / '0003.png').rename(folder / '0004.png')
    assert content_hash(folder) != before
    with refused(InputError, 'E-FILE-UNREADABLE', 'gone.avi'):
        content_hash(tmp_path / 'gone.avi')
    same = settings_hash(CONFIG, None, None)
    assert settings_hash(CONFIG.replace({'verdict.max_sigma': 0.1, 'workers': 1}),
                         None, None) == same
    assert len({same, settings_hash(CONFIG, 10.0, None), settings_hash(CONFIG, None, '/a'),
                settings_hash(CONFIG.replace({'tracks.points': 700}), None, None)}) == 4


def test_a_clip_without_turns_is_a_result_too(tmp_path):
    video = write_video(tmp_path / 'still.avi', smooth(), fps=10.0)
    content = content_hash(video)
    found = gather(video, content, None, None, CONFIG)
    assert (found.frames, found.turns, found.origin.image_size) == (12, (), (64, 48))
    assert found.seconds == pytest.approx(1.1, abs=0.01) and found.content == content
    assert encoded(decoded(encoded(found))) == encoded(found)


def gathered(place, out, fps=None):
    return gather_clip(Row(1, place.name, str(place), 'cam', fps=fps), str(out), CONFIG)


def test_a_clip_of_two_cameras_is_not_used(shared_drive, tmp_path):
    """Its turns may be of either."""
    images = [frame.image for frame in shared_drive.frames()]
    both = [Frame(n, 0, image[:, ::-1] if n % 2 else image)
            for n, image in enumerate([*images, *images[::-1]])]
    result = gathered(write_folder(tmp_path / 'images', both), tmp_path / 'out', 20.0)
    assert result.problem.endswith('[E-TWO-CAMERAS]') and not result.file
    assert not list((tmp_path / 'out').rglob('*.npz'))


@pytest.mark.parametrize('how', ['in place', 'another in its place'])
def test_pictures_that_changed_are_read_again(tmp_path, how):
    folder = write_folder(tmp_path / 'images', smooth(4))
    before = gathered(folder, tmp_path / 'out')
    assert before.file and gathered(folder, tmp_path / 'out').again
    picture = folder / '0002.png'
    about = picture.stat()
    data = bytearray(picture.read_bytes())
    data[-20] ^= 1
    other = picture if how == 'in place' else tmp_path / 'other.png'
    other.write_bytes(data)
    os.utime(other, ns=(about.st_atime_ns, about.st_mtime_ns))
    other.replace(picture)
    # the same names, sizes and dates
    after = gathered(folder, tmp_path / 'out')
    assert not after.again and after.content != before.content and after.file != before.file


@pytest.mark.parametrize(('yaw_deg', 'thorough', 'stretches'), [
    (80.0, False, 0), (30.0, False, 1), (80.0, True, 1)])
def test_other_stretches_are_gathered_where_no_turn_is_sharp(
        shared_drive, tmp_path, monkeypatch, yaw_deg, thorough, stretches):
    scene = clip_of(yaws=(yaw_deg,), tracks=60, keyframes=8).turns[0].scene
    tried = []

    def reconstructed(turn, config, valid):
        tried.append(turn)
        assert turn.frames
        return replace(scene, turn=turn.id)

    monkeypatch.setattr(clips, 'reconstruct', reconstructed)
    folder = write_folder(tmp_path / 'images', shared_drive.frames())
    config = CONFIG.replace({'turns.thorough': thorough, 'turns.half_width': 1.6})
    found = gather(folder, 'f' * 32, shared_drive.spec.rate, None, config)
    few = sum(not is_turn(turn.prominence) for turn in found.turns)
    assert bool(few) == bool(stretches) and found.found == len(found.turns) == len(tried)
    assert encoded(decoded(encoded(found))) == encoded(found)


def test_what_changes_while_it_is_read_is_not_kept(tmp_path, monkeypatch):
    """Else another drive's turns stay under this one's content, also when it is back."""
    folder, other = (write_folder(tmp_path / name, smooth(4)) for name in ('images', 'other'))
    (other / '0003.png').unlink()
    opened = clips.gather

    def swapped(path, *arguments):
        folder.rename(tmp_path / 'away')
        other.rename(folder)
        return opened(path, *arguments)

    monkeypatch.setattr(clips, 'gather', swapped)
    result = gathered(folder, tmp_path / 'out')
    assert result.problem.endswith('[E-CLIP-CHANGED]') and not result.file
    assert not list((tmp_path / 'out').rglob('*.npz'))
    monkeypatch.undo()
    assert gathered(folder, tmp_path / 'out').frames == 3


def test_gathered_turns_are_what_they_are_whatever_they_say(tmp_path):
    """A file that claims another's content does not take its place, nor name a file."""
    one, other = clip_of(world=1, tracks=60, keyframes=8), clip_of(world=2, tracks=60, keyframes=8)
    places = [written(one, tmp_path / 'one.npz'),
              written(replace(other, content=one.content), tmp_path / 'two.npz')]
    found = [gathered(place, tmp_path / 'out') for place in places]
    assert found[0].file != found[1].file and found[0].content != found[1].content
    for result, place in zip(found, places, strict=True):
        assert (tmp_path / 'out' / result.file).read_bytes() == place.read_bytes()


def test_damaged_turns_of_the_output_are_gathered_again(tmp_path):
    video = write_video(tmp_path / 'still.avi', smooth(), fps=10.0)
    before = gathered(video, tmp_path / 'out')
    (tmp_path / 'out' / before.file).write_bytes(b'half')
    os.utime(video)
    assert gathered(video, tmp_path / 'out').file == before.file
    assert decoded((tmp_path / 'out' / before.file).read_bytes()).frames == 12


def odd_clip(kind, folder):
    place = folder / {'zero': 'z.npz', 'images': 'images'}.get(kind, 'clip.avi')
    if kind == 'fifo':
        os.mkfifo(place)
    elif kind == 'endless':
        place.touch()
        os.truncate(place, 2**40)
    elif kind == 'images':
        write_folder(place, smooth(4))
        os.mkfifo(place / '0004.png')
        (place / '0005.png').symlink_to('/dev/zero')
        (place / '0006.png').symlink_to('0005.png')
        (place / 'up').symlink_to('..')
    else:
        place.symlink_to({'link': '/dev/fd', 'proc': '/proc'}.get(kind, '/dev/zero'))
    return place


@pytest.mark.parametrize('kind', ['fifo', 'device', 'zero', 'endless', 'images', 'proc'])
def test_what_is_no_regular_file_is_not_waited_for(tmp_path, kind):
    place = odd_clip(kind, tmp_path)
    for _ in range(2):
        result = gathered(place, tmp_path / 'out')
        assert bool(result.file) == (kind == 'images')
        assert kind == 'images' or len(result.problem) < 250
