"""The calibration in use: loaded or adopted, replaced or given up, published and kept on disk."""
from __future__ import annotations

import time
from typing import Any

from rclpy.clock import Clock
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo
from std_msgs.msg import Header

from dashcalib_ros.camera import Camera, ros_camera
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.ros.background import Result
from dashcalib_ros.ros.diagnostics import Complaints
from dashcalib_ros.ros.images import Source
from dashcalib_ros.ros.parameters import make_publisher
from dashcalib_ros.ros.state import Action, Rules, judge, outcome_text, sigma_text
from dashcalib_ros.ros.store import Kept, Store, Whose

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# a reliable publisher reaches reliable and best-effort subscribers alike
BESIDE_IMAGES = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
# s between two looks whether the driver has answered
LOOK_S = 0.1


def camera_info(camera: Camera, header: Header, rectified: str) -> CameraInfo:
    """Return the camera as a message; rectified: as ros_camera()'s."""
    c = ros_camera(camera, rectified)
    width, height = c.image_size
    return CameraInfo(header=header, width=width, height=height,
                      distortion_model=c.distortion_model, d=c.d, k=c.k, r=c.r, p=c.p)


class Publication:
    """Publishes a camera between set() and retract(), and nothing before or after.

    info: what is published now. sent: how many were published beside images.
    """

    def __init__(self, node: Node, rectified: str) -> None:
        """rectified: what P shows, the setting of this name."""
        self.info: CameraInfo | None = None
        self.sent = 0
        self._rectified = rectified
        self._clock = node.get_clock()
        self._beside = make_publisher(node, CameraInfo, 'camera_info', BESIDE_IMAGES)
        self._latched = make_publisher(node, CameraInfo, '~/calibration', LATCHED)
        # the full name of the topic beside the images
        self.topic = str(self._beside.topic_name)

    def set(self, camera: NamedCamera, frame_id: str) -> None:
        """Publish this one from now on."""
        self.info = camera_info(camera.camera, self._now(frame_id), self._rectified)
        self._latched.publish(self.info)

    def retract(self) -> None:
        """Stop publishing; the latched topic gets an uncalibrated message."""
        if self.info is not None:
            # K[0] = 0 says that it is uncalibrated (sensor_msgs)
            self._latched.publish(CameraInfo(header=self._now(self.info.header.frame_id)))
        self.info = None

    def accompany(self, header: Header, size: tuple[int, int]) -> None:
        """Publish for one image, with its header, if the camera has such images."""
        if self.info is not None and (self.info.width, self.info.height) == size:
            self.info.header = header
            self._beside.publish(self.info)
            self.sent += 1

    def _now(self, frame_id: str) -> Header:
        return Header(stamp=self._clock.now().to_msg(), frame_id=frame_id)


class CalibrationInUse:
    """At most one calibration; its topics and its file are always changed together.

    publication: its topics. contradictions: number of calibrations in a row that contradict it.
    stale: it was given up, and is published only because of publish_stale. confirmed: False for
    one of a file until turns of this drive agree with it. settled: whether the last calibration's
    turns have told all that they can of it.
    """

    def __init__(self, node: Node, whose: Whose, store: Store, rules: Rules,
                 complaints: Complaints, rectified: str) -> None:
        self.contradictions = 0
        self.stale = False
        self.confirmed = self.settled = True
        self._node = node
        self.publication = Publication(node, rectified)
        self._kept: Kept | None = None
        self._log = node.get_logger()
        self._whose = whose
        self._store = store
        self._rules = rules
        self._complaints = complaints
        self._rectified = rectified
        # turns of this drive, with their bank, that were in a contradiction that was counted
        self._counted: frozenset[tuple[int, TurnId]] = frozenset()

    @property
    def camera(self) -> NamedCamera | None:
        """Return the camera that is published."""
        return None if self._kept is None else self._kept.camera

    @property
    def trusted(self) -> NamedCamera | None:
        """Return the camera that is published, None if it is stale."""
        return None if self.stale else self.camera

    @property
    def file(self) -> str:
        """Return the file's path."""
        return str(self._store.path)

    def load(self) -> None:
        """Use the file's calibration, if it is an accepted one of this node."""
        try:
            kept = self._store.load()
        except InputError as error:
            self._log.warning(str(error))
            return
        if kept is None:
            return
        wanted = kept.rectified(self._rectified)
        if wanted is not kept:
            self._log.warning(f'the projection_matrix in {self.file} is not that of rectified: '
                              f'{self._rectified}, which is published; ~/save writes it there')
        self._use(wanted, confirmed=False)
        self.contradictions = kept.contradictions
        self._log.info(f'loaded {self.file}: {sigma_text(kept.camera)}; unconfirmed until turns '
                       f'agree with it')

    def check(self, source: Source) -> None:
        """Stop using it if it is for other images than these; the file stays where it is."""
        kept = self._kept
        if kept is None:
            return
        of = Source(kept.camera.image_size,
                    source.frame_id if kept.frame_id is None else kept.frame_id)
        if of != source:
            self._log.warning(f'{self.file} is ignored: it is for {of}, the images are {source}')
            self._unpublish()

    def judge(self, result: Result, frame_id: str, publish_stale: bool) -> Action:
        """Adopt a new calibration, or not (state.py has the reasons); return what was done.

        publish_stale: go on publishing a calibration that is given up.
        """
        calibration = result.calibration
        self.settled = False
        turns = frozenset((result.bank, turn) for turn in calibration.misfits
                          if turn.of_this_drive)
        if self.trusted is not None and turns and turns <= self._counted:
            return 'keep'  # again, by request or with other stored turns: they count once
        judged = judge(calibration, result.complete, self.trusted, self.contradictions,
                       self._rules)
        if judged.action == 'keep':
            if judged.contradictions > self.contradictions:
                self._counted |= turns
            self._count(judged.contradictions)
            self.settled = judged.confirmed
            self.confirmed = self.confirmed or judged.confirmed
        if judged.action in ('adopt', 'replace'):
            if judged.action == 'replace':
                self._log.warning(f'the calibration is replaced: {judged.why}')
            self._adopt(Kept.of(calibration, self._whose, frame_id))
        elif judged.action == 'give_up':
            self._log.error(f'the published calibration is given up: {judged.why}')
            self.contradictions = 0
            self.retire()
            if publish_stale:
                self.stale = True
            else:
                self._unpublish()
        else:
            text = outcome_text(calibration, judged.why)
            # rclpy takes one severity for each line of code
            if judged.contradictions:
                self._log.warning(text)
            else:
                self._log.info(text)
        return judged.action

    def drop(self) -> None:
        """Use no calibration, as at the start; the file stays where it is."""
        self._unpublish()
        self.contradictions = 0

    def retire(self) -> tuple[bool, str]:
        """Move the file aside; return whether it is out of the way, and a line about it."""
        if self._store.taken:
            return True, self._store.taken
        try:
            moved = self._store.retire()
        except OutputError as error:
            text = f'{error}; until then the next start of the node publishes it again'
            self._log.error(text)
            return False, text
        return True, 'there was no file' if moved is None else f'{self.file} is now {moved}'

    def save(self) -> tuple[bool, str]:
        """Write the file; return whether it was written, and a line about it."""
        if self._kept is None:
            return False, 'there is no accepted calibration yet'
        if self.stale:
            return False, 'the calibration is contradicted by new turns'
        try:
            moved = self._store.save(self._kept)
        except OutputError as error:
            self._complaints.say('unsaved', str(error))
            return False, str(error)
        if moved is not None:
            self._log.warning(f'{self.file} was written by another program: it is now {moved}')
        return True, f'written: {self.file}'

    def close(self) -> None:
        """Leave the file to other nodes."""
        self._store.close()

    def warnings(self) -> list[str]:
        """Return warnings about the file and the topic, for the operator."""
        found = [self._store.taken] if self._store.taken else []
        if self.contradictions:
            found.append(f'{self.contradictions} of {self._rules.contradictions} calibrations in '
                         f'a row contradict the published one: was the camera moved, its lens '
                         f'changed, or a stabiliser switched on?')
        if self._kept is not None and self._kept.edited and not self.confirmed:
            found.append(f'{self.file} was edited since a node wrote it: unconfirmed until turns '
                         f'agree with it')
        if self._store.given_up:
            found.append(f'{self.file} was given up, but could not be moved aside: remove it, or '
                         f'the next start of the node publishes it again')
        beside = self.publication.topic
        if self._node.count_publishers(beside) > 1:
            found.append(f'another node publishes {beside}: remap it, or its subscribers get both')
        return found

    def _count(self, contradictions: int) -> None:
        """Keep the count in the file too: it outlives the node."""
        if contradictions == self.contradictions or self._kept is None:
            return
        self.contradictions = contradictions
        self._kept = self._kept.contradicted(contradictions)
        try:
            self._store.update(self._kept)
        except OutputError as error:
            self._complaints.say('unsaved', str(error))

    def _adopt(self, kept: Kept) -> None:
        self._use(kept)
        self.contradictions = 0
        saved, text = self.save()
        self._log.info(f'accepted: {sigma_text(kept.camera)}; '
                       + (f'saved to {self.file}' if saved else f'not saved: {text}'))

    def _use(self, kept: Kept, confirmed: bool = True) -> None:
        self._kept, self.stale, self.confirmed = kept, False, confirmed
        self.publication.set(kept.camera, kept.frame_id or '')

    def _unpublish(self) -> None:
        self._kept, self.stale = None, False
        self.publication.retract()


class Commit:
    """Calls the driver's service without waiting for it; logs the outcome.

    There is one warning if the driver has no service, does not answer, or dies meanwhile.
    """

    def __init__(self, node: Node, timeout_s: float, clock: Clock) -> None:
        self._node = node
        self._timeout_s = timeout_s
        self._name = node.resolve_service_name('set_camera_info')
        self._client = node.create_client(SetCameraInfo, 'set_camera_info')
        self._timer = node.create_timer(LOOK_S, self._look, clock=clock, autostart=False)
        self._waiting: CameraInfo | None = None
        self._answer: Any = None
        self._deadline = 0.0

    def call(self, info: CameraInfo) -> None:
        """Send a calibration; an earlier call that is not answered yet is cancelled."""
        self._forget()
        self._waiting = info
        self._deadline = time.monotonic() + self._timeout_s
        self._timer.reset()

    def _look(self) -> None:
        if self._answer is None and self._client.service_is_ready():
            request = SetCameraInfo.Request(camera_info=self._waiting)
            self._answer = self._client.call_async(request)
        if self._answer is not None and self._answer.done():
            self._report(self._answer)
            self._forget()
        elif time.monotonic() > self._deadline:
            trouble = (f'there is no service {self._name}' if self._answer is None else
                       f'{self._name} did not answer within {self._timeout_s:g} s')
            self._node.get_logger().warning(
                f'{trouble}: the camera driver does not have the calibration; start a driver with '
                f'that service, or set commit to false')
            self._forget()

    def _report(self, answer: Any) -> None:
        if answer.exception() is not None:
            text = f'{self._name} failed: {answer.exception()}'
        elif answer.result().success:
            self._node.get_logger().info(f'{self._name} took the calibration')
            return
        else:
            text = f'{self._name} refused: {answer.result().status_message}'
        self._node.get_logger().warning(text)

    def _forget(self) -> None:
        if self._answer is not None and not self._answer.done():
            self._client.remove_pending_request(self._answer)
        self._answer = self._waiting = None
        self._timer.cancel()
