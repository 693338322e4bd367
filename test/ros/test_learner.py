# SPDX-License-Identifier: Apache-2.0
"""The background thread: when it calibrates, what a failure costs, how it ends."""
from __future__ import annotations

import dataclasses
import threading
import time
import types
from typing import ClassVar

import numpy as np
import pytest
from fakes import image_message, stands_in_for

from dashcalib_ros import judge
from dashcalib_ros.camera import Radial
from dashcalib_ros.config import Config
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import WorkerError
from dashcalib_ros.input.scale import FULL_SIZE
from dashcalib_ros.judge import Check, Reading, TurnSummary, Verdict
from dashcalib_ros.judge.calibration import StoredTurnSummary
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.problem.quadratic import Quadratic
from dashcalib_ros.report import Calibration, NamedCamera
from dashcalib_ros.ros import background as room
from dashcalib_ros.ros.background import (
    Goal,
    Learner,
    Measured,
    Moved,
    Result,
    Trouble,
    Watched,
)
from dashcalib_ros.selection import SceneSelection, Status

LIMIT = 20.0
CONFIG = Config().replace({'turns.wanted': 2})
CAMERA = NamedCamera('in use', Radial((64, 48), 60.0, 60.0, 31.5, 23.5, -0.1, 0.01),
                     dict.fromkeys(('fx', 'fy', 'cx', 'cy', 'k1', 'k2'), 0.1))
ZERO = Quadratic.prior(np.zeros((6, 6)))


@stands_in_for(Calibrator)
class Core:
    """In the Calibrator's place: turns by command, calibrations that fail or last."""

    made: ClassVar[list[Core]] = []
    failures: ClassVar[list[Exception]] = []

    def __init__(self, config=None, mask=None, verbose=False, live=False, use_stored=True,
                 warn=None, inline=False, on_trouble=None, on_wait=None):
        assert live and not inline
        self.on_wait = on_wait
        self.options = {'mask': mask, 'use_stored': use_stored, 'warn': warn,
                        'on_trouble': on_trouble}
        self.stored, self.pushed, self.done = (), [], []
        self.ready, self.frames, self.calls, self.pairs, self.asked = (), 0, 0, 0, []
        self.strangers, self.watched, self.checked = (), [], []
        self.stretches, self.asks_stretches = (), False
        self.hold, self.closed = threading.Event(), threading.Event()
        self.hold.set()
        self.scenes = Scenes()
        self.scenes.core = self
        self.workers = types.SimpleNamespace(run=self._run)
        self.solution = None
        Core.made.append(self)

    @property
    def detection(self):
        return types.SimpleNamespace(
            frames=self.frames, start_s=0.0, straight_pairs=self.pairs, lines=lambda: None,
            resized=lambda camera: camera, scale=FULL_SIZE, straights=lambda newest:
            types.SimpleNamespace(stamps_s=np.array([50.0, 62.0])))

    def push(self, frame):
        self.frames += 1
        self.pushed.append(frame)
        return self.status()

    def status(self):
        ready, further = self.ready + self.stored, self.stretches
        return Status(self.frames, len(ready), len(ready), 60.0 * len(ready), 0.1, False, ready,
                      len(self.stored), (60.0,) * len(ready), self.ready, stretches=further)

    def sense(self, motion):
        self.motion = motion

    def calibrate(self, progress=None, final=True):
        assert not final
        self.calls += 1
        ready = self.ready
        while not self.hold.wait(0.01):
            self.on_wait()
            if self.closed.is_set():
                raise WorkerError('E-CALIBRATOR-CLOSED', 'closed while it calibrated')
        if Core.failures:
            raise Core.failures.pop()
        turns = tuple(TurnSummary(turn.number, turn.number, turn.number, 0.0, 0.1, 1, 1,
                                  turn not in self.strangers,
                                  misfit=9.0 if turn in self.strangers else 1.0)
                      for turn in (*ready, *self.stretches))
        stored = tuple(StoredTurnSummary(turn, 0.0, 0.1, 60.0, 20, True, 1.0)
                       for turn in self.stored)
        return Calibration(Verdict('weak'), (64, 48), None, None, turns, 1, None, {}, {}, CONFIG,
                           stored_turns=stored)

    def _run(self, function, *given):
        """Answer in a worker's place."""
        if function is judge.moved:
            self.asked.append(self.pairs)
            return (50.0, np.array([-1.0, 0.2])) if self.pairs > 70 else None
        if function is judge.check:
            self.checked.append(given[0])
            return Check('right', ('it fits',), 0.5, 1.0)
        assert function is judge.readings_of
        turns = tuple(scene.turn for scene in given[0])
        self.watched.append((given[1], turns))
        if Core.failures:
            raise Core.failures.pop()
        return tuple(Reading(turn, ZERO, None, explained=turn not in self.strangers)
                     for turn in turns)

    def close(self):
        self.closed.set()
        self.done.append('close')


@stands_in_for(SceneSelection)
class Scenes:
    """In the SceneSelection's place: of such a core."""

    config = CONFIG

    def want(self, turns, more=0, stretches=True):
        self.core.wanted, self.core.asks_stretches = turns + more, stretches

    def exclude(self, reasons, keep_files=False):
        self.core.ready = tuple(turn for turn in self.core.ready if turn not in reasons)

    def clear_store(self):
        self.core.done.append('clear')

    def forget_stored(self, but=frozenset()):
        self.core.done.append('forget')

    def reconstructed(self):
        return [types.SimpleNamespace(turn=turn) for turn in self.core.ready]


@pytest.fixture
def desk(monkeypatch):
    """A learner over such cores, and all it tells."""
    monkeypatch.setattr(room, 'Calibrator', Core)
    Core.made, Core.failures = [], []
    heard = types.SimpleNamespace(results=[], troubles=[], statuses=[], turns=[], begun=[],
                                  shown=[], watched=[], moved=[])

    def hear(news):
        match news:
            case Trouble():
                heard.troubles.append((news.kind, news.text))
            case str():
                (heard.begun if 'calibrating' in news else heard.turns).append(news)
            case _:
                {Result: heard.results, Measured: heard.statuses,
                 Watched: heard.watched, Moved: heard.moved}[type(news)].append(news)
    heard.goal = Goal(CONFIG, 2)
    heard.learner = Learner(heard.goal, 10, hear, lambda *shown: heard.shown.append(shown))
    yield heard
    heard.learner.close()


def aim(desk, **changes):
    """Change the goal of the learner."""
    desk.goal = dataclasses.replace(desk.goal, **changes)
    desk.learner.watch(desk.goal)


def at(*centers):
    return tuple(TurnId.at(center) for center in centers)


def until(condition):
    end = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def held(desk, core):
    """Have a calibration under way until core.hold is set."""
    core.ready = at(10, 20)
    core.hold.clear()
    until(lambda: desk.learner.activity.calibrating)


def image(width=64):
    data = np.zeros((48, width), np.uint8)
    return image_message(encoding='mono8', width=width, height=48, step=width, is_bigendian=0,
                         data=data.tobytes())


def test_it_calibrates_when_enough_turns_are_built_and_again_only_with_others(desk):
    core = Core.made[0]
    core.ready = at(10)
    time.sleep(3 * room.LOOK_S)
    assert core.calls == 0
    core.ready = at(10, 20)
    until(lambda: len(desk.results) == 1)
    time.sleep(3 * room.LOOK_S)
    assert core.calls == 1 and desk.results[0].complete
    core.ready = at(20, 30)
    until(lambda: len(desk.results) == 2)
    assert core.calls == 2


def test_one_new_turn_is_worth_a_calibration_and_so_are_as_many_new_stretches(desk):
    core = Core.made[0]
    core.stretches = at(1, 2)
    until(lambda: len(desk.results) == 1 and core.asks_stretches)
    core.stretches = at(1, 2, 3)
    time.sleep(3 * room.LOOK_S)
    assert core.calls == 1
    core.stretches = at(1, 2, 3, 4)
    until(lambda: len(desk.results) == 2)
    core.ready = at(10)
    until(lambda: len(desk.results) == 3)
    assert 'other pieces' in desk.begun[0]
    # a camera in use is compared with turns only
    aim(desk, camera=CAMERA)
    until(lambda: not core.asks_stretches)


def test_a_turn_that_fits_another_camera_is_not_tried_over_and_over(desk):
    core = Core.made[0]
    core.strangers = at(20)
    core.ready = at(10, 20)
    until(lambda: len(desk.results) == 1)
    time.sleep(3 * room.LOOK_S)
    assert core.calls == 1 and not desk.results[0].complete
    assert core.ready == at(10, 20)  # the newest: it may be a new camera
    core.strangers = at(20, 30)
    core.ready = at(10, 20, 30)
    until(lambda: len(desk.results) == 2)
    until(lambda: core.ready == at(20, 30))
    time.sleep(3 * room.LOOK_S)
    assert core.calls == 2


def test_each_turn_and_each_calibration_is_told_once(desk):
    core = Core.made[0]
    core.ready = at(10)
    until(lambda: desk.turns)
    assert desk.begun == []
    core.ready = at(20, 10)
    until(lambda: desk.results)
    core.ready = at(10)
    time.sleep(3 * room.LOOK_S)
    core.ready = at(10, 20)
    time.sleep(3 * room.LOOK_S)
    assert desk.turns == ['turn 1 of 2: 60°, 60° in all', 'turn 2 of 2: 60°, 120° in all']
    assert desk.begun == ['calibrating with 2 turns, 120° of yaw…']


def test_other_numbers_of_turns_can_be_wanted_while_it_runs(desk):
    core = Core.made[0]
    core.ready = at(10)
    aim(desk, config=CONFIG.replace({'turns.wanted': 1}), turns=1)
    until(lambda: desk.results)
    assert core.wanted == 1 and desk.results[0].complete
    desk.learner.restart()
    until(lambda: getattr(Core.made[-1], 'wanted', None) == 1)


def test_a_bank_is_extended_turn_by_turn_as_far_as_turns_are_kept(desk):
    aim(desk, config=CONFIG.replace({'turns.wanted': 9}))
    assert desk.learner.extend()
    until(lambda: getattr(Core.made[0], 'wanted', None) == 10)
    assert not desk.learner.extend()
    # the next bank begins as usual
    desk.learner.restart()
    until(lambda: len(Core.made) == 2 and getattr(Core.made[1], 'wanted', None) == 9)


def test_images_are_shown_with_what_was_found(desk):
    message = image()
    desk.learner.offer(0, 0, message, (64, 48))
    until(lambda: desk.statuses)
    (header, picture, found), = desk.shown
    assert header is message.header and picture.shape == (48, 64)
    assert found.frames == 1 and desk.troubles == []


def test_a_lower_goal_calibrates_sooner_but_not_completely(desk):
    aim(desk, turns=1)
    Core.made[0].ready = at(10)
    until(lambda: desk.results)
    assert not desk.results[0].complete


def test_a_request_needs_turns_and_only_one_runs(desk):
    core = Core.made[0]
    assert 'no turn' in desk.learner.request()
    core.ready = at(10)
    core.hold.clear()
    until(lambda: desk.learner.request() == '')
    until(lambda: desk.learner.activity.calibrating)
    assert 'already running' in desk.learner.request()
    core.hold.set()
    until(lambda: desk.results)
    assert not desk.learner.activity.calibrating


def test_a_failed_calibration_is_told_and_tried_again(desk):
    Core.failures = [RuntimeError('odd'), WorkerError('E-WORKER-DIED', 'exit code 7')]
    Core.made[0].ready = at(10, 20)
    until(lambda: len(desk.results) == 1)
    assert [kind for kind, _ in desk.troubles] == ['failed_calibrations'] * 2
    assert 'exit code 7 [E-WORKER-DIED]' in desk.troubles[0][1] and 'in 2 s' in desk.troubles[0][1]
    assert 'RuntimeError: odd' in desk.troubles[1][1] and 'in 4 s' in desk.troubles[1][1]
    assert len(Core.made) == 1  # the turns are kept


def test_a_restart_cancels_what_runs_and_its_result_is_out_of_date(desk):
    first = Core.made[0]
    held(desk, first)
    desk.learner.restart()
    until(first.closed.is_set)
    until(lambda: not desk.learner.activity.calibrating)
    assert desk.troubles == [] and desk.results == [] and desk.learner.bank == 1
    Core.made[1].ready = at(30, 40)
    until(lambda: desk.results)
    assert desk.results[0].bank == 1


def test_stored_turns_count_as_any(desk):
    core = Core.made[0]
    assert core.options['use_stored']
    core.stored = (TurnId.stored(0),)
    core.ready = at(10)
    until(lambda: desk.results)
    assert desk.results[0].complete
    time.sleep(3 * room.LOOK_S)
    assert core.calls == 1


def test_a_restart_empties_the_store_unless_another_camera_comes(desk):
    first = Core.made[0]
    desk.learner.restart()
    until(lambda: first.done == ['close', 'clear'])
    second = Core.made[1]
    assert not second.options['use_stored']
    desk.learner.restart(keep_stored=True)
    until(lambda: second.done == ['close'])
    assert Core.made[2].options['use_stored']
    desk.learner.forget_stored(set())
    until(lambda: Core.made[2].done == ['forget'])


def test_troubles_with_the_store_are_told(desk):
    Core.made[0].options['warn']('no space')
    assert desk.troubles == [('store', 'no space')]


def test_troubles_with_the_workers_are_told(desk):
    Core.made[0].options['on_trouble']('a turn is tried again')
    assert desk.troubles == [('workers', 'a turn is tried again')]


def test_images_keep_to_the_bank_they_were_taken_for(desk):
    desk.learner.offer(0, 0, image(), (64, 48), 'front')
    until(lambda: desk.statuses)
    assert Core.made[0].pushed[0].frame_id == 'front'
    desk.learner.restart()
    desk.learner.offer(1, 1, image(32), (32, 48))
    until(lambda: len(desk.statuses) == 2)
    assert [core.frames for core in Core.made] == [1, 1] and desk.troubles == []


def test_images_that_cannot_be_used_are_told(desk):
    desk.learner.offer(0, 0, image(), (640, 480))
    odd = image()
    odd.encoding = 'smell'
    desk.learner.offer(1, 1, odd, (64, 48))
    desk.learner.offer(2, 2, object(), (64, 48))
    until(lambda: len(desk.troubles) == 3)
    assert [kind for kind, _ in desk.troubles] == ['undecodable', 'undecodable', 'failed']
    desk.learner.offer(3, 3, image(), (64, 48))
    until(lambda: desk.statuses)


def test_sensors_that_cannot_be_used_are_told_at_the_next_calibration(desk):
    for n in range(100):
        desk.learner.sensors.add('rate', 7.0, (0.1 * n, 0.0, 0.0))
    desk.learner.offer(1, 10**9, image(), (64, 48))
    until(lambda: desk.statuses)
    core = Core.made[0]
    core.ready = at(10, 20)
    until(lambda: desk.results)
    assert core.motion.empty and 'not used' in str(core.motion.warnings[0])


def test_a_failing_core_ends_no_thread(desk, monkeypatch):
    core = Core.made[0]
    failures = ['status', 'exclude']

    def status():
        if 'status' in failures:
            failures.remove('status')
            raise RuntimeError('status')
        return Core.status(core)

    def exclude(reasons):
        if 'exclude' in failures:
            failures.remove('exclude')
            raise RuntimeError('exclude')
    core.ready = at(10, 20)
    core.status, core.scenes.exclude = status, exclude
    until(lambda: desk.results)
    assert failures == []
    # the first look at the turns may come before status is replaced, never after two results
    assert {'failed_calibrations'} <= {kind for kind, _ in desk.troubles}


def test_new_turns_are_compared_with_the_camera_in_use_once(desk):
    core = Core.made[0]
    aim(desk, turns=None)
    core.ready = at(10)
    time.sleep(2 * room.LOOK_S)
    assert core.watched == []  # there is none in use
    aim(desk, camera=CAMERA)
    until(lambda: desk.watched)
    time.sleep(2 * room.LOOK_S)
    aim(desk, camera=CAMERA)
    core.ready = at(10, 20)
    until(lambda: len(desk.watched) == 2)
    time.sleep(2 * room.LOOK_S)
    assert core.watched == [(CAMERA.camera, at(10)), (CAMERA.camera, at(20))]
    assert desk.watched[0].camera is CAMERA and core.calls == 0


def test_what_turns_of_an_earlier_bank_showed_is_kept(desk):
    aim(desk, turns=None, camera=CAMERA)
    Core.made[0].strangers = Core.made[0].ready = at(10, 20)
    until(lambda: desk.watched)
    assert desk.watched[-1].monitor.lens.confirmed
    # the turns of earlier drives are of the camera before
    assert Core.made[0].done == ['forget']
    desk.learner.restart()
    until(lambda: len(Core.made) == 2)
    Core.made[1].ready = at(30)
    until(lambda: len(desk.watched) == 2)
    assert desk.watched[-1].monitor.lens.confirmed
    # not with another calibration
    aim(desk, camera=dataclasses.replace(CAMERA, name='another'))
    until(lambda: len(desk.watched) == 3)
    assert desk.watched[-1].monitor.lens is None


def test_a_camera_that_is_moved_on_a_straight_road_is_told_once(desk):
    core = Core.made[0]
    core.pairs = 40
    time.sleep(2 * room.LOOK_S)
    assert not core.asked
    aim(desk, camera=CAMERA)
    for pairs in (41, 75, 80, 200):
        core.pairs = pairs
        time.sleep(2 * room.LOOK_S)
    assert core.asked == [41, 75] or core.asked == [40, 75]
    [told] = desk.moved
    assert told.camera is CAMERA and told.text.startswith(
        'the camera points elsewhere than 12 s ago: by 1.0 degrees to the right and 0.2 up')
    # another camera in use is asked anew
    aim(desk, camera=dataclasses.replace(CAMERA, name='another'))
    core.pairs = 300
    until(lambda: len(desk.moved) == 2)


def test_turns_that_could_not_be_compared_are_told_and_tried_with_the_next(desk):
    aim(desk, turns=None, camera=CAMERA)
    Core.failures = [WorkerError('E-WORKER-DIED', 'exit code 7')]
    core = Core.made[0]
    core.ready = at(10)
    until(lambda: desk.troubles)
    time.sleep(2 * room.LOOK_S)
    (kind, text), = desk.troubles
    assert kind == 'failed_watches' and '[E-WORKER-DIED]' in text and len(core.watched) == 1
    core.ready = at(10, 20)
    until(lambda: desk.watched)
    assert core.watched[-1][1] == at(10, 20) and len(desk.troubles) == 1


def test_each_calibration_is_compared_with_a_camera_that_is_to_be_checked(desk):
    core = Core.made[0]
    aim(desk, turns=None)
    core.ready = at(10, 20)
    time.sleep(2 * room.LOOK_S)
    assert core.calls == 0
    aim(desk, turns=2, check=CAMERA)
    until(lambda: desk.results)
    assert desk.results[0].given is CAMERA and desk.results[0].check.answer == 'right'
    time.sleep(2 * room.LOOK_S)
    assert core.calls == 1
    # another one: the same turns are used again
    other = dataclasses.replace(CAMERA, name='another')
    aim(desk, check=other)
    until(lambda: len(desk.results) == 2)
    assert desk.results[1].given is other and core.watched == []


def test_a_camera_that_changes_during_a_calibration_is_checked_by_the_next(desk):
    core = Core.made[0]
    aim(desk, check=CAMERA)
    held(desk, core)
    other = dataclasses.replace(CAMERA, name='another')
    aim(desk, check=other)
    core.hold.set()
    until(lambda: len(desk.results) == 2)
    assert [result.given for result in desk.results] == [CAMERA, other]


def test_closing_ends_the_thread_in_the_middle_of_a_calibration(desk):
    core = Core.made[0]
    held(desk, core)
    desk.learner.close()
    assert not desk.learner._thread.is_alive()
    assert desk.troubles == []
