# SPDX-License-Identifier: Apache-2.0
"""The rectified picture, and the P of CameraInfo for it, checked by OpenCV's rectification."""
from __future__ import annotations

import cv2
import numpy as np
import pytest
from refused import refused

from dashcalib_ros.camera import RECTIFIED, Brown, Camera, Fisheye, Radial, ros_camera, ros_faults
from dashcalib_ros.camera.field import TERMS, Field
from dashcalib_ros.camera.remap import OUTSIDE, WIDEST, rectified_matrix, rectify, source_map
from dashcalib_ros.config import describe
from dashcalib_ros.errors import ConfigError

SIZE = (1280, 720)
PINHOLES: dict[str, Camera] = {
    'barrel': Radial(SIZE, 700.0, 703.0, 652.0, 350.0, -0.30, 0.09),
    'pincushion': Radial(SIZE, 900.0, 897.0, 630.0, 371.0, 0.12, 0.05),
    'plain': Radial(SIZE, 650.0, 650.0, 639.5, 359.5),
    'decentred': Brown(SIZE, 700.0, 703.0, 652.0, 350.0, -0.30, 0.09, 0.002, -0.003, -0.01),
    'upright': Radial((480, 640), 380.0, 381.0, 244.0, 310.0, -0.25, 0.06)}
FISHEYES: dict[str, Camera] = {
    '60 degrees': Fisheye(SIZE, 1200.0, 1205.0, 650.0, 350.0, -0.02, 0.003),
    '100 degrees': Fisheye(SIZE, 700.0, 703.0, 652.0, 350.0, -0.03, 0.01, -0.004, 0.001),
    '190 degrees': Fisheye(SIZE, 390.0, 391.0, 630.0, 365.0, -0.02, 0.004, -0.002, 0.0003)}
CAMERAS = PINHOLES | FISHEYES


def sources(camera: Camera, matrix: np.ndarray) -> np.ndarray:
    """Return (h, w, 2) the pixel that OpenCV takes for each pixel of the rectified picture."""
    make = (cv2.fisheye.initUndistortRectifyMap if isinstance(camera, Fisheye)
            else cv2.initUndistortRectifyMap)
    return np.stack(make(camera.matrix, np.array(camera.ros_distortion()), np.eye(3), matrix,
                         camera.image_size, cv2.CV_32FC1), axis=-1)


def border(camera: Camera) -> np.ndarray:
    """Return the pixels all around the camera's picture."""
    width, height = camera.image_size
    x, y = np.arange(width * 1.0), np.arange(height * 1.0)
    return np.concatenate([
        np.stack(np.broadcast_arrays(*pair), -1) for pair in (
            (x, 0.0), (x, height - 1.0), (0.0, y), (width - 1.0, y))])


def test_the_setting_has_these_choices():
    about = dict(describe())['rectified']
    assert about.metadata['choices'] == RECTIFIED and about.default == 'same'
    with refused(ConfigError, 'E-CONFIG-CHOICE', 'same, crop, all'):
        ros_camera(PINHOLES['barrel'], 'whole')


@pytest.mark.parametrize('rectified', RECTIFIED)
@pytest.mark.parametrize('name', CAMERAS)
def test_each_view_fits_its_camera_and_those_of_other_sizes_do_not(name, rectified):
    camera = CAMERAS[name]
    c = ros_camera(camera, rectified)
    assert ros_faults(camera, c.k, c.r, c.p) == ros_faults(camera) == ()
    for scale in (0.5, 1.5, 2.0):
        assert ros_faults(camera, c.k, c.r, [scale * value for value in c.p[:8]] + c.p[8:])


@pytest.mark.parametrize('name', CAMERAS)
def test_same_is_the_camera_s_own(name):
    camera = CAMERAS[name]
    for ros in (ros_camera(camera), ros_camera(camera, 'same')):
        k = np.reshape(ros.k, (3, 3))
        np.testing.assert_array_equal(np.reshape(ros.p, (3, 4)), np.column_stack([k, [0] * 3]))


@pytest.mark.parametrize('rectified', ['crop', 'all'])
@pytest.mark.parametrize('name', CAMERAS)
def test_only_p_changes_and_its_pixels_are_square(name, rectified):
    camera = CAMERAS[name]
    ros, plain = ros_camera(camera, rectified), ros_camera(camera)
    assert (ros.k, ros.d, ros.r, ros.width, ros.height, ros.distortion_model) == (
        plain.k, plain.d, plain.r, *camera.image_size, plain.distortion_model)
    p = np.reshape(ros.p, (3, 4))
    assert all(type(value) is float for value in ros.p)
    assert p[0, 0] == p[1, 1] > 0
    np.testing.assert_array_equal(p[2], [0, 0, 1, 0])
    assert p[0, 1] == p[1, 0] == 0 and not p[:, 3].any()
    assert ros_camera(camera, rectified) == ros


@pytest.mark.parametrize('name', CAMERAS)
def test_crop_has_no_black_border_and_wastes_nothing(name):
    camera = CAMERAS[name]
    width, height = camera.image_size
    matrix = rectified_matrix(camera, 'crop')
    found = sources(camera, matrix)
    assert found.min() > -1e-3
    assert found[..., 0].max() < width - 1 + 1e-3 and found[..., 1].max() < height - 1 + 1e-3
    # a view that is 1 % larger would have one, or see too far off the axis
    larger = matrix.copy()
    middle = (np.array(camera.image_size) - 1) / 2
    larger[[0, 1], [0, 1]] /= 1.01
    larger[:2, 2] = middle + (matrix[:2, 2] - middle) / 1.01
    found = sources(camera, larger)
    corners = np.array([[x, y, 1] for x in (0, width - 1) for y in (0, height - 1)])
    rays = corners @ np.linalg.inv(larger).T
    outside = (found < 0).any() or (found > [width - 1, height - 1]).any()
    assert outside or np.hypot(*rays[:, :2].T).max() > np.tan(WIDEST)


@pytest.mark.parametrize('name', CAMERAS)
def test_all_has_the_whole_border_inside(name):
    camera = CAMERAS[name]
    width, height = camera.image_size
    matrix = rectified_matrix(camera, 'all')
    rays = camera.rays(border(camera))
    seen = rays[rays[:, 2] > np.cos(WIDEST - 1e-6)]
    assert len(seen) == len(rays) or name == '190 degrees'
    # those that are left out, in the same direction as far off the axis as there is room
    flat = rays[rays[:, 2] <= np.cos(WIDEST - 1e-6), :2]
    flat = flat / np.linalg.norm(flat, axis=1, keepdims=True) * np.sin(WIDEST)
    seen = np.concatenate([seen, np.column_stack([flat, np.full(len(flat), np.cos(WIDEST))])])
    found = seen @ matrix.T
    found = found[:, :2] / found[:, 2:]
    # where the limit meets the border, the outline has an edge that is known to a pixel only
    assert found.min() > -1
    assert found[:, 0].max() < width and found[:, 1].max() < height
    # and it reaches two opposite sides
    gaps = [found[:, 0].min() + width - 1 - found[:, 0].max(),
            found[:, 1].min() + height - 1 - found[:, 1].max()]
    assert min(gaps) < 1


@pytest.mark.parametrize('rectified', RECTIFIED)
@pytest.mark.parametrize('name', ['barrel', 'decentred', 'upright', '100 degrees'])
def test_image_proc_makes_the_picture_of_ours_from_camera_info(name, rectified):
    """As image_geometry does for rectify_node: K, D, R and P of the message as they are."""
    camera = CAMERAS[name]
    c = ros_camera(camera, rectified)
    make = (cv2.fisheye if c.distortion_model == 'equidistant' else cv2).initUndistortRectifyMap
    maps = make(np.reshape(c.k, (3, 3)), np.array(c.d), np.reshape(c.r, (3, 3)),
                np.reshape(c.p, (3, 4)), (c.width, c.height), cv2.CV_16SC2)
    x, y = np.meshgrid(np.arange(c.width), np.arange(c.height))
    picture = (128 + 100 * np.sin(x / 9) * np.cos(y / 7)).astype(np.uint8)
    theirs = cv2.remap(picture, *maps, cv2.INTER_LINEAR).astype(int)
    ours = rectify(picture, camera, rectified).astype(int)
    # their maps are rounded to 1/32 px; beside the picture's border one has black a pixel earlier
    assert np.percentile(np.abs(theirs - ours), 99) <= 2


@pytest.mark.parametrize('name', PINHOLES)
def test_opencv_would_choose_about_the_same(name):
    """OpenCV's alpha 0 and 1 scale both axes by themselves, ours alike."""
    camera = PINHOLES[name]
    distortion = np.array(camera.ros_distortion())
    inner, outer = (cv2.getOptimalNewCameraMatrix(
        camera.matrix, distortion, camera.image_size, alpha)[0] for alpha in (0, 1))
    crop, everything = (rectified_matrix(camera, each)[0, 0] for each in ('crop', 'all'))
    assert crop == pytest.approx(max(inner[0, 0], inner[1, 1]), rel=0.01)
    assert everything == pytest.approx(min(outer[0, 0], outer[1, 1]), rel=0.01)


def test_a_lens_without_distortion_keeps_its_view():
    camera = PINHOLES['plain']
    for each in RECTIFIED:
        np.testing.assert_allclose(rectified_matrix(camera, each), camera.matrix, rtol=2e-3)


def test_the_widest_lens_is_cut_at_75_degrees():
    camera = FISHEYES['190 degrees']
    focal = rectified_matrix(camera, 'all')[0, 0]
    assert 75.0 <= np.degrees(np.arctan(639.5 / focal)) < 80.0
    # a fisheye's K has no such limit: its picture shows the middle only
    assert rectified_matrix(camera, 'crop')[0, 0] < camera.fx


@pytest.mark.parametrize('camera', [
    Radial(SIZE, 1e-300, 1e-300, 640.0, 360.0), Radial(SIZE, 1e300, 1e300, 640.0, 360.0, 1e300),
    Brown(SIZE, 5.0, 5.0, 640.0, 360.0, 1e9, -1e9, 1e9, 1e9, 1e9),
    Fisheye(SIZE, 1e-9, 1e-9, 640.0, 360.0, -1e9), Radial((1, 1), 5.0, 5.0, 0.0, 0.0),
    Radial(SIZE, 700.0, 700.0, -5000.0, 9000.0), Fisheye(SIZE, 300.0, 300.0, 9000.0, 360.0)])
def test_a_camera_that_is_none_gives_numbers_all_the_same(camera):
    for each in RECTIFIED:
        assert np.isfinite(rectified_matrix(camera, each)).all()


def test_a_lens_that_folds_over_is_used_as_far_as_it_sees():
    camera = Radial(SIZE, 700.0, 700.0, 639.5, 359.5, -0.6)
    crop, everything = (rectified_matrix(camera, each) for each in ('crop', 'all'))
    # the fold is at a radius of 0.745
    assert np.hypot(639.5, 359.5) / crop[0, 0] <= 0.7455
    # all around it comes before the picture's border; rays() ends a little before it
    assert everything[0, 0] == pytest.approx(359.5 / 0.7454, rel=0.04)
    found = sources(camera, crop)
    assert found.min() >= 0 and (found <= [1279, 719]).all()


SMALL = (320, 240)
LENS = Radial(SMALL, 260.0, 261.0, 165.0, 118.0, -0.25, 0.05)
WIDE = Fisheye(SMALL, 110.0, 111.0, 161.0, 118.0, -0.02, 0.003, -0.001, 0.0002)


def texture() -> np.ndarray:
    noise = np.random.default_rng(3).integers(0, 256, (24, 32), np.uint8)
    return np.asarray(cv2.resize(noise, SMALL, interpolation=cv2.INTER_CUBIC))


@pytest.mark.parametrize('view', RECTIFIED)
def test_a_rectified_picture_is_what_opencv_makes_of_it(view):
    image = texture()
    theirs = cv2.undistort(image, LENS.matrix, np.array(LENS.ros_distortion()),
                           newCameraMatrix=rectified_matrix(LENS, view))
    ours = rectify(image, LENS, view)
    assert np.abs(ours.astype(int) - theirs)[8:-8, 8:-8].max() <= 4
    np.testing.assert_array_equal(rectify(np.dstack([image] * 3), LENS, view)[..., 1], ours)


def test_a_fisheye_is_rectified_and_what_it_cannot_see_is_black():
    image = np.full((240, 320), 255, np.uint8)
    ours = rectify(image, WIDE, 'all')
    theirs = cv2.fisheye.undistortImage(
        image, WIDE.matrix, np.array(WIDE.ros_distortion()), Knew=rectified_matrix(WIDE, 'all'))
    assert np.mean(np.abs(ours.astype(int) - theirs) > 4) < 0.02
    assert ours[120, 160] == 255 and (ours == 0).any()
    # another camera, another view
    assert (rectify(image, LENS, 'all') != ours).any()


def test_what_folds_over_is_nowhere_in_the_image():
    folded = Fisheye(SMALL, 110.0, 111.0, 161.0, 118.0, -0.5)  # at 47 degrees off the axis
    places = source_map(folded)
    assert (places == OUTSIDE).all(axis=-1).any() and np.isfinite(places).all()
    assert rectify(np.full((240, 320), 255, np.uint8), folded)[0, 0] == 0


def test_a_field_moves_what_is_seen():
    moves = np.zeros((2, len(TERMS)))
    moves[:, 0] = 3.0, -2.0
    shifted, plain = source_map(LENS, field=Field(SMALL, moves)), source_map(LENS)
    np.testing.assert_allclose(shifted - plain, np.broadcast_to([3.0, -2.0], plain.shape),
                               atol=1e-4)
