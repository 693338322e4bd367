# SPDX-License-Identifier: Apache-2.0
"""Cameras compared by what they do: the mapping error, its derivatives, one lens in two models."""
from __future__ import annotations

import numpy as np
import pytest

from dashcalib_ros.camera import Brown, Camera, Fisheye, Radial
from dashcalib_ros.camera.mapping import as_model, mapping_error, sensitivity, unseen_share

SIZE = (1280, 720)
RADIAL = Radial(SIZE, 1100.0, 1103.0, 652.0, 350.0, -0.30, 0.09)
BROWN = Brown(SIZE, 700.0, 703.0, 652.0, 350.0, -0.30, 0.09, 0.002, -0.003, -0.01)
# the corners are 62 and 117 degrees off the axis
FISHEYE = Fisheye(SIZE, 700.0, 703.0, 652.0, 350.0, -0.03, 0.01, -0.004, 0.001)
ROUND = Fisheye(SIZE, 390.0, 391.0, 630.0, 365.0, -0.02, 0.004, -0.002, 0.0003)
CAMERAS: dict[str, Camera] = {'radial': RADIAL, 'brown': BROWN, 'fisheye': FISHEYE, 'round': ROUND}


def rms(moved: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(moved**2, -1))))


@pytest.mark.parametrize('name', CAMERAS)
def test_sensitivity_is_the_mapping_error_of_a_small_change(name):
    camera = CAMERAS[name]
    by_params, pixels = sensitivity(camera)
    assert by_params.shape == (len(pixels), 2, len(camera.names())) and len(pixels) == 25 * 15
    for n in range(len(camera.params)):
        # so much that the picture moves by 0.01 px or more, of which a rotation hides the most
        change = np.zeros(len(camera.params))
        change[n] = 0.05 if n < 4 else 1e-4
        expected = rms(by_params @ change)
        found = mapping_error(camera.with_params(camera.params + change), camera)
        assert found == pytest.approx(expected, rel=0.02, abs=1e-5), camera.names()[n]


def test_a_shift_of_the_centre_is_mostly_a_rotation():
    by_params, _ = sensitivity(RADIAL)
    index = RADIAL.names().index('cx')
    # 1 px of cx moves each pixel by 1 px; a pan of the camera undoes most of it
    assert 0.02 < rms(by_params[:, :, index]) < 0.5
    # a rotation does not look like another focal length
    assert rms(by_params[:, :, 0]) > 0.2


def test_only_pixels_with_a_ray_count():
    folded = Radial(SIZE, 700.0, 700.0, 639.5, 359.5, -0.6)
    by_params, pixels = sensitivity(folded)
    assert 0 < len(pixels) < 25 * 15 and np.isfinite(by_params).all()


def test_a_wider_model_of_the_same_family_is_the_same_camera():
    brown = as_model(RADIAL, Brown)
    assert type(brown) is Brown
    np.testing.assert_allclose(brown.params, [*RADIAL.params, 0, 0, 0], rtol=1e-9, atol=1e-12)
    again = as_model(brown, Radial)
    assert type(again) is Radial
    np.testing.assert_allclose(again.params, RADIAL.params, rtol=1e-9, atol=1e-12)
    assert as_model(ROUND, Fisheye) == ROUND


def test_a_pinhole_s_lens_as_a_fisheye():
    narrow = Radial(SIZE, 1100.0, 1100.0, 645.0, 355.0, -0.1, 0.02)  # 60 degrees across
    fisheye = as_model(narrow, Fisheye)
    assert type(fisheye) is Fisheye
    assert mapping_error(fisheye, narrow) < 0.01
    # in every model fx is the scale on the axis
    np.testing.assert_allclose(fisheye.params[:4], narrow.params[:4], rtol=1e-3)


def test_a_fisheye_s_lens_as_a_pinhole():
    brown = as_model(FISHEYE, Brown)
    assert mapping_error(brown, FISHEYE) < 3.0
    # a model with fewer coefficients is no better
    assert mapping_error(as_model(FISHEYE, Radial), FISHEYE) >= mapping_error(brown, FISHEYE)


def test_what_a_camera_cannot_see_is_left_out_and_told():
    pinhole = Radial(SIZE, 390.0, 391.0, 630.0, 365.0)
    rays = ROUND.rays(np.stack(np.meshgrid(np.linspace(0, 1279, 25), np.linspace(0, 719, 15)), -1))
    beyond = np.mean(rays[..., 2] < np.cos(np.radians(88.0)))
    assert unseen_share(pinhole, ROUND) == pytest.approx(beyond) and 0.1 < beyond < 0.4
    assert unseen_share(ROUND, ROUND) == unseen_share(ROUND, pinhole) == 0.0
    assert mapping_error(pinhole, ROUND) > 100
    # the other way round everything is seen
    assert mapping_error(ROUND, pinhole) > 10
    assert mapping_error(ROUND, ROUND) == pytest.approx(0.0, abs=1e-9)
