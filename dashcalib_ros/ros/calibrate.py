# SPDX-License-Identifier: Apache-2.0
"""The program that calibrates: what is accepted is published beside the images, and kept."""
from __future__ import annotations

import math
from functools import partial

from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from dashcalib_ros.camera import Camera, ros_camera
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import InputError, OutputError, coded
from dashcalib_ros.formats import calibrated_camera
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.report import Calibration, NamedCamera
from dashcalib_ros.report.wording import mount_text, mounts_text
from dashcalib_ros.ros.background import Goal, Result
from dashcalib_ros.ros.car import Mounting
from dashcalib_ros.ros.commit import Commit, driver_services
from dashcalib_ros.ros.diagnostics import ERROR, OK, WARN, Health
from dashcalib_ros.ros.drive import Drive
from dashcalib_ros.ros.endpoints import Answer, Endpoints
from dashcalib_ros.ros.images import Source
from dashcalib_ros.ros.settings import Settings
from dashcalib_ros.ros.state import Judgement, judge, outcome_text, sigma_text
from dashcalib_ros.ros.store import CameraIdentity, Store, StoredCalibration, camera_info_path

# s; an older temperature says nothing of now. px of fx by which camera_info follows it at the
# least: what rectifies images makes its maps anew each time
OLD_S, LEAST_PX = 60.0, 0.1


class Calibrating:
    """At most one calibration is in use; its topics and its file are always changed together.

    drive: gives it results. inputs: of the images. summary: what it does, for the log.
    """

    def __init__(self, endpoints: Endpoints, settings: Settings, camera_name: str) -> None:
        """Raises DashcalibError for settings that cannot be used."""
        self._endpoints, self._log = endpoints, endpoints.log
        self._core, self._own = settings.core, settings.own
        own = settings.own
        node, topic = endpoints.node, endpoints.node.resolve_topic_name('image_raw')
        plain = topic == f'{node.get_namespace().rstrip("/")}/image_raw'
        self._whose = CameraIdentity(camera_name, topic, plain)
        self._store = Store(camera_info_path(own.camera_info_url, camera_name), self._whose)
        endpoints.at_end(self._store.close)
        self._commit: Commit | None = None
        self._beside = endpoints.publisher('camera_info')
        self._latch = endpoints.latched('~/calibration')
        self._mounting = Mounting(endpoints, own)
        # what is published now, and how many were published beside images
        self._info: CameraInfo | None = None
        self._shown: Camera | None = None
        self._sent = 0
        self._kept: StoredCalibration | None = None
        # given up, and published only because of publish_stale
        self._stale = False
        # False for one of a file until turns of this drive agree with it
        self._confirmed = True
        # turns of this drive, with their bank, that were in a contradiction that was counted
        self._counted: frozenset[tuple[int, TurnId]] = frozenset()
        self.drive = Drive(endpoints, settings, camera_name, self)
        self.inputs = self.drive.images
        endpoints.service('~/calibrate', self.drive.calibrate)
        endpoints.service('~/calibrate_now', self.drive.calibrate_now)
        endpoints.service('~/reset', self.reset)
        endpoints.service('~/save', self.save)
        self._load()
        self._check_writable()
        self.summary = (f'learning the camera {camera_name!r} from the turns seen on '
                        f'{self.drive.images.topic}')

    def change(self, settings: Settings) -> None:
        """Use other settings from now on: those of CHANGEABLE."""
        self._core, self._own = settings.core, settings.own
        self._watch()

    @property
    def _contradictions(self) -> int:
        return self._kept.contradictions if self._kept else 0

    def _trusted(self) -> NamedCamera | None:
        return None if self._kept is None or self._stale else self._kept.camera

    def _watch(self) -> None:
        """Let the drive work: for a first camera by all turns wanted, to check one by a few."""
        core, trusted = self._core, self._trusted()
        wanted = core.turns.wanted
        self.drive.watch(Goal(
            core, wanted if trusted is None else min(core.verdict.min_turns, wanted), trusted))

    def accompany(self, header: Header, size: tuple[int, int]) -> None:
        """Publish the camera_info of an image, if the camera has such images."""
        self._follow_temperature(header)
        if self._info is not None and (self._info.width, self._info.height) == size:
            self._info.header = header
            self._beside.publish(self._info)
            self._sent += 1

    def _follow_temperature(self, header: Header) -> None:
        """Let what is published beside images be the camera at the temperature now."""
        kept, newest = self._kept, self.drive.learner.sensors.newest('temperature')
        if kept is None or kept.camera.temperature_c is None or newest is None:
            return
        stamp_s = header.stamp.sec + 1e-9 * header.stamp.nanosec
        # without a thermometer it is that of the calibration
        now_c = (newest[1][0] if abs(stamp_s - newest[0]) < OLD_S and math.isfinite(newest[1][0])
                 else kept.camera.temperature_c)
        camera = kept.camera.at_temperature(now_c)
        if self._shown is not None and abs(camera.fx - self._shown.fx) > LEAST_PX:
            self._shown = camera
            self._info = camera_info(camera, header, self._core.rectified)

    def _load(self) -> None:
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

    def _check_writable(self) -> None:
        """Raise OutputError where no calibration can be kept; an installed one is used, though."""
        try:
            self._store.check_writable()
        except OutputError as error:
            if self._kept is None:
                raise
            self._log.warning(coded(error))

    def begin_anew(self) -> None:
        """Drop the calibration in use, and begin with the file's."""
        self._drop()
        self._load()

    def fit(self, source: Source) -> None:
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

    def show_changes(self) -> None:
        """Do nothing: /diagnostics has the changes."""

    def judge(self, result: Result) -> None:
        """Adopt a new calibration, or not: state.py has the reasons."""
        calibration = result.calibration
        turns = frozenset((result.bank, turn) for turn in calibration.misfits
                          if turn.of_this_drive)
        # by request, or with other stored turns: count once
        again = self._trusted() is not None and bool(turns) and turns <= self._counted
        judged = Judgement('keep') if again else judge(
            calibration, result.complete, self._trusted(), self._contradictions, self._own,
            self._kept.days if self._kept else 0.0)
        match judged.action:
            case 'adopt' | 'follow' | 'replace':
                if judged.action == 'replace':
                    self._log.warning(f'the calibration is replaced: {judged.why}')
                elif judged.action == 'follow':
                    self._log.info(f'the calibration follows the newest turns: {judged.why}')
                self._adopt(judged.calibration or calibration)
                self.drive.learner.restart()
            case 'give_up':
                self._log.error(f'the published calibration is withdrawn: {judged.why}')
                self._give_up()
                # the turns that contradict it stay, and are used for the next one
                self.drive.learner.forget_stored(calibration.used_turns)
            case 'wait' | 'keep' if not again:
                if judged.contradictions > self._contradictions:
                    self._counted |= turns
                if judged.action == 'keep':
                    self._count(judged, calibration)
                log = self._log.warning if judged.contradictions else self._log.info
                log(outcome_text(calibration, judged.why))
        # turns that do not confirm it may be all that is known about another camera: they stay
        if judged.action == 'keep' and result.complete and (
                judged.confirmed or not self.drive.learner.extend()):
            # the next calibration must be independent: it uses new turns only
            self.drive.learner.restart()

    def outcome(self, result: Result) -> Answer:
        """Return whether it is accepted, and the numbers or the reasons."""
        verdict = result.calibration.verdict
        if verdict.level == 'accepted':
            return True, f'accepted: {sigma_text(calibrated_camera(result.calibration, ""))}'
        return False, f'{verdict.level}: {"; ".join(map(str, verdict.reasons))}'

    def _adopt(self, calibration: Calibration) -> None:
        source = self.drive.source
        # DDS lists a driver twice for a while after it was killed and started again
        publishers = dict.fromkeys(self.drive.images.publishers)
        kept = StoredCalibration.of(calibration, self._whose, source.frame_id if source else '',
                                    ', '.join(publishers))
        info = self._use(kept)
        self._log.info(f'accepted: {sigma_text(kept.camera)}; {self.save()[1]}')
        if self._own.commit:
            if self._commit is not None:
                self._commit.end()
            self._commit = Commit(self._endpoints, info, self._own.commit_timeout,
                                  partial(driver_services, self._endpoints.node,
                                          self.drive.images))

    def _give_up(self) -> None:
        self._retire()
        if self._own.publish_stale and self._kept is not None:
            self._stale, self._kept = True, self._kept.contradicted(0)
            self._watch()
        else:
            self._drop()

    def _count(self, judged: Judgement, calibration: Calibration) -> None:
        if self._kept is None:
            return
        if judged.contradictions != self._contradictions:
            self._kept = self._kept.contradicted(judged.contradictions)
            try:
                self._store.update(self._kept)
            except OutputError as error:
                self._endpoints.complaints.say('unsaved', coded(error))
        if judged.confirmed:
            self._confirmed = True
            if calibration.mount is not None:
                # the newest, as a camera may have been pushed
                self._show_mount(calibration.mount, self._kept.frame_id or '')

    def _use(self, kept: StoredCalibration, confirmed: bool = True) -> CameraInfo:
        self._kept, self._stale, self._confirmed = kept, False, confirmed
        self._shown = kept.camera.camera
        self._info = camera_info(self._shown, self._header(kept.frame_id or ''),
                                 self._core.rectified)
        self._latch(self._info)
        self._show_mount(kept.mount, kept.frame_id or '')
        self._watch()
        return self._info

    def _show_mount(self, mount: Mount | None, frame_id: str) -> None:
        before = self._mounting.mount
        if before and mount and mount.moved_from(before) and 'mount' not in self.drive.changes():
            self._log.info(mounts_text(mount, before))
        self.drive.forget_moved()
        self._mounting.show(mount, frame_id)

    def _drop(self) -> None:
        if self._info is not None:
            # K[0] = 0 says that it is uncalibrated (sensor_msgs)
            self._latch(CameraInfo(header=self._header(self._info.header.frame_id)))
        self._kept, self._stale, self._info, self._shown = None, False, None, None
        self._mounting.show(None, '')
        self._watch()

    def _retire(self) -> tuple[bool, str]:
        try:
            return True, self._store.retire()
        except OutputError as error:
            self._log.error(coded(error))
            return False, coded(error)

    def reset(self) -> tuple[bool, str]:
        """Begin anew, without the file; return whether it is out of the way, and a message."""
        self._log.warning('reset by request: the turns and the calibration are dropped')
        self.drive.forget()
        self._drop()
        moved, text = self._retire()
        return moved, f'collecting; {text}'

    def save(self) -> tuple[bool, str]:
        """Write the file; return whether it was written, and a line about it."""
        if self.drive.held:
            return False, self.drive.held
        if self._kept is None:
            return False, 'there is no accepted calibration yet'
        if self._stale:
            return False, 'the calibration is contradicted by new turns'
        try:
            return True, self._store.save(self._kept)
        except OutputError as error:
            self._endpoints.complaints.say('unsaved', coded(error))
            return False, f'not saved: {coded(error)}'

    def _warnings(self) -> list[str]:
        found = [text for text in (self._store.taken, self._store.given_up) if text]
        if self._contradictions:
            found.append(f'{self._contradictions} of {self._own.contradictions} calibrations in '
                         f'a row contradict the published one: check whether the camera was '
                         f'moved, its lens changed, or a stabiliser switched on')
        if self._kept is not None and self._kept.edited and not self._confirmed:
            found.append(f'{self._store.path} was edited since a node wrote it: unconfirmed until '
                         f'turns agree with it')
        beside = self._beside.topic_name
        if self._endpoints.node.count_publishers(beside) > 1:
            found.append(f'another node also publishes {beside}: remap one of the two topics')
        return found

    def health(self) -> Health:
        """Return the state of the calibration."""
        verdict, activity = self.drive.verdict, self.drive.learner.activity
        turns, monitor = self.drive.turns_text, self.drive.monitor
        self._confirmed |= monitor is not None and monitor.agrees
        camera = self._kept.camera if self._kept else None
        sigma = camera.sigma if camera else None
        known = 'confirmed' if self._confirmed else 'unconfirmed'
        state, level, message = 'collecting', WARN, f'not calibrated yet: {turns}'
        if activity.calibrating:
            state, message = 'calibrating', f'calibrating with {turns}: {activity.stage}'
        elif verdict is not None and verdict.level != 'accepted':
            state = 'refused_so_far'
            # the reason has what one more turn would bring
            message = (f'not calibrated: {turns}; so far {verdict.level}: '
                       f'{"; ".join(map(str, verdict.reasons[:1]))}')
        if self._stale:
            level = ERROR
            message = f'the published calibration is contradicted; new turns: {turns}'
        elif camera:
            state, level = 'calibrated', OK
            exact = f', fx ± {100 * sigma["fx"] / camera.camera.fx:.2g} %' if sigma else ''
            message = f'calibrated, {known}{exact}; for the next check {turns}'
        mount = self._mounting.mount
        return Health(state, level, message, camera, {
            'published': sigma_text(camera) if camera else 'nothing',
            'calibration': known if camera else '',
            'camera model': camera.camera.model if camera else '',
            'sigma fx (px)': f'{sigma["fx"]:.3f}' if sigma else '',
            'file': self._store.path,
            'camera_info published': self._sent,
            'contradictions': self._contradictions,
            'mounting': mount_text(mount) if mount else 'unknown'}, self._warnings())

    def _header(self, frame_id: str) -> Header:
        return Header(stamp=self._endpoints.node.get_clock().now().to_msg(), frame_id=frame_id)


def camera_info(camera: Camera, header: Header, rectified: str) -> CameraInfo:
    """Return the camera as a message; rectified: as ros_camera()'s."""
    return CameraInfo(header=header, **vars(ros_camera(camera, rectified)))
