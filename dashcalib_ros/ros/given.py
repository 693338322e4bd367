"""With check_only: the calibration that a driver publishes, checked with turns, never changed."""
from __future__ import annotations

import json
from collections.abc import Callable, Hashable
from dataclasses import replace

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header, String

from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError
from dashcalib_ros.judge import Check, with_faults
from dashcalib_ros.report import NamedCamera, answer_dict
from dashcalib_ros.report.camera_file import camera_of_message
from dashcalib_ros.ros.camera_in_use import CameraInUse
from dashcalib_ros.ros.complaints import Complaints
from dashcalib_ros.ros.news import Result, Watched
from dashcalib_ros.ros.publication import LATCHED
from dashcalib_ros.ros.qos import make_publisher, make_subscription
from dashcalib_ros.ros.state import Action
from dashcalib_ros.ros.stream import Source, SourceWatch

# hears reliable and best-effort drivers alike; one that is lost is followed by the next image's
FROM_DRIVER = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
NOT_YET = Check('cannot tell', ('the turns wanted are not there yet',))
UNTOUCHED = 'check_only: the calibration is the driver\'s, and stays as it is'


class GivenCalibration(CameraInUse):
    """A driver's calibration, and the answer of the turns, which is latched on ~/check."""

    def __init__(self, node: Node, complaints: Complaints, changed: Callable[[], None]) -> None:
        """changed: called when the camera has changed."""
        super().__init__(node)
        self.topic = node.resolve_topic_name('camera_info')
        self._log = node.get_logger()
        self._complaints = complaints
        self._changed = changed
        self._infos: SourceWatch[Hashable] = SourceWatch()
        self._camera: NamedCamera | None = None
        self._size: tuple[int, int] | None = None
        self._found = NOT_YET
        # why there is no camera, or it is not of the images
        self._problem = f'no camera_info on {self.topic} yet'
        self._publisher = make_publisher(node, String, '~/check', LATCHED)
        make_subscription(node, CameraInfo, 'camera_info', self._on_info, FROM_DRIVER)

    @property
    def camera(self) -> NamedCamera | None:
        """Return the driver's camera, None before it came or where it cannot be used."""
        return self._camera

    @property
    def trusted(self) -> NamedCamera | None:
        """Return the driver's camera, None if it is for other images."""
        return self._camera if self._fits else None

    @property
    def checked(self) -> NamedCamera | None:
        """Return the driver's camera: of one for other images, the answer says what it is for."""
        return self._camera

    @property
    def answer(self) -> Check:
        """Return what the turns say of it, and what no turn is needed for."""
        return with_faults(self._found, self._camera.faults if self._camera else ())

    def goal(self, config: Config) -> int | None:
        """Return from how many turns on one is tried, None while there is no camera.

        A single turn may be wrong; the next ones are waited for where two cannot tell.
        """
        return (None if self._camera is None
                else min(config.verdict.min_turns, config.turns.wanted))

    def on_watched(self, watched: Watched) -> None:
        """Take what new turns show; publish it where it says more than before."""
        before = self.changes.texts
        super().on_watched(watched)
        if self.changes.texts != before:
            self._publish()

    def load(self) -> None:
        """Do nothing: the driver has the calibration."""

    def check(self, source: Source) -> None:
        """Take the size of the images, which is compared with the driver's."""
        self._size = source.size
        self._tell_size()

    def judge(self, result: Result, frame_id: str, publish_stale: bool) -> Action:
        """Take an answer; 'keep' where the next one should be of new turns."""
        if result.check is None or self._camera is None or result.given is not self._camera:
            return 'wait'
        self.verdict = result.calibration.verdict
        for text in result.calibration.warnings:
            self._complaints.once(text)
        before, found = self._found.answer, result.check
        if found.answer == 'cannot tell' and before != 'cannot tell' and not result.complete:
            return 'wait'  # that of more turns stays
        self._found = found
        self._publish()
        if not result.complete and found.answer == before:
            return 'wait'
        answer, reasons = self.answer.answer, '; '.join(self.answer.reasons)
        # rclpy takes one severity for each line of code
        if answer == 'wrong':
            self._log.warning(f'the calibration on {self.topic} is wrong: {reasons}')
        elif answer == 'right':
            self._log.info(f'the calibration on {self.topic} is right: {reasons}')
        else:
            self._log.info(f'the turns cannot tell whether the calibration on {self.topic} is '
                           f'right: {reasons}')
        return 'wait' if found.answer == 'cannot tell' else 'keep'

    def accompany(self, header: Header, size: tuple[int, int]) -> None:
        """Do nothing: the driver publishes the camera_info."""

    def drop(self) -> None:
        """Forget the answer and the changes; the driver's camera stays."""
        # as another object: what is still said of the former one is out of date
        self._camera = None if self._camera is None else replace(self._camera)
        self.verdict = None
        self.changes.forget()
        self._found = NOT_YET
        if self._infos.current is not None:
            self._publish()

    def retire(self) -> tuple[bool, str]:
        """Return that there is no file to move."""
        return True, UNTOUCHED

    def save(self) -> tuple[bool, str]:
        """Return that nothing is saved."""
        return False, UNTOUCHED

    def warnings(self) -> list[str]:
        """Return what keeps the calibration from being checked."""
        return [self._problem] if self._problem else []

    @property
    def _fits(self) -> bool:
        return self._camera is None or self._size in (None, self._camera.image_size)

    def _on_info(self, message: CameraInfo) -> None:
        roi = message.roi
        what = self._infos.take((
            message.width, message.height, message.distortion_model, tuple(message.d),
            tuple(message.k), tuple(message.r), tuple(message.p), message.binning_x,
            message.binning_y, roi.x_offset, roi.y_offset, roi.width, roi.height))
        if what == 'stray':
            self._complaints.say('other_calibrations', f'a camera_info on {self.topic} differs '
                                 f'from those before: is there a second publisher?')
        elif what != 'same':
            self._take(message, what == 'changed')

    def _take(self, message: CameraInfo, changed: bool) -> None:
        """Check this calibration from now on."""
        if changed:
            self._log.warning(f'the calibration on {self.topic} has changed: it is checked anew')
        try:
            self._camera, self._problem = camera_of_message(message, self.topic), ''
        except InputError as error:
            self._camera, self._problem = None, str(error)
            self._log.warning(self._problem)
        if self._camera is not None and self._camera.faults:
            self._log.warning(f'the calibration on {self.topic} is wrong: '
                              f'{"; ".join(self._camera.faults)}')
        self._tell_size()
        self.drop()
        self._changed()

    def _tell_size(self) -> None:
        if self._camera is None:
            return
        self._problem = ''
        if not self._fits and self._size is not None:
            (width, height), (w, h) = self._camera.image_size, self._size
            self._problem = (f'the camera_info on {self.topic} is for {width}x{height}, and the '
                             f'images are {w}x{h}')
            self._log.warning(self._problem)

    def _publish(self) -> None:
        values = answer_dict(self.answer, self.changes.texts)
        if self._camera is None:
            values['reasons'] = self.warnings()
        self._publisher.publish(String(data=json.dumps(values, allow_nan=False)))
