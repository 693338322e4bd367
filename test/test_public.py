"""What `from dashcalib_ros import ...` gives, and that its help needs no other help."""
from __future__ import annotations

import inspect
import types

import cv2
import numpy as np
import pytest
from fakes import stands_in_for
from made_calibration import TRUTH, make_calibration

import dashcalib_ros
from dashcalib_ros import Calibrator, calibrate, check, session
from dashcalib_ros.errors import InputError
from dashcalib_ros.judge import Check
from dashcalib_ros.questions import Questions

NAMES = ('calibrate', 'check', 'load_camera', 'open_frames', 'Calibration', 'Calibrator', 'Config',
         'Frame', 'Camera', 'Radial', 'Brown', 'Fisheye', 'Rational')


def test_all_names_are_there_to_see():
    assert set(NAMES) == set(dashcalib_ros.__all__) <= set(dir(dashcalib_ros))


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
        type(self).mask = mask

    def push(self, frame):
        pass

    def calibrate(self, progress=None):
        progress('solving', 1.0)
        return make_calibration()

    def turns(self):
        return ()

    def close(self):
        pass


@stands_in_for(Questions)
class FakeQuestions:
    """Asks nothing."""

    def __init__(self, calibrator):
        pass

    def check(self, given, calibration, progress=None):
        progress('checking', 1.0)
        return Check('right', (), 0.0, 1.0)

    def watch(self, camera, sigma=None, progress=None):
        return types.SimpleNamespace(changes=())


@pytest.fixture
def drive(tmp_path, monkeypatch):
    monkeypatch.setattr(session, 'Calibrator', FakeCalibrator)
    monkeypatch.setattr(session, 'Questions', FakeQuestions)
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
        assert told[5] == ('solving', 1.0)
    with pytest.raises(InputError, match='64x47'):
        run(drive, mask=mask[1:])
    with pytest.raises(InputError, match='height, width'):
        run(drive, mask=np.zeros((48, 64, 3)))
