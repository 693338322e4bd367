# SPDX-License-Identifier: Apache-2.0
"""Images in, turns learned from them, and what these turns say about the camera in use.

Both roles, calibrate.py and check.py, are built on it. Every method and callback runs in the
executor's single thread and is short; what other threads leave with _later() is done in that same
thread: no lock is needed.
"""
from __future__ import annotations

import queue
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from rclpy.task import Future
from std_msgs.msg import Float64, Header

from dashcalib_ros.errors import DashcalibError, InputError
from dashcalib_ros.input.decode import check_mask, read_mask
from dashcalib_ros.judge import Monitor, Verdict
from dashcalib_ros.report.wording import witness_texts
from dashcalib_ros.ros.background import (
    Goal,
    Learner,
    Measured,
    Moved,
    News,
    Result,
    Trouble,
    Watched,
    seen,
)
from dashcalib_ros.ros.car import subscribe_sensors
from dashcalib_ros.ros.diagnostics import ERROR, WARN, Health, diagnostic
from dashcalib_ros.ros.endpoints import Answer, Endpoints
from dashcalib_ros.ros.images import CURES, ImageInput, Intake, Source, since_text
from dashcalib_ros.ros.preview import Preview
from dashcalib_ros.ros.settings import Settings
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


class Role(Protocol):
    """What is done with a drive."""

    def accompany(self, header: Header, size: tuple[int, int]) -> None:
        """Publish what belongs beside an image."""

    def begin_anew(self) -> None:
        """Begin as at the start: the images are of another camera, the turns are dropped."""

    def fit(self, source: Source) -> None:
        """Take what all images are from now on: the camera in use may be of others."""

    def judge(self, result: Result) -> None:
        """Take a new calibration."""

    def outcome(self, result: Result) -> Answer:
        """Return what a calibration says, for the caller of the service."""

    def show_changes(self) -> None:
        """Take that the turns show other changes of the camera in use than before."""

    def health(self) -> Health:
        """Return what is to be said about the camera in use."""


class Drive:
    """Gives the images to the learner, and compares each turn with the camera in use.

    learner: what learns, in the background. images: the subscription. held: why nothing is
    learned, published and saved now; '' where all is well. monitor: what turns say about the
    camera in use, None before they do. verdict: of the last calibration.
    """

    def __init__(self, endpoints: Endpoints, settings: Settings, camera_name: str, role: Role
                 ) -> None:
        """camera_name: in /diagnostics.

        Raises ConfigError for a topic's name that is none, InputError for the mask's file.
        """
        self._endpoints, self._camera_name, self._role = endpoints, camera_name, role
        self._log, self._complaints = endpoints.log, endpoints.complaints
        core, own = settings.core, settings.own
        self._mask = read_mask(Path(own.mask_file)) if own.mask_file else None
        self.held = ''
        self.monitor: Monitor | None = None
        self.verdict: Verdict | None = None
        # in words: that the camera was moved, as straight stretches show it; and what the car's
        # own sensors say about the last calibration
        self._moved = ''
        self._witnesses: list[str] = []
        # of fx, of it, by the last calibration; None where it has none
        self._sigma: float | None = None
        # by those who wait for a calibration
        self._asked: list[Future] = []
        endpoints.at_end(self._answer, False, 'the node was stopped')
        self._actions: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._wake = endpoints.guard_condition(self.catch_up)
        self._magnitude = endpoints.publisher('~/turn_magnitude')
        self._diagnostics = endpoints.publisher('/diagnostics')
        self._preview = Preview(
            endpoints, own, core.rectified,
            lambda error: self._later(partial(self.survive, error, 'preview')))
        self._intake = Intake(core.tracking.rate, self._complaints, self._on_source)
        self._video = None
        if own.image_transport == 'video':
            self._video = VideoDecoding(
                lambda image: self._later(partial(self._on_decoded, image)),
                lambda text: self._later(partial(self._complaints.say, 'undecodable', text)))
            endpoints.at_end(self._video.close)
        self.images = ImageInput(
            endpoints, own, self._video.put if self._video else self._on_image)
        self._goal = Goal(core)
        self.learner = Learner(self._goal, own.queue_size, self._hear, self._preview.take,
                               self._mask)
        endpoints.at_end(self.learner.close)
        subscribe_sensors(endpoints, own, self.learner.sensors.add)
        endpoints.timer(PERIOD_S, self._tick)

    # what the role asks for --------------------------------------------------------------------

    def watch(self, goal: Goal) -> None:
        """Learn for another goal from now on."""
        if goal.camera is not self._goal.camera:
            self.monitor, self._moved = None, ''
        self._goal = goal
        self.learner.watch(goal)

    def forget(self, keep_stored: bool = False) -> None:
        """Forget the turns; keep_stored: not those in turns.store."""
        self.verdict, self._witnesses, self._sigma = None, [], None
        self.learner.restart(keep_stored)
        self._intake.forget()
        self._answer(False, 'the turns were dropped meanwhile')

    def calibrate(self) -> Answer | Future:
        """Calibrate with the present turns; return why not, or what will have the outcome."""
        begun, text = self.calibrate_now()
        if not begun:
            return begun, text
        self._asked.append(Future())
        return self._asked[-1]

    def calibrate_now(self) -> Answer:
        """Calibrate with the present turns; return whether that began, and a message."""
        refused = self.held or self.learner.request()
        return not refused, refused or 'started: /diagnostics and the log have the result'

    def _answer(self, success: bool, text: str) -> None:
        asked, self._asked = self._asked, []
        for each in asked:
            each.set_result((success, text))

    @property
    def source(self) -> Source | None:
        """Return what the camera's images have in common, None before the first."""
        return self._intake.source

    def changes(self) -> dict[str, str]:
        """Return the changes of the camera in use, in words by their kind.

        Two turns or more show them, or straight stretches that it was moved on the car.
        """
        found = {'mount': self._moved} if self._moved else {}
        return found | {each.kind: str(each) for each in (
            self.monitor.changes if self.monitor else ())}

    def forget_moved(self) -> None:
        """Take that a newer mounting is known than the one that straight stretches contradict."""
        self._moved = ''

    # other threads -----------------------------------------------------------------------------

    def survive(self, error: Exception, kind: str = 'failed_callbacks') -> None:
        """Log and count what a callback raised."""
        self._complaints.failure(kind, error)

    def _hear(self, news: News) -> None:
        action = partial(self._on_news, news)
        if isinstance(news, Measured):
            # one comes with each image: it waits for the next one, as waking up takes time
            self._actions.put(action)
        else:
            self._later(action)

    def _later(self, action: Callable[[], None]) -> None:
        """Let the executor's thread run an action, in order; called from other threads."""
        self._actions.put(action)
        with suppress(RuntimeError):  # rclpy's, when the guard condition is gone already
            self._wake.trigger()

    def catch_up(self) -> None:
        """Do what other threads left to do."""
        with suppress(queue.Empty):
            while True:
                action = self._actions.get_nowait()
                try:
                    action()
                except Exception as error:
                    # the other actions must not wait for the next trigger
                    self.survive(error)

    # images ------------------------------------------------------------------------------------

    def _on_decoded(self, image: Any) -> None:
        if self.images.listening:
            self._on_image(image)

    def _on_image(self, message: Any) -> None:
        self.catch_up()
        taken = self._intake.take(message)
        if taken is None:
            return
        index, source = taken
        self._hold()
        if not self.held:
            self._role.accompany(message.header, source.size)
        stamp_ns = self._intake.stamp_ns(message)
        # where one publisher mixes two cameras, its images must tell when that ends
        if stamp_ns is not None and not self.images.several:
            self.learner.offer(index, stamp_ns, message, source.size, source.frame_id)

    def _hold(self) -> None:
        """Look whether the images are of one camera; when they are again, begin anew with turns.

        The camera in use stays.
        """
        images, mixed = self.images, self.learner.activity.status.two_cameras
        before, self.held = self.held, ''
        if images.several:
            self.held = (f'{len(images.publishers)} publishers on {images.topic} '
                         f'({", ".join(images.publishers)}): nothing is learned, published or '
                         f'saved until one is left; remap the others')
        elif mixed:
            self.held = (f'{mixed}: nothing is published or saved until one is left; remap each '
                         f'camera to its own topic')
        if self.held and not before:
            self._log.error(self.held)
        elif before and not self.held:
            self._log.warning(f'{images.topic} has the images of one camera again: the turns are '
                              f'dropped')
            self.forget(keep_stored=True)

    def _on_source(self, before: Source | None, source: Source) -> None:
        """Handle the first source, or a change of it, which drops the turns and the calibration.

        Raises SetupError, which ends the node, for a mask that does not fit the first image.
        """
        if before is None:
            try:
                check_mask(self._mask, source.size)
            except InputError as error:
                raise SetupError(error.code, str(error)) from error
            self._log.info(f'the images on {self.images.topic} are {source}')
        else:
            self._log.error(f'the camera changed from {before} to {source}: the turns and the '
                            f'calibration are dropped')
            self.forget(keep_stored=True)
            self._role.begin_anew()
        self._role.fit(source)

    # what was learned --------------------------------------------------------------------------

    def _on_news(self, news: News) -> None:
        match news:
            case Measured():
                self._magnitude.publish(Float64(data=float(news.status.magnitude)))
            case str():
                self._log.info(news)
            case Trouble():
                self._complaints.say(news.kind, news.text)
                if news.kind == 'failed_calibrations':
                    self._answer(False, news.text)
            case Watched():
                self._on_watched(news)
            case Moved():
                self._on_moved(news)
            case Result():
                self.on_result(news)

    def _on_watched(self, watched: Watched) -> None:
        if watched.camera is not self._goal.camera or self.held:
            return
        known = self.changes()
        self.monitor = watched.monitor
        now = self.changes()
        for kind, text in now.items():
            if kind not in known:
                (self._log.warning if kind == 'lens' else self._log.info)(text)
        if 'lens' in known and 'lens' not in now:
            self._log.info('the newest turns fit the calibration again')
        if now != known:
            self._role.show_changes()

    def _on_moved(self, moved: Moved) -> None:
        if moved.camera is self._goal.camera and not (self.held or 'mount' in self.changes()):
            self._moved = moved.text
            self._log.info(moved.text)
            self._role.show_changes()

    def on_result(self, result: Result) -> None:
        """Take a calibration."""
        if result.bank != self.learner.bank:
            return  # a reset came in between
        if self.held:  # nobody knows whose calibration it is
            self._answer(False, self.held)
            return
        found = result.calibration
        self.verdict, self._sigma = found.verdict, (
            found.sigma['fx'] / found.camera.fx if found.camera and found.sigma else None)
        self._witnesses = witness_texts(result.calibration.witnesses)
        for text in self._witnesses:
            self._log.info(text)
        for warning in result.calibration.warnings:
            self._complaints.once(str(warning))
        self._role.judge(result)
        self._answer(*self._role.outcome(result))

    # diagnostics -------------------------------------------------------------------------------

    @property
    def turns_text(self) -> str:
        """Return what turns there are for the next calibration and how many are missing."""
        goal = self._goal
        return seen(self.learner.activity.status, goal.turns or goal.config.turns.wanted,
                    self._sigma if goal.camera is None else None)

    def _tick(self) -> None:
        self.catch_up()
        images, learner = self.images, self.learner
        self._intake.complain(
            learner.inbox.dropped + (self._video.dropped if self._video else 0), images.why_lost)
        if images.listening:
            images.log_silence(self._intake.silent_s)
        self._hold()
        self._report(self._role.health())

    def _report(self, health: Health) -> None:
        images, learner, monitor = self.images, self.learner, self.monitor
        now, wanted = learner.activity.status, self._goal.config.turns.wanted
        clock = self._intake.clock
        warnings = [*([self.held] if self.held else ()), *self._namesakes(), *health.warnings,
                    *clock]
        verdict = self.verdict
        values = {
            'state': health.state,
            'stage': learner.activity.stage,
            'turns found': now.turns,
            'turns stored': now.stored,
            'turns built': now.built,
            'turns wanted': wanted,
            'yaw (deg)': f'{now.yaw_deg:.0f}',
            'bends': now.bends,
            'straight pieces': len(now.stretches) - now.bends,
            'sigma fx so far (%)': f'{100 * self._sigma:.2g}' if self._sigma else '',
            'percent': min(100, round(100 * now.built / wanted)),
            'turning magnitude': f'{now.magnitude:.4f}',
            'standing': now.standing,
            'verdict': verdict.level if verdict else '',
            'reasons': verdict.main_text if verdict else '',
            **health.values,
            'warnings': '; '.join(warnings),
            'change': '; '.join(self.changes().values()),
            'suspected change': '; '.join(
                str(each) for each in (monitor.lens, monitor.mount)
                if each and not each.confirmed) if monitor else '',
            'topic': images.topic,
            'publishers': ', '.join(images.publishers),
            'reliability': images.reliability,
            'time stamps': '; '.join(clock) or 'of the images',
            'motion sensors': '; '.join(self._witnesses),
            'received': self._intake.received,
            **{kind: self._complaints.counts[kind] for kind in (*CURES, *TROUBLES)},
            'pictures published': self._preview.published}
        level, message = self._level(health, warnings)
        self._preview.show_state(message, health.camera.camera if health.camera else None)
        self._diagnostics.publish(diagnostic(
            self._endpoints.node, 'camera calibration', self._camera_name, level, message, values))

    def _namesakes(self) -> list[str]:
        node = self._endpoints.node
        own = node.get_name(), node.get_namespace()
        if node.get_node_names_and_namespaces().count(own) < 2:
            return []
        text = (f'another node is {node.get_fully_qualified_name()}, too: their services, '
                f'parameters and latched topics collide; start each camera in a namespace of its '
                f'own with -r __ns:=/front, and so on')
        self._complaints.once(text)
        return [text]

    def _level(self, health: Health, warnings: list[str]) -> tuple[bytes, str]:
        silent_s = self._intake.silent_s
        if not self.images.listening:
            return WARN, 'inactive: the node subscribes to no images until it is activated'
        if silent_s is None or silent_s > SILENT_S:
            return WARN, f'no image on {self.images.topic} {since_text(silent_s)}'
        if self.held:
            return ERROR, self.held
        if health.level != ERROR and warnings:
            return WARN, f'{health.state}: {warnings[0]}'
        if health.level != ERROR and 'lens' in self.changes():
            return WARN, self.changes()['lens']
        return health.level, health.message
