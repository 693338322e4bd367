# SPDX-License-Identifier: Apache-2.0
"""Whether a stream has the images of two cameras: what thinning leaves out is looked at."""
from __future__ import annotations

from contextlib import suppress

import cv2
import numpy as np
import pytest
from refused import refused
from synthetic import rotation

from dashcalib_ros.config import Config
from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.demo.spec import Stop, Turn
from dashcalib_ros.detect.detection import Detection, detect
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.stamps import StampGate
from dashcalib_ros.judge.conclude import conclude, evidence_of_detection

LENS = Lens.of(320, 180, 75.0, -0.30, 0.10)
MIDDLE = np.array([159.5, 89.5])


def zoomed(factor):
    def other(image):
        matrix = np.hstack([factor * np.eye(2), ((1 - factor) * MIDDLE)[:, None]])
        return cv2.warpAffine(image, matrix, image.shape[::-1], borderMode=cv2.BORDER_REFLECT)
    return other


def turned(image):
    matrix = LENS.matrix @ rotation(1, np.radians(3.0)) @ np.linalg.inv(LENS.matrix)
    return cv2.warpPerspective(image, matrix, image.shape[::-1], borderMode=cv2.BORDER_REFLECT)


def mirrored(image):
    return np.ascontiguousarray(image[:, ::-1])


def black(image):
    return np.full_like(image, 3)


@pytest.fixture(scope='module')
def pictures():
    """Return a sharp turn on a bad road, with a stop, a rolling shutter and traffic, at 30 Hz."""
    spec = DriveSpec(rate=30, turns=(Turn(90.0, 8.0),), straight_m=20.0, lead_m=25.0,
                     vibration_deg=0.8, rolling_shutter_ms=30.0, moving_cars=3,
                     stops=(Stop(1, 2.0),), seed=3)
    return [frame.image for frame in Drive(LENS, spec).frames()]


def frames(pictures, pattern='A', other=None, rate=30.0):
    """Return the drive's images; those that the pattern calls B are of the other camera."""
    return [Frame(n, round(n * 1e9 / rate), image if pattern[n % len(pattern)] == 'A'
                  else other(image)) for n, image in enumerate(pictures)]


@pytest.mark.parametrize(('pattern', 'rate', 'other', 'says'), [
    ('AB', 20.0, zoomed(1.1), '10.0 % larger'), ('AB', 20.0, zoomed(0.95), '5.0 % smaller'),
    ('AB', 20.0, zoomed(1.03), 'the same view 3.'), ('AB', 20.0, mirrored, 'another view'),
    ('AB', 20.0, turned, 'another mounting'), ('ABA', 30.0, zoomed(1.1), '10.0 % larger'),
    ('ABA', 30.0, mirrored, 'another view'), ('AAB', 30.0, mirrored, 'another view')])
def test_two_cameras_are_told(pictures, pattern, rate, other, says):
    found = detect(frames(pictures, pattern, other, rate), Config())
    assert found.mixed and says in str(found.other_camera), found.other_camera
    assert [each.code for each in found.warnings()] == ['E-TWO-CAMERAS']


@pytest.mark.parametrize('pattern', ['B' * 40 + 'A' * 400, 'AB' * 20 + 'A' * 400])
def test_pictures_that_are_mirrored_before_the_first_turn_are_seen(pictures, pattern):
    """No image is skipped, and no turn has any of them."""
    found = detect(frames(pictures[::3], pattern, mirrored, 10.0), Config())
    first = pattern.index('BA' if pattern[0] == 'B' else 'AB') + 1
    assert f'image {first} is mirrored' in str(found.other_camera)
    assert [each.code for each in found.warnings()] == ['E-TWO-CAMERAS']


def test_another_view_before_the_first_turn_is_named(pictures):
    """As where the pictures of two cameras were exchanged; missing images have a gap in time."""
    ten = frames(pictures[::3], rate=10.0)
    shown = [Frame(n, frame.stamp_ns, ten[-1 - n].image if n < 20 else frame.image)
             for n, frame in enumerate(ten)]
    [warning] = detect(shown, Config()).warnings()
    assert warning.code == 'E-VIEW-JUMPS' and 'image 20 ' in str(warning)
    gap = [Frame(n, frame.stamp_ns + 10**9 * (n >= 20), frame.image)
           for n, frame in enumerate(shown)]
    assert detect(gap, Config()).warnings() == () == detect(ten, Config()).warnings()


def test_they_are_refused(pictures):
    found = detect(frames(pictures, 'AB', zoomed(1.1), 20.0), Config())
    calibration = conclude(None, evidence_of_detection(found), Config())
    assert calibration.verdict.level == 'refused'
    assert calibration.verdict.codes[0] == 'E-TWO-CAMERAS' and not calibration.warnings


def repeated(pictures):
    return [pictures[n - n % 2] for n in range(len(pictures))]


def blended(pictures):
    """Return every second image mixed from those around it, as converters of rates do."""
    return [image if n % 2 == 0 or n + 1 == len(pictures) else
            cv2.addWeighted(pictures[n - 1], 0.5, pictures[n + 1], 0.5, 0.0)
            for n, image in enumerate(pictures)]


@pytest.mark.parametrize('change', [list, repeated, blended, lambda all_: all_[::-1]])
@pytest.mark.parametrize('rate', [20.0, 30.0])
def test_one_camera_is_not_doubted(pictures, change, rate):
    found = detect(frames(change(pictures), rate=rate), Config())
    assert found.other_camera is None and not found.warnings()


def test_lost_images_late_stamps_and_black_images_are_not_doubted(pictures):
    rng = np.random.default_rng(0)
    sound = frames(pictures)
    for stream in ([frame for frame in sound if rng.random() > 0.4],
                   [Frame(n, frame.stamp_ns + int(rng.integers(15_000_000)), frame.image)
                    for n, frame in enumerate(sound)],
                   frames(pictures, 'AB', black, 20.0)):
        assert detect(stream, Config()).other_camera is None


@pytest.mark.thorough
def test_it_ends_with_the_second_camera(pictures):
    found = Detection(Config())
    both = frames(pictures, 'AB', mirrored, 20.0)
    one = frames(pictures, rate=20.0)
    for lap, stream in enumerate([both, one, one]):
        for n, frame in enumerate(stream):
            found.push(Frame(n, frame.stamp_ns + lap * 10**9 * len(both) // 20, frame.image))
        assert found.mixed == (lap == 0) or lap == 1
    # the verdict on what was seen stays
    assert found.other_camera is not None


@pytest.mark.thorough
@pytest.mark.parametrize(('rate', 'pattern'), [(20.0, 'AB'), (30.0, 'ABA'), (60.0, 'ABBAA')])
def test_the_node_sees_what_the_command_sees(pictures, rate, pattern):
    """The node thins the images before they are decoded: one a second more is let through."""
    both = frames(pictures * 2, pattern, mirrored, rate)
    gate, live = StampGate(Config().tracking.rate), Detection(Config())
    passed = [frame for frame in both if gate.take(frame.stamp_ns + 1, 0) is not None]
    for frame in passed:
        live.push(frame)
    used = both[-1].stamp_ns / 1e9 * Config().tracking.rate
    assert len(passed) < 1.4 * used
    assert live.other_camera == detect(both, Config()).other_camera is not None


def beside(image):
    """Return what the other camera of a pair sees: shifted, darker, with noise of its own."""
    noise = np.random.default_rng(int(image[90, 160])).normal(0, 3, image.shape)
    return np.clip(0.9 * np.roll(image, -10, 1) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(('stack', 'crop'), [(np.hstack, 'crop=iw/2:ih:0:0'),
                                             (np.vstack, 'crop=iw:ih/2:0:0')])
def test_two_pictures_in_one_are_named(pictures, stack, crop):
    detection = Detection(Config())
    drive = iter(frames([stack([image, beside(image)]) for image in pictures]))
    with refused(InputError, 'E-TWO-PICTURES', crop):
        for frame in drive:
            detection.push(frame)
    assert detection.seconds < 12
    for frame in drive:  # a live stream goes on
        with suppress(InputError):
            detection.push(frame)
    assert detection.finish() == [] and detection.turns() == ()


@pytest.mark.parametrize('stack', [np.hstack, np.vstack])
def test_two_pictures_of_different_views_are_no_pair(pictures, stack):
    detect(frames([stack([image, mirrored(image)]) for image in pictures]), Config())
