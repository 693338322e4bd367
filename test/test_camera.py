"""The camera model against OpenCV's, its inverse, and where it folds over."""
from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dashcalib_ros.reconstruction.camera import Camera

SIZE = (1280, 720)
BARREL = Camera(SIZE, 700.0, 703.0, 652.0, 350.0, -0.30, 0.09)
PINCUSHION = Camera(SIZE, 900.0, 897.0, 630.0, 371.0, 0.12, 0.05)
PINHOLE = Camera(SIZE, 650.0, 650.0, 639.5, 359.5)
# reaches a radius of 0.66 at k1 = -0.6 (fold at 0.745, distorted 0.497): the corners lie beyond
FOLDED = Camera(SIZE, 700.0, 700.0, 639.5, 359.5, -0.6, 0.0)
CAMERAS = {'barrel': BARREL, 'pincushion': PINCUSHION, 'pinhole': PINHOLE}


def pixels(camera: Camera) -> np.ndarray:
    width, height = camera.image_size
    x, y = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 19))
    return np.stack([x, y], axis=-1)


@pytest.mark.parametrize('name', CAMERAS)
def test_projects_as_opencv_does(name):
    camera = CAMERAS[name]
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.5, 60.0, 300)
    points = np.stack([rng.uniform(-0.9, 0.9, 300) * depth, rng.uniform(-0.5, 0.5, 300) * depth,
                       depth], axis=1)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix,
                                    np.array([camera.k1, camera.k2, 0, 0, 0]))
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)
    # any leading shape
    np.testing.assert_array_equal(camera.project(points.reshape(3, 100, 3)).reshape(-1, 2),
                                  camera.project(points))


@pytest.mark.parametrize('name', CAMERAS)
def test_rays_undo_project_all_over_the_picture(name):
    camera = CAMERAS[name]
    xy = pixels(camera)
    rays = camera.rays(xy)
    assert np.isfinite(rays).all()
    points = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1)
    np.testing.assert_allclose(camera.project(points), xy, atol=1e-3)
    # and the other way round: rays of a projection are the directions it came from
    np.testing.assert_allclose(camera.rays(camera.project(points * 7.0)), rays, atol=3e-6)


@given(fx=st.floats(300, 3000), aspect=st.floats(0.97, 1.03), k1=st.floats(-0.45, 0.4),
       k2=st.floats(-0.2, 0.3), x=st.floats(-0.5, 1279.5), y=st.floats(-0.5, 719.5))
@settings(max_examples=300, deadline=None, derandomize=True)
def test_rays_are_right_or_missing(fx, aspect, k1, k2, x, y):
    camera = Camera(SIZE, fx, fx * aspect, 645.0, 352.0, k1, k2)
    ray = camera.rays(np.array([x, y]))
    if np.isnan(ray).any():
        assert not camera.monotonic()
    else:
        np.testing.assert_allclose(camera.project(np.append(ray, 1.0)), [x, y],
                                   atol=1e-5 * fx)


def test_the_centre_is_straight_ahead_and_nan_stays_nan():
    rays = BARREL.rays(np.array([[BARREL.cx, BARREL.cy], [np.nan, np.nan]]))
    np.testing.assert_allclose(rays[0], 0.0, atol=1e-12)
    assert np.isnan(rays[1]).all()


def test_a_pixel_beyond_the_fold_has_no_ray():
    rays = FOLDED.rays(pixels(FOLDED))
    reached = np.isfinite(rays[..., 0])
    # r (1 - 0.6 r^2) has its maximum 0.4969 at r = 0.7454
    radius = np.linalg.norm((pixels(FOLDED) - [639.5, 359.5]) / 700.0, axis=-1)
    assert not reached[radius > 0.4971].any()
    assert reached[radius < 0.49].all()
    assert (np.linalg.norm(rays[reached], axis=-1) < 0.7455).all()


def test_monotonic():
    assert all(camera.monotonic() for camera in CAMERAS.values())
    assert not FOLDED.monotonic()
    # the same distortion is harmless behind a longer lens
    assert Camera(SIZE, 1600.0, 1600.0, 639.5, 359.5, -0.6, 0.0).monotonic()
    # one corner is enough: the principal point is off towards the other side
    near = Camera(SIZE, 1500.0, 1500.0, 639.5, 359.5, -0.6, 0.0)
    assert near.monotonic()
    assert not near.with_params([1500, 1500, 350, 300, -0.6, 0]).monotonic()
    # k2 < 0 folds even a pincushion
    assert not Camera(SIZE, 500.0, 500.0, 639.5, 359.5, 0.1, -0.3).monotonic()


def test_centred_is_in_the_middle_of_the_pixels():
    camera = Camera.centred((641, 480), 500.0, -0.1)
    assert (camera.cx, camera.cy) == (320.0, 239.5)
    assert (camera.fx, camera.fy, camera.k1, camera.k2) == (500.0, 500.0, -0.1, 0.0)
    left, right = camera.rays(np.array([[0.0, 239.5], [640.0, 239.5]]))
    np.testing.assert_allclose(left, -right, atol=1e-12)


def test_params_go_in_as_they_come_out():
    np.testing.assert_array_equal(BARREL.params, [700, 703, 652, 350, -0.30, 0.09])
    assert PINHOLE.with_params(BARREL.params) == BARREL
