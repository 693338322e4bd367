"""The node: takes images, and publishes a camera_info for each once the camera is calibrated."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from dashcalib_ros.errors import DashcalibError, InputError, one_line
from dashcalib_ros.input.decode import check_mask, read_mask
from dashcalib_ros.report.camera_yaml import check_camera_name
from dashcalib_ros.ros.camera_url import camera_info_path
from dashcalib_ros.ros.commit import Commit
from dashcalib_ros.ros.complaints import Complaints
from dashcalib_ros.ros.diagnosis import PERIOD_S, Diagnosis
from dashcalib_ros.ros.given import GivenCalibration
from dashcalib_ros.ros.images import ImageInput
from dashcalib_ros.ros.in_use import CalibrationInUse
from dashcalib_ros.ros.intake import Intake
from dashcalib_ros.ros.kept import Whose
from dashcalib_ros.ros.learner import Learner
from dashcalib_ros.ros.mailbox import Mailbox
from dashcalib_ros.ros.news import Listener, NewTurn, Result
from dashcalib_ros.ros.parameters import (
    camera_name,
    changed,
    check_known,
    declare,
    refusal,
    why_read_only,
)
from dashcalib_ros.ros.preview import Preview
from dashcalib_ros.ros.qos import make_publisher
from dashcalib_ros.ros.state import Rules
from dashcalib_ros.ros.store import Store
from dashcalib_ros.ros.stream import Source
from dashcalib_ros.ros.wording import started_text, turn_text
from dashcalib_ros.status import Status


class SetupError(DashcalibError):
    """The node's parameters do not fit its images: it ends."""


class CalibratorNode(Node):
    """Connects the camera's topic, the learner's threads and the calibration in use.

    Every callback runs in the executor's single thread and is short. The learner's threads put
    their results into a mailbox, which is emptied in that same thread: no lock is needed.
    """

    def __init__(self, listen: bool = True) -> None:
        """listen: subscribe the images at once."""
        super().__init__('calibrator')
        self._core, self._own = declare(self)
        self._topic = self.resolve_topic_name('image_raw')
        self._name = camera_name(self._own, self._topic)
        check_camera_name(self._name)
        self._mask = read_mask(Path(self._own.mask_file)) if self._own.mask_file else None
        self._complaints = Complaints(self.get_logger().warning)
        self._mail = Mailbox(self, self.survive)
        self._in_use = self._make_in_use()
        self._magnitude = make_publisher(self, Float64, '~/turn_magnitude', QoSProfile(depth=10))
        self._preview = Preview(self, self._own, self._core.rectified,
                                lambda error: self._later(
                                    lambda: self._failed('preview', error)))
        self._intake = Intake(self._core.motion.rate, self._complaints, self._on_source)
        # not the ROS clock: diagnostics must also be published while a simulation is paused
        self._steady = steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._images = ImageInput(self, self._own, self._on_image, steady)
        self._diagnosis = Diagnosis(self, self._name, self._complaints, self._images,
                                    self._intake, self._in_use, self._preview)
        self._images.start()
        # all parameters are declared now, those of qos_overrides too
        check_known(self._parameter_overrides, self._parameters)
        if not listen:
            self._images.stop()
        self._commit: Commit | None = None
        self._in_use.load()
        # so many turns are kept: no more can be wanted later
        self._most_turns = max(self._core.turns.capacity, self._core.turns.wanted)
        self._learner = Learner(self._core, self._own.queue_size, self._listener(), self._mask)
        self._set_goal()
        self.create_timer(PERIOD_S, self._on_tick, clock=steady)
        for name, action in (('calibrate', self._calibrate), ('reset', self._reset),
                             ('save', self._in_use.save)):
            self.create_service(Trigger, f'~/{name}', _service(action))
        self.answer_always()
        self.add_on_set_parameters_callback(self._on_parameters)
        doing = 'checking' if self._own.check_only else 'learning'
        self.get_logger().info(f'{doing} the camera {self._name!r} from the turns seen on '
                               f'{self._images.topic}')

    def _make_in_use(self) -> CalibrationInUse | GivenCalibration:
        if self._own.check_only:
            return GivenCalibration(self, self._complaints, self._set_goal)
        plain = self._topic == f'{self.get_namespace().rstrip("/")}/image_raw'
        whose = Whose(self._name, self._topic, plain)
        return CalibrationInUse(
            self, whose, Store(camera_info_path(self._own.calibration_url, self._name), whose),
            Rules(self._own.better, self._own.contradictions), self._complaints,
            self._core.rectified)

    def close(self) -> None:
        """End the learner with its child processes, the drawing, then the node."""
        self._learner.close()
        self._preview.close()
        self._in_use.close()
        self.destroy_node()

    def survive(self, error: Exception) -> None:
        """Log and count what a callback raised, unless the context was shut down meanwhile."""
        self._failed('failed_callbacks', error)

    def _failed(self, kind: str, error: Exception) -> None:
        # a callback that is at work while the node is stopped may raise nearly anything
        if self.context.ok():
            self._complaints.failure(kind, error)

    def blocked(self) -> bool:
        """Return whether rclpy calls no callback any more, after an exception of its own."""
        return self._mail.blocked()

    # images ----------------------------------------------------------------------------------

    def _on_image(self, message: Any) -> None:
        taken = self._intake.take(message)
        if taken is None:
            return
        index, source = taken
        self._in_use.accompany(message.header, source.size)
        stamp_ns = self._intake.stamp_ns(message)
        if stamp_ns is not None:
            self._learner.offer(index, stamp_ns, message, source.size, source.frame_id)

    def _on_source(self, before: Source | None, source: Source) -> None:
        """Handle the first source, or a change of it, which drops the turns and the calibration.

        Raises SetupError, which ends the node, for a mask that does not fit the first image.
        """
        if before is None:
            try:
                check_mask(self._mask, source.size)
            except InputError as error:
                raise SetupError(str(error)) from error
            self.get_logger().info(f'the images on {self._images.topic} are {source}')
        else:
            self.get_logger().error(
                f'the camera changes from {before} to {source}: the turns and the calibration '
                f'are dropped')
            self._forget(keep_stored=True)
            self._in_use.load()
        self._in_use.check(source)
        self._set_goal()

    # what was learned ------------------------------------------------------------------------

    def _listener(self) -> Listener:
        """Return what the learner's threads call: most of it is left for the executor's."""
        return Listener(
            result=lambda result: self._later(lambda: self._on_result(result)),
            status=lambda status: self._later(lambda: self._on_status(status)),
            trouble=lambda kind, text: self._later(lambda: self._complaints.say(kind, text)),
            turn=lambda turn: self._later(lambda: self._on_turn(turn)),
            started=lambda status: self._later(
                lambda: self.get_logger().info(started_text(status))),
            watching=self._preview.wanted, picture=self._preview.show,
            watched=lambda watched: self._later(lambda: self._in_use.on_watched(watched)))

    def _on_status(self, status: Status) -> None:
        self._magnitude.publish(Float64(data=float(status.magnitude)))

    def _on_turn(self, turn: NewTurn) -> None:
        self.get_logger().info(turn_text(turn, self._core.turns.wanted,
                                         self._in_use.trusted is not None))

    def _on_result(self, result: Result) -> None:
        if result.bank != self._learner.bank:
            return  # a reset came in between
        current = self._intake.source
        action = self._in_use.judge(result, current.frame_id if current else '',
                                    self._own.publish_stale)
        if action in ('adopt', 'replace'):
            self._learner.restart()
            if self._own.commit and isinstance(self._in_use, CalibrationInUse):
                self._commit = self._commit or Commit(self, self._own.commit_timeout,
                                                      self._steady)
                self._commit.call(self._in_use.info)
        elif action == 'give_up':
            # the turns that contradict it stay, and are used for the next one
            self._learner.forget_stored(result.calibration.used_turns)
        elif (action == 'keep' and result.complete
              # turns that do not confirm it may be all that is known of another camera: they stay
              and (self._in_use.settled or not self._learner.extend())):
            # the next calibration must be independent: it uses new turns only
            self._learner.restart()
        self._set_goal()

    def _forget(self, keep_stored: bool = False) -> None:
        self._in_use.drop()
        self._learner.restart(keep_stored)
        self._intake.forget()
        self._set_goal()

    def _set_goal(self) -> None:
        """Tell the learner from how many turns to calibrate, and what to compare turns with."""
        self._learner.goal = self._in_use.goal(self._core)
        self._learner.compare(self._in_use.watched(), self._in_use.checked)

    # services and parameters -----------------------------------------------------------------

    def answer_always(self) -> None:
        """Let each service, rclpy's own too, answer where its callback fails.

        A client waits for ever for an answer that does not come.
        """
        for service in self.services:
            service.callback = self._answering(service.callback)

    def _answering(self, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:
                self.survive(error)
                return refusal(request, response,
                               f'failed: {one_line(error)}; the log of the node has more')
        return answer

    def _calibrate(self) -> tuple[bool, str]:
        if self._learner.goal is None:
            return False, '; '.join(self._in_use.warnings())
        refusal = self._learner.request()
        return not refusal, refusal or 'started: /diagnostics will have the result'

    def _reset(self) -> tuple[bool, str]:
        self.get_logger().warning('reset by request: the turns and the calibration are dropped')
        self._forget()
        moved, text = self._in_use.retire()
        return moved, f'collecting; {text}'

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        before = self._core.turns.wanted
        self._core, self._own, result = changed(self._core, self._own, parameters,
                                                self._most_turns)
        wanted = self._core.turns.wanted
        if wanted != before:
            self.get_logger().info(f'{wanted} turns are wanted now, not {before}')
            self._learner.want(wanted)
            self._set_goal()
        return result

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters as rclpy does, and say why where one is read-only."""
        result = super().set_parameters_atomically(parameter_list)
        for name in (each.name for each in parameter_list):
            if not result.successful and result.reason.endswith(f'read-only parameter: {name}.'):
                result.reason = why_read_only(name)
        return result

    # timers, other threads -------------------------------------------------------------------

    def _on_tick(self) -> None:
        self._diagnosis.tick(self._learner, self._core.turns.wanted)

    def _later(self, action: Callable[[], None]) -> None:
        """Let the executor's thread run an action; called from other threads."""
        self._mail.put(action)


def _service(action: Callable[[], tuple[bool, str]]) -> Callable[..., Trigger.Response]:
    """Return a service's callback; action: returns success and a message."""
    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = action()
        return response
    return answer
