# SPDX-License-Identifier: Apache-2.0
"""Upright edges in made pictures."""
from __future__ import annotations

import cv2
import numpy as np
import pytest

from dashcalib_ros.detect import LineCollector, Lines, edges
from dashcalib_ros.detect.edges import ENDS, KNOTS, upright_edges

FINE = 8


def picture(edge, size=(320, 240), top=40, bottom=200, noise=2.0, seed=0, levels=(60, 160)):
    """Draw a bright field to the right of edge(y) px, between two rows, as a camera would."""
    width, height = size
    x, y = (((np.arange(length * FINE) + 0.5) / FINE - 0.5) for length in size)
    bright = (x[None] > edge(y)[:, None]) & ((y > top) & (y < bottom))[:, None]
    fine = np.where(bright, levels[1], levels[0]).astype(np.float32)
    image = cv2.GaussianBlur(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    image += np.random.default_rng(seed).normal(0, noise, (height, width))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize('edge', [
    lambda y: 150.25 + 0 * y, lambda y: 120.0 + 0.5 * y, lambda y: 200.0 - 0.2 * y,
    lambda y: 150.0 + 8 * ((y - 120) / 80)**2], ids=['upright', 'leaning', 'back', 'curved'])
@pytest.mark.parametrize('levels', [(60, 160), (160, 60)], ids=['brighter', 'darker'])
def test_an_edge_is_found_to_a_fraction_of_a_pixel(edge, levels):
    points = upright_edges(picture(edge, levels=levels))
    assert points.shape == (1, KNOTS, 2) and points.dtype == np.float32
    x, y = points[0].T
    off = x - edge(y)
    assert abs(off.mean()) < 0.08 and off.std() < 0.06
    assert np.all(np.diff(y) > 0)
    assert y[0] > 40 + ENDS and y[-1] < 200 - ENDS


@pytest.mark.parametrize('image', [
    np.zeros((240, 320), np.uint8),
    np.random.default_rng(1).normal(128, 6, (240, 320)).astype(np.uint8),
    picture(lambda y: 150.0 + 0 * y, top=100, bottom=130),
    picture(lambda y: 150.0 + 2.0 * (y - 120)),
    picture(lambda y: 150.0 + 3 * np.sin(y / 4)),
    np.zeros((1, 1), np.uint8), np.zeros((3, 400), np.uint8), np.full((400, 2), 9, np.uint8)],
    ids=['black', 'noise', 'short', 'leaning too much', 'wavy', 'a pixel', 'flat', 'thin'])
def test_what_is_no_upright_smooth_edge_gives_nothing(image):
    assert upright_edges(image).shape == (0, KNOTS, 2)


def test_both_edges_of_a_pole_are_found():
    image = picture(lambda y: 150.0 + 0.1 * y)
    image[:, 180:] = picture(lambda y: 150.0 + 0.1 * y, levels=(160, 60))[:, 180:]
    pole = np.maximum(picture(lambda y: 140.0 + 0 * y), 0) // 2
    pole += picture(lambda y: 144.0 + 0 * y, levels=(160, 60)) // 2
    points = upright_edges(pole)
    assert sorted(points[:, :, 0].mean(axis=1)) == pytest.approx([140, 144], abs=0.3)


def test_lines_on_the_own_car_are_left_out():
    lines = Lines(upright_edges(picture(lambda y: 150.0 + 0 * y)), np.zeros(1))
    valid = np.ones((240, 320), bool)
    assert len(lines.within(None)) == len(lines.within(valid)) == 1
    valid[150:170] = False
    assert len(lines.within(valid)) == 0


def collected(count, step_s=0.1, beside=False, **changes):
    collector = LineCollector(beside=beside, **changes)
    images = [picture(lambda y, x=x: x + 0 * y) for x in (100.0, 130.0, 160.0)]
    for n in range(count):
        collector.push(images[n % 3], round(n * step_s * 1e9))
    return collector.lines()


@pytest.mark.parametrize('images', [100, 20])
def test_a_thread_beside_finds_the_same(images):
    now, beside = (collected(200, beside=each, images=images) for each in (False, True))
    np.testing.assert_array_equal(beside.stamps_s, now.stamps_s)
    np.testing.assert_array_equal(beside.points, now.points)


def test_what_the_thread_raises_is_not_lost(monkeypatch):
    def fails(image):
        raise MemoryError
    monkeypatch.setattr(edges, 'upright_edges', fails)
    with pytest.raises(MemoryError):
        collected(1, beside=True)


def test_a_picture_is_searched_now_and_then():
    np.testing.assert_allclose(collected(31).stamps_s, np.arange(7) * 0.5)


def test_a_long_drive_has_no_more_lines_than_a_short_one():
    stamps = collected(700, images=20).stamps_s
    assert len(stamps) <= 20 and stamps[0] == 0.0 and stamps[-1] > 60.0
    assert np.ptp(np.diff(stamps)) == 0.0


def test_a_clock_that_is_set_back_does_not_stop_the_search():
    collector, image = LineCollector(), picture(lambda y: 150.0 + 0 * y)
    for stamp_s in (100.0, 100.5, 3.0, 3.2, 3.5):
        collector.push(image, round(stamp_s * 1e9))
    assert collector.lines().stamps_s.tolist() == [100.0, 100.5, 3.0, 3.5]


def test_nothing_found_is_no_error():
    lines = LineCollector().lines()
    assert len(lines) == 0 and lines.points.shape == (0, KNOTS, 2)
    assert len(lines.within(np.ones((5, 5), bool))) == 0


def test_a_fence_has_its_longest_posts_only():
    x = np.arange(1280)
    image = np.tile(np.where(x % 8 < 4, 60, 180).astype(np.uint8), (120, 1))
    collector = LineCollector()
    collector.push(image, 0)
    assert len(upright_edges(image)) > 300 and len(collector.lines()) == 50
