# SPDX-License-Identifier: Apache-2.0
"""How a camera bends straight lines: made lines, whose truth is known."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_calibration import EACH_MODEL
from made_lines import made_lines

from dashcalib_ros.camera import Radial
from dashcalib_ros.detect import Bend, Lines, bend
from dashcalib_ros.detect.edges import KNOTS

CAMERA = Radial((1242, 375), 721.5, 724.2, 609.6, 172.9, -0.363, 0.151)


@pytest.mark.parametrize('model', EACH_MODEL)
def test_the_true_camera_leaves_lines_straight(model):
    camera = EACH_MODEL[model]
    away = [found.k1 / found.sigma for seed in range(8)
            if (found := bend(made_lines(camera, seed=seed), camera)) is not None]
    assert len(away) == 8 and np.sqrt(np.mean(np.square(away))) < 1.6
    assert np.max(np.abs(away)) < 3.5


@pytest.mark.parametrize('off', [0.02, -0.02])
@pytest.mark.parametrize('model', EACH_MODEL)
def test_lines_ask_for_the_true_k1_back(model, off):
    camera = EACH_MODEL[model]
    found = bend(made_lines(camera, noise_px=0.05), replace(camera, k1=camera.k1 + off))
    assert found.k1 == pytest.approx(-off, abs=4 * found.sigma + 0.1 * abs(off))
    assert found.sigmas > 4
    assert found.picture_px > 0.3


def test_a_wrong_distortion_bends_lines_more():
    lines = made_lines(CAMERA)
    true, wrong = (bend(lines, replace(CAMERA, k1=k1)) for k1 in (CAMERA.k1, CAMERA.k1 + 0.1))
    assert 0.07 < true.bend_px < 0.13 and wrong.bend_px > 1.5 * true.bend_px


def test_curved_lines_hardly_count():
    straight = bend(made_lines(CAMERA), CAMERA)
    mixed = bend(made_lines(CAMERA, curved=0.5), CAMERA)
    assert abs(mixed.k1) < 3 * mixed.sigma and mixed.sigma < 4 * straight.sigma


def test_leaning_lines_do_not_count():
    upright, leaning = (bend(made_lines(CAMERA, lean_deg=lean), CAMERA) for lean in (1.0, 25.0))
    assert leaning.lines < 0.7 * upright.lines


def test_many_pictures_of_the_same_lines_are_no_better_than_one():
    once = made_lines(CAMERA)
    again = Lines(np.concatenate([once.points] * 9),
                  np.concatenate([once.stamps_s // 5 * 5 + 0.5 * n for n in range(9)]))
    one, nine = bend(once, CAMERA), bend(again, CAMERA)
    assert nine.lines == 9 * one.lines and nine.groups == one.groups
    assert nine.sigma == pytest.approx(one.sigma, rel=1e-6)


def test_the_camera_s_own_sigma_counts_where_it_bends_lines():
    lines, count = made_lines(CAMERA), len(CAMERA.names())
    of_k1, of_fx = np.zeros((count, count)), np.zeros((count, count))
    of_k1[4, 4], of_fx[0, 0] = 0.01**2, 5.0**2
    assert bend(lines, CAMERA).camera_sigma is None
    assert bend(lines, CAMERA, covariance=of_k1).camera_sigma == pytest.approx(0.01)
    # without distortion, a focal length alone bends nothing
    plain = CAMERA.without_distortion()
    assert bend(made_lines(plain), plain, covariance=of_fx).camera_sigma < 1e-6
    assert bend(lines, CAMERA, covariance=of_fx).camera_sigma > 1e-3


@pytest.mark.parametrize('lines', [
    Lines(np.zeros((0, KNOTS, 2), np.float32), np.zeros(0)),
    made_lines(CAMERA, 15),
    Lines(made_lines(CAMERA).points, np.zeros(len(made_lines(CAMERA)))),
    Lines(made_lines(CAMERA).points * np.float32(np.nan), made_lines(CAMERA).stamps_s)],
    ids=['none', 'few', 'one moment', 'not a number'])
def test_too_few_lines_tell_nothing(lines):
    assert bend(lines, CAMERA) is None


def test_lines_through_the_middle_tell_nothing_but_do_no_harm():
    camera = Radial((1242, 375), 721.0, 721.0, 600.0, 187.0)
    points = np.full((200, KNOTS, 2), 600.0, np.float32)
    points[:, :, 1] = np.linspace(50, 300, KNOTS)
    middle = Lines(points, np.arange(200) / 2.0)
    others = made_lines(camera)
    both = Lines(np.concatenate([others.points, points]),
                 np.concatenate([others.stamps_s, middle.stamps_s]))
    found, alone = bend(both, camera), bend(others, camera)
    assert found.k1 == pytest.approx(alone.k1) and np.isfinite(found.sigma)


def test_what_the_camera_cannot_see_is_left_out():
    lines = made_lines(CAMERA)
    folding = replace(CAMERA, k1=-0.5, k2=0.0)
    assert bend(lines, folding).lines < bend(lines, CAMERA).lines


@pytest.mark.parametrize('k1', [-0.33, -0.45, -0.8, 5.0])
def test_a_camera_that_is_far_off_raises_nothing(k1):
    """It may fold over in the middle of the lines: numbers for the others, or None."""
    found = bend(made_lines(CAMERA), replace(CAMERA, k1=k1, k2=0.0))
    assert found is None or np.isfinite([found.k1, found.sigma, found.bend_px]).all()


def test_the_order_of_lines_does_not_matter():
    lines = made_lines(CAMERA)
    turned = Lines(lines.points[::-1], lines.stamps_s[::-1])
    assert bend(turned, CAMERA).k1 == pytest.approx(bend(lines, CAMERA).k1, abs=1e-9)


def test_pixels_are_those_of_the_input():
    found = Bend(100, 9, 0.2, 0.01, 0.002, 0.001, 3.0)
    assert found.resized(2.0) == replace(found, bend_px=0.4, picture_px=6.0)
    assert found.sigmas == pytest.approx(0.01 / np.hypot(0.002, 0.001))
    assert replace(found, camera_sigma=None).sigmas == pytest.approx(5.0)


def test_a_long_drive_has_no_more_groups():
    lines = made_lines(CAMERA, 1500)
    apart = replace(lines, stamps_s=1000.0 * lines.stamps_s)
    near, far = (bend(each, CAMERA) for each in (lines, apart))
    assert near.groups == 15 and far.groups == 40
    assert far.k1 == near.k1 and 0.5 < far.sigma / near.sigma < 2.0


def test_longer_groups_are_fewer():
    lines = made_lines(CAMERA)
    long, short = (bend(lines, CAMERA, group_s=s) for s in (5.0, 1.0))
    assert short.groups > 3 * long.groups
