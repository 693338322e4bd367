# SPDX-License-Identifier: Apache-2.0
"""Turns of the same pictures count once: forwards, backwards, moved in time, and in parts."""
from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from synthetic import LENS, synthetic_turn

from dashcalib_ros.detect import TurnId
from dashcalib_ros.reconstruct.repeated import repeats, without_repeated
from dashcalib_ros.reconstruct.scene import Scene


@cache
def scene_of(yaw_deg: float, world: int, seed: int = 0, number: int | None = None) -> Scene:
    turn = synthetic_turn(LENS, yaw_deg, keyframes=24, tracks=600, noise_px=0.3, seed=seed,
                          world=world)
    return turn.scene(LENS, world if number is None else number)


def rows(scene: Scene, chosen, number: int, later_s: float = 0.0) -> Scene:
    """Return the scene with these keyframes, as another turn."""
    tracks, structure = scene.tracks, scene.structure
    stamps = np.sort(tracks.stamps_ns[chosen]) + round(later_s * 1e9)
    return replace(
        scene, turn=TurnId.at(number),
        tracks=replace(tracks, xy=tracks.xy[chosen], frames=tracks.frames[chosen],
                       stamps_ns=stamps),
        structure=replace(structure, rotations=structure.rotations[chosen],
                          translations=structure.translations[chosen],
                          registered=structure.registered[chosen], used=structure.used[chosen]))


def test_other_turns_are_kept():
    scenes = [scene_of(yaw, world) for world, yaw in enumerate((80.0, -75.0, 82.0, -88.0))]
    kept, repeated = without_repeated(scenes)
    assert kept == scenes and not repeated


@pytest.mark.parametrize('chosen', [np.arange(24), np.arange(24)[::-1], np.arange(2, 22)])
def test_a_turn_shown_again_counts_once(chosen):
    first = scene_of(80.0, 0)
    # the same place and path, tracked anew: other noise
    again = rows(scene_of(80.0, 0, seed=5), chosen, 99, later_s=40.0)
    kept, repeated = without_repeated([first, scene_of(-70.0, 1), again])
    assert len(kept) == 2 and repeated == {TurnId.at(99): TurnId.at(0)}


def test_what_repeats_a_repetition_repeats_the_first():
    first = scene_of(80.0, 0)
    others = [rows(scene_of(80.0, 0, seed=n), np.arange(24), 90 + n) for n in (1, 2)]
    kept, repeated = without_repeated([first, *others])
    assert kept == [first] and set(repeated.values()) == {first.turn}


def seen_anew(scene: Scene, number: int, scatter_m: float = 0.0, aside_m: float = 0.0) -> Scene:
    """Return the scene with other corners of its surfaces, or from a path to the side of its own.

    scatter_m: how far the corners lie beside those of the scene.
    """
    structure = scene.structure
    corners = structure.points + scatter_m * np.random.default_rng(number).standard_normal(
        structure.points.shape)
    local = corners @ structure.rotations.transpose(0, 2, 1) + structure.translations[:, None]
    xy = np.where(scene.tracks.seen[..., None], LENS.project(local - (aside_m, 0, 0)), np.nan)
    return replace(scene, turn=TurnId.at(number), tracks=replace(scene.tracks, xy=xy))


@pytest.mark.parametrize('chosen', [
    np.arange(24)[::-1],
    # there and back within one turn; a part of it, from the middle on
    np.r_[4:20, 18:6:-1], np.r_[16:8:-1, 8:20]])
def test_other_corners_of_the_same_pictures_count_once(chosen):
    """A tracker that meets the pictures in another order follows other corners."""
    first = scene_of(80.0, 0)
    again = rows(seen_anew(first, 99, scatter_m=0.15), chosen, 99, later_s=40.0)
    # the path there and back has its own times
    times = np.arange(len(chosen)) * (first.tracks.stamps_ns[1] - first.tracks.stamps_ns[0])
    again = replace(again, tracks=replace(again.tracks, stamps_ns=times))
    kept, repeated = without_repeated([first, again])
    assert kept == [first] and repeated == {TurnId.at(99): TurnId.at(0)}


def test_a_second_drive_through_the_same_bend_is_another_turn():
    first = scene_of(80.0, 0)
    second = seen_anew(first, 99, scatter_m=0.15, aside_m=0.5)
    assert len(without_repeated([first, second])[0]) == 2


def test_a_turn_of_which_a_little_was_shown_is_cut():
    whole = scene_of(85.0, 3)
    first, second = rows(whole, np.arange(9), 1), rows(whole, np.arange(4, 24), 2)
    kept, repeated = without_repeated([first, second])
    assert not repeated and len(kept) == 2
    assert kept[0] is first and 14 <= len(kept[1].tracks.frames) <= 17
    assert kept[1].structure.used.shape == kept[1].tracks.seen.shape
    # where more was shown, one place counts once
    kept, repeated = without_repeated([rows(whole, np.arange(14), 1), second])
    assert len(kept) == 1 and TurnId.at(2) in repeated


def test_pictures_of_another_size_are_no_repetition():
    first = scene_of(80.0, 0)
    other = replace(first, turn=TurnId.at(9), tracks=replace(first.tracks, image_size=(400, 225)))
    assert not repeats(other, first).any()


def test_a_turn_without_yaw_is_compared_with_nothing():
    straight = scene_of(0.5, 4)
    assert not repeats(replace(straight, turn=TurnId.at(9)), straight).any()
