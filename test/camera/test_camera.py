# SPDX-License-Identifier: Apache-2.0
"""The camera model against OpenCV's, its inverse, and where it folds over."""
from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import refused

from dashcalib_ros.camera import (
    MODELS,
    Brown,
    Camera,
    Fisheye,
    Radial,
    Rational,
    calibrated_models,
    camera_from_ros,
    camera_of,
    larger_models,
    model_named,
    ros_camera,
    searched,
)
from dashcalib_ros.errors import ConfigError, InputError

SIZE = (1280, 720)
BARREL = Radial(SIZE, 700.0, 703.0, 652.0, 350.0, -0.30, 0.09)
PINCUSHION = Radial(SIZE, 900.0, 897.0, 630.0, 371.0, 0.12, 0.05)
PINHOLE = Radial(SIZE, 650.0, 650.0, 639.5, 359.5)
# reaches a radius of 0.66 at k1 = -0.6 (fold at 0.745, distorted 0.497): the corners lie beyond
FOLDED = Radial(SIZE, 700.0, 700.0, 639.5, 359.5, -0.6, 0.0)
DECENTRED = Brown(SIZE, 700.0, 703.0, 652.0, 350.0, -0.30, 0.09, 0.002, -0.003, -0.01)
# the size of the coefficients that an Azure Kinect has
QUOTIENT = Rational(SIZE, 607.0, 606.5, 638.0, 366.0, 0.44, -2.66, 0.0006, -0.0003, 1.53, 0.32,
                    -2.48, 1.46)
FISHEYE = Fisheye(SIZE, 700.0, 703.0, 652.0, 350.0, -0.03, 0.01, -0.004, 0.001)
# 190 degrees across; the corners see to 117
ROUND = Fisheye(SIZE, 390.0, 391.0, 630.0, 365.0, -0.02, 0.004, -0.002, 0.0003)
# theta (1 - 0.3 theta^2) has its maximum 0.7027 at theta = 1.0541: the sides lie beyond
FOLDED_FISHEYE = Fisheye(SIZE, 600.0, 600.0, 639.5, 359.5, -0.3)
CAMERAS: dict[str, Camera] = {
    'barrel': BARREL, 'pincushion': PINCUSHION, 'pinhole': PINHOLE, 'decentred': DECENTRED,
    'quotient': QUOTIENT, 'fisheye': FISHEYE, 'round': ROUND}
FISHEYES = [name for name, camera in CAMERAS.items() if isinstance(camera, Fisheye)]


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
    fisheye = isinstance(camera, Fisheye)
    names = ('k1', 'k2', 'k3', 'k4') if fisheye else ('k1', 'k2', 'p1', 'p2', 'k3', 'k4', 'k5',
                                                         'k6')
    distortion = np.array([named.get(name, 0.0) for name in names])
    origin = np.zeros(3)
    if fisheye:
        expected, _ = cv2.fisheye.projectPoints(points[:, None], origin, origin, matrix,
                                                distortion)
        expected = expected.reshape(-1, 1, 2)
    else:
        expected, _ = cv2.projectPoints(points, origin, origin, matrix, distortion)
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


def angles_off_axis(rays: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(rays[..., 2]))


def all_around(angles: np.ndarray) -> np.ndarray:
    """Return (n, 3) rays so many degrees off the axis, in all directions."""
    theta, phi = np.meshgrid(np.radians(angles), np.radians(np.arange(0, 360, 15)))
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)],
                    -1).reshape(-1, 3)


def test_a_fisheye_sees_behind_itself():
    rays = ROUND.rays(pixels(ROUND))
    assert 110 < angles_off_axis(rays).max() < 120
    wanted = all_around(np.linspace(0.0, 110.0, 45))
    seen = ROUND.project(wanted)
    assert np.isfinite(seen).all()
    np.testing.assert_allclose(ROUND.rays(seen), wanted, atol=1e-8)
    # the farther off the axis, the farther out in the picture
    out = np.linalg.norm((seen - [ROUND.cx, ROUND.cy]) / [ROUND.fx, ROUND.fy], axis=1)
    assert (np.diff(out.reshape(-1, 45), axis=1) > 0).all()
    # other models do not
    assert np.isnan(BARREL.project(wanted[wanted[:, 2] < 0])).all()
    assert (ROUND.sees_behind, BARREL.sees_behind, DECENTRED.sees_behind) == (True, False, False)


def test_a_fisheye_has_an_end_too():
    assert np.isnan(ROUND.project(all_around(np.array([121.0, 150.0, 180.0])))).all()
    assert np.isnan(ROUND.project(np.zeros(3))).all()
    straight_back = ROUND.project(np.array([0.0, 0.0, -1.0]))
    assert np.isnan(straight_back).all()
    assert np.isnan(ROUND.rays(np.array([5000.0, 365.0]))).all()


def test_a_fisheye_folds_over_where_its_slope_is_0():
    assert FOLDED_FISHEYE.fold == pytest.approx(1.0541, abs=1e-4)
    assert not FOLDED_FISHEYE.covers_picture()
    xy = pixels(FOLDED_FISHEYE)
    rays = FOLDED_FISHEYE.rays(xy)
    reached = np.isfinite(rays[..., 0])
    radius = np.linalg.norm((xy - [639.5, 359.5]) / 600.0, axis=-1)
    assert not reached[radius > 0.7029].any() and reached[radius < 0.69].all()
    assert angles_off_axis(rays[reached]).max() < 60.4  # 1.0541 rad
    np.testing.assert_allclose(FOLDED_FISHEYE.project(rays[reached]), xy[reached], atol=1e-3)
    # rays beyond would come to lie in the picture again
    assert np.isnan(FOLDED_FISHEYE.project(all_around(np.array([60.5, 80.0, 100.0])))).all()
    # k4 decides far out only
    assert Fisheye(SIZE, 390.0, 390.0, 639.5, 359.5, 0.0, 0.0, 0.0, -0.002).fold < 1.9


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


@pytest.mark.parametrize('name', CAMERAS)
def test_the_centre_is_straight_ahead_and_nan_stays_nan(name):
    camera = CAMERAS[name]
    rays = camera.rays(np.array([[camera.cx, camera.cy], [np.nan, np.nan], [np.nan, 100.0]]))
    np.testing.assert_allclose(rays[0], [0.0, 0.0, 1.0], atol=1e-12)
    assert np.isnan(rays[1:]).all()
    seen = camera.project(np.array([[0.0, 0.0, 3.0], [np.nan, 0.0, 1.0], [0.1, 0.2, np.nan]]))
    np.testing.assert_allclose(seen[0], [camera.cx, camera.cy], atol=1e-9)
    assert np.isnan(seen[1:]).any(axis=1).all()


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


@pytest.mark.parametrize('distance', [1.0, 0.2, 30.0])
@pytest.mark.parametrize('name', FISHEYES)
def test_derivatives_of_a_fisheye_are_right_all_around(name, distance):
    camera = CAMERAS[name]
    # on the axis, so near to it that limits are taken, a little farther, and behind
    points = distance * all_around(np.array([0.0, 1e-7, 1e-5, 1e-3, 0.1, 30, 60, 89.9, 90, 100,
                                             112]))
    by_params, by_point, found = camera.derivatives(points)
    np.testing.assert_allclose(found, camera.project(points), atol=1e-9)
    for n, value in enumerate(camera.params):
        step = 1e-6 * max(abs(value), 1.0) * np.eye(len(camera.params))[n]
        ahead, behind = (camera.with_params(camera.params + sign * step).project(points)
                         for sign in (1, -1))
        numeric = (ahead - behind) / (2 * step[n])
        np.testing.assert_allclose(by_params[:, :, n], numeric, atol=1e-4)
    size = 1e-5 * distance
    for axis in range(3):
        step = size * np.eye(3)[axis]
        numeric = (camera.project(points + step) - camera.project(points - step)) / (2 * size)
        np.testing.assert_allclose(by_point[:, :, axis] * distance, numeric * distance,
                                   atol=1e-4)


def test_derivatives_of_no_points():
    for camera in CAMERAS.values():
        n = len(camera.names())
        shapes = [each.shape for each in camera.derivatives(np.zeros((0, 3)))]
        assert shapes == [(0, 2, n), (0, 2, 3), (0, 2)]


def test_points_behind_the_camera_have_no_pixel():
    pixels = BARREL.project(np.array([[1.0, 1.0, -5.0], [0.0, 0.0, 0.0], [1.0, 1.0, 5.0]]))
    assert np.isnan(pixels[:2]).all() and np.isfinite(pixels[2]).all()


@pytest.mark.parametrize('model', MODELS.values(), ids=lambda model: model.model)
def test_parameters_go_to_colmap(model):
    params = np.arange(1.0, 1.0 + len(model.names()))
    values = model.colmap.values(params)
    assert len(values) == model.colmap.size
    assert values[model.colmap.places[2]] == params[2] + 0.5  # COLMAP's pixel centres
    places = list(model.colmap.places)
    np.testing.assert_array_equal(values[places] - params, [0, 0, 0.5, 0.5, *params[4:] * 0])
    assert not np.delete(values, places).any()


@pytest.mark.parametrize('name', CAMERAS)
def test_colmap_projects_as_we_do(name):
    pycolmap = pytest.importorskip('dashcalib_ros.reconstruct.colmap').pycolmap
    camera = CAMERAS[name]
    colmap = pycolmap.Camera(camera_id=1, model=camera.colmap.name, width=SIZE[0], height=SIZE[1],
                             params=camera.colmap.values(camera.params))
    points = np.random.default_rng(2).uniform([-3, -2, 4], [3, 2, 9], (40, 3))
    np.testing.assert_allclose(np.array(colmap.img_from_cam(points)) - 0.5,
                               camera.project(points), atol=1e-9)


@pytest.mark.parametrize('name', CAMERAS)
def test_ros_describes_the_same_camera(name):
    camera = CAMERAS[name]
    ros = ros_camera(camera)
    assert (ros.distortion_model, len(ros.d)) == (
        ('equidistant', 4) if name in FISHEYES else
        ('rational_polynomial', 8) if name == 'quotient' else ('plumb_bob', 5))
    assert len(ros.p) == 12 and ros.p[:3] == ros.k[:3]
    again = camera_from_ros(SIZE, ros.distortion_model, ros.k, ros.d)
    # the simplest that has these numbers
    assert again == camera


def test_other_names_of_a_model_are_understood():
    k = ros_camera(FISHEYE).k
    for name in ('equidistant', 'fisheye'):
        assert camera_from_ros(SIZE, name, k, FISHEYE.ros_distortion()) == FISHEYE
    assert camera_from_ros(SIZE, 'equidistant', k, [0.0] * 4) == Fisheye(
        SIZE, 700.0, 703.0, 652.0, 350.0)
    # four are the same coefficients of other models, too, and never taken for them
    assert camera_from_ros(SIZE, 'plumb_bob', k, [0.1, 0.2, 0.001, 0.0]).model == 'brown'


def test_a_model_that_nobody_knows_is_told_in_one_line():
    for name in ('fish-eye', 'Fisheye', '', 'x\ny' * 100):
        with refused(ConfigError, 'E-MODEL-UNKNOWN', 'auto, radial, brown, fisheye') as caught:
            model_named(name)
        assert len(str(caught.value)) < 300
        with pytest.raises(ConfigError):
            searched(name)
    assert [model.model for model in searched('auto')] == ['radial', 'fisheye']


def test_the_turns_do_not_choose_the_rational_model_by_themselves():
    assert MODELS['rational_polynomial'] is Rational and Rational not in calibrated_models()
    assert not any(Rational in larger_models(camera) for camera in CAMERAS.values())
    with refused(ConfigError, 'E-MODEL-NOT-CALIBRATED', 'rational_polynomial', 'auto, radial'):
        searched('rational_polynomial')


def test_a_rational_lens_ends_where_its_radius_grows_no_more():
    # r / (1 + 0.8 r^2) has its maximum 0.559 at r = 1.118
    lens = Rational(SIZE, 500.0, 500.0, 639.5, 359.5, k4=0.8)
    assert lens.fold == pytest.approx(1.118, abs=1e-3)
    assert not lens.covers_picture() and QUOTIENT.covers_picture()
    # 1 - 0.25 r^2 is 0 at r = 2
    assert Rational(SIZE, 500.0, 500.0, 639.5, 359.5, k4=-0.25).fold == pytest.approx(2.0)
    far = lens.rays(np.array([[639.5 + 0.6 * 500, 359.5], [639.5 + 0.5 * 500, 359.5]]))
    assert np.isnan(far[0]).all() and np.isfinite(far[1]).all()


def test_a_camera_matrix_with_skew_is_refused():
    k = ros_camera(BARREL).k
    for place in (1, 3, 6):
        with refused(InputError, 'E-CAMERA-SKEW'):
            camera_from_ros(SIZE, 'plumb_bob', [0.5 if n == place else value
                                                for n, value in enumerate(k)], [0.0] * 5)


def test_what_no_model_describes_is_refused():
    with refused(InputError, 'E-MODEL-DISTORTION', 'plumb_bob', '8 coefficients'):
        camera_from_ros(SIZE, 'plumb_bob', ros_camera(BARREL).k, [0.1] * 8)
    with refused(InputError, 'E-MODEL-DISTORTION', 'equirectangular'):
        camera_from_ros(SIZE, 'equirectangular', ros_camera(BARREL).k, [0.0] * 5)
    with refused(InputError, 'E-MODEL-UNKNOWN', 'no such model', 'radial, brown'):
        camera_of('no such model', SIZE, BARREL.params)


def test_the_camera_of_images_of_another_size():
    small = Radial((640, 360), 400.0, 401.0, 319.5, 179.5, -0.2)
    large = Radial((1280, 720), 800.0, 802.0, 639.5, 359.5, -0.2)
    assert small.resized(2, (1280, 720)) == large and large.resized(0.5, (640, 360)) == small
    assert small.resized(2, (1281, 720)).image_size == (1281, 720)
