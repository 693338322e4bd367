# SPDX-License-Identifier: Apache-2.0
"""What the node does with a calibration: published, kept on disk, replaced, given up, committed.

The real node in this process, between real publishers; only the calibrations are made up here,
since a camera that is bumped in the middle of a drive takes fifteen turns to show.
"""
from __future__ import annotations

import dataclasses
import errno
import os
import time
from pathlib import Path

import pytest
import yaml

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import TransitionCallbackReturn
from ros_bench import START
from ros_desk import FIRST, SIGMA
from sensor_msgs.srv import SetCameraInfo
from std_srvs.srv import Trigger
from synthetic import synthetic_turn

from dashcalib_ros.camera import Radial
from dashcalib_ros.config import Config
from dashcalib_ros.detect import TurnId
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.detect.one_camera import OtherCamera
from dashcalib_ros.errors import Notice
from dashcalib_ros.formats import load_camera
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge import TurnSummary, Verdict
from dashcalib_ros.judge.calibration import Drift, Mount
from dashcalib_ros.report import Calibration
from dashcalib_ros.ros import calibrate
from dashcalib_ros.ros.background import Moved, Result, Trouble
from dashcalib_ros.ros.store import CameraIdentity, Store
from dashcalib_ros.store.turn_store import Origin, StoredTurn, TurnStore

MOUNT = Mount('accepted', (), 2.0, -1.0, None, None,
              {'yaw_left_deg': 0.1, 'pitch_up_deg': 0.1, 'roll_right_deg': None,
               'height_m': None}, (600.0, 170.0), 0.5, 300.0)


def test_a_driver_that_dds_lists_twice_costs_no_calibration(make_desk, make_bench):
    """As for a while after it was killed and started again."""
    desk = make_desk()
    make_bench(listen=False)
    desk.until(lambda: desk.bench.values['publishers'] == '/bench, /bench')
    desk.give()
    assert desk.show() == 400.0
    assert yaml.safe_load(desk.file.read_text())['dashcalib']['publisher'] == '/bench'


def test_its_life_with_a_camera_that_is_bumped(make_desk):
    desk = make_desk()
    desk.show()
    assert desk.bench.status.message == 'not calibrated yet: no turn yet; 5 more turns needed'
    desk.give('weak')
    assert desk.show() is None and desk.bench.values['state'] == 'refused_so_far'
    assert desk.bench.status.message.endswith('; so far weak: few turns')
    assert desk.bench.values['reasons'] == 'few turns'
    desk.give()
    assert desk.show() == 400.0
    assert load_camera(desk.file).camera.fx == 400.0
    assert desk.bench.values['state'] == 'calibrated'
    assert desk.bench.status.message.startswith('calibrated, confirmed, fx ± 0.5 %; for the next ')
    # confirmed, but no better
    desk.give(fx=401.0)
    assert desk.show() == 400.0
    # clearly better: four times as much is known about fx
    desk.give(fx=402.0, sigma={**SIGMA, 'fx': 1.0})
    followed = desk.show()
    assert followed == pytest.approx(401.6, abs=1e-3)
    assert load_camera(desk.file).camera.fx == followed
    # bumped
    for count in (1, 2):
        desk.give(complete=False, cx=350.0)
        assert desk.show() == followed and desk.bench.values['contradictions'] == str(count)
    desk.give(complete=False, cx=350.0)
    assert desk.show() is None and desk.bench.values['state'] == 'collecting'
    desk.until(lambda: desk.bench.latched[-1].k[0] == 0)
    assert not desk.file.exists()
    desk.give(fx=403.0, cx=350.0)
    assert desk.show() == 403.0
    desk.until(lambda: desk.bench.latched[-1].k[0] == 403.0)


def test_camera_info_is_that_of_the_temperature_now(make_desk):
    desk = make_desk(use_temperature=True)
    drift = Drift(0.1, 0.05, 0.0, 0.05, 0.01, 20.0, 40.0)
    desk.give(drift=drift, temperature_c=30.0)
    assert desk.show() == 400.0
    add = desk.drive.learner.sensors.add
    for now_c, times in ((38.0, 1.004), (25.0, 0.9975), (55.0, 1.005), (float('nan'), 1.0)):
        add('temperature', START / 1e9, (now_c,))
        assert desk.show() == pytest.approx(400.0 * times)
    # what is in use and kept stays that of its own temperature
    assert desk.bench.latched[-1].k[0] == 400.0 and load_camera(desk.file).camera.fx == 400.0
    add('temperature', START / 1e9 - 100, (38.0,))
    assert desk.show() == 400.0
    # warmer turns say what it says, and do not contradict it
    desk.give(fx=402.0, temperature_c=40.0, sigma={**SIGMA, 'fx': 1.5})
    assert desk.bench.values['contradictions'] == '0'


def test_images_of_two_cameras_get_nothing(make_desk, monkeypatch):
    desk, found = make_desk(), OtherCamera(10, 20, 'another view')
    desk.until(lambda: desk.bench.values['publishers'] == '/bench')
    desk.give()
    assert desk.show() == 400.0
    assert yaml.safe_load(desk.file.read_text())['dashcalib']['publisher'] == '/bench'
    with monkeypatch.context() as patched:
        patched.setattr(Detection, 'other_camera', found)
        patched.setattr(Detection, 'mixed', True)
        desk.until(lambda: 'two cameras' in desk.bench.values['warnings'])
        assert desk.bench.status.level == DiagnosticStatus.ERROR
        # neither published, nor accepted, nor saved
        assert desk.show() is None
        desk.give(fx=402.0, sigma={**SIGMA, 'fx': 1.0})
        assert not desk.call('save').success and load_camera(desk.file).camera.fx == 400.0
    bank = desk.drive.learner.bank
    desk.until(lambda: not desk.bench.values['warnings'])
    # the turns of the time with two cameras are dropped, what was known before is used again
    assert desk.drive.learner.bank == bank + 1 and desk.show() == 400.0


def test_each_outcome_is_one_line_that_says_what_comes_next(make_desk, capfd):
    desk = make_desk()
    desk.give('weak')
    desk.give('refused')
    desk.give()
    said = [line for line in capfd.readouterr().err.splitlines() if ': a calibration' in line
            or ': accepted' in line]
    assert len(said) == 3, said
    assert said[0].endswith('of 0 turns is weak: few turns; it is calculated again with each '
                            'better turn')
    assert 'is refused: few turns; ' in said[1]
    assert ': accepted: fx 400.00 ± 2.00, fy' in said[2]
    assert said[2].endswith(f'; saved to {desk.file}')


def test_a_contradicted_one_goes_on_where_that_is_wanted(make_desk):
    desk = make_desk(publish_stale='true', contradictions=1)
    desk.give()
    desk.give(complete=False, fx=450.0)
    assert desk.show() == 400.0
    assert desk.bench.status.level == b'\x02' and not desk.file.exists()
    assert desk.bench.values['state'] == 'collecting'
    desk.give(fx=450.0)
    assert desk.show() == 450.0 and desk.bench.status.level == b'\x00'


def test_results_of_forgotten_turns_are_not_used(make_desk):
    desk = make_desk()
    result_of_old_bank = desk.drive.learner.bank
    assert desk.call('reset').success
    assert desk.drive.learner.bank == result_of_old_bank + 1
    calibration = Calibration(Verdict('accepted'), (320, 240), FIRST, SIGMA, (), 10, 0.3, {}, {},
                              Config())
    desk.drive.on_result(Result(calibration, True, result_of_old_bank))
    assert desk.show() is None


def test_a_disk_that_takes_nothing_is_counted_and_the_calibration_published(make_desk, tmp_path):
    (tmp_path / 'plain').write_text('a file, no folder')
    desk = make_desk()
    desk.role._store.path = tmp_path / 'plain' / 'camera.yaml'
    desk.give()
    assert desk.show() == 400.0
    assert desk.bench.values['unsaved'] == '1'
    saved, why = desk.role.save()
    assert not saved and 'camera_info_url' in why


def test_each_warning_of_a_calibration_is_logged_once(make_desk, capfd):
    desk = make_desk()
    for _ in range(2):
        desk.give('weak', warnings=(Notice('', 'the mask is odd'), Notice('', 'a turn is odd')))
    logged = capfd.readouterr().err
    for words in ('the mask is odd', 'a turn is odd'):
        assert [line.split()[0] for line in logged.splitlines() if words in line] == ['[WARN]']


def test_a_file_of_another_tool_is_set_aside(make_desk, tmp_path):
    (tmp_path / 'camera.yaml').write_text('camera_matrix: theirs\n')
    desk = make_desk()
    desk.give()
    assert load_camera(desk.file).camera.fx == 400.0
    assert (tmp_path / 'camera.previous.yaml').read_text() == 'camera_matrix: theirs\n'


@pytest.fixture
def read_only(monkeypatch, tmp_path):
    """Let no file below tmp_path be made or renamed, for root too."""
    plain = Path.open

    def refuse(self, mode='r', *args, **options):
        if tmp_path in self.parents and mode not in ('r', 'rb'):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))
        return plain(self, mode, *args, **options)
    monkeypatch.setattr(Path, 'open', refuse)


def test_a_reset_on_a_disk_that_is_read_only_does_not_say_it_was_done(make_desk, request, capfd):
    desk = make_desk()
    desk.give()
    request.getfixturevalue('read_only')
    answer = desk.call('reset')
    assert not answer.success
    for text in (answer.message, capfd.readouterr().err):
        assert 'camera.yaml' in text and 'Read-only file system' in text
        assert 'the next start of the node publishes it again' in text
    assert desk.file.exists() and desk.show() is None
    desk.until(lambda: 'could not be moved aside' in desk.bench.values['warnings'])
    # this process trusts it no more, whatever makes it look again
    desk.role._load()
    assert desk.show() is None
    desk.file.unlink()
    desk.until(lambda: desk.bench.values['warnings'] == '')
    assert desk.call('reset').message == 'collecting; there was no file'


def test_one_that_is_given_up_on_a_read_only_disk_is_told(make_desk, request, capfd):
    desk = make_desk(contradictions=1)
    desk.give()
    request.getfixturevalue('read_only')
    desk.give(complete=False, fx=450.0)
    assert desk.show() is None and desk.file.exists()
    assert 'could not be moved aside' in capfd.readouterr().err
    desk.until(lambda: 'could not be moved aside' in desk.bench.values['warnings'])
    desk.role._load()
    assert desk.show() is None


def test_what_was_set_aside_before_is_never_overwritten(make_desk, tmp_path):
    (tmp_path / 'camera.yaml').write_text('camera_matrix: theirs\n')
    desk = make_desk()
    desk.give()
    first = desk.file.read_text()
    answer = desk.call('reset')
    assert answer.success and str(tmp_path / 'camera.previous.2.yaml') in answer.message
    desk.give()
    # another program writes it while the node runs
    desk.file.write_text('camera_matrix: theirs too\n')
    assert desk.call('save').success
    assert [(tmp_path / f'camera.previous{number}.yaml').read_text()
            for number in ('', '.2', '.3')] == [
                'camera_matrix: theirs\n', first, 'camera_matrix: theirs too\n']
    assert load_camera(desk.file).camera.fx == 400.0
    assert desk.call('save').success
    assert not (tmp_path / 'camera.previous.4.yaml').exists()


def test_what_a_killed_node_left_is_removed_at_the_start(make_desk, tmp_path):
    (tmp_path / '.camera.yaml.0123abcd.tmp').touch()
    (tmp_path / '.other.yaml.0123abcd.tmp').touch()
    make_desk()
    assert [path.name for path in tmp_path.glob('.*.tmp')] == ['.other.yaml.0123abcd.tmp']


def test_news_that_fail_do_not_hold_back_the_others_and_are_counted(make_desk, capfd):
    desk = make_desk()

    def fail():
        raise ZeroDivisionError('odd news')
    for _ in range(3):
        desk.drive._later(fail)
    desk.give()
    assert desk.show() == 400.0
    desk.until(lambda: desk.bench.count('failed_callbacks') == 3)
    assert capfd.readouterr().err.count('Traceback') == 1


def test_a_service_that_fails_answers(make_desk, monkeypatch):
    desk = make_desk()

    def fail(*args):
        raise ZeroDivisionError('odd')
    monkeypatch.setattr(desk.drive.learner, 'restart', fail)
    answer = desk.call('reset')
    assert not answer.success and 'odd' in answer.message
    desk.until(lambda: desk.bench.count('failed_callbacks') == 1)


@pytest.mark.parametrize('driver', ['missing', 'hangs', 'refuses'])
def test_a_driver_that_does_not_take_the_calibration_disturbs_nothing(make_desk, driver, capfd):
    desk = make_desk(commit='true', commit_timeout=1.0 if driver == 'missing' else 6.0)
    asked = []

    def refuse(request, response):
        asked.append(request)
        response.success, response.status_message = False, 'no flash'
        return response

    if driver == 'hangs':
        # a service that is there, in a process that never spins it
        context = rclpy.Context()
        rclpy.init(context=context)
        dead = rclpy.create_node('driver', context=context)
        dead.create_service(SetCameraInfo, 'set_camera_info', refuse)
    elif driver == 'refuses':
        desk.bench.node.create_service(SetCameraInfo, 'set_camera_info', refuse)
    desk.give()
    words = {'missing': 'there is no service /bench/set_camera_info or /set_camera_info',
             'hangs': 'did not answer within 6 s', 'refuses': 'refused: no flash'}[driver]
    said = []
    desk.until(lambda: said.append(capfd.readouterr().err) or words in ''.join(said))
    assert desk.show() == 400.0 and bool(asked) == (driver == 'refuses')
    if driver == 'hangs':
        dead.destroy_node()
        rclpy.try_shutdown(context=context)


@pytest.mark.parametrize(('remapped', 'service', 'called'), [
    ('', '/camera/set_camera_info', True), ('', '/bench/set_camera_info', True),
    ('', '/set_camera_info', True), ('/driver/set', '/driver/set', True),
    ('/driver/set', '/camera/set_camera_info', False)])
def test_the_driver_s_service_is_looked_for_beside_the_images(make_desk, capfd, remapped, service,
                                                              called):
    desk = make_desk(topic='/camera/image_raw', remapped=remapped, commit='true',
                     commit_timeout=30.0 if called else 1.0)
    asked = []

    def take(request, response):
        asked.append(request)
        response.success = True
        return response
    desk.bench.node.create_service(SetCameraInfo, service, take)
    desk.give()
    words = f'{service} accepted the calibration' if called else 'there is no service /driver/set'
    said = []
    desk.until(lambda: said.append(capfd.readouterr().err) or words in ''.join(said))
    assert len(asked) == called


def test_a_driver_whose_name_is_seen_late_is_found(make_desk, capfd, monkeypatch):
    desk, asked, looks = make_desk(commit='true', commit_timeout=30.0), [], []
    real = calibrate.driver_services

    def late(*arguments):
        looks.append(True)
        return real(*arguments) if len(looks) > 3 else ()

    def take(request, response):
        asked.append(request)
        response.success = True
        return response
    monkeypatch.setattr(calibrate, 'driver_services', late)
    desk.bench.node.create_service(SetCameraInfo, '/bench/set_camera_info', take)
    desk.give()
    said = []
    desk.until(lambda: said.append(capfd.readouterr().err)
               or '/bench/set_camera_info accepted' in ''.join(said))
    assert len(asked) == 1 and len(looks) > 3


KEPT = """\
image_width: 320
image_height: 240
camera_name: dashcam
camera_matrix: {rows: 3, cols: 3, data: [400.0, 0.0, 160.0, 0.0, 401.0, 120.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0.0, 0.0, 0.0]}
dashcalib:
  verdict: accepted
  sigma: {fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0, k1: 0.01, k2: 0.01}
  frame_id: camera
"""


def test_a_camera_that_was_moved_since_the_last_calibration_is_told_once(make_desk, capfd):
    desk = make_desk()
    desk.give(mount=MOUNT)
    desk.until(lambda: 'yaw 2.00 ± 0.10° to the left' in desk.bench.values['mounting'])
    desk.give(mount=dataclasses.replace(MOUNT, yaw_left_deg=2.4))
    assert 'the camera was moved' not in capfd.readouterr().err
    desk.give(mount=dataclasses.replace(MOUNT, yaw_left_deg=-1.0))
    desk.until(lambda: 'yaw 1.00 ± 0.10° to the right' in desk.bench.values['mounting'])
    logged = capfd.readouterr().err
    assert logged.count('the camera was moved') == 1
    assert desk.show() == 400.0
    # straight stretches have told it already
    trusted = desk.role._trusted()
    desk.drive.learner._hear(Moved(trusted, 'the camera points elsewhere'))
    desk.until(lambda: desk.bench.values['change'] == 'the camera points elsewhere')
    desk.give(mount=MOUNT)
    desk.until(lambda: desk.bench.values['change'] == '')
    assert 'the camera was moved' not in capfd.readouterr().err


def test_contradictions_are_counted_over_short_trips(make_desk):
    desk = make_desk()
    desk.give()
    for trip in (1, 2):
        desk.close()
        desk = make_desk()
        assert desk.show() == 400.0 and desk.bench.values['contradictions'] == str(trip - 1)
        desk.give('weak', complete=False)
        desk.give(complete=False, fx=420.0)
        desk.until(lambda desk=desk, trip=trip: desk.bench.count('contradictions') == trip)
        assert desk.bench.status.level == b'\x01'
        assert f'{trip} of 3' in desk.bench.status.message
    desk.close()
    desk = make_desk()
    # it warns from the start
    desk.until(lambda: desk.bench.status.level == b'\x01')
    desk.give(complete=False, fx=420.0)
    assert desk.show() is None and not desk.file.exists()


def test_a_confirmation_is_kept_on_disk_too(make_desk):
    desk = make_desk()
    desk.give()
    desk.give(complete=False, fx=420.0)
    desk.give(complete=False)
    desk.close()
    desk = make_desk()
    desk.show()
    assert desk.bench.values['contradictions'] == '0' and desk.bench.status.level == b'\x00'


def test_complete_turns_that_contradict_it_are_kept_and_counted_on(make_desk):
    desk = make_desk()
    desk.give()
    bank = desk.drive.learner.bank
    for _ in range(2):
        desk.give(fx=420.0)
        assert desk.drive.learner.bank == bank and desk.show() == 400.0
    desk.give(fx=420.0)
    assert desk.drive.learner.bank == bank + 1 and desk.show() == 420.0


def test_the_same_turns_count_once(make_desk):
    desk = make_desk()
    desk.give()
    turns = tuple(TurnSummary(n, n, n, 0.0, 0.1, 1, 1, True, misfit=1.0) for n in (1, 2, 3))
    for count, used in ((1, turns[:2]), (1, turns[:2]), (2, turns)):
        desk.give(complete=False, fx=420.0, turns=used)
        desk.until(lambda count=count: desk.bench.values['contradictions'] == str(count))


def test_a_loaded_calibration_is_unconfirmed_until_turns_agree(make_desk):
    desk = make_desk()
    desk.give()
    desk.until(lambda: desk.bench.values['calibration'] == 'confirmed')
    desk.close()
    desk = make_desk()
    assert desk.show() == 400.0
    desk.until(lambda: desk.bench.values['calibration'] == 'unconfirmed')
    assert desk.bench.status.level == b'\x00' and 'unconfirmed' in desk.bench.status.message
    desk.give(complete=False)
    desk.until(lambda: desk.bench.values['calibration'] == 'confirmed')


def test_an_edited_file_warns_until_turns_agree_and_is_replaced_then(make_desk):
    desk = make_desk()
    desk.give()
    desk.close()
    text = desk.file.read_text()
    desk.file.write_text(text.replace('fx: 2.0', 'fx: 0.001').replace('400.0', '404.0'))
    desk = make_desk()
    assert desk.show() == 404.0
    desk.until(lambda: desk.bench.status.level == b'\x01')
    assert 'was edited' in desk.bench.status.message and desk.bench.values['sigma fx (px)'] == ''
    desk.give(complete=False)
    desk.until(lambda: desk.bench.status.level == b'\x00')
    # no sigma is better than one that somebody wrote
    desk.give()
    assert desk.show() == 400.0 and load_camera(desk.file).sigma['fx'] == 2.0


def test_a_file_that_another_node_has_is_neither_published_nor_written(make_desk, tmp_path):
    desk = make_desk()
    desk.give()
    desk.close()
    text = desk.file.read_text()
    other = Store(desk.file, CameraIdentity('dashcam', '/image_raw'))
    assert other.claim()
    desk = make_desk()
    desk.until(lambda: 'another node uses' in desk.bench.status.message)
    assert desk.show() is None and desk.bench.status.level == b'\x01'
    # its own is published, and kept nowhere
    desk.give(fx=420.0)
    assert desk.show() == 420.0 and desk.file.read_text() == text
    assert desk.call('reset').success and desk.file.read_text() == text
    other.close()
    desk.give(fx=420.0)
    assert load_camera(desk.file).camera.fx == 420.0


def test_a_camera_that_changed_does_not_learn_from_the_turns_of_earlier_drives(
        make_desk, tmp_path):
    (tmp_path / 'camera.yaml').write_text(KEPT)
    store = TurnStore(str(tmp_path / 'turns'), 10, 3.0, pytest.fail)
    store.load(Origin((320, 240), Scale(enlarge=2)))
    lens = Radial((640, 480), 400.0, 402.0, 320.0, 240.0)
    scene = synthetic_turn(lens, keyframes=8, tracks=60).scene(lens)
    store.mirror({TurnId.at(0): StoredTurn(scene, 5.0, 0.05)})
    desk = make_desk(contradictions=1, **{'turns.store': tmp_path / 'turns'})
    assert desk.show() == 400.0
    desk.until(lambda: desk.bench.count('turns stored') == 1)
    desk.give(complete=False, fx=450.0)
    assert desk.show() is None
    desk.until(lambda: desk.bench.count('turns stored') == 0)
    desk.until(lambda: list((tmp_path / 'turns').iterdir()) == [])


def test_a_file_where_nothing_can_be_written_is_used_with_a_warning(make_desk, request, tmp_path,
                                                                    capfd):
    """As one that is installed with a package is; without it, the node would learn for nothing."""
    first = make_desk()
    first.give()
    first.close()
    request.getfixturevalue('read_only')
    second = make_desk()
    assert second.show() == 400.0
    line, = [line for line in capfd.readouterr().err.splitlines() if 'E-KEPT-NOT-W' in line]
    assert '[WARN]' in line and 'Read-only file system' in line
    for transition in (second.node.trigger_deactivate, second.node.trigger_cleanup):
        assert transition() == TransitionCallbackReturn.SUCCESS
    (tmp_path / 'camera.yaml').unlink()
    assert second.node.trigger_configure() == TransitionCallbackReturn.FAILURE
    line, = capfd.readouterr().err.splitlines()
    assert '[ERROR]' in line and '[E-KEPT-NOT-WRITABLE]' in line


def test_who_asks_for_a_calibration_is_answered_when_it_is_done(make_desk, monkeypatch):
    desk = make_desk()
    assert 'no turn' in desk.call('calibrate').message
    # as if there were turns, which come to nothing before desk.give()
    monkeypatch.setattr(desk.drive.learner, 'request', lambda: '')
    client = desk.bench.node.create_client(Trigger, 'calibrator/calibrate')
    desk.until(client.service_is_ready)

    def ask():
        count, future = len(desk.drive._asked), client.call_async(Trigger.Request())
        desk.until(lambda: len(desk.drive._asked) == count + 1)
        assert not future.done()
        return future

    def answer(future):
        desk.until(future.done)
        return future.result().success, future.result().message

    both = ask(), ask()
    # others are served meanwhile
    assert desk.call('calibrate_now').success and not desk.call('save').success
    desk.give('weak')
    assert [answer(each) for each in both] == [(False, 'weak: few turns')] * 2
    accepted = ask()
    desk.give()
    success, text = answer(accepted)
    assert success and text.startswith('accepted: fx 400.00 ± 2.00')
    dropped = ask()
    desk.call('reset')
    assert answer(dropped) == (False, 'the turns were dropped meanwhile')
    failed = ask()
    desk.drive._later(lambda: desk.drive._on_news(Trouble('failed_calibrations', 'it is odd')))
    assert answer(failed) == (False, 'it is odd')
    ask()
    for transition in (desk.node.trigger_deactivate, desk.node.trigger_cleanup):
        assert transition() == TransitionCallbackReturn.SUCCESS
    with pytest.raises(InvalidHandle):
        desk.until(lambda: False)


def test_an_answer_that_is_waited_for_keeps_no_core_busy(make_desk, monkeypatch):
    """The executor sleeps: rclpy issue 1405 is of executors that are made for each call."""
    desk = make_desk()
    monkeypatch.setattr(desk.drive.learner, 'request', lambda: '')
    client = desk.bench.node.create_client(Trigger, 'calibrator/calibrate')
    desk.until(client.service_is_ready)
    client.call_async(Trigger.Request())
    desk.until(lambda: desk.drive._asked)
    end, spins = time.monotonic() + 2.0, 0
    while time.monotonic() < end:
        desk.spinner.spin_once()
        spins += 1
    # the node's timers, and little else
    assert spins < 500
