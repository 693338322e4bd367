"""What both nodes have: images in, a background thread that learns, services, diagnostics."""
from __future__ import annotations

import queue
from abc import ABC, abstractmethod
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
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64, Header
from std_srvs.srv import Trigger

from dashcalib_ros.calibrator import Status
from dashcalib_ros.errors import DashcalibError, InputError, one_line
from dashcalib_ros.input.decode import check_mask, read_mask
from dashcalib_ros.judge import Verdict
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.report.result import check_camera_name
from dashcalib_ros.report.wording import witness_texts
from dashcalib_ros.ros.background import (
    Activity,
    Learner,
    News,
    NewTurn,
    Result,
    Started,
    Trouble,
    Watched,
)
from dashcalib_ros.ros.car import Sensors
from dashcalib_ros.ros.diagnostics import (
    Changes,
    Complaints,
    Health,
    diagnostic_status,
    silence,
    turns_text,
)
from dashcalib_ros.ros.images import CURES, ImageInput, Intake, Source
from dashcalib_ros.ros.parameters import (
    camera_name,
    changed,
    check_known,
    declare,
    make_publisher,
    refusal,
    why_read_only,
)
from dashcalib_ros.ros.preview import Preview

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# s between two messages on /diagnostics
PERIOD_S = 1.0
# further kinds of problems than those of CURES, which come with a message of their own
TROUBLES = ('undecodable', 'strays', 'failed', 'failed_calibrations', 'failed_watches', 'unsaved',
            'store', 'workers', 'failed_callbacks', 'preview', 'other_calibrations')


class SetupError(DashcalibError):
    """The node's parameters do not fit its images: it ends."""


class Mailbox:
    """Actions that other threads leave for the executor's thread.

    A guard condition wakes the executor, whose thread then runs what was put in, in order.
    failed: called in that thread with what an action raised.
    """

    def __init__(self, node: Node, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._actions: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.wake = node.create_guard_condition(self._empty)

    def put(self, action: Callable[[], None]) -> None:
        """Let the executor's thread run an action; may be called from any thread."""
        self._actions.put(action)
        with suppress(RuntimeError):  # rclpy's, when the context is shut down already
            self.wake.trigger()

    def blocked(self) -> bool:
        """Return whether rclpy calls no callback any more, after an exception of its own."""
        return not self.wake.callback_group.can_execute(self.wake)

    def _empty(self) -> None:
        with suppress(queue.Empty):
            while True:
                action = self._actions.get_nowait()
                try:
                    action()
                except Exception as error:
                    # the other actions must not wait for the next trigger
                    self._failed(error)


class CameraNode(Node, ABC):
    """What the node that calibrates and the one that checks have in common.

    It gives the images to the background thread, and compares each turn with a camera in use.
    Every callback runs in the executor's single thread and is short. The background thread puts
    its news into a mailbox, which is emptied in that same thread: no lock is needed.
    """

    # what the node does with the camera, for its first line in the log
    doing: str

    def __init__(self, listen: bool = True) -> None:
        """listen: subscribe the images at once."""
        super().__init__('calibrator')
        try:
            self._make(listen)
        except Exception:
            # a node that is left half made may crash rclpy at the end of the process
            self.destroy_node()
            raise

    def _make(self, listen: bool) -> None:
        self._core, self._own = declare(self)
        topic = self.resolve_topic_name('image_raw')
        self._name = camera_name(self._own, topic)
        check_camera_name(self._name)
        self._mask = read_mask(Path(self._own.mask_file)) if self._own.mask_file else None
        self._log = self.get_logger()
        self._complaints = Complaints(self._log.warning)
        self._mail = Mailbox(self, self.survive)
        self._changes = Changes(self._log)
        self._verdict: Verdict | None = None
        # what the car's own sensors say of the last calibration, in words
        self._witnesses: list[str] = []
        self._watched: NamedCamera | None = None
        # not the ROS clock: diagnostics must also be published while a simulation is paused
        self._steady = steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._open(topic)
        self._magnitude = make_publisher(self, Float64, '~/turn_magnitude', QoSProfile(depth=10))
        self._diagnostics = make_publisher(self, DiagnosticArray, '/diagnostics',
                                           QoSProfile(depth=10))
        self._preview = Preview(self, self._own, self._core.rectified,
                                lambda error: self._later(
                                    lambda: self._failed('preview', error)))
        self._intake = Intake(self._core.motion.rate, self._complaints, self._on_source)
        self._images = ImageInput(self, self._own, self._on_image, steady)
        self._images.start()
        # all parameters are declared now, those of qos_overrides too
        check_known(self._parameter_overrides, self._parameters)
        if not listen:
            self._images.stop()
        self._load()
        # so many turns are kept: no more can be wanted later
        self._most_turns = max(self._core.turns.capacity, self._core.turns.wanted)
        self._learner = Learner(self._core, self._own.queue_size,
                                lambda news: self._later(lambda: self._on_news(news)),
                                self._preview, self._mask)
        self._sensors = Sensors(self, self._own, self._learner.sense)
        self._set_goal()
        self.create_timer(PERIOD_S, self._on_tick, clock=steady)
        for name, action in (('calibrate', self._calibrate), ('reset', self._reset),
                             ('save', self._save)):
            self.create_service(Trigger, f'~/{name}', _service(action))
        self.answer_always()
        self.add_on_set_parameters_callback(self._on_parameters)
        self._log.info(f'{self.doing} the camera {self._name!r} from the turns seen on '
                       f'{self._images.topic}')

    # what the two nodes do in their own ways --------------------------------------------------

    @abstractmethod
    def _open(self, topic: str) -> None:
        """Make what belongs to the camera in use. topic: of the images."""

    @abstractmethod
    def _trusted(self) -> NamedCamera | None:
        """Return the camera that each turn is compared with, None if there is none."""

    @abstractmethod
    def _goal(self) -> int | None:
        """Return how many turns the next calibration needs; None: there is to be none."""

    def _checked(self) -> NamedCamera | None:
        """Return the camera that each calibration is to check, None if there is none."""
        return None

    def _load(self) -> None:
        """Begin, at the start and after the turns were dropped."""

    def _accompany(self, header: Header, size: tuple[int, int]) -> None:
        """Publish what belongs beside an image."""

    @abstractmethod
    def _fit(self, source: Source) -> None:
        """Take what the images are: the camera in use may be of others."""

    @abstractmethod
    def _judge(self, result: Result) -> None:
        """Take a new calibration."""

    @abstractmethod
    def _drop(self) -> None:
        """Forget what turns said of the camera in use, and the camera if they made it."""

    @abstractmethod
    def _reset(self) -> tuple[bool, str]:
        """Begin anew; return success and a message."""

    @abstractmethod
    def _save(self) -> tuple[bool, str]:
        """Write the calibration; return success and a message."""

    @abstractmethod
    def _warnings(self) -> list[str]:
        """Return warnings for the operator, about the camera in use."""

    @abstractmethod
    def _health(self, activity: Activity, turns: str) -> Health:
        """Return what is said of the camera in use; turns: how many there are, in words."""

    # the end, and what fails ------------------------------------------------------------------

    def close(self) -> None:
        """End the background thread with its child processes, the drawing, then the node."""
        self._learner.close()
        self._preview.close()
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

    def _later(self, action: Callable[[], None]) -> None:
        """Let the executor's thread run an action; called from other threads."""
        self._mail.put(action)

    # images ----------------------------------------------------------------------------------

    def listen(self, active: bool) -> None:
        """Subscribe the images, or end the subscription."""
        (self._images.start if active else self._images.stop)()

    def _on_image(self, message: Any) -> None:
        taken = self._intake.take(message)
        if taken is None:
            return
        index, source = taken
        self._accompany(message.header, source.size)
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
            self._log.info(f'the images on {self._images.topic} are {source}')
        else:
            self._log.error(f'the camera changes from {before} to {source}: the turns and the '
                            f'calibration are dropped')
            self.begin_anew()
        self._fit(source)
        self._set_goal()

    def begin_anew(self) -> None:
        """Forget the turns, not those in turns.store; begin as at the start."""
        self._forget(keep_stored=True)
        self._load()
        self._set_goal()

    def _forget(self, keep_stored: bool = False) -> None:
        self._verdict, self._witnesses = None, []
        self._drop()
        self._learner.restart(keep_stored)
        self._intake.forget()
        self._set_goal()

    # what was learned ------------------------------------------------------------------------

    def _on_news(self, news: News) -> None:
        match news:
            case Status():
                self._magnitude.publish(Float64(data=float(news.magnitude)))
            case NewTurn():
                self._log.info(news.text(self._core.turns.wanted, self._trusted() is not None))
            case Started():
                self._log.info(str(news))
            case Trouble():
                self._complaints.say(news.kind, news.text)
            case Watched():
                self._on_watched(news)
            case Result():
                self._on_result(news)

    def _on_watched(self, watched: Watched) -> None:
        if watched.camera is self._compared():
            self._changes.take(watched.monitor)

    def _on_result(self, result: Result) -> None:
        if result.bank != self._learner.bank:
            return  # a reset came in between
        self._verdict = result.calibration.verdict
        self._witnesses = witness_texts(result.calibration.witnesses)
        for text in self._witnesses:
            self._log.info(text)
        for text in result.calibration.warnings:
            self._complaints.once(text)
        self._judge(result)
        self._set_goal()

    def _compared(self) -> NamedCamera | None:
        """Return the camera that each turn is compared with; the changes are of this one."""
        if self._watched is not self._trusted():
            self._watched = self._trusted()
            self._changes.forget()
        return self._watched

    def _set_goal(self) -> None:
        """Tell the learner from how many turns to calibrate, and what to compare turns with."""
        self._learner.goal = self._goal()
        self._learner.compare(self._compared(), self._checked())

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
            return False, '; '.join(self._warnings())
        refused = self._learner.request()
        return not refused, refused or 'started: /diagnostics will have the result'

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        before = self._core.turns.wanted
        self._core, self._own, result = changed(self._core, self._own, parameters,
                                                self._most_turns)
        wanted = self._core.turns.wanted
        if wanted != before:
            self._log.info(f'{wanted} turns are wanted now, not {before}')
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

    # diagnostics -----------------------------------------------------------------------------

    def _on_tick(self) -> None:
        images, intake, learner = self._images, self._intake, self._learner
        intake.complain(learner.dropped)
        if images.listening:
            images.tell_silence(intake.silent_s)
        activity, wanted = learner.activity(), self._core.turns.wanted
        warnings = self._warnings()
        if images.publishers > 1:
            warnings.append(f'{images.publishers} publishers on {images.topic}: remap all but one '
                            f'camera')
        health = self._health(activity, turns_text(activity, wanted))
        status = diagnostic_status(
            silence(images.topic, images.listening, intake.silent_s), activity, wanted,
            self._verdict, self._changes, warnings, health,
            {'topic': images.topic, 'reliability': images.reliability,
             'motion sensors': '; '.join(self._witnesses), 'received': intake.received,
             **health.counts,
             **{kind: self._complaints.counts[kind] for kind in (*CURES, *TROUBLES)},
             'pictures published': self._preview.published})
        status.name = f'{self.get_fully_qualified_name().strip("/")}: camera calibration'
        status.hardware_id = self._name
        camera = self._trusted() if health.published is None else health.published
        self._preview.tell(status.message, camera.camera if camera else None)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def _service(action: Callable[[], tuple[bool, str]]) -> Callable[..., Trigger.Response]:
    """Return a service's callback; action: returns success and a message."""
    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = action()
        return response
    return answer
