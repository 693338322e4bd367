"""What both nodes have: images in, a background thread that learns, services, diagnostics."""
from __future__ import annotations

import queue
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64, Header
from std_srvs.srv import Trigger

from dashcalib_ros.errors import ConfigError, DashcalibError, InputError, coded
from dashcalib_ros.input.decode import check_mask, read_mask
from dashcalib_ros.judge import Monitor, Verdict
from dashcalib_ros.pipeline import Status
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.report.result import check_camera_name
from dashcalib_ros.report.wording import witness_texts
from dashcalib_ros.ros.background import Learner, Moved, News, Result, Trouble, Watched
from dashcalib_ros.ros.car import Sensors
from dashcalib_ros.ros.diagnostics import ERROR, STALE, WARN, Complaints, Health, Log, log_line
from dashcalib_ros.ros.images import CURES, ImageInput, Intake, Source, since_text
from dashcalib_ros.ros.parameters import (
    OVERRIDES,
    camera_name,
    changed,
    check_changeable,
    check_known,
    declare,
    refusal,
)
from dashcalib_ros.ros.preview import Preview
from dashcalib_ros.ros.video import VideoDecoding

# s between two messages on /diagnostics
PERIOD_S = 1.0
# s without an image, after which a camera has stopped
SILENT_S = 5.0
# further kinds of problems than those of CURES, which come with a message of their own
TROUBLES = ('undecodable', 'strays', 'failed', 'failed_calibrations', 'failed_watches', 'unsaved',
            'store', 'workers', 'failed_callbacks', 'preview', 'other_calibrations')


class SetupError(DashcalibError):
    """The node's parameters do not fit its images: it ends."""


class CameraNode(Node, ABC):
    """What the node that calibrates and the one that checks have in common.

    It gives the images to the background thread, and compares each turn with a camera in use.
    Every callback runs in the executor's single thread and is short. What other threads leave with
    _later() is done in that same thread: no lock is needed.
    """

    # what the node does with the camera, for its first line in the log
    doing: str
    _visible: Log | None = None

    def __init__(self, listen: bool = True) -> None:
        """listen: subscribe the images at once."""
        super().__init__('calibrator')
        try:
            self._make(listen)
        except Exception:
            # a node that is left half made may crash rclpy at the end of the process
            self.destroy_node()
            raise

    def get_logger(self) -> Log:
        """Return the node's log."""
        self._visible = self._visible or Log(super().get_logger().name)
        return self._visible

    def _make(self, listen: bool) -> None:
        self._core, self._own = declare(self)
        topic = self.resolve_topic_name('image_raw')
        self._name = camera_name(self._own, topic)
        check_camera_name(self._name)
        self._mask = read_mask(Path(self._own.mask_file)) if self._own.mask_file else None
        self._log = self.get_logger()
        self._complaints = Complaints(self._log.warning)
        self._actions: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._wake = self.create_guard_condition(self._empty)
        # what turns say of the camera in use, None before they do
        self._monitor: Monitor | None = None
        # in words, as straight stretches show it
        self._moved = ''
        self._verdict: Verdict | None = None
        # why nothing is learned, published and saved now; '' where all is well
        self._held = ''
        # what the car's own sensors say of the last calibration, in words
        self._witnesses: list[str] = []
        # not the ROS clock: diagnostics must also be published while a simulation is paused
        self._steady = steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._open(topic)
        self._magnitude = self._publisher(Float64, '~/turn_magnitude', 10)
        self._diagnostics = self._publisher(DiagnosticArray, '/diagnostics', 10)
        self._preview = Preview(
            self, self._own, self._core.rectified,
            lambda error: self._later(lambda: self.survive(error, 'preview')))
        self._intake = Intake(self._core.motion.rate, self._complaints, self._on_source)
        self._video = None
        if self._own.image_transport == 'video':
            self._video = VideoDecoding(
                lambda image: self._later(partial(self._on_decoded, image)),
                lambda text: self._later(partial(self._complaints.say, 'undecodable', text)))
        self._images = ImageInput(
            self, self._own, self._video.put if self._video else self._on_image, steady)
        self._images.start()
        # all parameters are declared now, those of qos_overrides too
        check_known(self._parameter_overrides, self._parameters)
        if not listen:
            self._images.stop()
        self._load()
        # so many turns are kept: no more can be wanted later
        self._most_turns = max(self._core.turns.capacity, self._core.turns.wanted)
        self._learner = Learner(self._core, self._own.queue_size, self._hear, self._preview.take,
                                self._mask)
        self._sensors = Sensors(self, self._own, self._learner.sensors.add)
        self._set_goal()
        self.create_timer(PERIOD_S, self._on_tick, clock=steady)
        for name, action in (('calibrate', self._calibrate), ('reset', self._reset),
                             ('save', self._save)):
            self.create_service(Trigger, f'~/{name}', partial(_trigger, action))
        self.answer_always()
        self.add_on_set_parameters_callback(self._on_parameters)
        self._log.info(f'{self.doing} the camera {self._name!r} from the turns seen on '
                       f'{self._images.topic}')

    def _publisher(self, kind: type, topic: str, qos: QoSProfile | int) -> Publisher:
        return self.create_publisher(kind, topic, qos, qos_overriding_options=OVERRIDES)

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
    def _health(self, turns: str) -> Health:
        """Return what is said of the camera in use; turns: how many there are, in words."""

    # the end, and what fails ------------------------------------------------------------------

    def close(self) -> None:
        """End the background thread with its child processes, the drawing, then the node."""
        if self._video is not None:
            self._video.close()
        self._learner.close()
        self._preview.close()
        self.destroy_node()

    def survive(self, error: Exception, kind: str = 'failed_callbacks') -> None:
        """Log and count what a callback raised, unless the context was shut down meanwhile."""
        # a callback that is at work while the node is stopped may raise nearly anything
        if self.context.ok():
            self._complaints.failure(kind, error)

    def blocked(self) -> bool:
        """Return whether rclpy calls no callback any more, after an exception of its own."""
        return not self._wake.callback_group.can_execute(self._wake)

    def _hear(self, news: News) -> None:
        """Take news from other threads."""
        action = partial(self._on_news, news)
        if isinstance(news, Status):
            # one comes with each image: it waits for the next one, as waking up takes time
            self._actions.put(action)
        else:
            self._later(action)

    def _later(self, action: Callable[[], None]) -> None:
        """Let the executor's thread run an action, in order; called from other threads."""
        self._actions.put(action)
        with suppress(RuntimeError):  # rclpy's, when the context is shut down already
            self._wake.trigger()

    def _empty(self) -> None:
        with suppress(queue.Empty):
            while True:
                action = self._actions.get_nowait()
                try:
                    action()
                except Exception as error:
                    # the other actions must not wait for the next trigger
                    self.survive(error)

    # images ----------------------------------------------------------------------------------

    def _on_decoded(self, image: Any) -> None:
        if self._images.listening:
            self._on_image(image)

    def _on_image(self, message: Any) -> None:
        self._empty()
        taken = self._intake.take(message)
        if taken is None:
            return
        index, source = taken
        self._hold()
        if not self._held:
            self._accompany(message.header, source.size)
        stamp_ns = self._intake.stamp_ns(message)
        # where one publisher mixes two cameras, its images must tell when that ends
        if stamp_ns is not None and len(self._images.publishers) < 2:
            self._learner.offer(index, stamp_ns, message, source.size, source.frame_id)

    def _hold(self) -> None:
        """Look whether the images are of one camera; when they are again, begin anew with turns.

        The camera in use stays.
        """
        images, mixed = self._images, self._learner.activity.status.two_cameras
        before, self._held = self._held, ''
        if len(images.publishers) > 1:
            self._held = (f'{len(images.publishers)} publishers on {images.topic} '
                          f'({", ".join(images.publishers)}): nothing is learned, published or '
                          f'saved until one is left; remap the others')
        elif mixed:
            self._held = (f'{mixed}: nothing is published or saved until one is left; remap each '
                          f'camera to its own topic')
        if self._held and not before:
            self._log.error(self._held)
        elif before and not self._held:
            self._log.warning(f'{images.topic} has the images of one camera again: the turns are '
                              f'dropped')
            self._verdict = None
            self._learner.restart(keep_stored=True)
            self._intake.forget()

    def _on_source(self, before: Source | None, source: Source) -> None:
        """Handle the first source, or a change of it, which drops the turns and the calibration.

        Raises SetupError, which ends the node, for a mask that does not fit the first image.
        """
        if before is None:
            try:
                check_mask(self._mask, source.size)
            except InputError as error:
                raise SetupError(error.code, str(error)) from error
            self._log.info(f'the images on {self._images.topic} are {source}')
        else:
            self._log.error(f'the camera changed from {before} to {source}: the turns and the '
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
            case str():
                self._log.info(news)
            case Trouble():
                self._complaints.say(news.kind, news.text)
            case Watched():
                self._on_watched(news)
            case Moved():
                self._on_moved(news)
            case Result():
                self._on_result(news)

    def _on_watched(self, watched: Watched) -> None:
        """Take what turns say of the camera in use; each change is told once in the log."""
        if watched.camera is not self._trusted() or self._held:
            return
        known = self._changes()
        self._monitor = watched.monitor
        for kind, text in self._changes().items():
            if kind not in known:
                log_line(self._log, kind == 'lens', text)
        if 'lens' in known and 'lens' not in self._changes():
            self._log.info('the newest turns fit the calibration again')

    def _on_moved(self, moved: Moved) -> None:
        if moved.camera is self._trusted() and not (self._held or 'mount' in self._changes()):
            self._moved = moved.text
            self._log.info(moved.text)

    def _changes(self) -> dict[str, str]:
        """Return the changes of the camera in use, in words by their kind.

        Two turns or more show them, or straight stretches that it was moved on the car.
        """
        found = {'mount': self._moved} if self._moved else {}
        return found | {each.kind: str(each) for each in (
            self._monitor.changes if self._monitor else ())}

    def _on_result(self, result: Result) -> None:
        if result.bank != self._learner.bank or self._held:
            return  # a reset came in between, or nobody knows of which camera it is
        self._verdict = result.calibration.verdict
        self._witnesses = witness_texts(result.calibration.witnesses)
        for text in self._witnesses:
            self._log.info(text)
        for text in result.calibration.warnings:
            self._complaints.once(text)
        self._judge(result)
        self._set_goal()

    def _set_goal(self) -> None:
        """Tell the learner from how many turns to calibrate, and what to compare turns with."""
        learner, trusted = self._learner, self._trusted()
        if learner.watched is not trusted:
            self._monitor, self._moved = None, ''
        learner.config, learner.goal = self._core, self._goal()
        learner.watched, learner.checked = trusted, self._checked()

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
                return refusal(request, response, f'failed: {coded(error)}; see the log of the '
                                                  f'node')
        return answer

    def _calibrate(self) -> tuple[bool, str]:
        if self._held:
            return False, self._held
        if self._learner.goal is None:
            return False, '; '.join(self._warnings())
        refused = self._learner.request()
        return not refused, refused or 'started: /diagnostics and the log have the result'

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        before = self._core.turns.wanted
        try:
            self._core, self._own = changed(self._core, self._own, parameters, self._most_turns)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=coded(error))
        wanted = self._core.turns.wanted
        if wanted != before:
            self._log.info(f'turns.wanted is now {wanted}, it was {before}')
            self._set_goal()
        return SetParametersResult(successful=True)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters as rclpy does; refuse unknown and read-only ones with the cure."""
        try:
            check_changeable(self, (each.name for each in parameter_list))
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=coded(error))
        return super().set_parameters_atomically(parameter_list)

    # diagnostics -----------------------------------------------------------------------------

    def _on_tick(self) -> None:
        self._empty()
        images, intake, learner = self._images, self._intake, self._learner
        intake.complain(learner.inbox.dropped + (self._video.dropped if self._video else 0),
                        images.why_lost)
        if images.listening:
            images.tell_silence(intake.silent_s)
        self._hold()
        warnings = [*([self._held] if self._held else ()), *self._warnings()]
        now, wanted = learner.activity.status, self._core.turns.wanted
        health = self._health(f'{min(now.built, wanted)} of {wanted} turns, {now.yaw_deg:.0f}° of '
                              f'yaw')
        verdict = self._verdict
        values = {
            'state': health.state,
            'stage': learner.activity.stage,
            'turns found': now.turns,
            'turns stored': now.stored,
            'turns built': now.built,
            'turns wanted': wanted,
            'yaw (deg)': f'{now.yaw_deg:.0f}',
            'percent': min(100, round(100 * now.built / wanted)),
            'turning magnitude': f'{now.magnitude:.4f}',
            'standing': now.standing,
            'verdict': verdict.level if verdict else '',
            'reasons': '; '.join(verdict.reasons) if verdict else '',
            **health.values,
            'warnings': '; '.join(warnings),
            'change': '; '.join(self._changes().values()),
            'suspected change': '; '.join(
                str(each) for each in (self._monitor.lens, self._monitor.mount)
                if each and not each.confirmed) if self._monitor else '',
            'topic': images.topic,
            'publishers': ', '.join(images.publishers),
            'reliability': images.reliability,
            'motion sensors': '; '.join(self._witnesses),
            'received': intake.received,
            **{kind: self._complaints.counts[kind] for kind in (*CURES, *TROUBLES)},
            'pictures published': self._preview.published}
        level, message = self._level(health, warnings)
        self._preview.tell(message, health.camera.camera if health.camera else None)
        array = DiagnosticArray(status=[DiagnosticStatus(
            level=level, message=message, hardware_id=self._name,
            name=f'{self.get_fully_qualified_name().strip("/")}: camera calibration',
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _level(self, health: Health, warnings: list[str]) -> tuple[bytes, str]:
        """Return the level of /diagnostics and its message: the worst of what is to be said."""
        silent_s = self._intake.silent_s
        if not self._images.listening:
            return WARN, 'inactive: the node subscribes to no images until it is activated'
        if silent_s is None or silent_s > SILENT_S:
            return STALE, f'no image on {self._images.topic} {since_text(silent_s)}'
        if self._held:
            return ERROR, self._held
        if health.level != ERROR and warnings:
            return WARN, f'{health.state}: {warnings[0]}'
        if health.level != ERROR and 'lens' in self._changes():
            return WARN, self._changes()['lens']
        return health.level, health.message


def _trigger(action: Callable[[], tuple[bool, str]], _: Trigger.Request,
             response: Trigger.Response) -> Trigger.Response:
    """Answer a service; action: returns success and a message."""
    response.success, response.message = action()
    return response
