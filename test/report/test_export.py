"""Exports: each read back by the program it is for, or by its format's rules."""
from __future__ import annotations

import json

import cv2
import numpy as np
import pycolmap
import pytest
import yaml
from made_calibration import EACH_MODEL

from dashcalib_ros.camera import camera_from_ros
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.report.camera_yaml import parse_calibration_yaml
from dashcalib_ros.report.export import EXPORTS, cropped, exported, resized

POINTS = np.array([[0.1, -0.05, 1.0], [-0.5, 0.1, 1.0], [0.6, 0.12, 1.0], [0.0, 0.0, 1.0]])


@pytest.fixture(params=EACH_MODEL)
def lens(request):
    return EACH_MODEL[request.param]


def test_opencv_reads_its_own(lens, tmp_path):
    path = tmp_path / 'camera.yaml'
    path.write_text(exported(lens, 'opencv'))
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    k, d = (file.getNode(name).mat() for name in ('camera_matrix', 'distortion_coefficients'))
    if file.getNode('camera_model').string() == 'fisheye':
        seen, _ = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), k, d)
    else:
        seen, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), k, d)
    np.testing.assert_allclose(seen.reshape(-1, 2), lens.project(POINTS), atol=1e-6)
    assert (file.getNode('image_width').real(), file.getNode('image_height').real()) \
        == lens.image_size


def test_colmap_projects_the_same_half_a_pixel_off(lens):
    line = exported(lens, 'colmap').splitlines()[-1].split()
    camera = pycolmap.Camera(model=line[1], width=int(line[2]), height=int(line[3]),
                             params=[float(value) for value in line[4:]])
    np.testing.assert_allclose(camera.img_from_cam(POINTS) - 0.5, lens.project(POINTS), atol=1e-6)
    assert (camera.width, camera.height) == lens.image_size


def test_ros_reads_it_back(lens):
    read = parse_calibration_yaml(exported(lens, 'ros'), 'camera.yaml')
    assert read.camera == lens and read.sigma is None and read.verdict is None


def test_kalibr(lens):
    if lens.model == 'brown':
        with pytest.raises(ConfigError, match='k3'):
            exported(lens, 'kalibr')
        return
    cam = yaml.safe_load(exported(lens, 'kalibr'))['cam0']
    assert cam['intrinsics'] == [lens.fx, lens.fy, lens.cx, lens.cy]
    assert cam['resolution'] == list(lens.image_size)
    model = {'radtan': 'plumb_bob', 'equidistant': 'equidistant'}[cam['distortion_model']]
    d = cam['distortion_coeffs'] + [0.0] * (model == 'plumb_bob')
    assert camera_from_ros(lens.image_size, model, lens.matrix.ravel().tolist(), d) == lens


def test_opensfm_s_units(lens):
    [(name, camera)] = json.loads(exported(lens, 'opensfm')).items()
    width, height = lens.image_size
    assert str(width) in name and (camera['width'], camera['height']) == lens.image_size
    # OpenSfM's own: normalised = (pixel + 0.5 - size / 2) / longer side
    x = camera['focal_x'] * 0.0 + camera['c_x']
    assert x * max(width, height) + width / 2 - 0.5 == pytest.approx(lens.cx)
    assert camera['c_y'] * max(width, height) + height / 2 - 0.5 == pytest.approx(lens.cy)
    assert camera['focal_y'] * max(width, height) == pytest.approx(lens.fy)
    assert camera['projection_type'] == ('fisheye_opencv' if lens.model == 'fisheye' else 'brown')
    assert camera['k1'] == lens.k1 and camera['k3'] == getattr(lens, 'k3', 0.0)


def test_nerfstudio_counts_from_the_corner(lens):
    camera = json.loads(exported(lens, 'nerfstudio'))
    assert camera['cx'] == lens.cx + 0.5 and camera['fl_y'] == lens.fy
    assert camera['k2'] == lens.k2 and camera['frames'] == []
    assert camera['camera_model'] == ('OPENCV_FISHEYE' if lens.model == 'fisheye' else 'OPENCV')


def test_a_resized_picture_s_camera(lens):
    width, height = lens.image_size
    small = resized(lens, (width // 2, height // 2))
    x, y = small.image_size[0] / width, small.image_size[1] / height
    seen = (lens.project(POINTS) + 0.5) * (x, y) - 0.5
    np.testing.assert_allclose(small.project(POINTS), seen, atol=1e-9)
    with pytest.raises(ConfigError, match='--crop'):
        resized(lens, (640, 480))


def test_a_part_s_camera(lens):
    part = cropped(lens, 40, 25, 640, 300)
    assert part.image_size == (640, 300)
    np.testing.assert_allclose(part.project(POINTS), lens.project(POINTS) - (40, 25), atol=1e-9)


@pytest.mark.parametrize('crop', [(-1, 0, 10, 10), (0, 0, 0, 10), (1200, 0, 100, 10)])
def test_a_part_that_is_none(lens, crop):
    with pytest.raises(ConfigError, match='no part'):
        cropped(lens, *crop)


def test_a_kind_that_there_is_not(lens):
    with pytest.raises(ConfigError, match=', '.join(EXPORTS)):
        exported(lens, 'matlab')
