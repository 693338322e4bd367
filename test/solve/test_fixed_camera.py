# SPDX-License-Identifier: Apache-2.0
"""A fixed camera's picture stands; one that moves, zooms or is bent is found and named."""
from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, scenes_of, solved, z_of
from synthetic import LENS, SIZE

from dashcalib_ros.camera.mapping import mapping_error
from dashcalib_ros.input.scale import FULL_SIZE
from dashcalib_ros.judge.conclude import Evidence, conclude
from dashcalib_ros.judge.verdict import STEADY, judge
from dashcalib_ros.problem.blocks import Shift, Zoom, imaging_with
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve import evidence

# what the others are measured against: nothing is taken out
KEPT = CONFIG.replace({'intrinsics.crop_rounds': 0})


pytestmark = pytest.mark.usefixtures('no_profile')


def moved(scenes: list[Scene], displacement) -> list[Scene]:
    """Return the scenes with their tracks displaced: of a scene (k, 1 or t, 2) px."""
    return [replace(scene, tracks=replace(
        scene.tracks, xy=scene.tracks.xy + displacement(scene))) for scene in scenes]


def stabilised(scene: Scene, limit_px: float = 30.0) -> np.ndarray:
    """Return (k, 1, 2) how a stabiliser moves the picture: against the turn, up to a limit."""
    ahead = scene.structure.rotations[:, 2]
    yaw = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 2]))
    smooth = yaw.copy()
    for k in range(1, len(yaw)):
        smooth[k] = 0.5 * smooth[k - 1] + 0.5 * yaw[k]
    shift = np.clip(LENS.fx * (yaw - smooth), -limit_px, limit_px)
    return np.stack([shift, np.zeros_like(shift)], axis=1)[:, None]


def zoomed(scene: Scene, factor: float) -> np.ndarray:
    middle = (np.array(SIZE) - 1) / 2
    return (factor - 1) * (scene.tracks.xy - middle)


def bent(scene: Scene, most_px: float) -> np.ndarray:
    places = (scene.tracks.xy - (250.0, 150.0)) / 120.0
    bump = np.exp(-0.5 * np.sum(places**2, axis=2, keepdims=True))
    return most_px * bump * (0.8, -0.6)


def test_a_fixed_camera_departs_in_nothing():
    solution = solved(scenes_of(4))
    assert {each.kind for each in solution.fixed_camera} == {'shift', 'zoom', 'bend'}
    assert all(0.3 < each.strength < 1.7 and not each.clear for each in solution.fixed_camera)
    assert not solution.crops


def test_a_stabilised_video_is_found_and_taken_out():
    scenes = moved(scenes_of(4, tracks=200, keyframes=16, noise_px=0.15), stabilised)
    kept, found = solved(scenes, KEPT), solved(scenes)
    strongest = kept.fixed_camera[0]
    assert strongest.kind == 'shift' and strongest.clear
    assert 'E-PICTURE-MOVES' in judge(kept, CONFIG.verdict).codes
    assert STEADY in judge(kept, CONFIG.verdict).remedies
    wrong, left = (mapping_error(each.camera, LENS) for each in (kept, found))
    assert wrong > 1.0 and left < 0.4
    assert not found.fixed_camera[0].clear
    # sigma knows that the crop is uncertain
    assert np.abs(z_of(found)).max() < 3.5
    assert found.sigma[2] > 2.0
    # the lens is told, but no camera_info holds for pictures that move
    verdict = judge(found, CONFIG.verdict)
    assert verdict.level == 'weak' and verdict.remedies[0] == STEADY
    assert verdict.codes[0] == 'E-PICTURE-MOVES'
    assert re.search(r'by up to \d+\.\d %', str(verdict.reasons[0]))
    # ... also before what refuses it; what is less than the picture is known by does no harm
    both = judge(found, replace(CONFIG.verdict, min_yaw_deg=1e3)).codes
    assert both[:2] == ('E-PICTURE-MOVES', 'E-LITTLE-YAW')
    lenient = CONFIG.replace({'verdict.max_crop_sigmas': 1e6})
    told = conclude(found, Evidence(SIZE, 100, (), {}, np.zeros((0, 2)), None, FULL_SIZE, {}),
                    lenient)
    assert told.verdict.level == 'accepted' and told.warnings[-1].code == 'E-PICTURE-SEEMS-TO-MOVE'
    # what was taken out is what was there, up to a shift of all pictures
    taken = np.concatenate([found.crops[scene.turn][:, 0] for scene in scenes])
    there = np.concatenate([stabilised(scene)[:, 0, 0] for scene in scenes])
    assert np.corrcoef(taken, there)[0, 1] > 0.95


def test_a_stabiliser_that_somebody_denies_is_found_and_named():
    denied = CONFIG.replace({'known.stabiliser': 'no'})
    still, found = (solved(scenes, denied) for scenes in (
        scenes_of(4), moved(scenes_of(4, tracks=200, keyframes=16, noise_px=0.15), stabilised)))
    assert still.fixed and not found.fixed and found.crops
    codes = [[each.code for each in conclude(each, Evidence(
        SIZE, 100, (), {}, np.zeros((0, 2)), None, FULL_SIZE, {}), denied).warnings]
        for each in (still, found)]
    assert 'E-KNOWN-CONTRADICTED' in codes[1] and 'E-KNOWN-CONTRADICTED' not in codes[0]


def test_who_knows_that_there_is_no_stabiliser_is_believed_against_little_evidence(monkeypatch):
    monkeypatch.setattr(evidence, 'SHIFT_NATS', -2.0)
    for known, shifted in (({}, True), ({'known.stabiliser': 'no'}, False)):
        assert bool(solved(scenes_of(4), CONFIG.replace(known)).crops) == shifted


def test_a_crop_is_taken_out_of_the_tracks():
    [scene] = scenes_of(1)
    imaging = imaging_with(LENS)
    np.testing.assert_array_equal(imaging.ideal(scene), scene.tracks.xy)
    count = len(scene.tracks.frames)
    middle = (np.array(SIZE) - 1) / 2
    moved = imaging.having(Shift({scene.turn: np.tile((3.0, -1.0), (count, 1))}), Zoom(
        {scene.turn: np.full((count, 1), 0.01)})).ideal(scene)
    np.testing.assert_allclose(middle + 1.01 * (moved - middle) + (3.0, -1.0), scene.tracks.xy)


@pytest.mark.parametrize('turns', [(0,), pytest.param((2, 3), marks=pytest.mark.thorough)])
def test_a_zoom_between_turns_is_named(turns):
    scenes = scenes_of(5)
    scenes = [moved([scene], lambda each: zoomed(each, 1.03))[0] if n in turns else scene
              for n, scene in enumerate(scenes)]
    verdict = judge(solved(scenes), CONFIG.verdict)
    # a shift of the pictures may look alike, so both are named
    assert verdict.level == 'weak' and verdict.codes[0] in ('E-PICTURE-MOVES', 'E-ZOOM-CHANGES')
    found = solved(scenes, KEPT)
    assert found.fixed_camera[0].kind == 'zoom' and found.fixed_camera[0].clear
    assert 'E-ZOOM-CHANGES' in judge(found, CONFIG.verdict).codes
    zooms = found.fixed_camera[0].by_turn
    larger = {scene.turn for n, scene in enumerate(scenes) if n in turns}
    assert min(zooms[turn] for turn in larger) > max(
        zoom for turn, zoom in zooms.items() if turn not in larger)


@pytest.mark.thorough
def test_a_slow_zoom_is_named_in_noise_too():
    scenes = [moved([scene], lambda each, n=n: zoomed(each, 1 + 0.012 * n))[0]
              for n, scene in enumerate(scenes_of(5, noise_px=0.45))]
    solution = solved(scenes)
    assert solution.fixed_camera[0].kind == 'zoom' and solution.fixed_camera[0].clear
    assert judge(solution, CONFIG.verdict).level == 'weak'


@pytest.mark.thorough
def test_every_other_picture_zoomed_is_named():
    def breathing(scene: Scene) -> np.ndarray:
        odd = np.arange(len(scene.tracks.frames)) % 2
        return odd[:, None, None] * zoomed(scene, 1.02)

    solution = solved(moved(scenes_of(4), breathing))
    assert solution.fixed_camera[0].kind == 'zoom'
    verdict = judge(solution, CONFIG.verdict)
    assert 'image to image' in verdict.reasons[verdict.codes.index('E-ZOOM-CHANGES')]


def test_a_windscreen_that_bends_the_picture_is_named():
    solution = solved(moved(scenes_of(4, tracks=260), lambda scene: bent(scene, 4.0)))
    assert solution.fixed_camera[0].kind == 'bend' and solution.fixed_camera[0].clear
    verdict = judge(solution, CONFIG.verdict)
    assert verdict.level != 'accepted' and 'E-PICTURE-BENT' in verdict.codes
    # nobody takes a windscreen away
    assert 'dashcalib export --to rays' in ' '.join(verdict.remedies)


@pytest.mark.thorough
def test_what_tracks_share_makes_sigma_larger():
    fixed = solved(scenes_of(3))
    slightly = solved(moved(scenes_of(3), lambda scene: bent(scene, 1.0)))
    assert not any(each.clear for each in slightly.fixed_camera)
    assert slightly.picture.rms > 1.1 * fixed.picture.rms


def test_one_scene_can_be_tested():
    solution = solved(scenes_of(1))
    assert all(np.isfinite(each.strength) and not each.clear for each in solution.fixed_camera)
