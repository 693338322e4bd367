# SPDX-License-Identifier: Apache-2.0
"""Points are followed from image to image: far, in small pictures, with any number of threads."""
from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from dashcalib_ros.detect.points import (
    Tracking,
    corner_strength,
    find_corners,
    follow_points,
)

WIDTH, HEIGHT = 640, 360
NOTHING = np.zeros((0, 2), np.float32)
# with a pyramid, and with dense flow
BOTH = (Tracking(levels=4), Tracking())


@pytest.fixture
def threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    yield
    cv2.setNumThreads(before)


def street(width: int, height: int) -> np.ndarray:
    """Return a picture with details of many sizes."""
    noise = np.random.default_rng(9).normal(size=(height, width))
    layers = [cv2.GaussianBlur(noise, (0, 0), size) * size for size in (1.5, 4.0, 12.0, 40.0)]
    return np.clip(128 + 60 * np.sum(layers, axis=0), 0, 255).astype(np.uint8)


def shifted(by: float) -> tuple[np.ndarray, np.ndarray]:
    """Return two pictures; what is in the first is `by` px farther left and half of that lower."""
    picture = street(WIDTH + 200, HEIGHT + 400)

    def seen(x: float, y: float) -> np.ndarray:
        return cv2.getRectSubPix(picture, (WIDTH, HEIGHT), (x + WIDTH / 2, y + HEIGHT / 2))
    return seen(0, 150), seen(by, 150 - by / 2)


def test_corners_are_spread_apart_and_where_they_may_be():
    picture = street(WIDTH, HEIGHT)
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[250:, :300] = False
    corners = find_corners(picture, NOTHING, 400, valid)
    assert 300 < len(corners) <= 450
    x, y = np.rint(corners).astype(int).T
    assert valid[y, x].all()
    counts = np.histogram2d(y, x, bins=(3, 4), range=((0, 250), (300, WIDTH)))[0]
    assert counts.min() >= 5
    apart = np.linalg.norm(corners[:, None] - corners, axis=2) + 1e3 * np.eye(len(corners))
    assert apart.min() >= 4


def test_new_corners_are_added_where_points_are_missing():
    picture = street(WIDTH, HEIGHT)
    points = find_corners(picture, NOTHING, 400)
    # right of the middle all are lost, and a few elsewhere
    kept = points[(points[:, 0] < WIDTH / 2) & (np.arange(len(points)) % 10 > 0)]
    new = find_corners(picture, kept, 400)
    assert np.mean(new[:, 0] >= WIDTH / 2) > 0.8
    assert len(new) > 0.9 * (len(points) - len(kept))
    assert np.linalg.norm(new[:, None] - kept, axis=2).min() > 4


def test_corners_are_where_edges_meet():
    picture = np.full((90, 160), 60, np.uint8)
    picture[30:, 50:] = 200
    [corner] = find_corners(picture, NOTHING, 4)
    assert np.abs(corner - [49.5, 29.5]).max() <= 2


@pytest.mark.parametrize('shape', [(1, 1), (1, 640), (2, 2), (3, 5), (480, 640)])
def test_pictures_without_corners(shape):
    present = np.array([[0.4, 0.2]], np.float32)
    assert find_corners(np.full(shape, 7, np.uint8), present, 300).shape == (0, 2)


@pytest.mark.parametrize('tracking', BOTH)
@pytest.mark.parametrize('by', [0.0, 0.4, 7.0, 40.0])
def test_points_are_followed_near_and_far(tracking, by):
    before, after = shifted(by)
    points = find_corners(before, NOTHING, 400)
    inside = ((points > 70) & (points < [WIDTH - 70, HEIGHT - 70])).all(axis=1)
    moved, trusted = follow_points(before, after, points, tracking)
    assert trusted[inside].mean() > 0.95
    error = np.linalg.norm(moved - points - [-by, by / 2], axis=1)[inside & trusted]
    assert np.median(error) < 0.05 and np.percentile(error, 98) < 0.3


@pytest.mark.parametrize('shape', [(8, 8), (8, 400), (12, 900), (31, 128), (33, 2000), (2000, 16)])
def test_pictures_too_narrow_for_dense_flow_are_no_crash(shape):
    """OpenCV's dense flow raises or crashes the process in most of these."""
    picture = street(shape[1], shape[0])
    points = np.array([[3, 3], [shape[1] / 2, shape[0] / 2]], np.float32)
    moved, trusted = follow_points(picture, picture, points, Tracking(border=1))
    assert np.abs(moved - points)[trusted].max(initial=0) < 0.01


def test_the_number_of_threads_changes_nothing(threads):
    before, after = shifted(23.0)
    points = find_corners(before, NOTHING, 400)
    found = []
    for count in (1, 2, 5):
        cv2.setNumThreads(count)
        found.append(follow_points(before, after, points, Tracking()))
    for moved, trusted in found[1:]:
        np.testing.assert_array_equal(moved, found[0][0])
        np.testing.assert_array_equal(trusted, found[0][1])


@pytest.mark.parametrize('size', [(640, 360), (1242, 375), (414, 125)])
def test_the_strength_of_corners_does_not_depend_on_where_arrays_lie_in_memory(size):
    picture, rng, kept = street(*size), np.random.default_rng(0), []
    for noise in range(1, 21):
        noisy = np.clip(picture + rng.normal(0, noise, picture.shape), 0, 255).astype(np.uint8)
        found = set()
        for _ in range(12):
            # other arrays come and go, and move those that are made next
            kept.append(np.full(int(rng.integers(1000, 300000)), 1, np.uint8))
            if len(kept) > 20:
                kept.pop(int(rng.integers(20)))
            found.add(corner_strength(noisy).tobytes())
        assert len(found) == 1
