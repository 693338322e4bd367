"""What the learner tells the node."""
from __future__ import annotations

import logging
from collections.abc import Callable, Set
from dataclasses import dataclass
from typing import Any

from dashcalib_ros.arrays import GreyImage
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import DashcalibError, one_line
from dashcalib_ros.judge import Calibration, Check, Monitor
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.status import Status, View

LOG = logging.getLogger(__name__)
NOTHING = Status(0, 0, 0, 0.0, 0.0, False)


@dataclass(frozen=True)
class Activity:
    """What the learner does now. stage, share: of the calibration that runs."""

    status: Status = NOTHING
    calibrating: bool = False
    stage: str = ''
    share: float = 0.0


@dataclass(frozen=True)
class Result:
    """A calibration; complete: it had all the turns wanted; bank: the number of their bank.

    given, check: a camera that was to be checked, and what the calibration says of it.
    """

    calibration: Calibration
    complete: bool
    bank: int
    given: NamedCamera | None = None
    check: Check | None = None


@dataclass(frozen=True)
class Watched:
    """What the turns so far say of a camera in use."""

    camera: NamedCamera
    monitor: Monitor


@dataclass(frozen=True)
class NewTurn:
    """A turn that was reconstructed. number: its place among the turns so far, from 1.

    of_this_drive: False for a stored turn of an earlier drive. total_deg: yaw of all turns so far.
    """

    number: int
    yaw_deg: float
    total_deg: float
    of_this_drive: bool


@dataclass(frozen=True)
class Picture:
    """A decoded image with its message's header, and what was tracked and masked in it."""

    header: Any
    image: GreyImage
    view: View


def _ignore(*news: Any) -> None:
    """Take news that nobody wants."""


@dataclass(frozen=True)
class Listener:
    """Callbacks of the learner; its threads call them, so they must not wait.

    result: called after each calibration. status: after each image. trouble: for each problem,
    with its kind, for counting, and one line for the log. turn: for each turn that was
    reconstructed. started: when a calibration begins. watching: called for each image; where it
    returns True, picture is called with the image. watched: when new turns were compared with the
    camera in use. Their exceptions are logged.
    """

    result: Callable[[Result], None]
    status: Callable[[Status], None]
    trouble: Callable[[str, str], None]
    turn: Callable[[NewTurn], None] = _ignore
    started: Callable[[Status], None] = _ignore
    watching: Callable[[], bool] = bool
    picture: Callable[[Picture], None] = _ignore
    watched: Callable[[Watched], None] = _ignore


def call(listener: Callable[..., None], *news: Any) -> None:
    """Call one of a Listener's callbacks; its exceptions are logged."""
    try:
        listener(*news)
    except Exception:
        LOG.exception('a listener of the learner failed')


def named(error: Exception) -> str:
    """Return an error in one line, with its kind where it is not one of this project's."""
    text = one_line(error, 500)
    return text if isinstance(error, DashcalibError) else f'{type(error).__name__}: {text}'


def new_turns(told: Set[TurnId], now: Status) -> list[NewTurn]:
    """Return the turns that are ready now and were not told.

    The total is that of the turns so far; a turn that replaces another has the last number.
    """
    fresh = [place for place, turn in enumerate(now.ready) if turn not in told]
    old = sum(now.yaws_deg) - sum(now.yaws_deg[place] for place in fresh)
    found = []
    for count, place in enumerate(fresh, len(now.ready) - len(fresh) + 1):
        old += now.yaws_deg[place]
        found.append(NewTurn(count, now.yaws_deg[place], old, now.ready[place].of_this_drive))
    return found
