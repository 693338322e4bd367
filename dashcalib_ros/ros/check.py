# SPDX-License-Identifier: Apache-2.0
"""The program that checks a driver's calibration with turns, and never changes it."""
from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from rclpy.task import Future
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from dashcalib_ros.errors import InputError, coded
from dashcalib_ros.formats.ros import camera_of_message
from dashcalib_ros.judge import Check, with_faults
from dashcalib_ros.report import NamedCamera, answer_dict
from dashcalib_ros.ros.background import Goal, Result
from dashcalib_ros.ros.diagnostics import OK, WARN, Health, diagnostic
from dashcalib_ros.ros.drive import Drive
from dashcalib_ros.ros.endpoints import Answer, Endpoints
from dashcalib_ros.ros.images import Source, SourceWatch
from dashcalib_ros.ros.settings import Settings

NOT_YET = Check('cannot tell', ('there are not enough turns yet',))
# 'the calibration', one of these, then the reasons, which begin with 'differs' where that is so
SAYS = {'right': 'is right: ', 'differs': '', 'wrong': 'is wrong: '}


class Checking:
    """Publishes on ~/check, latched, whether the calibration that a driver publishes is right.

    drive: gives it results. inputs: of the images. summary: what it does, for the log.
    """

    def __init__(self, endpoints: Endpoints, settings: Settings, camera_name: str) -> None:
        """Raises DashcalibError for settings that cannot be used."""
        self._endpoints, self._log = endpoints, endpoints.log
        self._settings, self._camera_name = settings, camera_name
        self._given_topic = endpoints.node.resolve_topic_name('camera_info')
        self._infos: SourceWatch[Hashable] = SourceWatch()
        self._given: NamedCamera | None = None
        self._size: tuple[int, int] | None = None
        self._found = NOT_YET
        # why there is no camera
        self._problem = f'no camera_info on {self._given_topic} yet'
        self._answers = endpoints.latched('~/check')
        self.drive = Drive(endpoints, settings, camera_name, self)
        self.inputs = self.drive.images
        endpoints.subscription('camera_info', self._on_info)
        for name, action in (('calibrate', self.drive.calibrate),
                             ('calibrate_now', self.drive.calibrate_now)):
            endpoints.service(f'~/{name}', partial(self._calibrate, action))
        endpoints.service('~/reset', self._reset)
        self._watch()
        self.summary = (f'checking the camera {camera_name!r} with the turns seen on '
                        f'{self.drive.images.topic}')

    def change(self, settings: Settings) -> None:
        """Use other settings from now on: those of CHANGEABLE."""
        self._settings = settings
        self._watch()

    def _watch(self) -> None:
        """Let the drive work for the driver's camera.

        From so few turns on it is tried: a single turn may be wrong; the next ones are waited for
        where two cannot tell. A camera for other images is checked, as the answer says what it is
        for, but turns are not compared with it.
        """
        core = self._settings.core
        few = min(core.verdict.min_turns, core.turns.wanted)
        self.drive.watch(Goal(core, None if self._given is None else few,
                              self._given if self._fits else None, self._given))

    def accompany(self, header: Header, size: tuple[int, int]) -> None:
        """Do nothing: the driver publishes camera_info."""

    def begin_anew(self) -> None:
        """Forget the answer and the changes; the driver's camera stays."""
        # as another object: what still comes about the former one is out of date
        self._given = None if self._given is None else replace(self._given)
        self._found = NOT_YET
        self._watch()
        if self._infos.current is not None:
            self._publish()

    def fit(self, source: Source) -> None:
        """Take the size of the images, which is compared with the driver's."""
        self._size = source.size
        self._warn()
        self._watch()

    def show_changes(self) -> None:
        """Publish the changes of the camera."""
        self._publish()

    def judge(self, result: Result) -> None:
        """Take an answer; where nothing more is to be expected, the next one is of new turns."""
        if result.check is None or self._given is None or result.given is not self._given:
            return
        before, found = self._found.answer, result.check
        if found.answer == 'cannot tell' and before != 'cannot tell' and not result.complete:
            return  # that of more turns stays
        self._found = found
        self._publish()
        if not result.complete and found.answer == before:
            return
        answer = self._answer()
        what = f'the calibration on {self._given_topic}'
        log = self._log.warning if answer.answer == 'wrong' else self._log.info
        log((f'{what} {SAYS[answer.answer]}' if answer.answer in SAYS else
             f'the turns cannot show whether {what} is right: ') + '; '.join(answer.reasons))
        if result.complete and found.answer != 'cannot tell':
            # the next answer must be independent: it uses new turns only
            self.drive.learner.restart()

    def outcome(self, result: Result) -> Answer:
        """Return whether the driver's calibration is known to be right or wrong, and why."""
        found = self._answer()
        if result.check is None or result.given is not self._given:
            return False, self._problem if self._given is None else NOT_YET.reasons[0]
        return found.answer in SAYS, f'{found.answer}: {"; ".join(found.reasons)}'

    def _calibrate(self, action: Callable[[], Answer | Future]) -> Answer | Future:
        return (False, self._problem) if self._given is None else action()

    def _reset(self) -> Answer:
        self._log.warning('reset by request: the turns are dropped')
        self.drive.forget()
        self.begin_anew()
        return True, 'collecting; the calibration of the driver is not changed'

    def _warnings(self) -> list[str]:
        if self._given is None:
            return [self._problem]
        if self._fits or self._size is None:
            return []
        (width, height), (w, h) = self._given.image_size, self._size
        return [f'the camera_info on {self._given_topic} is for {width}x{height}, and the images '
                f'are {w}x{h}']

    def health(self) -> Health:
        """Return the state of the check."""
        found, turns = self._answer(), self.drive.turns_text
        if found.answer == 'right':
            message = f'the calibration is right; for the next check {turns}'
        elif found.answer in SAYS:
            message = f'the calibration {SAYS[found.answer]}{found.reasons[0]}'
        else:
            message = f'checking the calibration: {found.reasons[0]}; {turns}'
        return Health('checking', _level(found), message, self._given if self._fits else None, {
            'check': found.answer, 'check reasons': '; '.join(found.reasons)}, self._warnings())

    def _answer(self) -> Check:
        return with_faults(self._found, self._given.faults if self._given else ())

    @property
    def _fits(self) -> bool:
        return self._given is None or self._size in (None, self._given.image_size)

    def _on_info(self, message: CameraInfo) -> None:
        roi = message.roi
        what = self._infos.take((
            message.width, message.height, message.distortion_model, tuple(message.d),
            tuple(message.k), tuple(message.r), tuple(message.p), message.binning_x,
            message.binning_y, roi.x_offset, roi.y_offset, roi.width, roi.height))
        if what == 'stray':
            self._endpoints.complaints.say(
                'other_calibrations', f'a camera_info on {self._given_topic} differs from those '
                                      f'before: check for a second publisher')
        elif what != 'same':
            self._take(message, what == 'changed')

    def _take(self, message: CameraInfo, changed: bool) -> None:
        topic = self._given_topic
        if changed:
            self._log.warning(f'the calibration on {topic} has changed: it is checked again')
        try:
            self._given = camera_of_message(message, topic)
            for warning in self._given.warnings:
                self._log.warning(str(warning))
            if self._given.faults:
                self._log.warning(f'the calibration on {topic} is wrong: '
                                  f'{"; ".join(self._given.faults)}')
        except InputError as error:
            self._given, self._problem = None, coded(error)
        self._warn()
        self.drive.verdict = None
        self.begin_anew()

    def _warn(self) -> None:
        for text in self._warnings():
            self._log.warning(text)

    def _publish(self) -> None:
        found = self._answer()
        values = answer_dict(found, tuple(self.drive.changes().values()))
        if self._given is None:
            values['reasons'] = self._warnings()
        self._answers(diagnostic(
            self._endpoints.node, 'check of a calibration', self._camera_name, _level(found),
            f'the calibration: {found.answer}', flat_texts(values)))


def _level(found: Check) -> bytes:
    level: bytes = WARN if found.answer == 'wrong' else OK
    return level


def flat_texts(values: Mapping[str, Any], before: str = '') -> dict[str, str]:
    """Return nested values as texts by their path: {'a': {'b': [1, 2]}} gives {'a.b': '1; 2'}.

    What is None is left out.
    """
    texts: dict[str, str] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            texts |= flat_texts(value, f'{before}{name}.')
        elif isinstance(value, (list, tuple)):
            texts[before + name] = '; '.join(map(str, value))
        elif value is not None:
            texts[before + name] = str(value)
    return texts
