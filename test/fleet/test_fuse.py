# SPDX-License-Identifier: Apache-2.0
"""The clips of one camera are one calibration; what contradicts is named and left out."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fleet_made import CONFIG, YAWS, clip_of, lens_of
from made_lines import made_lines
from refused import refused
from synthetic import LENS

from dashcalib_ros.detect import TurnId, bend
from dashcalib_ros.errors import InputError
from dashcalib_ros.fleet import solved
from dashcalib_ros.fleet.fuse import fuse
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.report import report_html
from dashcalib_ros.solve import solve
from dashcalib_ros.store.scene_file import Origin, decoded, encoded

FEW = {'tracks': 80, 'keyframes': 8}
CLIPS = {f'{n}.mp4': clip_of(yaws=YAWS[n:n + 1], world=n, **FEW) for n in range(4)}


@pytest.fixture(scope='module')
def fused():
    """Four good clips, one twice, one zoomed, some of another size, one without turns."""
    smaller = replace(clip_of(yaws=(), world=70), origin=Origin((640, 480)))
    enlarged = replace(smaller, content=f'{71:032x}',
                       origin=Origin(LENS.image_size, Scale(enlarge=2)))
    odd = {'again.mp4': CLIPS['0.mp4'], 'small.mp4': smaller, 'enlarged.mp4': enlarged,
           'straight.mp4': clip_of(yaws=(), world=60),
           'zoomed.mp4': clip_of(lens_of(1.2), YAWS[4:5], world=40, **FEW)}
    return fuse('cam', 'acme', odd | CLIPS, CONFIG)


def test_what_contradicts_is_named_and_left_out(fused):
    shares = fused.shares
    for name, code in {'again': 'E-CLIP-REPEATED', 'small': 'E-CLIP-OTHER-SIZE',
                       'enlarged': 'E-CLIP-OTHER-SETTINGS',
                       'zoomed': 'E-CLIP-OTHER-CAMERA'}.items():
        assert shares[f'{name}.mp4'].left_out.endswith(f' [{code}]')
    assert '0.mp4' in shares['again.mp4'].left_out
    assert all(size in shares['small.mp4'].left_out for size in ('640x480', '800x450'))
    assert [shares[f'{n}.mp4'].used for n in range(4)] == [1, 1, 1, 1]
    assert not shares['straight.mp4'].left_out
    warnings = '; '.join(map(str, fused.calibration.warnings))
    assert {each.code for each in fused.calibration.warnings} == {'E-CLIP-LEFT-OUT'}
    assert all(name in warnings for name in (
        'again.mp4', 'small.mp4', 'enlarged.mp4', 'zoomed.mp4'))


def test_turns_are_named_by_their_clips(fused):
    assert [turn.clip for turn in fused.calibration.stored_turns] == [
        f'{n}.mp4' for n in range(4)]
    again = solved.decoded(solved.encoded(fused), 'file').calibration
    page = report_html(again)
    assert 'earlier' not in page and '0.mp4' in page
    sharp = replace(CONFIG, verdict=replace(CONFIG.verdict, max_leverage=0.1))
    verdict = fuse('cam', '', CLIPS, sharp).calibration.verdict
    [reason] = [each for each in verdict.reasons if each.code == 'E-ONE-TURN-DOMINATES']
    assert '.mp4' in str(reason) and 'earlier' not in verdict.main_text


def with_lines(lens):
    """Return the clips, each with a part of the lines that a lens shows; each counts from 0."""
    lines, part = made_lines(lens), np.arange(600) // 150
    part = part[:len(lines)]
    found = {}
    for n, (name, clip) in enumerate(CLIPS.items()):
        own = lines.chosen(part == n)
        found[name] = replace(clip, lines=replace(own, stamps_s=own.stamps_s - own.stamps_s[0]))
    return found


@pytest.mark.parametrize(('off', 'level'), [(0.0, 'accepted'), (0.08, 'weak')])
def test_upright_lines_judge_a_fleet_s_camera_as_that_of_a_drive(off, level):
    """Also after the way through the clips' files."""
    clips = with_lines(replace(LENS, k1=LENS.k1 + off))
    read = {name: decoded(encoded(clip)) for name, clip in clips.items()}
    for name, clip in clips.items():
        np.testing.assert_array_equal(read[name].lines.points, clip.lines.points)
        np.testing.assert_array_equal(read[name].lines.stamps_s, clip.lines.stamps_s)
    found = fuse('cam', 'acme', read, CONFIG)
    assert found.calibration.verdict.level == level
    assert ('E-LINES-BENT' in found.calibration.verdict.codes) == (level == 'weak')
    # nor does such a camera tell others of its model what their lens is like
    assert found.estimate.sound == (level == 'accepted')
    lines = found.calibration.straight_lines
    assert lines.k1 == pytest.approx(off, abs=0.03) and lines.groups >= 8


def test_one_clip_has_the_lines_of_its_drive():
    lines = made_lines(LENS)
    lines = replace(lines, stamps_s=lines.stamps_s + 1.7e9)
    whole = clip_of(yaws=YAWS[:3], **FEW)
    found = fuse('cam', '', {'a.mp4': replace(whole, lines=lines)}, CONFIG)
    scenes = [turn.scene for turn in whole.turns]
    solution = solve([replace(scene, turn=TurnId.stored(n)) for n, scene in enumerate(scenes)],
                     CONFIG)
    alone = bend(lines, solution.camera, solution.covariance)
    assert found.calibration.straight_lines.groups == alone.groups
    assert found.calibration.straight_lines.k1 == pytest.approx(alone.k1, abs=1e-3)


def test_of_many_clips_lines_are_as_many_as_of_a_long_drive(monkeypatch):
    monkeypatch.setattr('dashcalib_ros.fleet.fuse.MOST_LINES', 200)
    found = fuse('cam', '', with_lines(LENS), CONFIG)
    assert 100 < found.calibration.straight_lines.lines <= 200


def first_two():
    return dict(list(CLIPS.items())[:2])


def test_one_clip_with_many_turns_does_not_decide_the_size():
    many = clip_of(yaws=YAWS, world=50, tracks=60, keyframes=7)
    clips = {'many.npz': replace(many, origin=Origin((640, 450))), **first_two()}
    shares = fuse('cam', 'acme', clips, CONFIG).shares
    assert shares['many.npz'].left_out.endswith(' [E-CLIP-OTHER-SIZE]')


# stretches of ten clips, with less yaw than a turn
GENTLE = {f's{n}.mp4': clip_of(yaws=((-1)**n * (9.0 + n / 2),), world=80 + n, prominence=0.001,
                               tracks=140, keyframes=12) for n in range(8)}


@pytest.mark.thorough
def test_clips_without_a_turn_add_up_by_the_rules_of_a_drive():
    unknown = fuse('cam', '', GENTLE, CONFIG)
    assert unknown.calibration.verdict.level == 'weak'
    assert 'E-ONLY-GENTLE' in unknown.calibration.verdict.codes and not unknown.estimate.sound
    known = fuse('cam', '', GENTLE, CONFIG.replace({'known.stabiliser': 'no'}))
    found = known.calibration
    assert found.verdict.level == 'accepted' and found.turns_used == len(GENTLE)
    assert abs(found.camera.fx - LENS.fx) < 2 * found.sigma['fx']
    so_far = [known.shares[name].sigma_so_far for name in sorted(GENTLE)]
    assert so_far[-1] == pytest.approx(found.sigma['fx']) and so_far[-1] < so_far[1] < so_far[0]
    assert found.sigma['fx'] < unknown.estimate.sigma['fx']


@pytest.mark.thorough
def test_no_stretch_takes_the_place_of_a_turn():
    both = {**CLIPS, **dict(list(GENTLE.items())[:2])}
    enough = CONFIG.replace({'turns.wanted': 4})
    assert fuse('cam', '', both, enough).calibration.turns_used == 4
    assert fuse('cam', '', both, CONFIG).calibration.turns_used == 6
    few = fuse('cam', '', both, CONFIG.replace({'fleet.turns': 4}))
    assert [few.shares[name].used for name in sorted(both)] == [1] * 4 + [0] * 2


def test_the_others_give_one_camera(fused):
    found = fused.calibration
    assert found.verdict.level == 'accepted' and found.turns_used == 4 and fused.estimate.sound
    assert abs(found.camera.fx - LENS.fx) < 2 * found.sigma['fx'] < 10
    for share in list(fused.shares.values())[:4]:
        assert abs(share.fx - LENS.fx) < 4 * share.fx_sigma if share.used else share.fx is None


def test_the_order_of_the_clips_does_not_count():
    turned = dict(reversed(first_two().items()))
    texts = [solved.encoded(fuse('cam', 'acme', clips, CONFIG))
             for clips in (first_two(), turned)]
    assert texts[0] == texts[1]


def test_a_solved_camera_comes_back_from_its_file(fused):
    text = solved.encoded(fused)
    found = solved.decoded(text, 'file')
    assert solved.encoded(found) == text
    assert found.calibration.camera == fused.calibration.camera
    assert found.calibration.mount == fused.calibration.mount
    assert found.calibration.sigma == pytest.approx(dict(fused.calibration.sigma))
    np.testing.assert_array_equal(found.estimate.covariance, fused.estimate.covariance)


def scrambled():
    """Return a clip with a turn whose tracks are of no scene."""
    clip, rng = clip_of(**FEW), np.random.default_rng(0)
    [turn] = clip.turns
    tracks = replace(turn.scene.tracks, xy=rng.uniform(
        0, 400, turn.scene.tracks.xy.shape).astype(np.float32))
    return replace(clip, turns=(replace(turn, scene=replace(turn.scene, tracks=tracks)),))


@pytest.mark.parametrize('spoil', [
    lambda data: data[:len(data) // 2], lambda data: b'{}', lambda data: b'[1]'])
def test_a_damaged_file_of_a_solved_camera_is_named(fused, spoil):
    with refused(InputError, 'E-FLEET-FILE-DAMAGED', 'the/file.json'):
        solved.decoded(spoil(solved.encoded(fused)), 'the/file.json')


@pytest.mark.parametrize(('clips', 'code'), [
    ({}, 'E-NO-CLIP'),
    ({'a': clip_of(yaws=(), world=1), 'b': clip_of(yaws=(), world=2)}, 'E-NO-TURN'),
    ({'a': replace(clip_of(yaws=(), world=1), found=1)}, 'E-NO-SCENE'),
    ({'a': scrambled()}, 'E-NO-COMMON-CAMERA')])
def test_nothing_to_solve_is_refused_with_the_reason(clips, code):
    found = fuse('cam', 'acme', clips, CONFIG)
    assert found.estimate is None and found.calibration.verdict.level == 'refused'
    assert found.calibration.verdict.codes[0] == code


def test_stamps_that_hide_a_loss_are_named():
    clips = {}
    for n in range(3):
        clip = clip_of(yaws=YAWS[n:n + 1], world=n, tracks=80, keyframes=14)
        [turn] = clip.turns
        tracks = turn.scene.tracks
        step_ns = np.diff(tracks.stamps_ns).min()
        later = np.where(np.arange(len(tracks.frames)) > 6, step_ns // 2, 0)
        tracks = replace(tracks, stamps_ns=tracks.stamps_ns - later)
        clips[f'{n}.mp4'] = replace(clip, turns=(
            replace(turn, scene=replace(turn.scene, tracks=tracks)),))
    found = fuse('cam', 'acme', clips, CONFIG).calibration
    assert 'E-TIME-MISSING' in {each.code for each in found.warnings}
    sound = fuse('cam', 'acme', CLIPS, CONFIG).calibration
    assert 'E-TIME-MISSING' not in {each.code for each in sound.warnings}
