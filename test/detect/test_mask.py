# SPDX-License-Identifier: Apache-2.0
"""The ego-vehicle mask: what it covers of a rendered vehicle, and what it leaves alone."""
from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from dashcalib_ros.config import MaskConfig, TrackingConfig
from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.detect import MotionEstimator
from dashcalib_ros.detect.mask import EgoMask
from dashcalib_ros.input import Frame
from dashcalib_ros.input.inputs import open_frames

LENS = Lens.of(480, 270, 75.0, -0.30, 0.10, offset=(7.0, -4.0))
KITTI = Path(__file__).parents[3] / 'shared/data/kitti03/bag'


def observe(frames, valid=None, **mask):
    estimator = MotionEstimator(TrackingConfig(), MaskConfig(**mask), valid)
    for frame in frames:
        estimator.push(frame)
    return estimator.valid()


@pytest.fixture(scope='module')
def bare(shared_drive) -> list[Frame]:
    return [dataclasses.replace(frame, image=cv2.resize(
        frame.image, LENS.size, interpolation=cv2.INTER_AREA)) for frame in shared_drive.frames()]


def dressed(bare, **changes) -> tuple[list[Frame], Drive]:
    """Return the same drive behind a windscreen."""
    other = Drive(LENS, DriveSpec(**changes))
    frames = []
    for frame in bare:
        image = frame.image.astype(np.float32)
        other.overlay.apply(image, frame.stamp_ns)
        frames.append(dataclasses.replace(frame, image=np.clip(image, 0, 255).astype(np.uint8)))
    return frames, other


def test_bonnet_pillar_and_text_are_found(bare):
    frames, other = dressed(bare, bonnet=True, pillar=True, timestamp=True)
    hidden = ~observe(frames)
    truth = other.overlay.mask
    assert (hidden & truth).sum() > 0.9 * truth.sum()
    # the logo at the top, which is not in the overlay's mask
    assert hidden[8:16, 402:436].mean() > 0.7
    # cells reach a little beyond the vehicle
    assert hidden.mean() < truth.mean() + 0.12
    assert hidden[60:230, 100:].mean() < 0.02


def test_no_vehicle_no_mask(bare):
    valid = observe(bare)
    assert valid is None or valid.mean() > 0.99


def test_users_mask_adds_to_it(bare):
    frames, _ = dressed(bare, bonnet=True)
    user = np.ones((270, 480), bool)
    user[100:150, 200:300] = False
    both = observe(frames, user)
    assert not both[100:150, 200:300].any()
    assert not both[-8:, 60:420].any() and both[30:90].mean() > 0.98
    alone = observe(frames, user, enabled=False)
    assert np.array_equal(alone, user)
    assert observe(frames[:20], enabled=False) is None


def test_standing_and_straight_tell_nothing_above_the_horizon(bare):
    assert observe([dataclasses.replace(bare[0], index=i, stamp_ns=i * 10**8)
                    for i in range(60)]) is None
    street = Drive(LENS, DriveSpec(turns=0, duration_s=6.0, seed=4, timestamp=True))
    valid = observe(street.frames())
    assert valid is None or valid[:120].all()


def test_a_vehicle_that_hides_most_is_not_believed():
    """A mask of nearly everything would leave nothing to calibrate with."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (200, 320)).astype(np.uint8)
    mask = EgoMask((320, 200))
    before = rng.uniform((0, 0), (320, 200), (100, 2)).astype(np.float32)
    epipoles = np.array([[0.0, 0.0], [0.1, 0.0]])
    for _ in range(40):
        mask.push(image, before, before + np.float32([20, 0]), epipoles)
    assert mask.cells() is None


def test_static_patch_in_a_moving_world():
    rng = np.random.default_rng(1)
    world = rng.integers(0, 255, (200, 3000)).astype(np.uint8)
    mask = EgoMask((320, 200))
    before = rng.uniform((0, 0), (320, 200), (100, 2)).astype(np.float32)
    epipoles = np.array([[0.0, 0.0], [0.1, 0.0]])
    assert mask.cells() is None and mask.hidden((200, 320), 1) is None
    for k in range(40):
        image = world[:, 50 * k:50 * k + 320].copy()
        image[160:, 100:220] = world[160:, 100:220]
        mask.push(image, before, before + np.float32([20, 0]), epipoles)
    hidden = mask.hidden((200, 320), 1)
    assert hidden[164:196, 116:204].all()
    assert not hidden[:140].any() and not hidden[:, :80].any() and not hidden[:, 240:].any()
    # the same evidence for an image three times as large
    large = mask.hidden((601, 962), 3)
    assert large.shape == (601, 962) and large[164 * 3:196 * 3, 116 * 3:204 * 3].all()


@pytest.mark.skipif(not KITTI.exists(), reason=f'no real drive at {KITTI}')
def test_kitti03_shows_no_vehicle():
    valid = observe(frame for frame in open_frames(str(KITTI)) if frame.index < 260)
    assert valid is None or valid.mean() > 0.99


def test_a_flat_bonnet_is_known_by_its_shading():
    mask = EgoMask((480, 270))
    flat, ego = np.zeros(mask.grid, bool), np.zeros(mask.grid, bool)
    flat[-1, 6:24] = True
    ego[-1, :6] = ego[-1, 24:] = True  # of its outline, a tenth
    for stays, taken in ((0.0, False), (0.9, True)):
        assert np.array_equal(mask._flat_parts(flat, ego, np.full(mask.grid, stays)),
                              flat & taken)
    sky = np.roll(flat, (1, 6), (0, 1))
    assert sky[0, -1] and not mask._flat_parts(sky, ego, np.full(mask.grid, 0.9)).any()
    ego[-2, 6:24] = True
    assert np.array_equal(mask._flat_parts(flat, ego, np.zeros(mask.grid)), flat)
