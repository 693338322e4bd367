"""The node: images in, one camera_info for each of them out, once the camera is known."""
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
from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.frames.mask_file import check_mask, read_mask
from dashcalib_ros.intrinsics import Calibration, Verdict
from dashcalib_ros.report.camera_yaml import check_camera_name
from dashcalib_ros.ros.commit import Commit
from dashcalib_ros.ros.complaints import Complaints
from dashcalib_ros.ros.image_size import image_size
from dashcalib_ros.ros.images import ImageInput
from dashcalib_ros.ros.learner import Learner, Listener, Result
from dashcalib_ros.ros.messages import Health, diagnostic_status
from dashcalib_ros.ros.parameters import camera_name, changed, declare, unknown
from dashcalib_ros.ros.publication import Publication
from dashcalib_ros.ros.state import Rules, judge, sigma_text, state_of
from dashcalib_ros.ros.store import Kept, Store
from dashcalib_ros.ros.stream import Source, SourceWatch, StampWatch, Thinning

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
# what else is counted, with a message of its own each time
TROUBLES = ('undecodable', 'strays', 'failed', 'failed_calibrations', 'unsaved', 'store')


class CalibratorNode(Node):
    """Wires the camera's topic, the learner's threads and what is published.

    Every callback runs in the executor's one thread and is short. The learner's threads leave
    their news in a queue that a guard condition empties in that same thread.
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
        self._store = Store(self._own.camera_info_file, self._name)
        self._publication = Publication(self)
        self._magnitude = self.create_publisher(Float64, '~/turn_magnitude', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._commit: Commit | None = None
        self._verdict: Verdict | None = None
        self._contradictions = 0
        self._received = 0
        self._last_image: float | None = None
        self._source = SourceWatch()
        self._stamps = StampWatch()
        self._thinning = Thinning(self._core.motion.rate)
        self._load()

        self._news: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._wake = self.create_guard_condition(self._on_news)
        self._learner = Learner(self._core, self._own.queue_size, Listener(
            result=lambda result: self._later(lambda: self._on_result(result)),
            status=lambda status: self._later(lambda: self._on_status(status)),
            trouble=lambda kind, text: self._later(lambda: self._complaints.say(kind, text))),
            self._mask)
        self._aim()
        # a paused simulation must not silence the diagnostics
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._steady = steady
        self._images = ImageInput(self, self._own, self._on_image, steady)
        self.create_timer(DIAGNOSTICS_S, self._on_tick, clock=steady)
        self.create_service(Trigger, '~/calibrate', self._on_calibrate)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(Trigger, '~/save', self._on_save)
        self.add_on_set_parameters_callback(self._on_parameters)
        self.get_logger().info(f'learning the camera {self._name!r} from the turns seen on '
                               f'{self._images.topic}')

    def close(self) -> None:
        """End the learner with its child processes, then the node."""
        self._learner.close()
        self.destroy_node()

    # images ----------------------------------------------------------------------------------

    def _on_image(self, message: Any) -> None:
        index, self._received = self._received, self._received + 1
        self._last_image = time.monotonic()
        try:
            source = Source(image_size(message), message.header.frame_id)
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
        self._publication.accompany(message.header, source)
        stamp = message.header.stamp
        stamp_ns = self._stamps.take(stamp.sec * 10**9 + stamp.nanosec, time.monotonic_ns())
        if stamp_ns is not None and self._thinning.wants(stamp_ns):
            self._learner.offer(index, stamp_ns, message, source.size, source.frame_id)

    def _on_source(self, source: Source) -> None:
        """Take the first image's source, or another one that lasts: all that was learned goes.

        Raises InputError, which ends the node, for a mask that does not fit the first image.
        """
        kept = self._publication.kept
        if self._source.previous is None:
            check_mask(self._mask, source.size)
        else:
            self.get_logger().error(
                f'the camera changes from {self._source.previous} to {source}: the turns and the '
                f'calibration are dropped')
            self._forget(keep_stored=True)
            self._load()
            kept = self._publication.kept
        if kept is None:
            return
        if (kept.camera.image_size, kept.frame_id or source.frame_id) != (source.size,
                                                                         source.frame_id):
            of = Source(kept.camera.image_size, kept.frame_id)
            self.get_logger().warning(f'{self._store.path} is ignored: it is for {of}, the images '
                                      f'are {source}')
            self._publication.retract()
            self._aim()

    # what was learned ------------------------------------------------------------------------

    def _on_status(self, status: Status) -> None:
        self._magnitude.publish(Float64(data=float(status.magnitude)))

    def _on_result(self, result: Result) -> None:
        """Judge a calibration; see state.py for the reasons."""
        if result.bank != self._learner.bank:
            return  # a reset came in between
        calibration, complete = result.calibration, result.complete
        self._verdict = calibration.verdict
        for text in calibration.warnings:
            self._complaints.once(text)
        trusted = None if self._publication.stale or self._publication.kept is None else (
            self._publication.kept.camera)
        rules = Rules(self._own.better, self._own.contradictions)
        judged = judge(calibration, complete, trusted, self._contradictions, rules)
        self._contradictions = judged.contradictions
        log = self.get_logger()
        if judged.action in ('adopt', 'replace'):
            if judged.action == 'replace':
                log.warning(f'the calibration is replaced: {judged.why}')
            self._adopt(calibration)
        elif judged.action == 'give_up':
            log.error(f'the published calibration is given up: {judged.why}')
            self._give_up()
        else:
            used = calibration.turns_used
            text = (f'a calibration of {used} turn{"" if used == 1 else "s"} is '
                    f'{calibration.verdict.level}' + (f': {judged.why}' if judged.why else ''))
            # rclpy takes one severity for each line of code
            if judged.contradictions:
                log.warning(text)
            else:
                log.info(text)
            if trusted is not None and complete:
                # the next opinion is formed from turns of its own
                self._learner.restart()

    def _adopt(self, calibration: Calibration) -> None:
        frame_id = self._source.current.frame_id if self._source.current else ''
        kept = Kept.of(calibration, self._name, frame_id)
        info = self._publication.set(kept)
        self._contradictions = 0
        self.get_logger().info(f'calibrated: {sigma_text(kept.camera)}')
        self._save(kept)
        self._learner.restart()
        self._aim()
        if self._own.commit:
            self._commit = self._commit or Commit(self, self._own.commit_timeout, self._steady)
            self._commit.call(info)

    def _give_up(self) -> None:
        """Trust the calibration no more; the turns that contradict it go on to the next one."""
        self._store.retire()
        if self._own.publish_stale:
            self._publication.stale = True
        else:
            self._publication.retract()
        self._learner.forget_stored()
        self._aim()

    def _forget(self, keep_stored: bool = False) -> None:
        self._publication.retract()
        self._verdict, self._contradictions = None, 0
        self._learner.restart(keep_stored)
        self._stamps.forget()
        self._thinning = Thinning(self._core.motion.rate)
        self._aim()

    def _aim(self) -> None:
        """Tell the learner how many turns are worth a calibration.

        The first needs all that are wanted; doubts about a published one need only a few.
        """
        trusted = self._publication.kept is not None and not self._publication.stale
        wanted = self._core.turns.wanted
        self._learner.goal = min(self._core.verdict.min_turns, wanted) if trusted else wanted

    # the file --------------------------------------------------------------------------------

    def _load(self) -> None:
        try:
            kept = self._store.load()
        except InputError as error:
            self.get_logger().warning(str(error))
            return
        if kept is not None:
            self._publication.set(kept)
            self.get_logger().info(f'loaded {self._store.path}: {sigma_text(kept.camera)}')

    def _save(self, kept: Kept) -> str:
        try:
            self._store.save(kept)
        except OutputError as error:
            self._complaints.say('unsaved', str(error))
            return str(error)
        return ''

    # services and parameters -----------------------------------------------------------------

    def _on_calibrate(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        refusal = self._learner.request()
        answer.success = not refusal
        answer.message = refusal or 'started: what comes of it is told in /diagnostics'
        return answer

    def _on_reset(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        self.get_logger().warning('reset by request: the turns and the calibration are dropped')
        self._forget()
        self._store.retire()
        answer.success, answer.message = True, 'collecting; a saved file was moved aside'
        return answer

    def _on_save(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        kept = self._publication.kept
        trouble = ('there is no accepted calibration yet' if kept is None
                   else 'the calibration is contradicted by new turns' if self._publication.stale
                   else self._save(kept))
        answer.success = not trouble
        answer.message = trouble or f'written: {self._store.path}'
        return answer

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
        activity, publication = self._learner.activity(), self._publication
        verdict = self._verdict
        published = publication.kept is not None
        state = state_of(published and not publication.stale, activity.calibrating,
                         verdict is not None and verdict.level != 'accepted')
        silent = None if self._last_image is None else time.monotonic() - self._last_image
        counts = {'received': self._received, 'camera_info published': publication.sent,
                  **{kind: self._complaints.counts[kind] for kind in (*CURES, *TROUBLES)},
                  'contradictions': self._contradictions}
        return Health(
            state, self._core.turns.wanted, self._images.topic, self._images.reliability,
            activity.status, activity.stage,
            publication.kept.camera if publication.kept else None, publication.stale,
            verdict.level if verdict else '', verdict.reasons if verdict else (), silent,
            str(self._store.path), tuple(self._warnings()), counts)

    def _warnings(self) -> list[str]:
        warnings = []
        if self._images.publishers > 1:
            warnings.append(f'{self._images.publishers} publishers on {self._images.topic}: '
                            f'remap all but one camera')
        if self.count_publishers(self._publication.topic) > 1:
            warnings.append(f'another node publishes {self._publication.topic}: remap it, or its '
                            f'subscribers get both')
        return warnings

    # between the threads ---------------------------------------------------------------------

    def _later(self, action: Callable[[], None]) -> None:
        """Have the executor's thread do this; called from the learner's threads."""
        self._news.put(action)
        with suppress(RuntimeError):  # rclpy's, when the context is shut down already
            self._wake.trigger()

    def _on_news(self) -> None:
        while True:
            try:
                action = self._news.get_nowait()
            except queue.Empty:
                return
            action()
