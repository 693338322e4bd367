# SPDX-License-Identifier: Apache-2.0
"""Scenes in a file: what is written comes back, and nothing else comes in."""
from __future__ import annotations

import io
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fleet_made import clip_of

from dashcalib_ros.camera import Fisheye
from dashcalib_ros.detect.edges import KNOTS
from dashcalib_ros.reconstruct.scene import Start
from dashcalib_ros.store.scene_file import MOST_LINES, decoded, encoded

MADE = clip_of(yaws=(80.0, -70.0), tracks=60, keyframes=8)
DATA = encoded(MADE)


def test_what_is_read_is_what_was_written_to_the_last_bit():
    first, second = MADE.turns
    rival = Start(first.scene.profile, Fisheye.centred(first.scene.tracks.image_size, 400.0))
    both = replace(first, scene=replace(first.scene, rivals=(rival,)))
    made = replace(MADE, turns=(both, second), warnings=('dark',), found=3)
    data = encoded(made)
    found = decoded(data)
    assert encoded(found) == data
    assert (found.origin, found.warnings, found.found) == (made.origin, ('dark',), 3)
    for one, other in zip(found.turns, made.turns, strict=True):
        assert one.repeats(other.scene) and one.scene.turn == other.scene.turn
        np.testing.assert_array_equal(one.scene.structure.points, other.scene.structure.points)
    assert set(found.turns[0].scene.starts) == {'pinhole', 'fisheye'}
    assert found.turns[0].scene.rivals[0].camera == rival.camera
    # no pictures, and not much else
    assert len(data) < 30_000


def damaged(about=None, **changes) -> bytes:
    """Return the file with other values in `about`, and other arrays; None removes one."""
    arrays = {**dict(np.load(io.BytesIO(DATA)))}
    if about:
        values = json.loads(str(arrays['about']))
        for name, value in about.items():
            into = values['turns'][0] if name in values['turns'][0] else values
            into[name] = value
        changes['about'] = np.asarray(json.dumps(values))
    arrays.update(changes)
    out = io.BytesIO()
    np.savez_compressed(out, **{name: value for name, value in arrays.items()
                                if value is not None})
    return out.getvalue()


def array(name):
    return np.load(io.BytesIO(DATA))[f'turn0.{name}']


def with_one(name, value, place=0):
    values = array(name).copy()
    values.flat[place] = value
    return values


EVIL = np.empty(1, object)
EVIL[0] = {}
ABOUTS = [
    {'format': 99}, {'image_size': [9, 9]}, {'image_size': [800, 10**400]}, {'image_size': '12'},
    {'scale': {'shrink': 0, 'enlarge': 1}}, {'scale': {'shrink': 2, 'enlarge': 2}},
    {'content': '../../x'}, {'content': 'abc/../..'}, {'settings': '../x'}, {'content': 7},
    {'frames': 1e308}, {'frames': -1}, {'frames': 10**400}, {'seconds': 'x'}, {'seconds': None},
    {'seconds': float('inf')}, {'warnings': [1]}, {'warnings': None}, {'turns': {}},
    {'turns': [{}]}, {'stamp_s': 'x'}, {'stamp_s': 10**400}, {'stamp_s': float('nan')},
    {'stamp_s': True}, {'prominence': 0}, {'prominence': 1e300}, {'center': 'x'}, {'center': 0.5},
    {'center': 100}, {'frame_id': 7}]
ARRAYS: list[dict[str, Any]] = [
    {'xy': EVIL}, {'xy': None}, {'rotations': np.zeros((3, 3))},
    {'rotations': 1e300 * array('rotations')}, {'rotations': 1.001 * array('rotations')},
    {'rotations': -array('rotations')}, {'rotations': np.zeros((8, 3, 3))},
    {'rotations': with_one('rotations', np.nan)},
    {'translations': 1e300 * array('translations')}, {'translations': with_one(
        'translations', np.inf)},
    {'points': -array('points')}, {'points': np.full(array('points').shape, np.nan)},
    {'points': np.full(array('points').shape, 1e300)},
    {'xy': with_one('xy', 1e30)}, {'xy': array('xy').astype(complex)},
    {'frames': array('frames')[::-1]}, {'stamps_ns': np.zeros(8, np.int64)},
    {'registered': np.zeros(8, bool)}, {'used': np.zeros_like(array('used'))},
    {'camera': with_one('camera', 1e-9)}, {'camera': with_one('camera', -520.0)},
    {'camera': with_one('camera', 99999.0, 2)}, {'camera': with_one('camera', 1e9, 4)},
    {'camera': array('camera')[:5]}, {'camera_model': np.asarray('../x')},
    {'ratios': array('ratios')[::-1]}, {'ratios': np.zeros(0), 'costs': np.zeros(0)},
    {'costs': with_one('costs', np.nan)}, {'costs': -array('costs')},
    {'observations': np.asarray(0)}, {'rival0.camera': array('camera')}]


@pytest.mark.parametrize('changes', [
    *({'about': about} for about in ABOUTS),
    *({f'turn0.{name}': value for name, value in each.items()} for each in ARRAYS)])
def test_what_is_no_scene_is_refused_on_one_line(changes):
    with pytest.raises(ValueError, match=r'\w') as caught:
        decoded(damaged(**changes))
    assert len(str(caught.value).splitlines()) == 1


POINTS, STAMPS_S = np.ones((3, KNOTS, 2), np.float32), np.arange(3.0)


@pytest.mark.parametrize(('points', 'stamps_s'), [
    (POINTS[:2], STAMPS_S), (POINTS[:, 1:], STAMPS_S), (POINTS, STAMPS_S[::-1]),
    (np.nan * POINTS, STAMPS_S), (1e6 * POINTS, STAMPS_S), (POINTS, 1e12 * STAMPS_S),
    (POINTS, None), (POINTS.astype(int), STAMPS_S), (POINTS[0, 0, 0], STAMPS_S),
    (np.ones((MOST_LINES + 1, KNOTS, 2)), np.arange(MOST_LINES + 1.0))])
def test_what_are_no_lines_is_refused(points, stamps_s):
    good = decoded(damaged(**{'lines.points': POINTS, 'lines.stamps_s': STAMPS_S})).lines
    assert len(good) == 3 and decoded(DATA).lines is None
    with pytest.raises(ValueError, match=r'\w'):
        decoded(damaged(**{'lines.points': points, 'lines.stamps_s': stamps_s}))


def test_the_undamaged_file_would_be_taken():
    assert encoded(decoded(damaged())) == DATA
    # of older versions: without the frame, with turns that have no scene
    values = json.loads(str(np.load(io.BytesIO(DATA))['about']))
    turns = [{**turn, 'scene': True, 'yaw_deg': 1.0} for turn in values['turns']]
    lost = {'center': 9, 'stamp_s': 1.0, 'prominence': 0.1, 'scene': False, 'yaw_deg': None}
    del values['frame_id'], values['found']
    values['turns'] = [*turns, lost]
    out = io.BytesIO()
    np.savez(out, **{**dict(np.load(io.BytesIO(DATA))), 'about': np.asarray(json.dumps(values))})
    found = decoded(out.getvalue())
    assert (found.found, len(found.turns)) == (3, 2)


@pytest.mark.parametrize('data', [
    b'', b'PK', DATA[:len(DATA) // 2], b'PK\1\2' * 10_000])
def test_what_is_no_such_file_is_refused(data):
    with pytest.raises(ValueError, match=r'\w'):
        decoded(data)
