"""The camera that turns are compared with: the node's own calibration, or a driver's."""
from __future__ import annotations

from abc import ABC, abstractmethod

from rclpy.node import Node
from std_msgs.msg import Header

from dashcalib_ros.config import Config
from dashcalib_ros.judge import Check, Verdict
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.ros.changes import Changes
from dashcalib_ros.ros.news import Result, Watched
from dashcalib_ros.ros.state import Action
from dashcalib_ros.ros.stream import Source


class CameraInUse(ABC):
    """What CalibrationInUse and, with check_only, GivenCalibration have in common.

    verdict: of the last calibration, used or not. contradictions: number of calibrations in a row
    that contradict the one in use. stale: it was given up, and is published only because of
    publish_stale. confirmed: False for one of a file until turns of this drive agree with it.
    settled: whether the last calibration's turns have told all that they can of it.
    """

    def __init__(self, node: Node) -> None:
        self.verdict: Verdict | None = None
        self.contradictions = 0
        self.stale = False
        self.confirmed = self.settled = True
        self.changes = Changes(node.get_logger())
        self._watched: NamedCamera | None = None

    @property
    @abstractmethod
    def camera(self) -> NamedCamera | None:
        """Return the camera in use."""

    @property
    @abstractmethod
    def trusted(self) -> NamedCamera | None:
        """Return the camera in use, None if it is stale or not of the images."""

    @property
    def checked(self) -> NamedCamera | None:
        """Return the camera that the next calibration is to check, None where there is none."""
        return None

    @property
    def answer(self) -> Check | None:
        """Return what was found of a driver's calibration; None where none is to be checked."""
        return None

    @property
    def published(self) -> int:
        """Return how many camera_infos were published beside images."""
        return 0

    @property
    def file(self) -> str:
        """Return the path of the calibration's file, '' where there is none."""
        return ''

    def watched(self) -> NamedCamera | None:
        """Return the camera that each turn is compared with; the changes are of this one."""
        if self._watched is not self.trusted:
            self._watched = self.trusted
            self.changes.forget()
        return self._watched

    def on_watched(self, watched: Watched) -> None:
        """Take what new turns show, unless it is of a camera that is no longer in use."""
        if watched.camera is self.watched():
            self.changes.take(watched.monitor)

    @abstractmethod
    def goal(self, config: Config) -> int | None:
        """Return how many turns the next calibration needs; None: there is to be none."""

    @abstractmethod
    def load(self) -> None:
        """Use the file's calibration, if there is one."""

    @abstractmethod
    def check(self, source: Source) -> None:
        """Take what the images are; a calibration for others is not used with them."""

    @abstractmethod
    def judge(self, result: Result, frame_id: str, publish_stale: bool) -> Action:
        """Take a new calibration; return what was done with it."""

    @abstractmethod
    def accompany(self, header: Header, size: tuple[int, int]) -> None:
        """Publish what belongs beside an image, if anything."""

    @abstractmethod
    def drop(self) -> None:
        """Forget what was learned, as at the start; a file stays where it is."""

    @abstractmethod
    def retire(self) -> tuple[bool, str]:
        """Move the file aside; return whether it is out of the way, and a line about it."""

    @abstractmethod
    def save(self) -> tuple[bool, str]:
        """Write the file; return whether it was written, and a line about it."""

    def close(self) -> None:  # noqa: B027, there may be nothing to leave
        """Leave the calibration's file to other nodes."""

    @abstractmethod
    def warnings(self) -> list[str]:
        """Return warnings for the operator."""
