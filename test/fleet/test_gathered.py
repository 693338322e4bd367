"""Gathered turns: the file holds all that solving needs, and nothing can be smuggled in."""
from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from fleet_made import CONFIG, clip_of
from made_drives import smooth, write_folder, write_video

from dashcalib_ros.camera import Fisheye
from dashcalib_ros.errors import InputError
from dashcalib_ros.fleet.gather import content_hash, gather, settings_hash
from dashcalib_ros.fleet.gathered import decoded, encoded
from dashcalib_ros.reconstruction.scene import Start


def test_what_is_read_is_what_was_written_to_the_last_bit():
    clip = clip_of(yaws=(80.0, -70.0), tracks=60, keyframes=8)
    first = min(clip.scenes)
    scene = clip.scenes[first]
    rival = Start(scene.profile, Fisheye.centred(scene.tracks.image_size, 400.0))
    clip = replace(clip, scenes={**clip.scenes, first: replace(scene, rivals=(rival,))},
                   warnings=('dark',))
    data = encoded(clip)
    found = decoded(data, 'clip')
    assert encoded(found) == data
    assert (found.turns, found.warnings, found.frames) == (clip.turns, ('dark',), clip.frames)
    for center, scene in clip.scenes.items():
        np.testing.assert_array_equal(found.scenes[center].tracks.xy, scene.tracks.xy)
        np.testing.assert_array_equal(found.scenes[center].structure.points,
                                      scene.structure.points)
    assert set(found.scenes[first].starts) == {'plumb_bob', 'equidistant'}
    # no pictures, and not much else
    assert len(data) < 30_000


def damaged(data: bytes, **changes) -> bytes:
    arrays = {**dict(np.load(io.BytesIO(data))), **changes}
    out = io.BytesIO()
    np.savez_compressed(out, **{name: value for name, value in arrays.items()
                                if value is not None})
    return out.getvalue()


def test_damaged_and_hostile_files_are_one_line():
    data = encoded(clip_of(tracks=60, keyframes=8))
    about = json.loads(str(np.load(io.BytesIO(data))['about']))
    evil = np.empty(1, object)
    evil[0] = print
    for bad in (b'', b'PK', data[:len(data) // 2], damaged(data, about=None),
                damaged(data, **{'turn0.xy': evil}), damaged(data, **{'turn0.xy': None}),
                damaged(data, **{'turn0.rotations': np.zeros((3, 3))}),
                damaged(data, about=np.asarray(json.dumps({**about, 'format': 99}))),
                damaged(data, about=np.asarray(json.dumps({**about, 'image_size': [9, 9]})))):
        with pytest.raises(InputError, match=r'clip is no file of gathered turns') as caught:
            decoded(bad, 'clip')
        assert len(str(caught.value).splitlines()) == 1


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
    with pytest.raises(InputError, match='cannot read'):
        content_hash(tmp_path / 'gone.avi')
    same = settings_hash(CONFIG, None, None)
    assert settings_hash(CONFIG.replace({'verdict.max_sigma': 0.1, 'threads': 1}),
                         None, None) == same
    assert len({same, settings_hash(CONFIG, 10.0, None), settings_hash(CONFIG, None, '/a'),
                settings_hash(CONFIG.replace({'tracks.points': 700}), None, None)}) == 4


def test_a_clip_without_turns_is_a_result_too(tmp_path):
    video = write_video(tmp_path / 'still.avi', smooth(), fps=10.0)
    found = gather(video, 'abc', None, None, CONFIG)
    assert (found.frames, found.turns, found.image_size) == (12, (), (64, 48))
    assert found.seconds == pytest.approx(1.1, abs=0.01) and found.content == 'abc'
    assert encoded(decoded(encoded(found), 'still')) == encoded(found)
