# SPDX-License-Identifier: Apache-2.0
"""dashcalib check around a calibrator of our own making: what the command itself decides."""
from __future__ import annotations

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from fakes import stands_in_for
from made_calibration import MOUNT, TRUTH, make_calibration
from made_drives import START, TIMES, drive, images, info_of, write_bag, write_timed

from dashcalib_ros import judge, session
from dashcalib_ros.camera import Radial
from dashcalib_ros.cli import command, main
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.formats import result_json
from dashcalib_ros.judge import Check, Odometry, Reading
from dashcalib_ros.judge.odometry import TurnOdometry, TurnPath
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.problem.quadratic import Quadratic
from dashcalib_ros.solve.spread import PictureSigma


@stands_in_for(Calibrator)
class FakeCalibrator:
    """Answers at once with what the test wants."""

    mount = None
    answer = 'right'
    asked: object = None
    fits = 5

    def __init__(self, config=None, mask=None, verbose=False):
        self.detection = SimpleNamespace(turns=tuple, lines=lambda: None,
                                         resized=lambda camera: camera)
        self.workers = SimpleNamespace(run=self._run)
        self.scenes = SimpleNamespace(reconstructed=list)
        self.solution = SimpleNamespace()

    def sense(self, motion, warmth=None):
        pass

    def push(self, frame):
        pass

    def calibrate(self, progress=None):
        return make_calibration(warnings=(Notice('', 'dark'),), mount=self.mount)

    def _run(self, function, *given):
        """Answer in a worker's place."""
        if function is judge.check:
            type(self).asked = given[0]
            return Check(self.answer, ('it is 0.2 px off',), 0.2, 0.5, PictureSigma(0.1, 0.2),
                         1.5, 4.7, 0.001)
        if function is judge.readings_of:
            return [Reading(TurnId.at(n), Quadratic.prior(100 * np.eye(6)), None, n < self.fits)
                    for n in range(5)]
        assert function is judge.beside_poses
        rotations, places = np.array([np.eye(3)] * 4), np.arange(12.0).reshape(4, 3)
        path = TurnPath(rotations, places)
        turn = TurnOdometry(TurnId.at(88), np.arange(4) * 10**8, path,
                            {'given': path, 'ours': path, 'guess': path})
        return Odometry(('given', 'ours', 'guess'), (turn,))

    def close(self):
        pass


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Make a drive, a calibration and a file of poses; return the command's first arguments."""
    monkeypatch.setattr('dashcalib_ros.session.Calibrator', FakeCalibrator)
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'drive').mkdir()
    for n in range(3):
        cv2.imwrite(str(tmp_path / 'drive' / f'{n}.png'), np.full((48, 64), 60 + n, np.uint8))
    (tmp_path / 'camera.json').write_text(json.dumps(
        {**TRUTH.named, 'width': TRUTH.image_size[0], 'height': TRUTH.image_size[1]}))
    (tmp_path / 'poses.txt').write_text('1 0 0 0 0 1 0 0 0 0 1 0\n' * 3)
    return ['check', 'camera.json', 'drive', '--fps', '10']


@pytest.mark.parametrize(('answer', 'code'), [('right', 0), ('differs', 0), ('wrong', 1),
                                             ('cannot tell', 3)])
def test_the_answer_is_shown_and_is_the_exit_code(files, monkeypatch, capfd, answer, code):
    monkeypatch.setattr(FakeCalibrator, 'answer', answer)
    assert main(files) == code
    out, errors = capfd.readouterr()
    assert out.splitlines()[0] == f'answer: {answer}' and 'it is 0.2 px off' in out
    assert 'dark' in errors and FakeCalibrator.asked == TRUTH


def test_the_answer_ends_with_what_to_do(files, monkeypatch, capfd):
    monkeypatch.setattr(FakeCalibrator, 'answer', 'wrong')
    assert main(files) == 1
    assert capfd.readouterr().out.splitlines()[-1].startswith('next: replace it')
    assert main([*files, '--json']) == 1
    assert json.loads(capfd.readouterr().out)['next_step'].startswith('replace it')


def test_what_is_odd_in_the_calibration_is_a_warning(files, tmp_path, capfd):
    (tmp_path / 'camera.json').write_text(json.dumps(
        {**TRUTH.named, 'fy': 1.3 * TRUTH.fx, 'width': 1242, 'height': 375}))
    assert main(files) == 0
    assert '[E-CALIBRATION-ASPECT]' in capfd.readouterr().err


def test_exchanged_arguments_are_told(files, tmp_path, capfd):
    write_bag(tmp_path / 'bag', [*images(drive(3)), ('/camera_info', START, info_of(TRUTH))])
    write_timed(tmp_path / 'drive.mp4', TIMES[:5])
    for given in ('drive', 'drive.mp4', 'bag'):
        assert main(['check', given, 'camera.json']) == 2
        assert '[E-ARGUMENTS-EXCHANGED]' in capfd.readouterr().err
        with pytest.raises(InputError) as raised:
            session.check(given, 'camera.json')
        assert raised.value.code == 'E-ARGUMENTS-EXCHANGED'
    # two calibrations, and two drives, are something else
    for pair in (('camera.json', 'camera.json'), ('drive', 'drive.mp4')):
        assert main(['check', *pair]) == 2
        assert 'EXCHANGED' not in capfd.readouterr().err


def test_a_bag_s_own_calibration_is_checked(files, tmp_path, capfd):
    write_bag(tmp_path / 'bag', [*images(drive(3)), ('/camera_info', START, info_of(TRUTH))])
    FakeCalibrator.asked = None
    assert main(['check', 'bag']) == 0 and FakeCalibrator.asked == TRUTH
    assert main(['check', 'bag', '--topic', '/camera']) == 0
    write_bag(tmp_path / 'without', images(drive(3)))
    assert main(['check', 'without']) == 2
    assert '[E-BAG-CAMERA-INFO]' in capfd.readouterr().err


def test_a_calibration_of_the_stored_pictures_is_checked_as_it_is_shown(files, tmp_path, capfd):
    """The drive's pixels are twice as wide as high."""
    write_timed(tmp_path / 'wide.mp4', TIMES[:5], aspect=(2, 1))
    shown = Radial((320, 64), 240.0, 241.0, 158.0, 30.0)
    stored = shown.resized(0.5, (160, 64), 1.0)
    for given in (shown, stored):
        (tmp_path / 'given.json').write_text(json.dumps(
            given.named | {'width': given.image_size[0], 'height': 64}))
        assert main(['check', 'given.json', 'wide.mp4']) == 0
        assert FakeCalibrator.asked == shown
    assert 'not square' in capfd.readouterr().err


def _shown(capfd):
    return ' '.join(capfd.readouterr().out.split())


@pytest.mark.parametrize(('now', 'code', 'said'), [
    (MOUNT, 0, 'sits as before'), (replace(MOUNT, pitch_up_deg=1.0), 1, 'camera was moved'),
    (None, 3, 'longer straight')])
def test_a_camera_that_was_moved_is_wrong_where_that_is_asked(files, tmp_path, monkeypatch, capfd,
                                                              now, code, said):
    assert main([*files, '--mount']) == 2
    assert '[E-MOUNT-UNKNOWN]' in capfd.readouterr().err
    (tmp_path / 'result.json').write_text(result_json(make_calibration(mount=MOUNT)))
    monkeypatch.setattr(FakeCalibrator, 'mount', now)
    asked = ['check', 'result.json', *files[2:]]
    assert main(asked) == 0 and (now is None) == (said not in _shown(capfd))
    assert main([*asked, '--mount']) == code and said in _shown(capfd)
    assert main([*asked, '--mount', '--json']) == code
    mount = json.loads(capfd.readouterr().out)['mount']
    assert mount is None if now is None else mount['moved'] == bool(code)


def test_json_has_what_programs_need(files, capfd):
    assert main([*files, '--json', '--poses', 'poses.txt']) == 0
    found = json.loads(capfd.readouterr().out)
    assert (found['answer'], found['rms_px'], found['worst_px']) == ('right', 0.2, 0.5)
    assert found['reasons'] == ['it is 0.2 px off'] and found['changes'] == []
    assert set(found['rotation_deg']) == {'given', 'ours', 'guess'}
    assert found['turns'][0]['center'] == 88


def test_a_gps_track_may_be_the_poses(files, tmp_path, capfd):
    rows = '\n'.join(f'{n / 10},49.0,{8 + n * 1e-5}' for n in range(60))
    (tmp_path / 'track.csv').write_text(f'stamp_s,latitude,longitude\n{rows}\n')
    assert main([*files, '--json', '--poses', 'track.csv']) == 0
    assert 'rotation_deg' in json.loads(capfd.readouterr().out)
    (tmp_path / 'gyro.csv').write_text('stamp_s,speed\n' + '0.1,2\n0.2,3\n')
    assert main([*files, '--poses', 'gyro.csv']) == 2
    assert '[E-NO-GPS-TRACK]' in capfd.readouterr().err
    write_bag(tmp_path / 'bag', images(drive(3)))
    assert main([*files, '--poses', 'bag']) == 2
    assert '[E-NO-GPS-TRACK]' in capfd.readouterr().err


@pytest.mark.parametrize(('more', 'line'), [
    (['--motion', 'none.csv'], 'none.csv'), (['--motion', 'camera.json'], 'E-MOTION-HEADER'),
    (['--motion', 'gyro.csv', '--imu', '/imu'], '--imu'),
    (['--gyro-scale-sigma', '-1'], 'must be 0 or more')])
def test_wrong_motion_arguments_are_one_line(files, tmp_path, capfd, more, line):
    (tmp_path / 'gyro.csv').write_text('stamp_s,speed\n0.1,2\n')
    assert main([*files, *more]) == 2
    [error] = capfd.readouterr().err.splitlines()
    assert line in error


def test_a_change_during_the_drive_is_told(files, monkeypatch, capfd):
    monkeypatch.setattr(FakeCalibrator, 'fits', 3)
    assert main(files) == 0
    assert 'since the turn at frame 3' in capfd.readouterr().out


def test_a_calibration_that_never_fitted_has_not_changed(files, monkeypatch, capfd):
    monkeypatch.setattr(FakeCalibrator, 'fits', 0)
    assert main(files) == 0
    assert 'since' not in capfd.readouterr().out


def test_poses_are_compared_and_paths_are_written(files, tmp_path, capfd):
    assert main([*files, '--poses', 'poses.txt', '--out', 'paths']) == 0
    out = capfd.readouterr().out
    assert 'rotation error' in out and 'written: paths' in out
    assert (tmp_path / 'paths' / 'turn_000088_ours.tum').exists()


@pytest.mark.parametrize(('arguments', 'match'), [
    (['check', 'nothing.json', 'drive'], 'does not exist'),
    (['check', 'camera.json', 'nothing'], 'does not exist'),
    (['check', 'camera.json', 'drive', '--poses', 'camera.json'], 'no poses'),
    (['check', 'camera.json', 'drive', '--out', 'x'], '[E-OUT-WITHOUT-POSES]'),
    (['check', 'camera.json'], '[E-INPUT-MISSING]'),
])
def test_bad_input_is_one_line(files, capfd, arguments, match):
    assert main(arguments) == 2
    errors = capfd.readouterr().err.strip().splitlines()
    assert len(errors) == 1 and match in errors[0]


def test_what_nobody_expected_is_no_answer(files, monkeypatch, capfd):
    def fail(*_):
        raise ZeroDivisionError('of a defect')
    monkeypatch.setattr(FakeCalibrator, '_run', fail)
    monkeypatch.setattr(sys, 'argv', ['dashcalib', *files, '--verbose'])
    # Python's own exit code, 1, would be "wrong"
    with pytest.raises(SystemExit) as ended:
        command()
    assert ended.value.code == 2
    error = capfd.readouterr().err
    assert 'Traceback' in error and error.splitlines()[-1].startswith('dashcalib: error: this is')


@pytest.mark.parametrize('name', ['track.txt', 'track.csv'])
def test_a_track_and_poses_are_known_by_their_content(files, tmp_path, capfd, name):
    rows = '\n'.join(f'{n / 10},49.0,{8 + n * 1e-5}' for n in range(60))
    (tmp_path / name).write_text(f'stamp_s,latitude,longitude\n{rows}\n')
    assert main([*files, '--poses', name]) == 0 and 'turn' in capfd.readouterr().out
    (tmp_path / name).write_text(''.join(
        f'{(1700000000 + n) * 10**9},{n},0,0,0,0,0,1\n' for n in range(5)))
    assert main([*files, '--poses', name]) == 0
    assert 'nanoseconds' in capfd.readouterr().err
    assert main([*files, '--motion', name]) == 2
    assert '--poses' in capfd.readouterr().err
