# SPDX-License-Identifier: Apache-2.0
"""Exports: each read back by the program it is for, or by its format's rules."""
from __future__ import annotations

import ast
import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import yaml
from made_calibration import EACH_MODEL, TRUTH

from dashcalib_ros.camera import camera_from_ros
from dashcalib_ros.camera.field import TERMS as FIELD_TERMS
from dashcalib_ros.camera.field import Field
from dashcalib_ros.errors import ConfigError, DashcalibError, InputError, OutputError
from dashcalib_ros.formats import export, load_camera
from dashcalib_ros.formats.export import EXPORTS, check_suffix, cropped, resized
from dashcalib_ros.report import NamedCamera, compare, write_text

POINTS = np.array([[0.1, -0.05, 1.0], [-0.5, 0.1, 1.0], [0.6, 0.12, 1.0], [0.0, 0.0, 1.0]])


@pytest.fixture(params=EACH_MODEL)
def lens(request):
    return EACH_MODEL[request.param]


def test_opencv_reads_its_own(lens, tmp_path):
    path = tmp_path / 'camera.yaml'
    path.write_text(export(lens, 'opencv'))
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
    line = export(lens, 'colmap').splitlines()[-1].split()
    camera = pycolmap.Camera(model=line[1], width=int(line[2]), height=int(line[3]),
                             params=[float(value) for value in line[4:]])
    np.testing.assert_allclose(camera.img_from_cam(POINTS) - 0.5, lens.project(POINTS), atol=1e-6)
    assert (camera.width, camera.height) == lens.image_size


# what a program cannot describe: the models, and what its export says
FOUR = {'brown': 'no k3', 'rational_polynomial': 'no k3, k4, k5, k6'}
FIVE, NO_FISHEYE = {'rational_polynomial': 'no k4'}, {'fisheye': 'no fisheye'}
LACKS = {'kalibr': FOUR, 'openvins': FOUR, 'svo': FOUR, 'opensfm': FIVE, 'nerfstudio': FIVE,
         'orbslam': FIVE, 'stella': FIVE, 'metashape': FIVE, 'matlab': FIVE | NO_FISHEYE,
         'droid': NO_FISHEYE, 'autoware': NO_FISHEYE}
# what says no size of the pictures
SIZELESS = ('droid',)
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
    path = folder / {'rays': 'a.npz', 'maps': 'a.npz', 'colmap-db': 'a.db'}.get(kind, 'a.txt')
    write_text(path, export(lens, kind))
    return path


@pytest.mark.parametrize(('kind', 'model'), CANNOT)
def test_a_lens_that_a_program_has_not_is_refused(kind, model):
    with pytest.raises(ConfigError, match=LACKS[kind][model]) as raised:
        export(EACH_MODEL[model], kind)
    assert raised.value.code == 'E-EXPORT-LENS'


@lenses(*(kind for kind, form in EXPORTS.items() if 'mount' not in form.keeps))
def test_each_export_is_read_back(lens, kind, tmp_path):
    path = written(lens, kind, tmp_path)
    if (kind, lens.model) == ('mrcal', 'fisheye'):
        with pytest.raises(InputError, match='SPLINED') as raised:
            load_camera(path)
        assert raised.value.code == 'E-LENS-MODEL'
        return
    if kind in SIZELESS:
        with pytest.raises(InputError) as unsized:
            load_camera(path)
        assert unsized.value.code == 'E-CALIBRATION-NO-SIZE'
    read = load_camera(path, image_size=lens.image_size if kind in SIZELESS else None)
    assert read.sigma is None and read.verdict is None
    np.testing.assert_allclose(read.camera.params, lens.params, rtol=1e-13)
    assert compare(read, NamedCamera('given', lens)).mapping_px < 1e-6
    if kind not in ('opensfm', 'metashape', 'matlab'):  # sums and shares are not exact
        assert read.camera == lens


@lenses('gyroflow')
@pytest.mark.parametrize('readout_ms', [None, 21.5, -20.1])
def test_a_lens_profile_has_what_gyroflow_needs(lens, kind, readout_ms, tmp_path):
    profile = json.loads(export(NamedCamera('given', lens, readout_ms=readout_ms), kind))
    assert profile['calib_dimension'] == {'w': 1242, 'h': 375} == profile['orig_dimension']
    # it loads none without, and takes the middle for the principal point
    assert profile['calibrator_version'] and profile['asymmetrical'] is True
    k = np.array(profile['fisheye_params']['camera_matrix'])
    d = np.array(profile['fisheye_params']['distortion_coeffs'])
    seen = {'opencv_fisheye': cv2.fisheye.projectPoints, 'opencv_standard': cv2.projectPoints}[
        profile['distortion_model']](POINTS[:, None], np.zeros(3), np.zeros(3), k, d)[0]
    np.testing.assert_allclose(seen.reshape(-1, 2), lens.project(POINTS), atol=1e-6)
    path = tmp_path / 'profile.json'
    path.write_text(json.dumps(profile))
    assert load_camera(path).readout_ms == readout_ms
    assert (profile['frame_readout_time'], profile['frame_readout_direction']) == {
        None: (None, None), 21.5: (21.5, 'TopToBottom'), -20.1: (20.1, 'BottomToTop')}[readout_ms]


def test_a_fisheye_without_coefficients_is_a_pinhole_to_gyroflow():
    ideal = replace(EACH_MODEL['fisheye'], k1=0.0, k2=0.0, k3=0.0, k4=0.0)
    with pytest.raises(ConfigError) as raised:
        export(ideal, 'gyroflow')
    assert raised.value.code == 'E-EXPORT-FISHEYE-ZERO'


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


def mrcal_sees(path, rays):
    """Return (n, 2) where the distribution's mrcal sees rays (n, 3), and its picture's size."""
    program = ('import mrcal, numpy, sys\n'
               'model = mrcal.cameramodel(sys.argv[1])\n'
               'seen = mrcal.project(numpy.load(sys.argv[2]), *model.intrinsics())\n'
               'numpy.savez(sys.argv[3], seen=seen, size=model.imagersize())')
    if subprocess.run(['/usr/bin/python3', '-c', 'import mrcal'], capture_output=True).returncode:
        pytest.skip('the distribution\'s python3-mrcal is not installed')
    given, told = path.with_name('rays.npy'), path.with_name('told.npz')
    np.save(given, rays)
    subprocess.run(['/usr/bin/python3', '-c', program, path, given, told], check=True)
    return np.load(told)['seen'], tuple(np.load(told)['size'])


@lenses('mrcal')
def test_mrcal_projects_the_same(lens, kind, tmp_path):
    seen, size = mrcal_sees(written(lens, kind, tmp_path), POINTS)
    np.testing.assert_allclose(seen, lens.project(POINTS),
                               atol=1e-3 if lens.model == 'fisheye' else 1e-6)
    assert size == lens.image_size


def a_field(size, rms_px):
    """Return a field whose terms are all about as large."""
    field = Field(size, np.random.default_rng(5).normal(size=(2, len(FIELD_TERMS))))
    x, y = np.meshgrid(np.linspace(0, size[0] - 1, 40), np.linspace(0, size[1] - 1, 40))
    lengths = np.linalg.norm(field.displacement(np.stack([x, y], -1)), axis=-1)
    return field.resized(rms_px / np.sqrt(np.mean(lengths**2)), size)


def seen_by_spline(text, rays):
    """Return (n, 2) where a splined .cameramodel sees rays (n, 3), by mrcal's documentation."""
    model = ast.literal_eval(text)
    rows, columns, fov_deg = (int(re.search(f'{key}=([0-9]+)', model['lensmodel'])[1])
                              for key in ('Ny', 'Nx', 'fov_x_deg'))
    focal, centre = np.array(model['intrinsics'][:4]).reshape(2, 2)
    control = np.array(model['intrinsics'][4:]).reshape(rows, columns, 2)
    angle = np.arccos(rays[:, 2] / np.linalg.norm(rays, axis=1))
    u = (2 * np.tan(angle / 2) / np.linalg.norm(rays[:, :2], axis=1))[:, None] * rays[:, :2]
    # a cubic spline needs a whole interval beyond the field of view at each end
    apart = 4 * np.tan(np.radians(fov_deg) / 4) / (columns - 3)
    places = u / apart + (np.array([columns, rows]) - 1) / 2
    first = np.floor(places).astype(int)
    t = places - first
    weights = np.stack([(1 - t)**3, 3 * t**3 - 6 * t**2 + 4,
                        -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]) / 6
    added = sum(weights[i, :, 0, None] * weights[j, :, 1, None]
                * control[first[:, 1] + j - 1, first[:, 0] + i - 1]
                for i in range(4) for j in range(4))
    return focal * (u + added) + centre


PART = (640, 375)


@pytest.fixture(scope='module', params=('radial', 'brown', 'fisheye'))
def bent(request):
    """Return a lens, the mrcal file of it with a field of 1 px, pixels to the rim, their rays."""
    lens = cropped(EACH_MODEL[request.param], 0, 0, *PART)
    field = a_field(PART, 1.0)
    places = (np.append(np.arange(0.0, size - 1, 3), size - 1) for size in PART)
    pixels = np.stack(np.meshgrid(*places), -1).reshape(-1, 2)
    text = export(NamedCamera('given', lens, field=field), 'mrcal')
    return lens, text, pixels, lens.rays(field.ideal(pixels))


def test_mrcal_s_spline_has_the_field(bent):
    lens, text, pixels, rays = bent
    assert np.linalg.norm(seen_by_spline(text, rays) - pixels, axis=1).max() < 1e-3
    # the lens alone is off by the field
    assert np.linalg.norm(lens.project(rays) - pixels, axis=1).mean() > 0.5


def test_mrcal_itself_sees_the_field(bent, tmp_path):
    _, text, pixels, rays = bent
    path = tmp_path / 'a.cameramodel'
    path.write_text(text)
    seen, size = mrcal_sees(path, rays)
    assert np.linalg.norm(seen - pixels, axis=1).max() < 1e-3 and size == PART


def test_a_field_that_no_spline_has_is_refused():
    with pytest.raises(OutputError, match=r'0\.001 px') as raised:
        export(NamedCamera('given', TRUTH.resized(1 / 3, (414, 125)),
                           field=a_field((414, 125), 5.0)), 'mrcal')
    assert raised.value.code == 'E-EXPORT-SPLINE'


@lenses('kalibr')
def test_kalibr(lens, kind):
    cam = yaml.safe_load(export(lens, kind))['cam0']
    assert cam['intrinsics'] == [lens.fx, lens.fy, lens.cx, lens.cy]
    assert cam['resolution'] == list(lens.image_size)
    model = {'radtan': 'plumb_bob', 'equidistant': 'equidistant'}[cam['distortion_model']]
    d = cam['distortion_coeffs'] + [0.0] * (model == 'plumb_bob')
    assert camera_from_ros(lens.image_size, model, lens.matrix.ravel().tolist(), d) == lens


@lenses('opensfm')
def test_opensfm_s_units(lens, kind):
    [(name, camera)] = json.loads(export(lens, kind)).items()
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
    camera = json.loads(export(lens, kind))
    assert camera['cx'] == lens.cx + 0.5 and camera['fl_y'] == lens.fy
    assert camera['k2'] == lens.k2 and camera['frames'] == []
    assert camera['camera_model'] == ('OPENCV_FISHEYE' if lens.model == 'fisheye' else 'OPENCV')


def test_a_resized_picture_s_camera(lens):
    width, height = lens.image_size
    small = resized(lens, (width // 2, height // 2))
    x, y = small.image_size[0] / width, small.image_size[1] / height
    seen = (lens.project(POINTS) + 0.5) * (x, y) - 0.5
    np.testing.assert_allclose(small.project(POINTS), seen, atol=1e-9)
    with pytest.raises(ConfigError, match='--crop') as raised:
        resized(lens, (640, 480))
    assert raised.value.code == 'E-SIZE-SHAPE'


@pytest.mark.parametrize('size', [(0, 0), (0, 10), (10, 0), (10**9, 10**9)])
def test_a_size_that_is_none(lens, size):
    with pytest.raises(DashcalibError) as raised:
        resized(lens, size)
    assert min(size) > 0 or raised.value.code == 'E-SIZE-NOT-POSITIVE'


def test_a_part_s_camera(lens):
    part = cropped(lens, 40, 25, 640, 300)
    assert part.image_size == (640, 300)
    np.testing.assert_allclose(part.project(POINTS), lens.project(POINTS) - (40, 25), atol=1e-9)


@pytest.mark.parametrize('crop', [(-1, 0, 10, 10), (0, 0, 0, 10), (1200, 0, 100, 10)])
def test_a_part_that_is_none(lens, crop):
    with pytest.raises(ConfigError) as raised:
        cropped(lens, *crop)
    assert raised.value.code == 'E-CROP-OUTSIDE'


def test_a_kind_that_there_is_not(lens):
    with pytest.raises(ConfigError, match=', '.join(EXPORTS)) as raised:
        export(lens, 'blender')
    assert raised.value.code == 'E-EXPORT-KIND'


@pytest.mark.parametrize('kind', EXPORTS)
def test_a_file_s_name_says_what_it_has(kind):
    known = EXPORTS[kind].suffixes
    for suffix in known:
        check_suffix(Path(f'a/camera{suffix.upper()}'), kind)
    for name in ('m.png', 'camera.v2', 'a.npz' if '.npz' not in known else 'a.txt'):
        with pytest.raises(ConfigError, match=Path(name).stem + re.escape(known[0])) as raised:
            check_suffix(Path(name), kind)
        assert raised.value.code == 'E-EXPORT-SUFFIX'
