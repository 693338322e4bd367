"""Exports: each read back by the program it is for, or by its format's rules."""
from __future__ import annotations

import json
import subprocess

import cv2
import numpy as np
import pycolmap
import pytest
import yaml
from made_calibration import EACH_MODEL

from dashcalib_ros.camera import camera_from_ros
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.report import NamedCamera, compare, load_camera, write_text
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


# what a program cannot describe: the models, and what its export says
LACKS = {'kalibr': {'brown': 'no k3', 'rational_polynomial': 'no k3, k4, k5, k6'},
         'opensfm': {'rational_polynomial': 'no k4'},
         'nerfstudio': {'rational_polynomial': 'no k4'}, 'mrcal': {'fisheye': 'no fisheye'}}


CANNOT = [(kind, model) for kind, models in LACKS.items() for model in models]


def lenses(*kinds):
    """Return a mark: one test for each kind and each lens that it can describe.

    What has a value for each pixel is of small pictures.
    """
    return pytest.mark.parametrize(('kind', 'lens'), [
        pytest.param(kind, lens.resized(1 / 3, (414, 125)) if kind in ('rays', 'maps') else lens,
                     id=f'{kind}-{model}') for kind in kinds
        for model, lens in EACH_MODEL.items() if (kind, model) not in CANNOT])


def written(lens, kind, folder):
    """Write an export, and return its path."""
    path = folder / {'rays': 'a.npz', 'maps': 'a.npz'}.get(kind, 'a.txt')
    write_text(path, exported(lens, kind))
    return path


@pytest.mark.parametrize(('kind', 'model'), CANNOT)
def test_a_lens_that_a_program_has_not_is_refused(kind, model):
    with pytest.raises(ConfigError, match=LACKS[kind][model]):
        exported(EACH_MODEL[model], kind)


@lenses(*EXPORTS)
def test_each_export_is_read_back(lens, kind, tmp_path):
    read = load_camera(written(lens, kind, tmp_path))
    assert read.sigma is None and read.verdict is None
    np.testing.assert_allclose(read.camera.params, lens.params, rtol=1e-13)
    assert compare(read, NamedCamera('given', lens)).mapping_px < 1e-6
    if kind != 'opensfm':  # shares of the width are not exact
        assert read.camera == lens


@lenses('rays')
def test_rays_are_those_of_each_pixel(lens, kind, tmp_path):
    rays = np.load(written(lens, kind, tmp_path))['rays']
    assert rays.dtype == np.float32 and rays.shape == (*lens.image_size[::-1], 3)
    for x, y in ((0, 0), (233, 7), (413, 124)):
        np.testing.assert_allclose(rays[y, x], lens.rays(np.array([x, y], float)), atol=1e-7)


@lenses('maps')
def test_maps_are_opencv_s(lens, kind, tmp_path):
    maps = np.load(written(lens, kind, tmp_path))
    module = cv2.fisheye if lens.model == 'fisheye' else cv2
    theirs = module.initUndistortRectifyMap(
        lens.matrix, np.array(lens.ros_distortion()), np.eye(3), lens.matrix, lens.image_size,
        cv2.CV_32FC1)
    for name, wanted in zip(('map_x', 'map_y'), theirs, strict=True):
        np.testing.assert_allclose(maps[name], wanted, atol=1e-3)
        assert maps[name].dtype == np.float32


@lenses('mrcal')
def test_mrcal_projects_the_same(lens, kind, tmp_path):
    path = written(lens, kind, tmp_path)
    program = ('import json, mrcal, numpy, sys\n'
               'model = mrcal.cameramodel(sys.argv[1])\n'
               'seen = mrcal.project(numpy.array(json.loads(sys.argv[2])), *model.intrinsics())\n'
               'print(json.dumps([seen.tolist(), model.imagersize().tolist()]))')
    if subprocess.run(['/usr/bin/python3', '-c', 'import mrcal'], capture_output=True).returncode:
        pytest.skip('the distribution\'s python3-mrcal is not installed')
    told = subprocess.run(['/usr/bin/python3', '-c', program, path, json.dumps(POINTS.tolist())],
                          check=True, capture_output=True, text=True).stdout
    seen, size = json.loads(told)
    np.testing.assert_allclose(seen, lens.project(POINTS), atol=1e-6)
    assert tuple(size) == lens.image_size


@lenses('kalibr')
def test_kalibr(lens, kind):
    cam = yaml.safe_load(exported(lens, kind))['cam0']
    assert cam['intrinsics'] == [lens.fx, lens.fy, lens.cx, lens.cy]
    assert cam['resolution'] == list(lens.image_size)
    model = {'radtan': 'plumb_bob', 'equidistant': 'equidistant'}[cam['distortion_model']]
    d = cam['distortion_coeffs'] + [0.0] * (model == 'plumb_bob')
    assert camera_from_ros(lens.image_size, model, lens.matrix.ravel().tolist(), d) == lens


@lenses('opensfm')
def test_opensfm_s_units(lens, kind):
    [(name, camera)] = json.loads(exported(lens, kind)).items()
    width, height = lens.image_size
    assert str(width) in name and (camera['width'], camera['height']) == lens.image_size
    # OpenSfM's own: normalised = (pixel + 0.5 - size / 2) / longer side
    x = camera['focal_x'] * 0.0 + camera['c_x']
    assert x * max(width, height) + width / 2 - 0.5 == pytest.approx(lens.cx)
    assert camera['c_y'] * max(width, height) + height / 2 - 0.5 == pytest.approx(lens.cy)
    assert camera['focal_y'] * max(width, height) == pytest.approx(lens.fy)
    assert camera['projection_type'] == ('fisheye_opencv' if lens.model == 'fisheye' else 'brown')
    assert camera['k1'] == lens.k1 and camera['k3'] == getattr(lens, 'k3', 0.0)


@lenses('nerfstudio')
def test_nerfstudio_counts_from_the_corner(lens, kind):
    camera = json.loads(exported(lens, kind))
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
