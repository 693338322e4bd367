# SPDX-License-Identifier: Apache-2.0
"""Whether an image follows the one before, on points that are projected exactly."""
from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic import rotation

from dashcalib_ros.config import TrackingConfig
from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.detect import MotionEstimator
from dashcalib_ros.detect.continuity import goes_on
from dashcalib_ros.input import Frame

SIZE = np.array([640, 360])
FOCAL = 420.0
# all points followed, as in the images before
ALL = 1.0, 1.0
LENS = Lens.of(320, 180, 75.0, -0.30, 0.10)


def seen(steps, shake_deg=0.0, yaw_deg=0.0, noise=0.1, seed=0):
    """Return (3, n, 2) where points are seen that all three images show.

    steps: m between the images. yaw_deg: from one image to the next, as long as the first of the
    steps. shake_deg: RMS of the camera's three angles.
    """
    rng = np.random.default_rng(seed)
    world = rng.uniform((-12, -4, 4), (12, 4, 50), (600, 3))
    at, yaw, images = 0.0, 0.0, []
    for step in (0.0, *steps):
        at, yaw = at + step, yaw + yaw_deg * (step / steps[0] if steps[0] else 0.0)
        turned = rotation(1, np.radians(yaw))
        for axis in range(3):
            turned = turned @ rotation(axis, np.radians(rng.normal(0.0, shake_deg)))
        local = (world - (0, 0, at)) @ turned
        images.append(np.where(local[:, 2:] > 1, FOCAL * local[:, :2] / local[:, 2:] + SIZE / 2,
                               np.nan) + rng.normal(0.0, noise, (len(world), 2)))
    inside = np.all([(xy > 0).all(1) & (xy < SIZE).all(1) for xy in images], axis=0)
    return np.array(images, np.float32)[:, inside]


@pytest.mark.parametrize('yaw_deg', [0.0, 2.0, -4.0])
@pytest.mark.parametrize('shake_deg', [0.0, 0.5])
@pytest.mark.parametrize('speed', [0.3, 1.0, 2.5])
def test_the_step_tells_what_is_lost(speed, shake_deg, yaw_deg):
    def answer(factor):
        return goes_on(*seen([speed, factor * speed], shake_deg, yaw_deg), *ALL)

    # a car brakes or gathers speed by less than that within a tenth of a second
    assert answer(0.85) and answer(1.0) and answer(1.15)
    for factor in (2.0, 3.0, 4.0, -1.0, -3.0):  # images lost, or shown once more
        assert not answer(factor)
    assert not goes_on(*seen([speed, 0.0], 0.0, yaw_deg), *ALL)  # the same image again


def test_a_standing_car():
    for shake in (0.0, 0.05):
        assert goes_on(*seen([0.0, 0.0], shake), *ALL)
        assert goes_on(*seen([0.0, 0.02], shake), *ALL)
        assert not goes_on(*seen([0.0, 1.5], shake), *ALL)
        assert not goes_on(*seen([1.0, 0.0], shake), *ALL)


def test_other_cars_do_not_decide():
    points = seen([1.0, 1.0])
    points[2, :len(points[2]) // 4] += (15.0, 3.0)
    assert goes_on(*points, *ALL)
    points = seen([1.0, 3.0])
    points[2, :len(points[2]) // 4] = 2 * points[1, :len(points[2]) // 4] - points[
        0, :len(points[2]) // 4]
    assert not goes_on(*points, *ALL)


def test_too_little_is_seen():
    points = seen([1.0, 1.0])
    assert goes_on(*points, 0.5, 0.7) and not goes_on(*points, 0.4, 0.7)
    assert goes_on(*points, 0.3, 0.3) and not goes_on(*points, 0.2, 0.2)
    assert not goes_on(*points[:, :29], *ALL) and not goes_on(*points[:, :0], *ALL)
    rng = np.random.default_rng(3)
    for _ in range(20):
        assert not goes_on(*points[:2], rng.uniform((0, 0), SIZE, points[2].shape), *ALL)


def test_points_that_are_all_the_same():
    same = np.full((3, 40, 2), 100.0, np.float32)
    assert goes_on(*same, *ALL)


# -- in the estimator -------------------------------------------------------------------------

STEP = 100_000_000


def motions(frames, joints=(), first=0, step_ns=STEP):
    """Return the motions; images at these positions are perhaps after a gap."""
    estimator = MotionEstimator(TrackingConfig())
    return [estimator.push(Frame(first + n, (first + n) * step_ns, frame.image,
                                 perhaps_after_gap=n in joints))
            for n, frame in enumerate(frames)]


def values(found):
    """Return what tells motions apart; NaN is equal to NaN."""
    return [each and dataclasses.astuple(each) for each in found]


@pytest.fixture(scope='module')
def frames():
    """A drive that turns from about the 14th image on."""
    spec = DriveSpec(turns=1, lead_m=7.0, speed_mps=5.0, turn_speed_mps=5.0, seed=4)
    return list(Drive(LENS, spec).frames(0, 36))


def test_files_that_go_on_are_as_one(frames):
    """Wherever the drive is cut, also in the turn; two images cannot tell yet."""
    whole = motions(frames)
    np.testing.assert_equal(values(motions(frames, range(3, 36))), values(whole))
    assert not any(motion.after_gap for motion in whole)
    found = motions(frames[:6], [1, 2])
    assert [motion.after_gap for motion in found] == [False, True, True, False, False, False]


@pytest.mark.parametrize('lost', [2, 5, 14])
@pytest.mark.parametrize('at', [6, 20])
def test_a_loss_is_a_gap(frames, at, lost):
    rest = frames[at + lost:]
    found = motions(frames[:at] + rest, [at])
    assert [motion.after_gap for motion in found] == [n == at for n in range(len(found))]
    # as if the drive began there
    begun = [dataclasses.replace(each, after_gap=n == 0)
             for n, each in enumerate(motions(rest, first=at))]
    np.testing.assert_equal(values(found[at:]), values(begun))


def test_the_first_image_of_a_file_may_be_skipped(frames):
    """As the camera is faster than tracking.rate: the next image answers."""
    whole = motions(frames, step_ns=STEP // 3)
    assert sum(motion is not None for motion in whole) == 12
    for at in (12, 13, 14):
        np.testing.assert_equal(values(motions(frames, [at], step_ns=STEP // 3)), values(whole))
        found = motions(frames[:at] + frames[at + 9:], [at], step_ns=STEP // 3)
        gaps = [motion.index for motion in found if motion is not None and motion.after_gap]
        assert gaps == [12 if at == 12 else 15]


def test_a_known_gap_is_one_whatever_the_pictures_show(frames):
    estimator = MotionEstimator(TrackingConfig())
    found = [estimator.push(dataclasses.replace(
        frame, after_gap=frame.index == 8, perhaps_after_gap=frame.index == 8))
        for frame in frames[:12]]
    assert [motion.index for motion in found if motion.after_gap] == [8]


def test_a_standing_car_goes_on_until_the_picture_changes(frames):
    rng = np.random.default_rng(1)
    images = [frames[n].image for n in [0] * 8 + [30] * 4]
    noisy = [np.clip(image + rng.normal(0.0, 1.0, image.shape), 0, 255).astype(np.uint8)
             for image in images]
    found = motions([dataclasses.replace(frames[0], image=image) for image in noisy], [4, 8])
    assert all(motion.moved_px < 1.0 for motion in found[2:8])
    assert [motion.index for motion in found if motion.after_gap] == [8]
