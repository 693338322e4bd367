# SPDX-License-Identifier: Apache-2.0
"""Changes of a camera in use: what turns say that were taken with another lens or mounting."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG
from synthetic import LENS, rotation, synthetic_turn

from dashcalib_ros.camera import Fisheye
from dashcalib_ros.camera.mapping import as_model
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.judge import Reading, watch
from dashcalib_ros.judge.monitor import readings_of
from dashcalib_ros.problem.quadratic import Quadratic
from dashcalib_ros.reconstruct.heading import Heading, heading
from dashcalib_ros.solve import start

NOTHING = Quadratic.prior(np.zeros((6, 6)))
ZOOMED = replace(LENS, fx=1.03 * LENS.fx, fy=1.03 * LENS.fy)
EXCHANGED = replace(LENS, fx=1.3 * LENS.fx, fy=1.3 * LENS.fy, k1=0.0, k2=0.0)
YAWS = (80.0, -70.0, 85.0)
SIGMA = {'fx': 1.0, 'fy': 1.0, 'cx': 1.0, 'cy': 1.0, 'k1': 0.001, 'k2': 0.001}


def scene_of(lens, yaw_deg, number):
    return synthetic_turn(lens, yaw_deg, 14, 180, 0.25, world=number).scene(lens, number)


@pytest.fixture(scope='module')
def readings():
    """What the camera in use makes of turns of three cameras, itself among them."""
    return {name: readings_of([scene_of(lens, yaw, n) for n, yaw in enumerate(YAWS)], LENS, CONFIG)
            for name, lens in (('same', LENS), ('zoomed', ZOOMED), ('exchanged', EXCHANGED))}


def driven(*turns):
    """Return readings as those of one drive: numbered in their order, without headings."""
    return [replace(reading, turn=TurnId.at(n), heading=None) for n, reading in enumerate(turns)]


def watched(turns, sigma=SIGMA):
    return watch(turns, LENS, sigma, CONFIG.monitor)


def test_the_same_camera_has_not_changed(readings):
    monitor = watched(driven(*readings['same'], *readings['same'], *readings['same']))
    assert monitor.changes == () and monitor.lens is None


def test_a_zoom_is_suspected_after_one_turn_and_told_after_two(readings):
    first = watched(driven(*readings['same'], readings['zoomed'][0]))
    assert first.lens is not None and not first.lens.confirmed and first.changes == ()
    [change] = watched(driven(*readings['same'], *readings['zoomed'][:2])).changes
    assert change.kind == 'lens' and change.since == TurnId.at(3)
    assert 0.015 < change.zoom < 0.06 and max(map(abs, change.shift)) < 0.01
    assert 'since the turn at frame 3' in str(change)
    text, = change.looks_like
    assert 'focal length' in text and 'short' in text and 'and' not in text


def test_another_distortion_is_not_told_as_a_focal_length(readings):
    bent = [replace(each, cost=replace(
                each.cost, score=each.cost.hessian @ (0, 0, 0, 0, 0.03, 0)))
            for each in readings['same'][:2]]
    [change] = watched(driven(*readings['same'], *bent)).changes
    assert change.looks_like == ('its distortion were different',)


def test_turns_that_cannot_tell_focal_length_from_distortion_leave_it_open(readings):
    """They know the centre, and of the others only the sum of zoom and k1."""
    zoom_and_k1 = np.array([0.5 / LENS.fx, 0.5 / LENS.fy, 0.0, 0.0, 1.0, 0.0])
    hessian = 1e6 * np.outer(zoom_and_k1, zoom_and_k1) + np.diag([0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    before = [replace(each, cost=Quadratic.prior(hessian)) for each in readings['same']]
    score = 0.02 * hessian @ zoom_and_k1 / (zoom_and_k1 @ zoom_and_k1)
    after = [replace(each, cost=replace(each.cost, score=score)) for each in before[:2]]
    [change] = watched(driven(*before, *after)).changes
    assert change.looks_like == ('its focal length were 0.8 to 2.6 % too short',
                                 'its distortion were different')


def test_turns_before_a_change_make_up_for_a_calibration_that_is_known_badly(readings):
    badly = {**SIGMA, 'fx': 0.03 * LENS.fx, 'fy': 0.03 * LENS.fy, 'k1': 0.02}
    assert not watched(driven(*readings['zoomed']), badly).changes
    [change] = watched(driven(*readings['same'], *readings['zoomed'][:2]), badly).changes
    assert change.since == TurnId.at(3)


def test_a_calibration_that_fits_no_turn_has_changed_only_if_it_fitted_others_before(readings):
    for name in ('zoomed', 'exchanged'):
        turns = driven(*readings[name])
        [change] = watched(turns).changes
        assert change.since == TurnId.at(0)
        assert watched(turns, None).changes == ()


def test_a_turn_that_the_calibration_explains_shows_that_it_changed(readings):
    for name in ('zoomed', 'exchanged'):
        [change] = watched(driven(readings['same'][0], *readings[name]), None).changes
        assert change.since == TurnId.at(1)
        # not one that any camera would explain
        nothing = replace(readings['same'][0], cost=NOTHING)
        assert watched(driven(nothing, *readings[name]), None).changes == ()


def test_the_first_turn_that_showed_a_change_is_kept(readings):
    turns = driven(*readings['same'], *readings['zoomed'] * 4)
    assert len(turns) > CONFIG.monitor.turns + 3
    [change] = watched(turns).changes
    assert change.since == TurnId.at(3)


def test_turns_of_this_drive_that_know_the_lens_confirm_the_camera_in_use(readings):
    turns = driven(*readings['same'][:2])
    assert watched(turns).agrees
    assert not watched(driven(*readings['zoomed'])).agrees
    assert not watched(driven(*readings['exchanged'])).agrees
    # not those of earlier drives, nor one that any camera would explain
    assert not watched([replace(each, turn=TurnId.stored(n)) for n, each in
                        enumerate(turns)]).agrees
    assert not watched([replace(turns[0], cost=NOTHING)]).agrees


def test_one_odd_turn_is_no_change(readings):
    turns = driven(*readings['same'], readings['zoomed'][0], *readings['same'])
    assert watched(turns).lens is None


def test_a_change_is_taken_back_only_when_two_turns_speak_against_it(readings):
    turns = (*readings['same'], *readings['zoomed'][:2])
    assert watched(driven(*turns, readings['same'][0])).changes
    assert not watched(driven(*turns, *readings['same'][:2])).changes


def unexplained(reading):
    """As a turn in the middle of which images were lost."""
    return replace(reading, cost=NOTHING, explained=False, misfit=3.2)


def test_a_chain_that_breaks_where_images_are_lost_is_no_other_camera(monkeypatch):
    """A turn that was taken for a fisheye's is chained anew with the camera in use."""
    scene = replace(scene_of(LENS, 80.0, 0), camera=as_model(LENS, Fisheye))
    few = np.arange(len(scene.structure.registered)) < 8
    broken = replace(scene, camera=LENS, structure=replace(
        scene.structure, registered=few, used=scene.structure.used & few[:, None]))
    monkeypatch.setattr(start, 'chain_scene', lambda *arguments: broken)
    [reading] = readings_of([scene], LENS, CONFIG)
    assert reading.explained and reading.misfit < CONFIG.monitor.max_misfit


def test_odd_turns_with_good_ones_between_are_no_other_camera(readings):
    good, bad = readings['same'], unexplained(readings['same'][0])
    assert watched(driven(*good, bad, good[0], good[1], bad)).changes == ()
    assert watched(driven(bad, good[0], bad, good[1], bad), None).changes == ()


def test_what_two_odd_turns_showed_is_taken_back_although_others_are_odd_too(readings):
    good, bad = readings['same'], unexplained(readings['same'][0])
    turns = [*good, bad, bad]
    assert watched(driven(*turns)).changes
    assert watched(driven(*turns, good[0], bad)).changes
    assert not watched(driven(*turns, good[0], bad, good[1])).changes
    assert not watched(driven(*turns, good[0], bad, good[1], bad)).changes


def test_a_turn_that_costs_more_and_asks_for_no_other_camera_shows_none(readings):
    costly = [replace(each, misfit=1.5) for each in readings['same']]
    assert watched(driven(*readings['same'], *costly)).lens is None


def test_another_camera_is_told_although_no_size_can_be(readings):
    assert not any(reading.explained for reading in readings['exchanged'])
    [change] = watched(driven(*readings['same'], *readings['exchanged'][:2])).changes
    assert change.kind == 'lens' and np.isnan(change.zoom) and 'another camera' in str(change)


def test_turns_that_know_nothing_say_nothing(readings):
    nothing = replace(readings['same'][0], cost=NOTHING)
    assert watched(driven(*[nothing] * 5)).changes == ()


def test_turns_that_the_camera_does_not_explain_do_not_show_where_it_points(readings):
    turned = Heading(2.0, 0.0, 0.1, 0.1)
    before = [looking(0.0, 0.0, n) for n in range(4)]
    for name, kind in (('same', 'mount'), ('zoomed', 'lens')):
        after = [replace(readings[name][0], turn=TurnId.at(n), heading=turned) for n in (4, 5)]
        assert [each.kind for each in watched([*before, *after]).changes] == [kind]


def looking(yaw_deg, pitch_deg, number, sigma_deg=0.1):
    return Reading(TurnId.at(number), NOTHING, Heading(yaw_deg, pitch_deg, sigma_deg, sigma_deg))


def test_a_camera_that_is_moved_on_the_car_is_told_and_its_calibration_stays():
    before = [looking(0.1 * (n % 2), 0.5, n) for n in range(4)]
    after = [looking(1.2, 0.5 + 0.1 * (n % 2), n) for n in range(4, 7)]
    assert watched(before).changes == ()
    assert not watched([*before, after[0]]).changes
    [change] = watched([*before, *after]).changes
    assert change.kind == 'mount' and change.since == TurnId.at(4) and change.turns == 3
    assert change.turned_deg == pytest.approx((1.15, 0.03), abs=0.05)
    assert '1.1 degrees to the left' in str(change) and 'stays right' in str(change)


@pytest.mark.parametrize(('sigma_deg', 'moved'), [(0.05, True), (0.3, False)])
def test_a_heading_counts_by_its_own_sigma(sigma_deg, moved):
    """KITTI 03 has turns of 17 degrees whose headings are known to 0.3 degrees."""
    before = [looking(0.0, 0.0, n) for n in range(3)]
    after = [looking(0.7, 0.0, n, sigma_deg) for n in (3, 4)]
    assert bool(watched([*before, *after]).changes) == moved


def test_headings_that_are_not_known_well_do_not_count():
    before = [looking(0.0, 0.0, n) for n in range(4)]
    assert watched([*before, *(looking(5.0, 0.0, n, 2.0) for n in (4, 5))]).changes == ()


@pytest.mark.parametrize('turned_deg', [0.0, 2.0, -3.0])
def test_the_heading_follows_the_mounting(turned_deg):
    """A camera that is turned to the left sees the car go to the right."""
    scene = scene_of(LENS, 80.0, 0)
    structure, turn = scene.structure, rotation(1, np.radians(turned_deg))
    turned = replace(scene, structure=replace(
        structure, rotations=turn @ structure.rotations,
        translations=structure.translations @ turn.T))
    assert heading(turned).yaw_deg - heading(scene).yaw_deg == pytest.approx(turned_deg, abs=0.05)


def test_few_keyframes_show_no_heading():
    scene = scene_of(LENS, 80.0, 0)
    few = np.arange(len(scene.structure.registered)) < 4
    assert heading(replace(scene, structure=replace(scene.structure, registered=few))) is None
