"""With check_only: the calibration that a driver publishes, checked with turns, never changed."""
from __future__ import annotations

import json
from collections.abc import Hashable
from dataclasses import replace

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import String

from dashcalib_ros.errors import InputError, coded
from dashcalib_ros.judge import Check, with_faults
from dashcalib_ros.report import NamedCamera, answer_dict
from dashcalib_ros.report.camera_file import camera_of_message
from dashcalib_ros.ros.background import Result, Watched
from dashcalib_ros.ros.diagnostics import OK, WARN, Health, log_line
from dashcalib_ros.ros.images import Source, SourceWatch
from dashcalib_ros.ros.node import CameraNode
from dashcalib_ros.ros.parameters import OVERRIDES, latched

NOT_YET = Check('cannot tell', ('there are not enough turns yet',))
UNTOUCHED = 'check_only is set: the calibration of the driver is not changed'
# 'the calibration', one of these, then the reasons, which begin with 'differs' where that is so
SAYS = {'right': 'is right: ', 'differs': '', 'wrong': 'is wrong: '}


class CheckNode(CameraNode):
    """Publishes on ~/check, latched, whether the calibration that a driver publishes is right."""

    doing = 'checking'

    def _open(self, topic: str) -> None:
        self._given_topic = self.resolve_topic_name('camera_info')
        self._infos: SourceWatch[Hashable] = SourceWatch()
        self._given: NamedCamera | None = None
        self._size: tuple[int, int] | None = None
        self._found = NOT_YET
        # why there is no camera
        self._problem = f'no camera_info on {self._given_topic} yet'
        self._answers = self._publisher(String, '~/check', latched())
        # hears reliable and best-effort drivers alike; one that is lost is followed by the next
        self.create_subscription(
            CameraInfo, 'camera_info', self._on_info,
            QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT),
            qos_overriding_options=OVERRIDES)

    def _trusted(self) -> NamedCamera | None:
        """Return the driver's camera, None if it is for other images."""
        return self._given if self._fits else None

    def _checked(self) -> NamedCamera | None:
        """Return the driver's camera: of one for other images, the answer says what it is for."""
        return self._given

    def _goal(self) -> int | None:
        """Return from how many turns on one is tried, None while there is no camera.

        A single turn may be wrong; the next ones are waited for where two cannot tell.
        """
        return (None if self._given is None
                else min(self._core.verdict.min_turns, self._core.turns.wanted))

    def _fit(self, source: Source) -> None:
        """Take the size of the images, which is compared with the driver's."""
        self._size = source.size
        self._warn()

    def _on_watched(self, watched: Watched) -> None:
        """Take what new turns show; publish it where it says more than before."""
        before = self._changes()
        super()._on_watched(watched)
        if self._changes() != before:
            self._publish()

    def _judge(self, result: Result) -> None:
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
        log_line(self._log, answer.answer == 'wrong', (
            f'{what} {SAYS[answer.answer]}' if answer.answer in SAYS else
            f'the turns cannot show whether {what} is right: ') + '; '.join(answer.reasons))
        if result.complete and found.answer != 'cannot tell':
            # the next answer must be independent: it uses new turns only
            self._learner.restart()

    def _drop(self) -> None:
        """Forget the answer and the changes; the driver's camera stays."""
        # as another object: what still comes about the former one is out of date
        self._given = None if self._given is None else replace(self._given)
        self._monitor, self._moved = None, ''
        self._found = NOT_YET
        if self._infos.current is not None:
            self._publish()

    def _reset(self) -> tuple[bool, str]:
        self._log.warning('reset by request: the turns are dropped')
        self._forget()
        return True, f'collecting; {UNTOUCHED}'

    def _save(self) -> tuple[bool, str]:
        return False, UNTOUCHED

    def _warnings(self) -> list[str]:
        """Return what keeps the calibration from being checked."""
        if self._given is None:
            return [self._problem]
        if self._fits or self._size is None:
            return []
        (width, height), (w, h) = self._given.image_size, self._size
        return [f'the camera_info on {self._given_topic} is for {width}x{height}, and the images '
                f'are {w}x{h}']

    def _health(self, turns: str) -> Health:
        found = self._answer()
        if found.answer == 'right':
            message = f'the calibration is right; {turns} for the next check'
        elif found.answer in SAYS:
            message = f'the calibration {SAYS[found.answer]}{found.reasons[0]}'
        else:
            message = f'checking the calibration, {turns}: {found.reasons[0]}'
        level = WARN if found.answer == 'wrong' else OK
        return Health('checking', level, message, self._trusted(), {
            'check': found.answer, 'check reasons': '; '.join(found.reasons)})

    def _answer(self) -> Check:
        """Return the answer of the turns, and the faults that need no turn."""
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
            self._complaints.say('other_calibrations', f'a camera_info on {self._given_topic} '
                                 f'differs from those before: check for a second publisher')
        elif what != 'same':
            self._take(message, what == 'changed')

    def _take(self, message: CameraInfo, changed: bool) -> None:
        """Check this calibration from now on."""
        topic = self._given_topic
        if changed:
            self._log.warning(f'the calibration on {topic} has changed: it is checked again')
        try:
            self._given = camera_of_message(message, topic)
            if self._given.faults:
                self._log.warning(f'the calibration on {topic} is wrong: '
                                  f'{"; ".join(self._given.faults)}')
        except InputError as error:
            self._given, self._problem = None, coded(error)
        self._warn()
        self._verdict = None
        self._drop()
        self._set_goal()

    def _warn(self) -> None:
        for text in self._warnings():
            self._log.warning(text)

    def _publish(self) -> None:
        values = answer_dict(self._answer(), tuple(self._changes().values()))
        if self._given is None:
            values['reasons'] = self._warnings()
        self._answers.publish(String(data=json.dumps(values, allow_nan=False)))
