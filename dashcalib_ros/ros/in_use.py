"""The calibration in use: loaded or adopted, replaced or given up, published and kept on disk."""
from __future__ import annotations

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.ros.camera_in_use import CameraInUse
from dashcalib_ros.ros.complaints import Complaints
from dashcalib_ros.ros.news import Result
from dashcalib_ros.ros.publication import Publication
from dashcalib_ros.ros.state import Action, Rules, judge, sigma_text
from dashcalib_ros.ros.store import Kept, Store
from dashcalib_ros.ros.stream import Source
from dashcalib_ros.ros.wording import outcome_text


class CalibrationInUse(CameraInUse):
    """At most one calibration; its topics and its file are always changed together."""

    def __init__(self, node: Node, name: str, store: Store, rules: Rules,
                 complaints: Complaints, rectified: str) -> None:
        super().__init__(node)
        self._node = node
        self._publication = Publication(node, rectified)
        self._kept: Kept | None = None
        self._log = node.get_logger()
        self._name = name
        self._store = store
        self._rules = rules
        self._complaints = complaints
        self._rectified = rectified

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

    @property
    def published(self) -> int:
        """Return how many camera_infos were published beside images."""
        return self._publication.sent

    @property
    def info(self) -> CameraInfo | None:
        """Return what is published now."""
        return self._publication.info

    def goal(self, config: Config) -> int:
        """Return how many turns the next calibration needs.

        The first one needs all turns wanted; to check a published one, a few are enough.
        """
        wanted = config.turns.wanted
        return wanted if self.trusted is None else min(config.verdict.min_turns, wanted)

    def accompany(self, header: Header, size: tuple[int, int]) -> None:
        """Publish the camera_info of an image, if the camera has such images."""
        self._publication.accompany(header, size)

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
        self._use(wanted)
        self._log.info(f'loaded {self.file}: {sigma_text(kept.camera)}')

    def check(self, source: Source) -> None:
        """Stop using it if it is for other images than these; the file stays where it is."""
        kept = self._kept
        if kept is None:
            return
        of = Source(kept.camera.image_size, kept.frame_id or source.frame_id)
        if of != source:
            self._log.warning(f'{self.file} is ignored: it is for {of}, the images are {source}')
            self._unpublish()

    def judge(self, result: Result, frame_id: str, publish_stale: bool) -> Action:
        """Adopt a new calibration, or not (state.py has the reasons); return what was done.

        publish_stale: go on publishing a calibration that is given up.
        """
        calibration = result.calibration
        self.verdict = calibration.verdict
        for text in calibration.warnings:
            self._complaints.once(text)
        judged = judge(calibration, result.complete, self.trusted, self.contradictions,
                       self._rules)
        self.contradictions = judged.contradictions
        if judged.action in ('adopt', 'replace'):
            if judged.action == 'replace':
                self._log.warning(f'the calibration is replaced: {judged.why}')
            self._adopt(Kept.of(calibration, self._name, frame_id))
        elif judged.action == 'give_up':
            self._log.error(f'the published calibration is given up: {judged.why}')
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
        self.verdict, self.contradictions = None, 0

    def retire(self) -> tuple[bool, str]:
        """Move the file aside; return whether it is out of the way, and a line about it."""
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

    def warnings(self) -> list[str]:
        """Return warnings about the file and the topic, for the operator."""
        found = []
        if self._store.given_up:
            found.append(f'{self.file} was given up, but could not be moved aside: remove it, or '
                         f'the next start of the node publishes it again')
        beside = self._publication.topic
        if self._node.count_publishers(beside) > 1:
            found.append(f'another node publishes {beside}: remap it, or its subscribers get both')
        return found

    def _adopt(self, kept: Kept) -> None:
        self._use(kept)
        self.contradictions = 0
        saved, text = self.save()
        self._log.info(f'accepted: {sigma_text(kept.camera)}; '
                       + (f'saved to {self.file}' if saved else f'not saved: {text}'))

    def _use(self, kept: Kept) -> None:
        self._kept, self.stale = kept, False
        self._publication.set(kept.camera, kept.frame_id)

    def _unpublish(self) -> None:
        self._kept, self.stale = None, False
        self._publication.retract()
