# SPDX-License-Identifier: Apache-2.0
"""Motion: epipoles that are known exactly, thinning by time, standing, and real drives."""
from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from refused import refused

from dashcalib_ros.config import Config, MaskConfig, TrackingConfig
from dashcalib_ros.demo import Drive, DriveSpec, Lens, Stop, Turn
from dashcalib_ros.detect import MotionEstimator, TurnDetector
from dashcalib_ros.detect import estimator as estimator_module
from dashcalib_ros.detect.epipoles import epipoles_of, turning
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.inputs import open_frames

LENS = Lens.of(480, 270, 75.0, -0.30, 0.10, offset=(7.0, -4.0))
KITTI = Path(__file__).parents[3] / 'shared/data/kitti03/bag'
SIZE = (640, 360)
FOCAL = 420.0


# -- epipoles ---------------------------------------------------------------------------------

def pair(yaw_deg: float, direction: tuple[float, float, float], outliers: int = 0,
         noise: float = 0.1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points in two images of a random world, and the true epipoles (2, 2)."""
    rng = np.random.default_rng(7)
    world = rng.uniform((-12, -4, 6), (12, 4, 60), (400, 3))
    yaw = math.radians(yaw_deg)
    rotation = np.array([[math.cos(yaw), 0, -math.sin(yaw)], [0, 1, 0],
                         [math.sin(yaw), 0, math.cos(yaw)]])
    step = np.array(direction, float)
    seen = [world, (world - step) @ rotation.T]
    middle = (np.array(SIZE) - 1) / 2
    pixels = [FOCAL * xyz[:, :2] / xyz[:, 2:] + middle for xyz in seen]
    inside = np.all([(xyz[:, 2] > 1) & np.all((px >= 0) & (px < SIZE), axis=1)
                     for xyz, px in zip(seen, pixels, strict=True)], axis=0)
    before, after = (px[inside] + rng.normal(0, noise, (inside.sum(), 2)) for px in pixels)
    after[:outliers] = rng.uniform((0, 0), SIZE, (outliers, 2))
    ends = [step, rotation @ step]
    truth = np.array([end[:2] / max(end[2] / FOCAL * SIZE[0], np.linalg.norm(end[:2]))
                      for end in ends])
    return before.astype(np.float32), after.astype(np.float32), truth


@pytest.mark.parametrize(('yaw', 'direction'), [
    (0.0, (0, 0, 1)), (0.0, (0.1, -0.05, 1)), (3.0, (0, 0, 1.5)), (-8.0, (-0.2, 0, 1.5)),
    (15.0, (0.3, 0, 1.5))])
def test_epipoles_are_where_the_geometry_says(yaw, direction):
    for outliers in (0, 50):
        before, after, truth = pair(yaw, direction, outliers)
        found = epipoles_of(before, after, SIZE, 0.5)
        assert np.abs(found - truth).max() < 0.02
        expected = FOCAL / SIZE[0] * math.tan(math.radians(abs(yaw)) / 2)
        assert turning(found) == pytest.approx(expected, rel=0.12, abs=0.003)


def test_epipoles_at_infinity_are_bounded():
    before, after, truth = pair(0.0, (1, 0, 0))
    found = epipoles_of(before, after, SIZE, 0.5)
    assert np.isfinite(found).all()
    assert np.all(np.linalg.norm(found, axis=1) <= 1 + 1e-9)
    assert np.abs(np.linalg.norm(found, axis=1) - 1).max() < 0.3
    assert np.linalg.norm(truth[0]) == 1


def test_no_epipoles_from_chance():
    rng = np.random.default_rng(0)
    random = [rng.uniform((0, 0), SIZE, (300, 2)).astype(np.float32) for _ in range(2)]
    assert epipoles_of(*random, SIZE, 0.5) is None
    few = np.zeros((10, 2), np.float32)
    assert epipoles_of(few, few, SIZE, 0.5) is None
    for same in (np.zeros((100, 2), np.float32), random[0]):
        found = epipoles_of(same, same, SIZE, 0.5)
        assert found is None or turning(found) < 0.05


# -- thinning ---------------------------------------------------------------------------------

def kept(stamps_ns: np.ndarray, **changes: float) -> list[int]:
    """Return which frames of a camera with these stamps are processed."""
    estimator = MotionEstimator(TrackingConfig(**changes), MaskConfig(enabled=False))
    image = np.zeros((48, 64), np.uint8)
    motions = [estimator.push(Frame(i, int(ns), image)) for i, ns in enumerate(stamps_ns)]
    return [motion.index for motion in motions if motion is not None]


def steady(rate: float, seconds: float = 20.0) -> np.ndarray:
    return np.rint(np.arange(round(seconds * rate)) * 1e9 / rate).astype(np.int64)


@pytest.mark.parametrize(('rate', 'every'), [
    (5.0, 1), (10.0, 1), (12.5, 1), (20.0, 2), (25.0, 2), (30.0, 3), (60.0, 5)])
def test_thinning_is_by_time(rate, every):
    stamps = steady(rate)
    assert kept(stamps)[:40] == list(range(0, len(stamps), every))[:40]


def test_thinning_stands_jitter():
    rng = np.random.default_rng(2)
    for rate in (10.0, 30.0):
        stamps = steady(rate, 60.0)
        stamps += np.rint(rng.normal(0, 4e6, len(stamps))).astype(np.int64)
        count = len(kept(stamps))
        assert 0.93 * 600 <= count <= 1.07 * 600


def test_thinning_is_not_by_count():
    stamps = np.concatenate([steady(30.0, 5.0), 5_000_000_000 + steady(10.0, 5.0)])
    chosen = np.array(kept(stamps))
    assert np.sum(chosen < 150) == np.sum(chosen >= 150) == 50
    assert len(kept(steady(30.0, 10.0), rate=30.0)) == 300


@pytest.mark.parametrize(('shift_ns', 'after_gap'), [(-10**12, False), (1_400_000_000, True)])
def test_clock_set_back_and_the_next_file_start_anew(stopping_frames, shift_ns, after_gap):
    frames = stopping_frames[:14]
    frames += [dataclasses.replace(f, index=f.index + 14, stamp_ns=f.stamp_ns + shift_ns,
                                   after_gap=after_gap and f.index == 0) for f in frames]
    estimator = MotionEstimator(TrackingConfig())
    motions = [estimator.push(frame) for frame in frames]
    assert all(motion is not None for motion in motions)
    assert [m.center for m in motions[:8]] == [None] * 6 + [3, 4]
    assert math.isnan(motions[14].moved_px)
    for first, second in zip(motions[:14], motions[14:], strict=True):
        assert first.magnitude == second.magnitude or math.isnan(first.magnitude)
        assert second.center == (None if first.center is None else first.center + 14)


# -- pictures that give nothing ---------------------------------------------------------------

@pytest.mark.parametrize('image', [
    np.zeros((32, 32), np.uint8), np.full((300, 2000), 255, np.uint8),
    np.zeros((4, 4), np.uint8), np.zeros((1, 1), np.uint8),
    np.random.default_rng(0).integers(0, 255, (120, 160)).astype(np.uint8)])
def test_pictures_without_motion_give_no_turns(image):
    estimator = MotionEstimator(TrackingConfig())
    for index in range(12):
        motion = estimator.push(Frame(index, index * 10**8, image))
        assert not motion.magnitude > 0
    assert estimator.valid() is None


def test_noise_alone_is_no_motion():
    rng = np.random.default_rng(0)
    estimator = MotionEstimator(TrackingConfig())
    for index in range(12):
        image = rng.integers(0, 255, (120, 160)).astype(np.uint8)
        assert not estimator.push(Frame(index, index * 10**8, image)).magnitude > 0


def test_user_mask_must_fit_and_hides(stopping_frames):
    wrong = MotionEstimator(TrackingConfig(), valid=np.ones((270, 479), bool))
    frame = stopping_frames[0]
    with refused(InputError, 'E-MASK-SIZE', '479x270', '480x270'):
        wrong.push(frame)
    valid = np.zeros((270, 480), bool)
    valid[:, :200] = True
    estimator = MotionEstimator(TrackingConfig(), valid=valid)
    assert estimator.push(frame).points == 0
    assert len(estimator._xy) > 0 and estimator._xy[:, 0].max() < 202
    assert np.array_equal(estimator.valid(), valid)


# -- drives -----------------------------------------------------------------------------------

def detect(frames, config=None):
    config = config or Config()
    estimator = MotionEstimator(config.tracking, config.mask)
    detector = TurnDetector(config.turns)
    motions = []
    for frame in frames:
        motion = estimator.push(frame)
        if motion is not None:
            motions.append(motion)
            detector.push(frame, motion)
    detector.finish()
    return motions, detector


@pytest.fixture(scope='module')
def stopping() -> Drive:
    return Drive(LENS, DriveSpec(turns=(Turn(80.0, 10.0),), stops=(Stop(0, 4.0),), seed=3,
                                 moving_cars=3, bonnet=True))


@pytest.fixture(scope='module')
def stopping_frames(stopping):
    return list(stopping.frames())


def test_rendered_turn_is_found_and_the_stop_is_seen(stopping, stopping_frames):
    motions, detector = detect(stopping_frames)
    turn, = detector.bank.turns()
    assert abs(turn.center - stopping.turn_centers[0]) <= 5
    assert turn.prominence > 0.03
    step = np.linalg.norm(np.diff(stopping.poses[:, :3, 3], axis=0), axis=1)
    still = {int(i) + 1 for i in np.flatnonzero(step < 1e-3)}
    moving = {int(i) + 1 for i in np.flatnonzero(step > 0.1)}
    seen = {motion.index for motion in motions if motion.standing}
    # cars cross meanwhile; the triplet's ends blur the beginning and the end
    assert len(still & seen) >= len(still) - 4
    assert not moving & seen
    assert all(motion.magnitude == 0 for motion in motions if motion.standing)


def test_same_input_same_motion(stopping_frames):
    first, _ = detect(stopping_frames[60:90])
    second, _ = detect(stopping_frames[60:90])
    assert str(first) == str(second)


def test_size_of_the_picture_hardly_matters(stopping, stopping_frames):
    """Magnitudes are relative to the width, whatever is tracked on."""
    part = stopping_frames[stopping.turn_centers[0] - 25:][:40]
    whole, _ = detect(part)
    small, _ = detect(part, Config().replace({'tracking.width': 240}))
    a, b = (np.array([m.magnitude for m in ms if m.center]) for ms in (whole, small))
    assert np.nanmedian(np.abs(a - b)) < 0.02 * np.nanmax(a)


def test_a_triplet_is_measured_once_a_spacing(stopping_frames, monkeypatch):
    """Triplets at each image cost three times as much; a magnitude holds until the next one."""
    asked = Mock(wraps=epipoles_of)
    monkeypatch.setattr(estimator_module, 'epipoles_of', asked)
    motions, _ = detect(stopping_frames[:40])
    of_triplets = [m.magnitude for m in motions if m.center is not None and not m.standing]
    assert asked.call_count <= 2 * len(of_triplets) / 3 + 3
    for begin in range(0, len(of_triplets) - 2, 3):
        assert len(set(of_triplets[begin:begin + 3])) == 1
    # a slow camera has one triplet for each image
    slow, _ = detect(stopping_frames[:40:4])
    values = [m.magnitude for m in slow if m.center is not None and not m.standing]
    assert len(set(values)) == len(values) > 3


def test_straight_drive_has_no_turns():
    drive = Drive(LENS, DriveSpec(turns=0, duration_s=6.0, moving_cars=3, seed=6))
    motions, detector = detect(drive.frames())
    assert len(motions) > 50
    assert detector.bank.turns() == ()
    assert not any(motion.standing for motion in motions)


@pytest.mark.parametrize('night', [False, True])
def test_parked_car_stands(stopping, night):
    drive = Drive(LENS, DriveSpec(kind='parked', duration_s=3.0, moving_cars=4, seed=2,
                                  turns=stopping.spec.turns, night=night))
    drive.__dict__['town'] = stopping.town
    motions, detector = detect(drive.frames())
    # before there is a triplet, points that jitter in the dark may go somewhere
    assert np.mean([motion.standing for motion in motions[6:]]) > 0.9
    assert detector.bank.turns() == () and detector.magnitude == 0


@pytest.mark.skipif(not KITTI.exists(), reason=f'no real drive at {KITTI}')
def test_kitti03_sharp_turn_is_found():
    frames = (frame for frame in open_frames(str(KITTI)) if frame.index < 260)
    _, detector = detect(frames)
    best = detector.bank.turns()[0]
    assert abs(best.center - 88) <= 8
    assert best.prominence > 0.03
    assert {66, 108} <= {frame.index for frame in best.frames}
