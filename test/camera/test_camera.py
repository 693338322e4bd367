"""The camera model against OpenCV's, its inverse, and where it folds over."""
from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dashcalib_ros.camera import (
    MODELS,
    Brown,
    Camera,
    Radial,
    camera_from_ros,
    camera_of,
    ros_camera,
)
from dashcalib_ros.errors import InputError

SIZE = (1280, 720)
BARREL = Radial(SIZE, 700.0, 703.0, 652.0, 350.0, -0.30, 0.09)
PINCUSHION = Radial(SIZE, 900.0, 897.0, 630.0, 371.0, 0.12, 0.05)
PINHOLE = Radial(SIZE, 650.0, 650.0, 639.5, 359.5)
# reaches a radius of 0.66 at k1 = -0.6 (fold at 0.745, distorted 0.497): the corners lie beyond
FOLDED = Radial(SIZE, 700.0, 700.0, 639.5, 359.5, -0.6, 0.0)
DECENTRED = Brown(SIZE, 700.0, 703.0, 652.0, 350.0, -0.30, 0.09, 0.002, -0.003, -0.01)
CAMERAS: dict[str, Camera] = {
    'barrel': BARREL, 'pincushion': PINCUSHION, 'pinhole': PINHOLE, 'decentred': DECENTRED}


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
    named = camera.named
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), matrix,
        np.array([named.get(name, 0.0) for name in ('k1', 'k2', 'p1', 'p2', 'k3')]))
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
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(camera.project(rays), xy, atol=1e-3)
    # and the other way round: rays of a projection are the directions it came from
    np.testing.assert_allclose(camera.rays(camera.project(rays * 7.0)), rays, atol=3e-6)


@given(fx=st.floats(300, 3000), aspect=st.floats(0.97, 1.03), k1=st.floats(-0.45, 0.4),
       k2=st.floats(-0.2, 0.3), x=st.floats(-0.5, 1279.5), y=st.floats(-0.5, 719.5))
@settings(max_examples=300, deadline=None, derandomize=True)
def test_rays_are_right_or_missing(fx, aspect, k1, k2, x, y):
    camera = Radial(SIZE, fx, fx * aspect, 645.0, 352.0, k1, k2)
    ray = camera.rays(np.array([x, y]))
    if np.isnan(ray).any():
        assert not camera.covers_picture()
    else:
        np.testing.assert_allclose(camera.project(ray), [x, y],
                                   atol=1e-5 * fx)


def test_the_centre_is_straight_ahead_and_nan_stays_nan():
    rays = BARREL.rays(np.array([[BARREL.cx, BARREL.cy], [np.nan, np.nan]]))
    np.testing.assert_allclose(rays[0], [0.0, 0.0, 1.0], atol=1e-12)
    assert np.isnan(rays[1]).all()


def test_a_pixel_beyond_the_fold_has_no_ray():
    rays = FOLDED.rays(pixels(FOLDED))
    reached = np.isfinite(rays[..., 0])
    # r (1 - 0.6 r^2) has its maximum 0.4969 at r = 0.7454
    radius = np.linalg.norm((pixels(FOLDED) - [639.5, 359.5]) / 700.0, axis=-1)
    assert not reached[radius > 0.4971].any()
    assert reached[radius < 0.49].all()
    there = rays[reached]
    assert (np.linalg.norm(there[:, :2] / there[:, 2:], axis=-1) < 0.7455).all()


def test_covers_picture():
    assert all(camera.covers_picture() for camera in CAMERAS.values())
    assert not FOLDED.covers_picture()
    # the same distortion is harmless behind a longer lens
    assert Radial(SIZE, 1600.0, 1600.0, 639.5, 359.5, -0.6, 0.0).covers_picture()
    # one corner is enough: the principal point is off towards the other side
    near = Radial(SIZE, 1500.0, 1500.0, 639.5, 359.5, -0.6, 0.0)
    assert near.covers_picture()
    assert not near.with_params([1500, 1500, 350, 300, -0.6, 0]).covers_picture()
    # k2 < 0 folds even a pincushion
    assert not Radial(SIZE, 500.0, 500.0, 639.5, 359.5, 0.1, -0.3).covers_picture()


def test_centred_is_in_the_middle_of_the_pixels():
    camera = Radial.centred((641, 480), 500.0, -0.1)
    assert (camera.cx, camera.cy) == (320.0, 239.5)
    assert (camera.fx, camera.fy, camera.k1, camera.k2) == (500.0, 500.0, -0.1, 0.0)
    left, right = camera.rays(np.array([[0.0, 239.5], [640.0, 239.5]]))
    np.testing.assert_allclose(left, right * [-1, 1, 1], atol=1e-12)


def test_params_go_in_as_they_come_out():
    np.testing.assert_array_equal(BARREL.params, [700, 703, 652, 350, -0.30, 0.09])
    assert PINHOLE.with_params(BARREL.params) == BARREL


@pytest.mark.parametrize('name', CAMERAS)
def test_derivatives_are_those_of_the_projection(name):
    camera = CAMERAS[name]
    rng = np.random.default_rng(3)
    points = rng.uniform([-3, -2, 4], [3, 2, 9], (50, 3))
    by_params, by_point, found = camera.derivatives(points)
    np.testing.assert_allclose(found, camera.project(points), atol=1e-9)
    for n, value in enumerate(camera.params):
        step = 1e-6 * max(abs(value), 1.0)
        ahead, behind = (camera.with_params(camera.params + sign * step * np.eye(
            len(camera.params))[n]).project(points) for sign in (1, -1))
        np.testing.assert_allclose(by_params[:, :, n], (ahead - behind) / (2 * step), atol=1e-4)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        numeric = (camera.project(points + step) - camera.project(points - step)) / 2e-6
        np.testing.assert_allclose(by_point[:, :, axis], numeric, atol=1e-4)


def test_points_behind_the_camera_have_no_pixel():
    pixels = BARREL.project(np.array([[1.0, 1.0, -5.0], [0.0, 0.0, 0.0], [1.0, 1.0, 5.0]]))
    assert np.isnan(pixels[:2]).all() and np.isfinite(pixels[2]).all()


@pytest.mark.parametrize('model', MODELS.values(), ids=lambda model: model.model)
def test_parameters_go_to_colmap_and_back(model):
    params = np.arange(1.0, 1.0 + len(model.names()))
    values = model.step2.values(params)
    assert len(values) == model.step2.size
    assert values[model.step2.places[2]] == params[2] + 0.5  # COLMAP's pixel centres
    np.testing.assert_array_equal(model.step2.params(values), params)
    assert not values[model.step2.held].any()
    # one focal length: that of x
    single = model.step1.params(model.step1.values(params[:len(model.step1.places)]))
    assert single[0] == single[1] == params[0]


@pytest.mark.parametrize('name', CAMERAS)
def test_colmap_projects_as_we_do(name):
    pycolmap = pytest.importorskip('dashcalib_ros.reconstruction.colmap').pycolmap
    camera = CAMERAS[name]
    colmap = pycolmap.Camera(camera_id=1, model=camera.step2.name, width=SIZE[0], height=SIZE[1],
                             params=camera.step2.values(camera.params))
    points = np.random.default_rng(2).uniform([-3, -2, 4], [3, 2, 9], (40, 3))
    np.testing.assert_allclose(np.array(colmap.img_from_cam(points)) - 0.5,
                               camera.project(points), atol=1e-9)


@pytest.mark.parametrize('name', CAMERAS)
def test_ros_describes_the_same_camera(name):
    camera = CAMERAS[name]
    ros = ros_camera(camera)
    assert ros.distortion_model == 'plumb_bob' and len(ros.d) == 5 and len(ros.p) == 12
    again = camera_from_ros(SIZE, ros.distortion_model, ros.k, ros.d)
    # the simplest that has these numbers
    assert again == camera


def test_what_no_model_describes_is_refused():
    with pytest.raises(InputError, match='none of the models'):
        camera_from_ros(SIZE, 'plumb_bob', ros_camera(BARREL).k, [0.1] * 8)
    with pytest.raises(InputError, match='none of the models'):
        camera_from_ros(SIZE, 'equirectangular', ros_camera(BARREL).k, [0.0] * 5)
    with pytest.raises(InputError, match='radial, brown'):
        camera_of('no such model', SIZE, BARREL.params)


def test_the_camera_of_images_of_another_size():
    small = Radial((640, 360), 400.0, 401.0, 319.5, 179.5, -0.2)
    large = Radial((1280, 720), 800.0, 802.0, 639.5, 359.5, -0.2)
    assert small.resized(2, (1280, 720)) == large and large.resized(0.5, (640, 360)) == small
    assert small.resized(2, (1281, 720)).image_size == (1281, 720)
