"""The node: takes images, and publishes a camera_info for each once the camera is calibrated."""
from __future__ import annotations

import queue
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from dashcalib_ros.calibrator import Status
from dashcalib_ros.errors import DashcalibError, InputError, one_line
from dashcalib_ros.frames.decode import message_size
from dashcalib_ros.frames.mask_file import check_mask, read_mask
from dashcalib_ros.frames.stamps import StampGate, live
from dashcalib_ros.report.camera_yaml import check_camera_name
from dashcalib_ros.ros.commit import Commit
from dashcalib_ros.ros.complaints import Complaints
from dashcalib_ros.ros.images import ImageInput
from dashcalib_ros.ros.in_use import CalibrationInUse
from dashcalib_ros.ros.learner import Learner, Listener, Result
from dashcalib_ros.ros.messages import Health, diagnostic_status
from dashcalib_ros.ros.parameters import camera_name, changed, declare, unknown
from dashcalib_ros.ros.state import Rules, state_of
from dashcalib_ros.ros.store import Store
from dashcalib_ros.ros.stream import Source, SourceWatch

DIAGNOSTICS_S = 1.0
CURES = {
    'lost': 'images are lost between the camera and this node (gaps in the stamps): give the '
            "camera driver's process config/fastdds_large_images.xml, or publish reliable or "
            'compressed images',
    'dropped': 'images are dropped because detection does not keep up: set motion.rate, '
               'motion.width or motion.points lower',
    'repeated': 'images have stamps that are not later than those before: is there a second '
                'publisher on the topic?',
    'unstamped': 'images without a stamp among others that have one: repair the camera driver',
    'set_back': 'the stamps were set back (a bag that loops?): tracking begins anew, the turns '
                'are kept',
}
# further kinds of problems, which come with a message of their own
TROUBLES = ('undecodable', 'strays', 'failed', 'failed_calibrations', 'unsaved', 'store',
            'workers', 'failed_callbacks')


class SetupError(DashcalibError):
    """The node's parameters do not fit its images: it ends."""


class CalibratorNode(Node):
    """Connects the camera's topic, the learner's threads and the calibration in use.

    Every callback runs in the executor's single thread and is short. The learner's threads put
    their results into a queue, which a guard condition's callback empties in that same thread: no
    lock is needed.
    """

    def __init__(self) -> None:
        super().__init__('calibrator')
        self._core, self._own = declare(self)
        self._name = camera_name(self._own, self.get_namespace())
        check_camera_name(self._name)
        self._mask = None
        if self._own.mask_file:
            self._mask = read_mask(Path(self._own.mask_file))
        for line in unknown(self._parameter_overrides):
            self.get_logger().warning(line)
        self._complaints = Complaints(self.get_logger().warning)
        self._in_use = CalibrationInUse(
            self, self._name, Store(self._own.camera_info_file, self._name),
            Rules(self._own.better, self._own.contradictions), self._complaints,
            self._core.rectified)
        self._publication = self._in_use.publication
        self._magnitude = self.create_publisher(Float64, '~/turn_magnitude', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._commit: Commit | None = None
        self._received = 0
        self._last_image: float | None = None
        self._source = SourceWatch()
        self._stamps = StampGate(live(self._core.motion.rate))
        self._in_use.load()

        self._news: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._wake = self.create_guard_condition(self._on_news)
        self._learner = Learner(self._core, self._own.queue_size, Listener(
            result=lambda result: self._later(lambda: self._on_result(result)),
            status=lambda status: self._later(lambda: self._on_status(status)),
            trouble=lambda kind, text: self._later(lambda: self._complaints.say(kind, text))),
            self._mask)
        self._set_goal()
        # not the ROS clock: diagnostics must also be published while a simulation is paused
        self._steady = steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._images = ImageInput(self, self._own, self._on_image, steady)
        self.create_timer(DIAGNOSTICS_S, self._on_tick, clock=steady)
        for name, action in (('calibrate', self._calibrate), ('reset', self._reset),
                             ('save', self._in_use.save)):
            self.create_service(Trigger, f'~/{name}', self._answering(action))
        self.add_on_set_parameters_callback(self._on_parameters)
        self.get_logger().info(f'learning the camera {self._name!r} from the turns seen on '
                               f'{self._images.topic}')

    def close(self) -> None:
        """End the learner with its child processes, then the node."""
        self._learner.close()
        self.destroy_node()

    def survive(self, error: Exception) -> None:
        """Log and count what a callback raised."""
        self._complaints.failure('failed_callbacks', error)

    def blocked(self) -> bool:
        """Return whether rclpy calls no callback any more, after an exception of its own."""
        return not self._wake.callback_group.can_execute(self._wake)

    # images ----------------------------------------------------------------------------------

    def _on_image(self, message: Any) -> None:
        index, self._received = self._received, self._received + 1
        self._last_image = time.monotonic()
        try:
            source = Source(message_size(message), message.header.frame_id)
        except InputError as error:
            self._complaints.say('undecodable', str(error))
            return
        what = self._source.take(source)
        if what == 'stray':
            self._complaints.say('strays', f'an image is {source}, the camera is '
                                           f'{self._source.current}: is there a second publisher?')
            return
        if what != 'same':
            self._on_source(source)
        self._publication.accompany(message.header, source.size)
        stamp = message.header.stamp
        stamp_ns = self._stamps.take(stamp.sec * 10**9 + stamp.nanosec, time.monotonic_ns())
        if stamp_ns is not None:
            self._learner.offer(index, stamp_ns, message, source.size, source.frame_id)

    def _on_source(self, source: Source) -> None:
        """Handle the first source, or a change of it, which drops the turns and the calibration.

        Raises SetupError, which ends the node, for a mask that does not fit the first image.
        """
        if self._source.previous is None:
            try:
                check_mask(self._mask, source.size)
            except InputError as error:
                raise SetupError(str(error)) from error
        else:
            self.get_logger().error(
                f'the camera changes from {self._source.previous} to {source}: the turns and the '
                f'calibration are dropped')
            self._forget(keep_stored=True)
            self._in_use.load()
        self._in_use.check(source)
        self._set_goal()

    # what was learned ------------------------------------------------------------------------

    def _on_status(self, status: Status) -> None:
        self._magnitude.publish(Float64(data=float(status.magnitude)))

    def _on_result(self, result: Result) -> None:
        if result.bank != self._learner.bank:
            return  # a reset came in between
        current = self._source.current
        action = self._in_use.judge(result.calibration, result.complete,
                                    current.frame_id if current else '', self._own.publish_stale)
        if action in ('adopt', 'replace'):
            self._learner.restart()
            if self._own.commit:
                self._commit = self._commit or Commit(self, self._own.commit_timeout,
                                                      self._steady)
                self._commit.call(self._publication.info)
        elif action == 'give_up':
            # the turns that contradict it stay, and are used for the next one
            self._learner.forget_stored()
        elif action == 'keep' and result.complete:
            # the next calibration must be independent: it uses new turns only
            self._learner.restart()
        self._set_goal()

    def _forget(self, keep_stored: bool = False) -> None:
        self._in_use.drop()
        self._learner.restart(keep_stored)
        self._stamps.forget()
        self._set_goal()

    def _set_goal(self) -> None:
        """Set the number of turns from which the learner calibrates.

        The first calibration needs all turns wanted; to check a published one, a few are enough.
        """
        wanted = self._core.turns.wanted
        self._learner.goal = (wanted if self._in_use.trusted is None
                              else min(self._core.verdict.min_turns, wanted))

    # services and parameters -----------------------------------------------------------------

    def _answering(self, action: Callable[[], tuple[bool, str]]) -> Callable[..., Any]:
        """Return a service's callback; action: returns success and a message."""
        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.success, response.message = action()
            except Exception as error:
                self.survive(error)
                response.success = False
                response.message = f'failed: {one_line(error)}; the log of the node has more'
            return response
        return answer

    def _calibrate(self) -> tuple[bool, str]:
        refusal = self._learner.request()
        return not refusal, refusal or 'started: /diagnostics will have the result'

    def _reset(self) -> tuple[bool, str]:
        self.get_logger().warning('reset by request: the turns and the calibration are dropped')
        self._forget()
        moved, text = self._in_use.retire()
        return moved, f'collecting; {text}'

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        self._own, result = changed(self._own, parameters)
        return result

    # diagnostics -----------------------------------------------------------------------------

    def _on_tick(self) -> None:
        stamps = self._stamps
        for kind, count in (('lost', stamps.lost), ('dropped', self._learner.dropped),
                            ('repeated', stamps.repeated), ('unstamped', stamps.zero),
                            ('set_back', stamps.set_back)):
            self._complaints.total(kind, count, CURES[kind])
        message = DiagnosticArray(status=[diagnostic_status(
            self._health(),
            f'{self.get_fully_qualified_name().strip("/")}: camera calibration', self._name)])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _health(self) -> Health:
        activity, in_use = self._learner.activity(), self._in_use
        verdict = in_use.verdict
        state = state_of(in_use.trusted is not None, activity.calibrating,
                         verdict is not None and verdict.level != 'accepted')
        silent = None if self._last_image is None else time.monotonic() - self._last_image
        counts = {'received': self._received, 'camera_info published': self._publication.sent,
                  **{kind: self._complaints.counts[kind] for kind in (*CURES, *TROUBLES)},
                  'contradictions': in_use.contradictions}
        return Health(
            state, self._core.turns.wanted, self._images.topic, self._images.reliability,
            activity.status, activity.stage, in_use.camera, in_use.stale,
            verdict.level if verdict else '', verdict.reasons if verdict else (), silent,
            in_use.file, tuple(self._warnings()), counts)

    def _warnings(self) -> list[str]:
        warnings = self._in_use.warnings()
        if self._images.publishers > 1:
            warnings.append(f'{self._images.publishers} publishers on {self._images.topic}: '
                            f'remap all but one camera')
        if self.count_publishers(self._publication.topic) > 1:
            warnings.append(f'another node publishes {self._publication.topic}: remap it, or its '
                            f'subscribers get both')
        return warnings

    # between the threads ---------------------------------------------------------------------

    def _later(self, action: Callable[[], None]) -> None:
        """Let the executor's thread run an action; called from the learner's threads."""
        self._news.put(action)
        with suppress(RuntimeError):  # rclpy's, when the context is shut down already
            self._wake.trigger()

    def _on_news(self) -> None:
        while True:
            try:
                action = self._news.get_nowait()
            except queue.Empty:
                return
            try:
                action()
            except Exception as error:
                # the other actions must not wait for the next trigger
                self.survive(error)
