"""The calibration in use: loaded or adopted, replaced or given up, published and kept on disk."""
from __future__ import annotations

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from dashcalib_ros.config import Config
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.ros.camera_in_use import CameraInUse
from dashcalib_ros.ros.complaints import Complaints
from dashcalib_ros.ros.kept import Kept, Whose
from dashcalib_ros.ros.news import Result, Watched
from dashcalib_ros.ros.publication import Publication
from dashcalib_ros.ros.state import Action, Rules, judge, sigma_text
from dashcalib_ros.ros.store import Store
from dashcalib_ros.ros.stream import Source
from dashcalib_ros.ros.wording import outcome_text


class CalibrationInUse(CameraInUse):
    """At most one calibration; its topics and its file are always changed together."""

    def __init__(self, node: Node, whose: Whose, store: Store, rules: Rules,
                 complaints: Complaints, rectified: str) -> None:
        super().__init__(node)
        self._node = node
        self._publication = Publication(node, rectified)
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
        self.verdict = calibration.verdict
        for text in calibration.warnings:
            self._complaints.once(text)
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
        self.verdict, self.contradictions = None, 0

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

    def on_watched(self, watched: Watched) -> None:
        """Take what new turns show; those that agree confirm a calibration that was loaded."""
        super().on_watched(watched)
        if watched.camera is self.watched() and watched.monitor.agrees:
            self.confirmed = True

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
        beside = self._publication.topic
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
        self._publication.set(kept.camera, kept.frame_id or '')

    def _unpublish(self) -> None:
        self._kept, self.stale = None, False
        self._publication.retract()
