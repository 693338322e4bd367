"""The node that calibrates: what is accepted is published beside the images and kept on disk."""
from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from rclpy.clock import Clock
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo
from std_msgs.msg import Header

from dashcalib_ros.camera import Camera, ros_camera
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import InputError, OutputError, coded
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.report import Calibration, NamedCamera
from dashcalib_ros.report.wording import mount_text, mounts_text
from dashcalib_ros.ros.background import Result, Watched
from dashcalib_ros.ros.car import Mounting
from dashcalib_ros.ros.diagnostics import ERROR, OK, WARN, Health, log_line
from dashcalib_ros.ros.images import ImageInput, Source
from dashcalib_ros.ros.node import CameraNode
from dashcalib_ros.ros.parameters import latched
from dashcalib_ros.ros.state import Judgement, judge, outcome_text, sigma_text
from dashcalib_ros.ros.store import Kept, Store, Whose, camera_info_path

# s between two looks whether the driver has answered
LOOK_S = 0.1


class CalibratorNode(CameraNode):
    """At most one calibration is in use; its topics and its file are always changed together."""

    doing = 'learning'

    def _open(self, topic: str) -> None:
        plain = topic == f'{self.get_namespace().rstrip("/")}/image_raw'
        self._whose = Whose(self._name, topic, plain)
        self._store = Store(camera_info_path(self._own.camera_info_url, self._name), self._whose)
        self._commit: Commit | None = None
        # a reliable publisher reaches reliable and best-effort subscribers alike
        self._beside = self._publisher(CameraInfo, 'camera_info', 10)
        self._latched = self._publisher(CameraInfo, '~/calibration', latched())
        self._mounting = Mounting(self, self._own, self._complaints.once)
        # what is published now, and how many were published beside images
        self._info: CameraInfo | None = None
        self._sent = 0
        self._kept: Kept | None = None
        # given up, and published only because of publish_stale
        self._stale = False
        # False for one of a file until turns of this drive agree with it
        self._confirmed = True
        # turns of this drive, with their bank, that were in a contradiction that was counted
        self._counted: frozenset[tuple[int, TurnId]] = frozenset()

    def close(self) -> None:
        """End it, and leave the calibration's file to other nodes."""
        self._store.close()
        super().close()

    @property
    def _contradictions(self) -> int:
        """Return how many calibrations in a row contradict the one in use."""
        return self._kept.contradictions if self._kept else 0

    def _trusted(self) -> NamedCamera | None:
        """Return the camera that is published, None if it is stale."""
        return None if self._kept is None or self._stale else self._kept.camera

    def _goal(self) -> int:
        """Return how many turns the next calibration needs.

        The first one needs all turns wanted; to check a published one, a few are enough.
        """
        wanted = self._core.turns.wanted
        return wanted if self._trusted() is None else min(self._core.verdict.min_turns, wanted)

    def _accompany(self, header: Header, size: tuple[int, int]) -> None:
        """Publish the camera_info of an image, if the camera has such images."""
        if self._info is not None and (self._info.width, self._info.height) == size:
            self._info.header = header
            self._beside.publish(self._info)
            self._sent += 1

    def _load(self) -> None:
        """Use the file's calibration, if it is an accepted one of this node."""
        try:
            kept = self._store.load()
        except InputError as error:
            self._log.warning(coded(error))
            return
        if kept is None:
            return
        wanted = kept.rectified(self._core.rectified)
        if wanted is not kept:
            self._log.warning(f'the projection_matrix in {self._store.path} does not belong to '
                              f'rectified: {self._core.rectified}; the node publishes the one '
                              f'that does, and ~/save writes it to the file')
        self._use(wanted, confirmed=False)
        self._log.info(f'loaded {self._store.path}: {sigma_text(kept.camera)}; unconfirmed until '
                       f'turns agree with it')

    def _fit(self, source: Source) -> None:
        """Stop using it if it is for other images than these; the file stays where it is."""
        kept = self._kept
        if kept is None:
            return
        of = Source(kept.camera.image_size,
                    source.frame_id if kept.frame_id is None else kept.frame_id)
        if of != source:
            self._log.warning(f'{self._store.path} is ignored: it is for {of}, the images are '
                              f'{source}')
            self._drop()

    def _on_watched(self, watched: Watched) -> None:
        super()._on_watched(watched)
        if watched.camera is self._trusted() and watched.monitor.agrees:
            self._confirmed = True

    def _judge(self, result: Result) -> None:
        """Adopt a new calibration, or not: state.py has the reasons."""
        calibration = result.calibration
        turns = frozenset((result.bank, turn) for turn in calibration.misfits
                          if turn.of_this_drive)
        # by request, or with other stored turns: count once
        again = self._trusted() is not None and bool(turns) and turns <= self._counted
        judged = Judgement('keep') if again else judge(
            calibration, result.complete, self._trusted(), self._contradictions, self._own)
        match judged.action:
            case 'adopt' | 'replace':
                if judged.action == 'replace':
                    self._log.warning(f'the calibration is replaced: {judged.why}')
                self._adopt(calibration)
                self._learner.restart()
            case 'give_up':
                self._log.error(f'the published calibration is withdrawn: {judged.why}')
                self._give_up()
                # the turns that contradict it stay, and are used for the next one
                self._learner.forget_stored(calibration.used_turns)
            case 'wait' | 'keep' if not again:
                if judged.contradictions > self._contradictions:
                    self._counted |= turns
                if judged.action == 'keep':
                    self._count(judged, calibration)
                log_line(self._log, judged.contradictions > 0,
                         outcome_text(calibration, judged.why))
        # turns that do not confirm it may be all that is known of another camera: they stay
        if judged.action == 'keep' and result.complete and (
                judged.confirmed or not self._learner.extend()):
            # the next calibration must be independent: it uses new turns only
            self._learner.restart()

    def _adopt(self, calibration: Calibration) -> None:
        frame_id = self._intake.source.frame_id if self._intake.source else ''
        kept = Kept.of(calibration, self._whose, frame_id, *self._images.publishers)
        info = self._use(kept)
        self._log.info(f'accepted: {sigma_text(kept.camera)}; {self._save()[1]}')
        if self._own.commit:
            if self._commit is not None:
                self._commit.end()
            self._commit = Commit(self, info, self._own.commit_timeout, self._steady,
                                  driver_services(self, self._images))

    def _give_up(self) -> None:
        self._retire()
        if self._own.publish_stale and self._kept is not None:
            self._stale, self._kept = True, self._kept.contradicted(0)
        else:
            self._drop()

    def _count(self, judged: Judgement, calibration: Calibration) -> None:
        """Keep what a calibration says of the one in use; its file outlives the node."""
        if self._kept is None:
            return
        if judged.contradictions != self._contradictions:
            self._kept = self._kept.contradicted(judged.contradictions)
            try:
                self._store.update(self._kept)
            except OutputError as error:
                self._complaints.say('unsaved', coded(error))
        if judged.confirmed:
            self._confirmed = True
            if calibration.mount is not None:
                # the newest, as a camera may have been pushed
                self._show_mount(calibration.mount, self._kept.frame_id or '')

    def _use(self, kept: Kept, confirmed: bool = True) -> CameraInfo:
        self._kept, self._stale, self._confirmed = kept, False, confirmed
        self._info = camera_info(kept.camera.camera, self._header(kept.frame_id or ''),
                                 self._core.rectified)
        self._latched.publish(self._info)
        self._show_mount(kept.mount, kept.frame_id or '')
        return self._info

    def _show_mount(self, mount: Mount | None, frame_id: str) -> None:
        """Publish a mounting, and log where it is another one than the last, once."""
        before = self._mounting.mount
        if before and mount and mount.moved_from(before) and 'mount' not in self._changes():
            self._log.info(mounts_text(mount, before))
        self._moved = ''
        self._mounting.show(mount, frame_id)

    def _drop(self) -> None:
        """Use no calibration, as at the start; the file stays where it is."""
        if self._info is not None:
            # K[0] = 0 says that it is uncalibrated (sensor_msgs)
            self._latched.publish(CameraInfo(header=self._header(self._info.header.frame_id)))
        self._kept, self._stale, self._info = None, False, None
        self._mounting.show(None, '')

    def _retire(self) -> tuple[bool, str]:
        """Move the file aside; return whether it is out of the way, and a line about it."""
        try:
            return True, self._store.retire()
        except OutputError as error:
            self._log.error(coded(error))
            return False, coded(error)

    def _reset(self) -> tuple[bool, str]:
        self._log.warning('reset by request: the turns and the calibration are dropped')
        self._forget()
        moved, text = self._retire()
        return moved, f'collecting; {text}'

    def _save(self) -> tuple[bool, str]:
        """Write the file; return whether it was written, and a line about it."""
        if self._held:
            return False, self._held
        if self._kept is None:
            return False, 'there is no accepted calibration yet'
        if self._stale:
            return False, 'the calibration is contradicted by new turns'
        try:
            return True, self._store.save(self._kept)
        except OutputError as error:
            self._complaints.say('unsaved', coded(error))
            return False, f'not saved: {coded(error)}'

    def _warnings(self) -> list[str]:
        """Return warnings about the file and the topic, for the operator."""
        found = [text for text in (self._store.taken, self._store.given_up) if text]
        if self._contradictions:
            found.append(f'{self._contradictions} of {self._own.contradictions} calibrations in '
                         f'a row contradict the published one: check whether the camera was '
                         f'moved, its lens changed, or a stabiliser switched on')
        if self._kept is not None and self._kept.edited and not self._confirmed:
            found.append(f'{self._store.path} was edited since a node wrote it: unconfirmed until '
                         f'turns agree with it')
        beside = self._beside.topic_name
        if self.count_publishers(beside) > 1:
            found.append(f'another node also publishes {beside}: remap one of the two topics')
        return found

    def _health(self, turns: str) -> Health:
        verdict, activity = self._verdict, self._learner.activity
        camera = self._kept.camera if self._kept else None
        known = 'confirmed' if self._confirmed else 'unconfirmed'
        state, level, message = 'collecting', WARN, f'not calibrated yet: {turns}'
        if activity.calibrating:
            state, message = 'calibrating', f'calibrating with {turns}: {activity.stage}'
        elif verdict is not None and verdict.level != 'accepted':
            state = 'refused_so_far'
            message = (f'not calibrated, {turns}; so far {verdict.level}: '
                       f'{"; ".join(verdict.reasons[:1])}')
        if self._stale:
            level = ERROR
            message = f'the published calibration is contradicted; new turns: {turns}'
        elif camera:
            state, level = 'calibrated', OK
            message = f'calibrated, {known}; {turns} for the next check of it'
        sigma = camera.sigma if camera else None
        mount = self._mounting.mount
        return Health(state, level, message, camera, {
            'published': sigma_text(camera) if camera else 'nothing',
            'calibration': known if camera else '',
            'camera model': camera.camera.model if camera else '',
            'sigma fx (px)': f'{sigma["fx"]:.3f}' if sigma else '',
            'file': self._store.path,
            'camera_info published': self._sent,
            'contradictions': self._contradictions,
            'mounting': mount_text(mount) if mount else 'unknown'})

    def _on_tick(self) -> None:
        super()._on_tick()
        self._mounting.tick()

    def _header(self, frame_id: str) -> Header:
        return Header(stamp=self.get_clock().now().to_msg(), frame_id=frame_id)


class Commit:
    """Sends a calibration to the driver's service without waiting for it; logs the outcome.

    There is one warning if the driver has no service, does not answer, or dies meanwhile.
    """

    def __init__(self, node: Node, info: CameraInfo, timeout_s: float, clock: Clock,
                 names: Sequence[str]) -> None:
        """names: of services, of which the first that there is is called."""
        self._node, self._info, self._timeout_s = node, info, timeout_s
        self._clients = {name: node.create_client(SetCameraInfo, name) for name in names}
        self._name = ' or '.join(names)
        self._answer: Any = None
        self._deadline = time.monotonic() + timeout_s
        self._timer = node.create_timer(LOOK_S, self._look, clock=clock)

    def end(self) -> None:
        """Wait for an answer no longer."""
        self._node.destroy_timer(self._timer)
        for client in self._clients.values():
            self._node.destroy_client(client)

    def _look(self) -> None:
        for name, client in self._clients.items():
            if self._answer is None and client.service_is_ready():
                self._name = name
                self._answer = client.call_async(SetCameraInfo.Request(camera_info=self._info))
        answered = self._answer is not None and self._answer.done()
        if not answered and time.monotonic() < self._deadline:
            return
        self.end()
        log, name = self._node.get_logger(), self._name
        if self._answer is None:
            trouble = f'there is no service {name}'
        elif not answered:
            trouble = f'{name} did not answer within {self._timeout_s:g} s'
        elif self._answer.exception() is not None:
            trouble = f'{name} failed: {self._answer.exception()}'
        elif self._answer.result().success:
            log.info(f'{name} accepted the calibration')
            return
        else:
            trouble = f'{name} refused: {self._answer.result().status_message}'
        log.warning(f'{trouble}: the camera driver does not have the calibration; start a driver '
                    f'with that service, or set commit to false')


def driver_services(node: Node, images: ImageInput) -> tuple[str, ...]:
    """Return where the driver's set_camera_info may be: where it was remapped to, if it was.

    Else the publisher's own, as camera_info_manager names it, the one beside the images, and that
    of this node's namespace.
    """
    name = 'set_camera_info'
    own = node.resolve_service_name(name)
    if own != node.resolve_service_name(name, only_expand=True):
        return (own,)
    drivers = [f'{each}/{name}' for each in images.publishers if each.startswith('/')]
    beside = f'{images.base.rpartition("/")[0]}/{name}'
    return tuple(dict.fromkeys((*drivers, beside, own)))


def camera_info(camera: Camera, header: Header, rectified: str) -> CameraInfo:
    """Return the camera as a message; rectified: as ros_camera()'s."""
    return CameraInfo(header=header, **vars(ros_camera(camera, rectified)))
