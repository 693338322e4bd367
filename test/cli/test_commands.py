# SPDX-License-Identifier: Apache-2.0
"""run and turns around a calibrator of our own making: all that the command itself decides."""
from __future__ import annotations

import dataclasses
import errno
import json
import os
import pty
import re
import shutil
import signal
import sys
import types
import warnings
from typing import ClassVar
from unittest.mock import create_autospec

import cv2
import made_drives
import numpy as np
import pytest
import yaml
from fakes import called_like, stands_in_for
from made_calibration import TRUTH, make_calibration
from refused import refused
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from dashcalib_ros.camera import AUTO, calibrated_models, ros_camera
from dashcalib_ros.cli import main, program
from dashcalib_ros.cli.arguments import make_parser
from dashcalib_ros.cli.drive import open_drive
from dashcalib_ros.cli.terminal import Stages
from dashcalib_ros.config import Config
from dashcalib_ros.demo import Drive, Lens, demo_drive, render_to_bag
from dashcalib_ros.detect.turn import Turn, TurnId
from dashcalib_ros.errors import ConfigError, Notice, OutputError, WorkerError
from dashcalib_ros.judge import Verdict
from dashcalib_ros.judge.conclude import Outlook
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.report import write_results
from dashcalib_ros.selection import Status

NAMES_OF_MODELS = [AUTO, *(model.model for model in calibrated_models())]


# what the fake warns of, and what the user sees of it
DARK, WARNED = Notice('E-DARK', 'dark'), 'dashcalib: warning: dark [E-DARK]\n'


@stands_in_for(Calibrator)
class FakeCalibrator:
    """Answers at once with what the test wants; remembers how it was used."""

    level = 'accepted'
    failure: BaseException | None = None
    found = (Turn(center=88, first=58, last=118, stamp_s=8.8, prominence=0.06,
                  released_images=61),)
    yaws_deg: ClassVar[dict[TurnId, float]] = {TurnId.at(88): 71.6}
    made: ClassVar[list[FakeCalibrator]] = []

    def __init__(self, config=None, mask=None, verbose=False):
        self.config, self.mask, self.verbose = config, mask, verbose
        self.frames, self.closed = 0, False
        self.made.append(self)

    def sense(self, motion, warmth=None):
        pass

    def push(self, frame):
        self.frames += 1
        return Status(frames=self.frames, turns=self.frames // 2, built=0, yaw_deg=0.0,
                      magnitude=0.0, standing=False)

    @property
    def detection(self):
        return types.SimpleNamespace(turns=lambda: self.found, finish=list)

    @property
    def scenes(self):
        return types.SimpleNamespace(config=self.config)

    def calibrate(self, progress=None):
        progress('reconstructing', 0.5)
        if self.failure is not None:
            raise self.failure
        return make_calibration(self.level, config=self.config, warnings=(DARK,), input_name='')

    def reconstruct(self, progress, final):
        return []

    def evidence(self, started, sensors):
        pass

    def close(self):
        self.closed = True

    @classmethod
    def _outlook(cls, scenes, evidence, config):
        return Outlook(cls.made[-1].frames, cls.found, cls.yaws_deg, Verdict(
            cls.level, () if cls.level == 'accepted' else
            (Notice('E-A', 'few', 'drive'), Notice('E-B', 'less', 'park'))),
            (), 0.0)


@pytest.fixture
def fake(monkeypatch):
    """Put the fake in the calibrator's place."""
    monkeypatch.setattr('dashcalib_ros.session.Calibrator', FakeCalibrator)
    monkeypatch.setattr('dashcalib_ros.session.outlook', FakeCalibrator._outlook)
    monkeypatch.setattr(FakeCalibrator, 'made', [])
    return FakeCalibrator


@pytest.fixture
def drive(tmp_path, monkeypatch):
    """Make a folder of four pictures and go to an empty folder beside it."""
    (tmp_path / 'drive').mkdir()
    (tmp_path / 'work').mkdir()
    monkeypatch.chdir(tmp_path / 'work')
    for i in range(4):
        picture = np.full((48, 64), 60 + i, np.uint8)
        cv2.imwrite(str(tmp_path / 'drive' / f'{i}.png'), picture)
    return str(tmp_path / 'drive')


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(('level', 'code', 'files'), [
    ('accepted', 0, ['calibration.yaml', 'report.html', 'result.json']),
    ('weak', 3, ['calibration.weak.yaml', 'report.html', 'result.json']),
    ('refused', 3, ['report.html', 'result.json']),
])
def test_run_writes_shows_and_says_the_verdict(
        fake, drive, tmp_path, monkeypatch, capsys, level, code, files):
    monkeypatch.setattr(fake, 'level', level)
    assert main(['run', drive, '--fps', '10']) == code
    assert names(tmp_path / 'work' / 'calibration') == files
    shown = capsys.readouterr()
    lines = shown.out.splitlines()
    assert lines[0] == f'verdict: {level}' and lines[-1].startswith('next: ')
    assert '\x1b' not in shown.out
    assert all(name in shown.out.partition('written to calibration: ')[2] for name in files)
    assert shown.err == WARNED  # no progress in a pipe
    assert fake.made[0].frames == 4 and fake.made[0].closed
    result = json.loads((tmp_path / 'work/calibration/result.json').read_text())
    assert 'drive' in result['input'] and result['warnings'] == ['dark']
    assert result['warning_codes'] == ['E-DARK']


def test_warnings_about_the_input_reach_the_user_and_the_result(fake, drive, tmp_path, capsys):
    (tmp_path / 'drive' / '2.png').write_bytes(b'no picture')
    assert main(['run', drive, '--fps', '10']) == 0
    warned = capsys.readouterr().err.splitlines()
    assert len(warned) == 2 and warned[0].endswith(' [E-IMAGES-UNDECODABLE]')
    result = json.loads((tmp_path / 'work/calibration/result.json').read_text())
    assert result['warning_codes'] == ['E-IMAGES-UNDECODABLE', 'E-DARK']
    assert len(result['warnings']) == 2 and '[' not in result['warnings'][0]


@pytest.mark.parametrize('level', ['weak', 'refused'])
def test_an_earlier_calibration_that_is_moved_aside_is_told(
        fake, drive, tmp_path, monkeypatch, capsys, level):
    assert main(['run', drive]) == 0
    assert 'previous' not in capsys.readouterr().err
    monkeypatch.setattr(fake, 'level', level)
    assert main(['run', drive]) == 3
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1] == ('dashcalib: warning: an earlier calibration was renamed to '
                         'calibration/calibration.previous.yaml [E-CALIBRATION-RENAMED]')


def test_the_result_alone_on_stdout(fake, drive, tmp_path, capsys):
    # `--json -` is what earlier versions needed
    for json_flag in (['--json'], ['--json', '-']):
        assert main(['run', drive, '--fps', '10', *json_flag]) == 0
        shown = capsys.readouterr()
        assert json.loads(shown.out) == json.loads(
            (tmp_path / 'work/calibration/result.json').read_text())
        assert shown.err.splitlines()[-1].startswith('next: ') and 'accepted' in shown.err


def test_quiet(fake, drive, tmp_path, capsys):
    assert main(['run', drive, '--fps', '10', '--quiet']) == 0
    assert capsys.readouterr() == ('', WARNED)
    assert main(['run', '--json', drive, '--fps', '10', '--quiet']) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out)['verdict'] == 'accepted' and 'next' not in shown.err


def test_several_inputs_are_one_drive(fake, drive, tmp_path, capsys):
    shutil.copytree(drive, tmp_path / 'drive2')
    assert main(['run', drive, str(tmp_path / 'drive2'), '--fps', '10']) == 0
    assert fake.made[0].frames == 8
    assert main(['run', str(tmp_path / 'drive*'), '--fps', '10', '--start', '0.35', '--duration',
                 '0.15']) == 0
    assert fake.made[1].frames == 2
    result = json.loads((tmp_path / 'work/calibration/result.json').read_text())
    assert result['input'] == f'{drive} and 1 more'
    capsys.readouterr()
    assert main(['run', drive, str(tmp_path / 'drive2'), '--write-bag', 'out']) == 2
    assert '[E-BAG-SEVERAL]' in capsys.readouterr().err


def test_in_a_pipe_progress_is_a_line_from_time_to_time(fake, drive, monkeypatch, capsys):
    monkeypatch.setattr('dashcalib_ros.cli.terminal.EVERY_S', 0.0)
    assert main(['run', drive, '--fps', '10']) == 0
    lines = capsys.readouterr().err.splitlines()
    assert 'dashcalib: reading: frame 4, 1 turn, 100 %' in lines
    assert 'dashcalib: reconstructing, 50 %' in lines
    assert main(['run', drive, '--fps', '10', '--quiet']) == 0
    assert capsys.readouterr().err == WARNED
    clock = iter(range(10**6))
    monkeypatch.setattr('dashcalib_ros.cli.terminal.EVERY_S', 10.0)
    monkeypatch.setattr('time.monotonic', lambda: next(clock))
    stages = Stages()
    for n in range(100):
        stages.show('reading', n / 100)
    assert len(capsys.readouterr().err.splitlines()) == 10


def test_flags_win_over_set_which_wins_over_the_file(fake, drive, tmp_path):
    path = tmp_path / 'config.yaml'
    path.write_text('turns:\n  wanted: 2\n  half_width: 2\nseed: 3\ntracking.standing_px: 2e-1\n')
    assert main(['run', drive, '--config', str(path), '--set', 'turns.wanted=3', '--set',
                 'turns.half_width=1e0', '--turns', '4', '--workers', '2', '--verbose']) == 0
    wanted = Config().replace({'turns.wanted': 4, 'turns.at_most': 4, 'turns.half_width': 1.0,
                               'seed': 3, 'tracking.standing_px': 0.2, 'workers': 2})
    assert fake.made[0].config == wanted and fake.made[0].verbose
    # its earlier name
    assert main(['run', drive, '--threads', '3']) == 0
    assert fake.made[1].config.workers == 3


@pytest.mark.parametrize('model', NAMES_OF_MODELS)
def test_model_is_a_setting(fake, drive, model):
    assert main(['run', drive, '--set', 'model=brown', '--model', model]) == 0
    assert main(['run', drive, '--set', f'model={model}']) == 0
    assert [made.config for made in fake.made] == [Config().replace({'model': model})] * 2


def test_help_names_every_model(capsys):
    for command in ('run', 'demo'):
        assert main([command, '--help']) == 0
        text = capsys.readouterr().out.rpartition('--model NAME')[2].partition('\n  --')[0]
        assert all(name in text for name in NAMES_OF_MODELS), text


def test_an_unknown_model_is_an_error_before_a_drive_is_rendered(
        fake, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for args in (['--model', 'mirror'], ['--lens', 'mirror']):
        assert main(['demo', *args]) == 2
        error = capsys.readouterr().err
        assert error.startswith('dashcalib: error: ') and error.count('\n') == 1
        assert 'mirror' in error and 'radial' in error and 'fisheye' in error
    assert names(tmp_path) == []
    with refused(ConfigError, 'E-MODEL-UNKNOWN', 'mirror'):
        Calibrator(Config(model='mirror'))


def test_the_bag_has_the_view_that_the_setting_wants(fake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made_drives.write_bag(tmp_path / 'drive',
                          made_drives.images(made_drives.drive(3), '/image_raw'))
    assert main(['run', 'drive', '--set', 'rectified=all', '--write-bag', 'with_info']) == 0
    p = load_projection(tmp_path / 'calibration' / 'calibration.yaml')
    assert p == ros_camera(TRUTH, 'all').p != ros_camera(TRUTH).p
    types = get_typestore(Stores.ROS2_JAZZY)
    with Reader(tmp_path / 'with_info') as reader:
        infos = [types.deserialize_cdr(raw, connection.msgtype) for connection, _, raw
                 in reader.messages() if connection.topic == '/camera_info']
    assert len(infos) == 3 and all(info.p.tolist() == p for info in infos)


def load_projection(path):
    return yaml.safe_load(path.read_text())['projection_matrix']['data']


@pytest.mark.parametrize(('args', 'complaint'), [
    (['--set', 'turns.wantd=3'], 'turns.wanted [E-CONFIG-UNKNOWN]'),
    (['--set', 'turns.half_width=.nan'], 'turns.half_width [E-CONFIG-FINITE]'),
    (['--set', 'turns.wanted'], '[E-SETTING-FORM]'),
    (['--set', 'turns.wanted=[1'], '[E-YAML-INVALID]'),
    (['--set', 'turns.wanted=' + '[' * 40 + ']' * 40], '[E-YAML-TOO-LARGE]'),
    (['--set', 'seed=0x' + 'f' * 5000], '[E-YAML-NUMBER]'),
    (['--set', 'seed=0x' + 'f' * 200], 'seed [E-CONFIG-RANGE]'),
    (['--set', 'turns.wanted=!!int ""'], '[E-YAML-INVALID]'),
    (['--turns', '0'], 'turns.wanted [E-CONFIG-RANGE]'),
    (['--seed', '-1'], 'seed [E-CONFIG-RANGE]'),
    (['--model', 'fish-eye'], 'auto, radial, brown, fisheye [E-MODEL-UNKNOWN]'),
    (['--set', 'model=Radial'], 'auto, radial, brown, fisheye [E-MODEL-UNKNOWN]'),
    (['--set', 'rectified=whole'], 'same, crop, all [E-CONFIG-CHOICE]'),
    (['--config', 'missing.yaml'], 'missing.yaml [E-FILE-MISSING]'),
    (['--config', '.'], '. [E-FILE-NOT-REGULAR]'),
    (['--config', 'broken.yaml'], 'line 3 [E-YAML-INVALID]'),
    (['--config', 'list.yaml'], '[E-CONFIG-EMPTY]'),
    (['--config', 'pipe'], 'pipe [E-FILE-NOT-REGULAR]'),
    (['--config', '/dev/full'], '/dev/full [E-FILE-NOT-REGULAR]'),
    (['--mask', 'pipe'], 'pipe [E-FILE-NOT-REGULAR]'),
    (['--mask', '/dev/full'], '/dev/full [E-FILE-NOT-REGULAR]'),
    (['--config', 'binary.yaml'], 'binary.yaml [E-FILE-NOT-TEXT]'),
    (['--mask', 'missing.png'], 'missing.png [E-FILE-MISSING]'),
    (['--mask', 'list.yaml'], 'list.yaml [E-IMAGE-DAMAGED]'),
    (['--mask', 'empty.png'], 'empty.png [E-IMAGE-DAMAGED]'),
    (['--mask', 'black.png'], 'black.png [E-MASK-BLACK]'),
    (['--mask', 'small.png'], '32x24 [E-MASK-SIZE]'),
    (['--out', 'list.yaml'], 'list.yaml'),
])
def test_what_is_wrong_is_one_line_and_nothing_is_left(
        fake, drive, tmp_path, capsys, args, complaint):
    work = tmp_path / 'work'
    os.mkfifo(work / 'pipe')
    (work / 'broken.yaml').write_text('seed: 1\nturns: [\n')
    (work / 'list.yaml').write_text('- 1\n')
    (work / 'binary.yaml').write_bytes(b'\xff\x00\x80')
    (work / 'empty.png').touch()
    cv2.imwrite(str(work / 'black.png'), np.zeros((48, 64), np.uint8))
    cv2.imwrite(str(work / 'small.png'), np.full((24, 32), 255, np.uint8))
    before = names(work)
    assert main(['run', drive, *args]) == 2
    shown = capsys.readouterr()
    assert shown.err.startswith('dashcalib: error: ') and shown.err.count('\n') == 1
    # a value that it names, and the code
    value, _, code = complaint.partition('[')
    assert value.strip() in shown.err and code in shown.err and shown.out == ''
    assert names(work) == before
    assert all(made.closed for made in fake.made)


@pytest.mark.parametrize('path', ['missing', 'missing.mcap', 'empty', 'empty.mcap', 'junk.mp4'])
@pytest.mark.parametrize('command', ['run', 'turns'])
def test_input_that_is_none(fake, drive, tmp_path, capfd, command, path):
    work = tmp_path / 'work'
    (work / 'empty').mkdir()
    (work / 'empty.mcap').touch()
    (work / 'junk.mp4').write_bytes(bytes(range(256)) * 40)
    before = names(work)
    assert main([command, path]) == 2
    shown = capfd.readouterr()  # what native code prints, too
    assert shown.err.startswith('dashcalib: error: ') and shown.err.count('\n') == 1
    assert shown.out == '' and names(work) == before


def test_a_mask_reaches_the_calibrator(fake, drive, tmp_path):
    mask = np.full((48, 64), 1, np.uint8)  # dark grey is not black
    mask[30:] = 0
    cv2.imwrite(str(tmp_path / 'work' / 'mask.png'), mask)
    assert main(['run', drive, '--mask', 'mask.png']) == 0
    assert np.array_equal(fake.made[0].mask, mask > 0)


def test_a_sixteen_bit_mask_keeps_its_darkest_grey(fake, drive, tmp_path):
    mask = np.full((48, 64), 1, np.uint16)
    cv2.imwrite(str(tmp_path / 'work' / 'mask.png'), mask)
    assert main(['run', drive, '--mask', 'mask.png']) == 0
    assert fake.made[0].mask.all()


def interrupted_while_it_waits():
    """Return what Condition.wait() raises when Ctrl-C comes before it has its lock again."""
    error = RuntimeError('release unlocked lock')
    error.__context__ = KeyboardInterrupt()
    return error


@pytest.mark.parametrize(('failure', 'code', 'complaint'), [
    (WorkerError('E-WORKER', 'it was killed; try again'), 2, 'killed; try again [E-WORKER]\n'),
    (KeyboardInterrupt(), 130, 'interrupted'),
    (interrupted_while_it_waits(), 130, 'interrupted'),
    (MemoryError(), 2, '[E-OUT-OF-MEMORY]'),
    (BrokenPipeError(), 2, '[E-OUTPUT-CLOSED]'),
    (OSError(errno.ENOSPC, 'No space left on device', '/tmp/x'), 2, '[E-DISK-FULL]'),
    (OSError(errno.EIO, 'Input/output error', '/media/x'), 2, '[E-FILE-ACCESS]'),
    (ModuleNotFoundError("No module named 'pycolmap'", name='pycolmap'), 2,
     '[E-PACKAGE-MISSING]'),
])
def test_known_failures_close_everything_and_leave_nothing(
        fake, drive, tmp_path, monkeypatch, capsys, failure, code, complaint):
    monkeypatch.setattr(fake, 'failure', failure)
    assert main(['run', drive]) == code
    error = capsys.readouterr().err
    assert error.startswith('dashcalib: error: ') and error.count('\n') == 1
    assert complaint in error
    assert names(tmp_path / 'work') == []


@pytest.mark.parametrize('options', [(), ('--json',)])
def test_a_disk_that_fills_up_meanwhile_does_not_hide_the_result(
        fake, drive, tmp_path, monkeypatch, capsys, options):
    def full(*_, **__):
        raise OutputError('E-FULL', 'cannot write to calibration: No space left on device')
    monkeypatch.setattr('dashcalib_ros.cli.run.write_results', create_autospec(
        write_results, side_effect=full))
    assert main(['run', drive, '--fps', '10', *options]) == 2
    shown = capsys.readouterr()
    assert 'fx' in shown.out and 'accepted' in shown.out
    if options:
        assert json.loads(shown.out)['intrinsics']['fx'] == TRUTH.fx
    assert shown.err.splitlines()[-1] == ('dashcalib: error: cannot write to calibration: No '
                                          'space left on device [E-FULL]')
    assert 'written to' not in shown.out + shown.err
    assert names(tmp_path / 'work') == []


def test_a_bag_at_the_place_of_the_results_is_told_before_the_calibration(
        fake, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made_drives.write_bag(tmp_path / 'drive', made_drives.images(made_drives.drive(3)))
    for bag, code, *more in (('calibration', 'E-OUTPUT-EXISTS'),
                             ('calibration/..', 'E-OUTPUT-EXISTS'),
                             ('new', 'E-BAG-PART', '--crop', '0,0,32,16')):
        assert main(['run', 'drive', '--write-bag', bag, *more]) == 2
        assert f'[{code}]' in capsys.readouterr().err
    assert fake.made == [] and names(tmp_path) == ['drive']


@pytest.mark.parametrize('bug', [ZeroDivisionError(), RuntimeError('release unlocked lock')])
def test_a_bug_is_not_hidden(fake, drive, monkeypatch, capsys, bug):
    monkeypatch.setattr(fake, 'failure', bug)
    with pytest.raises(type(bug)):
        main(['run', drive])
    assert fake.made[0].closed
    monkeypatch.setattr(warnings, 'showwarning', warnings.showwarning)
    monkeypatch.setattr(sys, 'argv', ['dashcalib', 'run', drive, '--verbose'])
    with pytest.raises(SystemExit) as ended:
        program.command()
    shown = capsys.readouterr().err
    assert ended.value.code == 2 and 'Traceback' in shown and shown.endswith(' [E-DEFECT]\n')


@pytest.mark.parametrize('name', ['SIGTERM', 'SIGINT'])
def test_signals_unwind_and_a_second_one_cannot_stop_the_closing(
        fake, drive, tmp_path, monkeypatch, capsys, name):
    number = getattr(signal, name)
    before = signal.getsignal(signal.SIGTERM)

    def calibrate(self, progress=None):
        os.kill(os.getpid(), number)

    def close(self):
        os.kill(os.getpid(), number)
        self.closed = True
    monkeypatch.setattr(fake, 'calibrate', called_like(Calibrator.calibrate)(calibrate))
    monkeypatch.setattr(fake, 'close', called_like(Calibrator.close)(close))
    assert main(['run', drive]) == 130
    assert capsys.readouterr().err == 'dashcalib: error: interrupted\n'
    assert names(tmp_path / 'work') == []
    assert signal.getsignal(signal.SIGTERM) is before


def test_turns_as_json(fake, drive, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fake, 'level', 'weak')
    assert main(['turns', drive, '--json']) == 0
    data = json.loads(capsys.readouterr().out)
    assert data['turns'] == [{'center': 88, 'first': 58, 'last': 118, 'stamp': 8.8,
                              'prominence': 0.06, 'images': 61, 'yaw_deg': 71.6}]
    assert data['frames'] == 4 and 'drive' in data['input'] and data['yaw_deg'] == 71.6
    assert (data['verdict_at_best'], data['reason_codes']) == ('weak', ['E-A', 'E-B'])
    assert data['warning_codes'] == ['E-RATE-ASSUMED'] and len(data['warnings']) == 1
    assert names(tmp_path / 'work') == [] and fake.made[0].closed


def test_turns_as_a_table(fake, drive, monkeypatch, capsys):
    def shown():
        assert main(['turns', drive]) == 0
        return ' '.join(capsys.readouterr().out.split())
    text = shown()
    assert '8.8 88 58 118 61 0.0600 72 ' in text and 'prominence: ' in text
    assert 'use 1, of 72° in all' in text and 'enough for a calibration next: dash' in text
    monkeypatch.setattr(fake, 'yaws_deg', {TurnId.at(88): 21.0})
    assert 'without a sharp turn it may be weak' in shown()
    monkeypatch.setattr(fake, 'level', 'weak')
    assert shown().endswith('would be weak: few; less next: drive')
    monkeypatch.setattr(fake, 'level', 'refused')
    monkeypatch.setattr(fake, 'yaws_deg', {})
    monkeypatch.setattr(fake, 'found', ())
    # the cause, and one step
    assert shown() == ('0 turns found in 4 frames: not enough, the result would be refused: few '
                       'next: drive')


def test_progress_is_drawn_on_a_terminal(fake, drive, monkeypatch):
    monkeypatch.setenv('TERM', 'xterm')
    reader, writer = pty.openpty()
    with os.fdopen(writer, 'w') as screen:
        monkeypatch.setattr(sys, 'stderr', screen)
        assert main(['run', drive]) == 0
        screen.flush()
        drawn = os.read(reader, 65536).decode()
    os.close(reader)
    assert 'reconstructing' in drawn and '50%' in drawn and '\x1b[' in drawn


@pytest.fixture
def rendered(fake, drive, monkeypatch):
    """Let the demo's drive be the folder of pictures, and its truth 7 px of fx away."""
    lens = Lens(1242, 375, **{**TRUTH.named, 'fx': TRUTH.fx - 7})

    def other_drive(seed=0, kind='radial'):
        made = demo_drive(seed, kind)
        return Drive(dataclasses.replace(lens, glass=made.lens.glass), made.spec)

    def copied(rendered, path, progress):
        shutil.copytree(drive, path)
        progress(1.0)

    monkeypatch.setattr('dashcalib_ros.cli.demo.demo_drive', create_autospec(
        demo_drive, side_effect=other_drive))
    monkeypatch.setattr('dashcalib_ros.cli.demo.render_to_bag', create_autospec(
        render_to_bag, side_effect=copied))


@pytest.mark.parametrize(('level', 'code'), [('accepted', 0), ('weak', 3), ('refused', 3)])
def test_demo_compares_with_the_truth(
        fake, rendered, tmp_path, monkeypatch, capsys, level, code):
    monkeypatch.setattr(fake, 'level', level)
    assert main(['demo', '--seed', '5', '--out', 'out']) == code
    shown = capsys.readouterr().out
    row = re.search(r'fx +721.54 px +± 3.50 px +714.54 px +\+0.980 % +2.0\n', shown)
    assert bool(row) == (level != 'refused')
    assert ('mapping error: ' in shown) == (level != 'refused')
    assert fake.made[0].config.seed == 5 and fake.made[0].closed
    truth = json.loads((tmp_path / 'work/out/truth.json').read_text())
    assert (truth['fx'], truth['width'], truth['height']) == (TRUTH.fx - 7, 1242, 375)
    assert not (tmp_path / 'work' / 'out' / 'bag').exists()


def test_demo_keeps_its_bag_when_asked_and_overwrites_none(fake, rendered, tmp_path, capsys):
    assert main(['demo', '--keep-bag']) == 0
    assert len(names(tmp_path / 'work' / 'demo' / 'bag')) == 4
    assert main(['demo', '--keep-bag']) == 2
    assert '[E-BAG-EXISTS]' in capsys.readouterr().err


@pytest.mark.parametrize(('kind', 'said'), [
    ('shutter', {'readout_ms': 25.0}), ('stabilised', {'stabiliser_px': pytest.approx(62.1)}),
    ('windscreen', {'windscreen_rms_px': 1.0})])
def test_the_truth_has_what_spoils_the_pictures(fake, rendered, tmp_path, capsys, kind, said):
    assert main(['demo', '--lens', kind, '--out', 'out', '--json']) == 0
    shown, out = capsys.readouterr(), tmp_path / 'work' / 'out'
    found, truth = json.loads(shown.out), json.loads((out / 'truth.json').read_text())
    assert found['truth'] == truth and truth.items() >= said.items()
    assert found['verdict'] == 'accepted' and 'rendered: ' in shown.err
    # this estimate has no field: what a windscreen bends adds to the error of 7 px of fx
    bent = 1.0 if kind == 'windscreen' else 0.0
    assert found['mapping_px'] == pytest.approx(np.hypot(3.649, bent), abs=0.1 * bent + 0.001)
    rays = out / 'truth_rays.npz'
    assert rays.exists() == bool(bent)
    if bent:
        assert np.load(rays)['rays'].shape == (375, 1242, 3)
    # another demo in the same folder is not left with them
    assert main(['demo', '--out', 'out']) == 0 and not rays.exists()


def test_demo_leaves_no_temporary_bag(fake, rendered, tmp_path, monkeypatch):
    (tmp_path / 'tmp').mkdir()
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path / 'tmp'))
    monkeypatch.setattr(fake, 'failure', KeyboardInterrupt())
    assert main(['demo']) == 130
    assert names(tmp_path / 'tmp') == [] and names(tmp_path / 'work') == []


def test_stamps_columns_and_an_offset_reach_the_drive(drive, tmp_path):
    (tmp_path / 'list').write_text('\n'.join(f'{n / 5:.1f}' for n in range(4)))
    (tmp_path / 'log.csv').write_text('t_ms,wx,wy,wz\n' + '\n'.join(
        f'{100 * n},0,0.1,{0.01 * n}' for n in range(20)))
    (tmp_path / 'warm.csv').write_text('stamp_s,temperature\n0,20\n10,21.5\n')
    opened = open_drive(make_parser().parse_args([
        'run', drive, '--stamps', str(tmp_path / 'list'), '--motion', str(tmp_path / 'log.csv'),
        '--columns', 'time=t_ms,gyro_x=wx,gyro_y=wy,gyro_z=wz', '--sensor-offset=-1h',
        '--temperature', str(tmp_path / 'warm.csv'),
        '--crop', '8,4,32,16']))
    assert [(frame.stamp_ns, frame.size) for frame in opened.source] == [
        (2 * 10**8 * n, (32, 16)) for n in range(4)]
    np.testing.assert_allclose(opened.motion.rate.stamps_s, 0.1 * np.arange(20) - 3600)
    np.testing.assert_allclose(opened.motion.rate.values[3], [0, 0.1, 0.03])
    warm = opened.warmth.temperature
    assert warm.stamps_s.tolist() == [-3600, -3590] and warm.values[1] == [21.5]


@pytest.mark.parametrize(('wrong', 'code'), [
    (['--columns', 'time=t_ms,gyro=wx'], 'E-USAGE'), (['--columns', 'time'], 'E-USAGE'),
    (['--sensor-offset', 'soon'], 'E-USAGE'), (['--crop', '1,2,3'], 'E-USAGE'),
    (['--columns', 'time=t_ms'], 'E-COLUMNS-WITHOUT-MOTION'),
    (['--motion', 'log.csv', '--gps', '/fix'], 'E-MOTION-TWICE'),
    (['--known', 'stabiliser'], 'E-KNOWN-FORM')])
def test_what_is_no_column_offset_or_part_is_refused(drive, wrong, code, capsys):
    assert main(['run', drive, *wrong]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.endswith(f' [{code}]')
