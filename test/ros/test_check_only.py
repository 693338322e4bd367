# SPDX-License-Identifier: Apache-2.0
"""The node that only checks a driver's calibration, and the watch over one in use.

The real node in this process, between real publishers; turns, and what they say, come by command.
"""
from __future__ import annotations

import re
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from fakes import stands_in_for

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_desk import FIRST, SIGMA
from sensor_msgs.msg import CameraInfo, RegionOfInterest
from std_msgs.msg import Header

from dashcalib_ros import judge
from dashcalib_ros.config import Config
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.ros import camera_of_message
from dashcalib_ros.input.scale import FULL_SIZE
from dashcalib_ros.judge import Check, Reading, TurnSummary, Verdict
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.problem.quadratic import Quadratic
from dashcalib_ros.report import Calibration
from dashcalib_ros.ros import background
from dashcalib_ros.ros import drive as drive_module
from dashcalib_ros.ros.calibrate import camera_info
from dashcalib_ros.ros.check import NOT_YET, flat_texts
from dashcalib_ros.ros.images import LASTING
from dashcalib_ros.selection import SceneSelection, Status

TOPIC = '/camera_info'
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# of a turn that knows each parameter to 0.1
KNOWS = Quadratic.prior(100 * np.eye(6))


@stands_in_for(Calibrator)
class Core:
    """In the Calibrator's place: its turns are made by command, and show a focal length of 400."""

    newest: ClassVar[Core]
    dark: ClassVar[bool] = False
    near: ClassVar[bool] = False

    def __init__(self, config=None, mask=None, verbose=False, live=False, use_stored=True,
                 warn=None, inline=False, on_trouble=None, on_wait=None):
        self.ready, self.strangers, self.scenes = (), (), Scenes()
        self.scenes.core = self
        self.detection = SimpleNamespace(frames=1, start_s=0.0, straight_pairs=0, scale=FULL_SIZE,
                                         lines=lambda: None, resized=lambda camera: camera)
        self.workers, self.solution = SimpleNamespace(run=self._run), None
        Core.newest = self

    def push(self, frame):
        return self.status()

    def status(self):
        return Status(1, len(self.ready), len(self.ready), 60.0 * len(self.ready), 0.1, False,
                      self.ready, 0, (60.0,) * len(self.ready), self.ready)

    def calibrate(self, progress=None, final=True):
        turns = tuple(TurnSummary(turn.number, 0, 0, 0.0, 0.1, 1, 1, True, misfit=1.0)
                      for turn in self.ready)
        return Calibration(Verdict('accepted'), (320, 240), FIRST, SIGMA, turns, 10, 0.3, {}, {},
                           Config())

    def _run(self, function, *given):
        """Answer in a worker's place."""
        if function is judge.readings_of:
            return tuple(Reading(scene.turn, KNOWS, None, scene.turn not in self.strangers)
                         for scene in given[0])
        assert function is judge.check
        given, right = given[0], given[0].fx == FIRST.fx
        if self.dark:
            return Check('cannot tell', ('too dark',))
        if self.near:
            return Check('differs', ('differs by 1.0 px, good enough',), 1.0, 2.0)
        return Check('right' if right else 'wrong', (f'fx {given.fx:.0f}',), 0.5, 1.0)

    def close(self):
        pass


@stands_in_for(SceneSelection)
class Scenes:
    """In the SceneSelection's place: its core's turns."""

    config = Config()

    def reconstructed(self):
        return [SimpleNamespace(turn=turn) for turn in self.core.ready]

    def forget_stored(self, but=frozenset()):
        pass

    def want(self, turns, more=0, stretches=True):
        pass

    def exclude(self, reasons, keep_files=False):
        pass

    def clear_store(self):
        pass


@pytest.fixture
def desk(make_desk, monkeypatch):
    """Make a node with such a core; with a driver and a reader of ~/check beside it."""
    monkeypatch.setattr(background, 'Calibrator', Core)
    monkeypatch.setattr(background, 'LOOK_S', 0.05)
    monkeypatch.setattr(drive_module, 'PERIOD_S', 0.1)

    def make(**parameters):
        desk = make_desk(**{'turns.wanted': 2, **parameters})
        if parameters:
            desk.driver = desk.bench.node.create_publisher(
                CameraInfo, 'camera_info',
                QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT))
        return desk
    return make


def drive(desk, info, until):
    """Publish a camera_info until something holds."""
    def published():
        desk.driver.publish(info)
        return until()
    desk.until(published)


def turns(*centers):
    return tuple(TurnId.at(center) for center in centers)


def info_of(camera=FIRST, **changes):
    message = camera_info(camera, Header(frame_id='camera'), 'same')
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def other(fx):
    values = [*info_of().k]
    values[0] = fx
    return info_of(k=values)


def answers(desk):
    """Return the values that a reader that comes now hears on ~/check, by name."""
    heard = []

    def hear(message):
        assert message.header.stamp.sec > 0
        status, = message.status
        heard.append({pair.key: pair.value for pair in status.values}
                     | {'level': status.level, 'message': status.message})

    desk.bench.node.create_subscription(DiagnosticArray, 'checker/check', hear, LATCHED)
    return heard


def test_a_right_calibration_is_called_right_and_nothing_else_is_done(desk, capfd):
    desk = desk(program='checker')
    Core.newest.ready = turns(10, 20)
    desk.until(lambda: f'no camera_info on {TOPIC} yet' in desk.bench.status.message)
    assert desk.bench.status.level == b'\x01' and desk.bench.values['state'] == 'checking'
    assert not desk.call('calibrate').success
    drive(desk, info_of(), lambda: desk.bench.values['check'] == 'right')
    desk.until(lambda: desk.bench.status.level == b'\x00')
    heard = answers(desk)
    desk.until(lambda: heard)
    assert heard[-1]['answer'] == 'right' and heard[-1]['changes'] == ''
    assert (heard[-1]['reasons'], heard[-1]['rms_px']) == ('fx 400', '0.5')
    assert f'the calibration on {TOPIC} is right: fx 400' in capfd.readouterr().err
    published = {name for name, _ in desk.bench.node.get_publisher_names_and_types_by_node(
        'checker', '/')}
    assert '/checker/check' in published
    assert not {TOPIC, '/checker/calibration'} & published
    assert not desk.file.exists() and 'published' not in desk.bench.values


def test_a_wrong_one_warns_until_the_driver_has_another(desk, capfd):
    desk = desk(program='checker')
    heard = answers(desk)
    drive(desk, other(440.0), lambda: heard)
    assert heard[-1]['answer'] == 'cannot tell' and heard[-1]['reasons'] == NOT_YET.reasons[0]
    Core.newest.ready = turns(10, 20)
    desk.until(lambda: desk.bench.values['check'] == 'wrong')
    desk.until(lambda: heard[-1]['answer'] == 'wrong')
    assert desk.bench.status.level == b'\x01'
    assert 'the calibration is wrong: fx 440' in desk.bench.status.message
    said = [line for line in capfd.readouterr().err.splitlines() if ' is wrong: ' in line]
    assert len(said) == 1 and said[0].startswith('[WARN]')
    # a single stray changes nothing; a lasting change is checked again, with turns of its own
    for _ in range(LASTING - 1):
        desk.driver.publish(info_of())
    desk.until(lambda: desk.bench.values['other_calibrations'] != '0')
    assert heard[-1]['answer'] == 'wrong'
    drive(desk, info_of(), lambda: heard[-1]['answer'] == 'cannot tell')
    assert f'the calibration on {TOPIC} has changed' in capfd.readouterr().err
    Core.newest.ready = turns(30, 40)
    desk.until(lambda: heard[-1]['answer'] == 'right')


def test_one_that_differs_and_is_good_enough_is_no_warning(desk, monkeypatch, capfd):
    desk = desk(program='checker')
    monkeypatch.setattr(Core, 'near', True)
    Core.newest.ready = turns(10, 20)
    drive(desk, other(404.0), lambda: desk.bench.values['check'] == 'differs')
    desk.until(lambda: desk.bench.status.level == b'\x00')
    assert desk.bench.status.message.startswith('the calibration differs by 1.0 px')
    line, = [line for line in capfd.readouterr().err.splitlines() if 'differs' in line]
    assert line.startswith('[INFO]') and f'{TOPIC} differs by 1.0 px' in line


def test_it_answers_as_soon_as_the_turns_can_tell(desk, monkeypatch):
    desk = desk(program='checker', **{'turns.wanted': 4})
    heard = answers(desk)
    monkeypatch.setattr(Core, 'dark', True)
    Core.newest.ready = turns(10, 20)
    drive(desk, info_of(), lambda: heard and heard[-1]['reasons'] == 'too dark')
    monkeypatch.setattr(Core, 'dark', False)
    Core.newest.ready = turns(10, 20, 30)
    desk.until(lambda: heard[-1]['answer'] == 'right')
    bank = desk.drive.learner.bank
    Core.newest.ready = turns(10, 20, 30, 40)
    desk.until(lambda: desk.drive.learner._now.number > bank)
    # few turns that cannot tell do not take back what more could
    heard.clear()
    monkeypatch.setattr(Core, 'dark', True)
    Core.newest.ready = turns(50, 60)
    desk.until(lambda: desk.drive.learner._now.tried == set(turns(50, 60)))
    monkeypatch.setattr(Core, 'dark', False)
    Core.newest.ready = turns(50, 60, 70)
    desk.until(lambda: heard)
    assert heard[0]['answer'] == 'right'


SAME_K, SAME_P = list(info_of().k), list(info_of().p)
FAULTS = [
    ({'k': [*SAME_K[:1], 50.0, *SAME_K[2:]]}, r'K\[1\] is 50, not 0'),
    ({'k': [*SAME_K[:8], 0.0]}, r'K\[8\] is 0, not 1'),
    ({'r': [0.985, 0.0, 0.174, 0.0, 1.0, 0.0, -0.174, 0.0, 0.985]}, 'R rotates .* 9.9 degrees'),
    ({'r': [0.0] * 9}, 'R is not a rotation'),
    ({'p': [0.0] * 12}, r'P\[10\] is 0'),
    ({'p': [*SAME_P[:3], -40.0, *SAME_P[4:]]}, r'P\[3\] is -40'),
    *(({'p': [scale * value for value in SAME_P[:8]] + SAME_P[8:]}, 'P .* another size')
      for scale in (0.5, 2.0))]


@pytest.mark.parametrize(('changes', 'words'), FAULTS)
def test_what_stands_beside_the_camera_is_checked_too(changes, words):
    [fault] = camera_of_message(info_of(**changes), TOPIC).faults
    assert re.search(words, fault)


def test_a_fault_beside_a_right_camera_is_wrong_before_and_after_the_turns(desk, capfd):
    desk = desk(program='checker')
    heard = answers(desk)
    drive(desk, info_of(r=FAULTS[2][0]['r']), lambda: heard)
    assert heard[-1]['answer'] == 'wrong' and 'R rotates' in heard[-1]['reasons']
    assert 'is wrong: R rotates' in capfd.readouterr().err
    Core.newest.ready = turns(10, 20)
    desk.until(lambda: 'fx 400' in heard[-1]['reasons'])
    assert heard[-1]['answer'] == 'wrong' and 'R rotates' in heard[-1]['reasons']
    # each field counts as a change
    drive(desk, info_of(), lambda: heard[-1]['answer'] == 'cannot tell')


def test_a_calibration_for_other_images_is_told_and_checked(desk, capfd):
    desk = desk(program='checker')
    drive(desk, info_of(width=640, height=480),
          lambda: 'is for 640x480, and the images are 320x240' in desk.bench.status.message)
    assert desk.bench.status.level == b'\x01' and '640x480' in capfd.readouterr().err
    Core.newest.ready = turns(10, 20)
    desk.until(lambda: desk.bench.values['check'] == 'right')
    assert desk.bench.values['failed_watches'] == '0'


def test_a_camera_that_is_exchanged_is_told(desk, capfd):
    desk = desk(program='checker', **{'turns.wanted': 5})
    heard = answers(desk)
    drive(desk, info_of(), lambda: heard)
    core = Core.newest
    core.strangers = turns(20, 30)
    core.ready = turns(10, 20)
    desk.until(lambda: 'does not explain' in desk.bench.values['suspected change'])
    assert desk.bench.values['change'] == '' and heard[-1]['changes'] == ''
    assert 'does not explain' not in capfd.readouterr().err
    core.ready = turns(10, 20, 30)
    desk.until(lambda: heard[-1]['changes'])
    text = heard[-1]['changes']
    assert 'does not explain the pictures since the turn at frame 20' in text
    desk.until(lambda: desk.bench.values['change'] == text)
    assert desk.bench.status.level == b'\x01' and desk.bench.status.message == text
    assert capfd.readouterr().err.count(text) == 1
    # after a reset, one turn is a suspicion again
    assert desk.call('reset').success
    desk.until(lambda: heard[-1]['changes'] == '' and Core.newest is not core)
    Core.newest.strangers = turns(50)
    Core.newest.ready = turns(40, 50)
    desk.until(lambda: 'frame 50' in desk.bench.values['suspected change'])
    assert desk.bench.values['change'] == ''


def test_a_change_of_an_own_calibration_is_told_until_another_is_adopted(desk, capfd):
    desk = desk()
    desk.give()
    desk.until(lambda: desk.bench.values['state'] == 'calibrated')
    core = Core.newest
    core.ready = core.strangers = turns(10, 20)
    desk.until(lambda: desk.bench.values['change'])
    assert desk.bench.status.level == b'\x01' and desk.show() == 400.0
    lines = [line for line in capfd.readouterr().err.splitlines() if 'does not explain' in line]
    assert len(lines) == 1 and lines[0].startswith('[WARN]')
    desk.give(sigma={**SIGMA, 'fx': 1.0})
    desk.until(lambda: desk.bench.values['change'] == '')
    assert desk.bench.status.level == b'\x00'


@pytest.mark.parametrize(('changes', 'words'), [
    ({'k': [0.0] * 9}, 'uncalibrated'),
    ({'d': [float('nan')] * 5}, 'not finite'),
    ({'binning_x': 2}, 'binning'),
    ({'roi': RegionOfInterest(x_offset=8, width=320, height=240)}, 'region of interest'),
    ({'p': [float('nan')] * 12}, 'not finite'),
    ({'width': 0}, 'width'),
    ({'distortion_model': 'rational_polynomial', 'd': [0.1] * 12}, 'rational_polynomial'),
    ({'k': [400.0, 0.0, 160.0, 0.0, -1.0, 120.0, 0.0, 0.0, 1.0]}, 'focal length')])
def test_a_calibration_that_cannot_be_used_is_refused_in_one_line(changes, words):
    with pytest.raises(InputError, match=words) as raised:
        camera_of_message(info_of(**changes), TOPIC)
    assert TOPIC in str(raised.value) and '\n' not in str(raised.value)


def test_an_uncalibrated_driver_is_told(desk):
    desk = desk(program='checker')
    heard = answers(desk)
    drive(desk, CameraInfo(), lambda: heard)
    assert heard[-1]['answer'] == 'cannot tell' and 'uncalibrated' in heard[-1]['reasons']
    desk.until(lambda: 'uncalibrated' in desk.bench.status.message)
    Core.newest.ready = turns(10, 20)
    drive(desk, info_of(), lambda: heard[-1]['answer'] == 'right')


def test_parameters_that_a_checker_does_not_change_say_so(desk):
    desk = desk(program='checker')
    # one for experts is not declared, but known
    for name, value in (('image_transport', 'raw'), ('scene.tracks', 500)):
        refused = desk.node.set_parameters_atomically([Parameter(name, value=value)])
        assert not refused.successful and '[E-PARAMETER-READ-ONLY]' in refused.reason


def test_nested_values_become_texts_by_their_path():
    assert flat_texts({'answer': 'right', 'a': {'b': 1.5, 'c': None}, 'reasons': ['x', 'y']}) == {
        'answer': 'right', 'a.b': '1.5', 'reasons': 'x; y'}
