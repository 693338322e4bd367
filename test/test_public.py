# SPDX-License-Identifier: Apache-2.0
"""What `from dashcalib_ros import ...` gives, and that its help needs no other help."""
from __future__ import annotations

import inspect
import json
import os
import pickle
import subprocess
import sys
import types
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import cv2
import numpy as np
import pytest
from fakes import stands_in_for
from made_calibration import MOUNT, TRUTH, make_calibration
from packaging.version import Version
from refused import refused

import dashcalib_ros
from dashcalib_ros import (
    Calibration,
    Calibrator,
    Check,
    Config,
    ConfigError,
    Frame,
    Verdict,
    calibrate,
    check,
    compare,
    export,
    judge,
    load_camera,
    open_frames,
    session,
)
from dashcalib_ros.errors import DashcalibError, InputError, NotAcceptedError, Notice
from dashcalib_ros.formats import given_camera
from dashcalib_ros.input.motion import SensorStream

FUNCTIONS = ('calibrate', 'calibrate_rig', 'check', 'compare', 'export', 'load_camera',
             'load_rig', 'open_frames')
ERRORS = ('ConfigError', 'DashcalibError', 'InputError', 'NotAcceptedError', 'OutputError',
          'WorkerError')
NAMES = (*FUNCTIONS, *ERRORS, 'AcceptedCalibration', 'Calibration', 'Calibrator', 'Config',
         'Check', 'Comparison', 'NamedCamera', 'Frame', 'Camera', 'Radial', 'Brown', 'Fisheye',
         'Notice', 'Rational', 'RigCalibration', 'SensorStream', 'Status', 'Verdict')
# what mypy --strict accepts of a user
SCRIPT = """
from dashcalib_ros import calibrate
found = calibrate('drive.mp4').accepted()
print(found.camera.fx, found.sigma['fx'], found.K @ found.rays([[0.0, 0.0]])[0], found.D.tolist())
"""


def test_all_names_are_there_to_see():
    assert {*NAMES, '__version__'} == set(dashcalib_ros.__all__)
    assert dir(dashcalib_ros) == sorted(dashcalib_ros.__all__)
    assert Version(dashcalib_ros.__version__)


def test_an_import_changes_nothing_in_its_process():
    script = """
import os, apsw, cv2
from rosbags.rosbag1 import reader
get_level = getattr(cv2, 'getLogLevel', None) or cv2.utils.logging.getLogLevel
def state():
    return dict(os.environ), get_level(), cv2.getNumThreads(), dict(reader.decompressors), list(
        apsw.connection_hooks)
before = state()
import dashcalib_ros
for name in dashcalib_ros.__all__:
    getattr(dashcalib_ros, name)
import dashcalib_ros.input.decode, dashcalib_ros.input.bag_read
assert state() == before, state()
"""
    kept = {name: value for name, value in os.environ.items() if not name.startswith('OPENCV_')}
    subprocess.run([sys.executable, '-c', script], env=kept, check=True)


def test_what_is_not_installed_has_a_version_too(monkeypatch):
    monkeypatch.setattr('importlib.metadata.version', raising(PackageNotFoundError()))
    assert Version(dashcalib_ros.__version__).local == 'sources'


def raising(error):
    def fail(name):
        raise error
    return fail


@pytest.mark.parametrize('name', [name for name in FUNCTIONS if name != 'calibrate_rig'])
def test_what_follows_the_path_is_named(name):
    order = ('topic', 'fps', 'start_s', 'duration_s', 'stamps', 'crop', 'mask', 'motion', 'model',
             'config', 'progress')
    options = [each.name for each in
               inspect.signature(getattr(dashcalib_ros, name)).parameters.values()
               if each.default is not inspect.Parameter.empty]
    known = [each for each in order if each in options]
    assert [each for each in options if each in order] == known
    assert all(inspect.signature(getattr(dashcalib_ros, name)).parameters[each].kind
               is inspect.Parameter.KEYWORD_ONLY for each in options)


def test_every_error_is_a_child_of_one():
    assert all(issubclass(getattr(dashcalib_ros, name), DashcalibError) for name in ERRORS)


@pytest.mark.parametrize('name', NAMES)
def test_help_stands_alone(name):
    what = getattr(dashcalib_ros, name)
    text = ' '.join((inspect.getdoc(what) or '').split())
    assert len(text.split()) > 8 and 'as for ' not in text and 'those of' not in text
    if inspect.isfunction(what):
        assert all(f'{each}' in text for each in inspect.signature(what).parameters), name
        assert 'Raises InputError' in text


@stands_in_for(Calibrator)
class FakeCalibrator:
    """Takes note of what it is given."""

    def __init__(self, config=None, mask=None, verbose=False):
        type(self).config = config
        type(self).mask, type(self).motion, type(self).frames = mask, None, 0
        self.detection = types.SimpleNamespace(turns=tuple, lines=lambda: None,
                                               resized=lambda camera: camera)
        self.workers = types.SimpleNamespace(run=self._run)
        self.scenes, self.solution = types.SimpleNamespace(reconstructed=list), None

    def sense(self, motion, warmth=None):
        type(self).motion = motion

    def push(self, frame):
        type(self).frames += 1

    def calibrate(self, progress=None):
        progress('solving', 1.0)
        return make_calibration()

    def _run(self, function, *given):
        """Answer in a worker's place."""
        if function is judge.readings_of:
            return ()
        type(self).given = given[0]
        return Check('right', (), 0.0, 1.0)

    def close(self):
        pass


@pytest.fixture
def drive(tmp_path, monkeypatch):
    monkeypatch.setattr(session, 'Calibrator', FakeCalibrator)
    (tmp_path / 'drive').mkdir()
    for n in range(4):
        cv2.imwrite(str(tmp_path / 'drive' / f'{n}.png'), np.full((48, 64), 60 + n, np.uint8))
    return tmp_path / 'drive'


@pytest.mark.parametrize('run', [calibrate, lambda path, **more: check(TRUTH, path, **more)])
def test_a_mask_and_the_progress(drive, tmp_path, run):
    mask = np.full((48, 64), 255, np.uint8)
    mask[40:] = 0
    cv2.imwrite(str(tmp_path / 'mask.png'), mask)
    for given in (mask, mask > 0, str(tmp_path / 'mask.png'), tmp_path / 'mask.png'):
        told = []
        run(drive, mask=given, progress=lambda stage, done, told=told: told.append((stage, done)))
        np.testing.assert_array_equal(FakeCalibrator.mask, mask > 0)
        assert told[:5] == [('reading', share) for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
        assert told[5][1] == 1.0 and told[-1] == ('done', 1.0)
    with pytest.raises(InputError, match='64x47'):
        run(drive, mask=mask[1:])
    for wrong in (np.zeros((48, 64, 3)), 3, [['a', 'b']]):
        with refused(InputError, 'E-MASK-SHAPE', 'height, width'):
            run(drive, mask=wrong)


@pytest.mark.parametrize('run', [calibrate, lambda path, **more: check(TRUTH, path, **more)])
def test_the_sensors_of_a_drive_are_heard(drive, tmp_path, run):
    (tmp_path / 'gyro.csv').write_text('stamp_s,gyro_x,gyro_y,gyro_z\n0,0,0.1,0\n1,0,0.2,0\n')
    run(drive, motion=tmp_path / 'gyro.csv')
    assert FakeCalibrator.motion is not None
    given = SensorStream()
    run(drive, motion=given)
    assert FakeCalibrator.motion is given
    run(drive)
    assert FakeCalibrator.motion is None


@pytest.mark.parametrize('run', [calibrate, open_frames,
                                 lambda path: check(TRUTH, path)], ids=['run', 'open', 'check'])
@pytest.mark.parametrize('path', [None, 3, b'drive.mp4', [None], ['a.mp4', 3]])
def test_what_is_no_path_is_an_input_error(run, path):
    with refused(InputError, 'E-PATH-TYPE'):
        run(path)


def test_no_path_is_taken_for_the_current_folder(drive, monkeypatch):
    monkeypatch.chdir(drive)
    for use in (calibrate, open_frames, load_camera, Calibration.load, make_calibration().save,
                lambda path: check(TRUTH, path), lambda path: check(path, drive),
                lambda path: calibrate([drive, path]), lambda path: calibrate(drive, mask=path),
                lambda path: calibrate(drive, motion=path)):
        with refused(InputError, 'E-PATH-EMPTY'):
            use('')
    for use in (load_camera, Calibration.load, make_calibration().save,
                lambda path: calibrate(drive, motion=path)):
        with refused(InputError, 'E-PATH-TYPE', '3'):
            use(3)


@pytest.mark.parametrize('run', [calibrate, lambda path, **more: check(TRUTH, path, **more)])
@pytest.mark.parametrize(('name', 'value', 'kind', 'code'), [
    ('fps', 'x', InputError, 'E-INPUT-FPS'), ('fps', True, InputError, 'E-INPUT-FPS'),
    ('start_s', '1:30', InputError, 'E-INPUT-START'),
    ('duration_s', [3], InputError, 'E-INPUT-DURATION'), ('topic', 3, InputError, 'E-TOPIC-TYPE'),
    ('config', 'settings.yaml', ConfigError, 'E-CONFIG-TYPE'),
    ('config', {'turns.wanted': 'x'}, ConfigError, 'E-CONFIG-TYPE'),
    ('config', {3: 4}, ConfigError, 'E-CONFIG-UNKNOWN'),
    ('model', 'fishy', ConfigError, 'E-MODEL-UNKNOWN')])
def test_a_wrong_argument_is_named(drive, run, name, value, kind, code):
    with refused(kind, code):
        run(drive, **{name: value})


@pytest.mark.parametrize('run', [calibrate, lambda path, **more: check(TRUTH, path, **more)])
def test_settings_are_a_config_or_a_mapping(drive, run):
    for given in (Config.of({'turns.wanted': 8}, model='fisheye'),
                  {'turns': {'wanted': 8}, 'model': 'fisheye'}):
        run(drive, config=given)
        assert FakeCalibrator.config == Config.of({'turns.wanted': 8, 'model': 'fisheye'})
    run(drive, config={'model': 'radial'}, model='brown')
    assert FakeCalibrator.config == Config(model='brown')
    with Calibrator({'turns.wanted': 8}) as calibrator:
        assert calibrator.scenes.config.turns.wanted == 8
    with refused(InputError, 'E-MASK-SHAPE'):
        Calibrator(mask=[1])


def test_paths_that_come_one_by_one_are_a_drive(drive):
    calibrate(each for each in (drive, drive))
    assert FakeCalibrator.frames == 8


def test_a_calibration_is_given_in_any_form(drive, tmp_path):
    result = make_calibration()
    result.save(tmp_path / 'a')
    named = dashcalib_ros.load_camera(tmp_path / 'a')
    for given in (result, TRUTH, named, tmp_path / 'a', str(tmp_path / 'a/calibration.yaml')):
        check(given, drive)
        assert FakeCalibrator.given == TRUTH
        assert compare(given, result).mapping_px == pytest.approx(0.0, abs=1e-6)
        assert json.loads(export(given, 'nerfstudio'))['fl_x'] == TRUTH.fx
    for use in (lambda given: check(given, drive), lambda given: compare(given, TRUTH),
                lambda given: export(given, 'ros')):
        with pytest.raises(InputError) as error:
            use(None)
        assert error.value.code == 'E-CALIBRATION-TYPE'


@pytest.mark.parametrize('image', [
    'x.png', None, [[1, 2]], np.zeros(5), np.zeros((375, 1242), bool), np.zeros((375, 1242), int)])
def test_what_is_no_image_is_not_undistorted(image):
    with refused(InputError, 'E-IMAGE-TYPE'):
        make_calibration().undistort(image)


@pytest.mark.parametrize('name', ['rays', 'project', 'sigma_at'])
@pytest.mark.parametrize('places', ['x', None, 3, [1, 2, 3, 4], [[1], [2, 3]]])
def test_places_of_another_shape(name, places):
    wide = make_calibration(picture_covariance=np.eye(9))
    with refused(InputError, 'E-ARRAY-SHAPE', '(..., '):
        getattr(wide, name)(places)


def test_results_can_be_compared_and_be_keys_and_be_sent():
    found = make_calibration(mount=MOUNT, details={'a': [1]})
    one = Frame(0, 0, np.zeros((4, 6), np.uint8))
    for result in (found, found.accepted(), found.verdict, TRUTH, Config(), compare(found, found),
                   given_camera(found), Check('right', (), limits_px={'mapping': 1.0}), one):
        assert len({result, result}) == 1
        same = pickle.loads(pickle.dumps(result))
        assert (same == result and hash(same) == hash(result)) == (result is not one)


def test_results_are_plain_values_and_one_line():
    found = make_calibration()
    for result in (found, make_calibration('refused'), compare(found, TRUTH), given_camera(found),
                   Check('right', ('so',), limits_px={'mapping': 1.0})):
        assert json.loads(json.dumps(result.to_dict(), allow_nan=False)) == result.to_dict()
    assert repr(compare(found, TRUTH)).startswith('Comparison(estimate and the radial camera: ')
    assert repr(Check('right', ('so',))) == 'Check(right: so)'
    for verdict in ('accepted', 'weak', 'refused'):
        assert make_calibration(verdict).verdict.accepted == (verdict == 'accepted')
    across, down, _ = found.field_of_view
    assert (across, down) == found.camera.field_of_view[:2] and 20 < down < across < 100


def test_a_notebook_shows_a_result():
    weak = make_calibration('weak', verdict=Verdict('weak', (Notice('', '<b>dark</b>'),)))
    page = weak._repr_html_()
    assert '<b>weak</b>' in page and '&lt;b&gt;dark' in page and '721.54 px' in page
    assert 'dark' in make_calibration(verdict=Verdict(
        'refused', (Notice('', 'dark'), Notice('', 'few'))), camera=None)._repr_html_()


def test_accepted_returns_the_same_result_or_raises_with_the_reasons():
    result = make_calibration()
    found = result.accepted()
    assert found.camera == result.camera and found.sigma == result.sigma
    assert found.material is result.material and repr(found) == repr(result)
    assert found.intrinsics == result.intrinsics and found.accepted() == found
    for level in ('weak', 'refused'):
        other = make_calibration(level)
        with pytest.raises(NotAcceptedError) as error:
            other.accepted()
        assert error.value.code == 'E-NOT-ACCEPTED' and level in str(error.value)
        assert all(str(reason) in str(error.value) for reason in other.verdict.reasons)


@pytest.mark.thorough
def test_a_script_of_three_lines_is_clean_for_mypy(tmp_path):
    pytest.importorskip('mypy')
    root = Path(__file__).parents[1]

    def checked(script):
        (tmp_path / 'script.py').write_text(script)
        return subprocess.run(
            # errors of an installed package are not the user's
            [sys.executable, '-m', 'mypy', '--strict', '--follow-imports=silent',
             str(tmp_path / 'script.py')], cwd=root,
            env={**os.environ, 'MYPYPATH': str(root)}, capture_output=True, text=True, timeout=300)
    done = checked(SCRIPT)
    assert done.returncode == 0, done.stdout + done.stderr
    # accepted() is what does it
    done = checked(SCRIPT.replace('.accepted()', ''))
    assert done.returncode == 1 and 'None' in done.stdout
