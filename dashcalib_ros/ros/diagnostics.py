"""Problems are counted and logged now and then; what the node does is in /diagnostics."""
from __future__ import annotations

import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.impl.rcutils_logger import RcutilsLogger

from dashcalib_ros.errors import one_line, visible
from dashcalib_ros.report import NamedCamera

# s between two lines of one kind of problem
EVERY_S = 10.0
# last lines that once() compares with
REMEMBERED = 100
OK, WARN, ERROR, STALE = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR,
                          DiagnosticStatus.STALE)


class Log(RcutilsLogger):  # type: ignore[misc]
    """rclpy's log, in which other people's names and texts cannot make lines of their own."""

    def info(self, message: str, **filters: Any) -> bool:
        """Log for information."""
        return bool(super().info(visible(message), **filters))

    def warning(self, message: str, **filters: Any) -> bool:
        """Log a warning."""
        return bool(super().warning(visible(message), **filters))

    def error(self, message: str, **filters: Any) -> bool:
        """Log an error."""
        return bool(super().error(visible(message), **filters))


def log_line(log: RcutilsLogger, severe: bool, text: str) -> None:
    """Log a text as a warning, or for information: rclpy takes one severity for each call."""
    if severe:
        log.warning(text)
    else:
        log.info(text)


class Complaints:
    """Problems: always counted, and logged at most every few seconds for each kind.

    counts: number of complaints of each kind, logged or not.
    """

    def __init__(self, log: Callable[[str], object], every_s: float = EVERY_S) -> None:
        self.counts: Counter[str] = Counter()
        self._log = log
        self._every_s = every_s
        self._logged: dict[str, tuple[float, int]] = {}
        # lines of code whose tracebacks were logged
        self._places: set[str] = set()
        self._said: deque[str] = deque(maxlen=REMEMBERED)

    def say(self, kind: str, text: str, times: int = 1) -> None:
        """Count a complaint, and log it unless its kind was logged in the last seconds."""
        self.counts[kind] += times
        at, before = self._logged.get(kind, (-self._every_s, 0))
        now = time.monotonic()
        if now - at < self._every_s:
            return
        unsaid = self.counts[kind] - before - 1
        self._logged[kind] = now, self.counts[kind]
        self._said.append(text)
        self._log(text + (f' ({unsaid} more like it)' if unsaid > 0 else ''))

    def failure(self, kind: str, error: Exception) -> None:
        """Count an unexpected exception; log its traceback the first time it comes from there."""
        where = traceback.extract_tb(error.__traceback__)[-1:]
        place = f'{type(error).__name__} at {where[0].filename}:{where[0].lineno}' if where else ''
        text = f'the node continues after {type(error).__name__}: {one_line(error)}'
        if place in self._places:
            self.say(kind, text)
            return
        self._places.add(place)
        self.counts[kind] += 1
        for line in '\n'.join([text, *traceback.format_exception(error)]).splitlines():
            self._log(line)

    def once(self, text: str) -> None:
        """Log a line unless it was logged before."""
        if text not in self._said:
            self._said.append(text)
            self._log(text)

    def total(self, kind: str, count: int, text: str) -> None:
        """Take over a count that is kept elsewhere; log when it has grown."""
        if count > self.counts[kind]:
            self.say(kind, text, count - self.counts[kind])


@dataclass(frozen=True)
class Health:
    """What a node reports of its calibration.

    state: in one word. level, message: where nothing else is wrong. camera: the one in use.
    values: further ones for /diagnostics, by their names.
    """

    state: str
    level: bytes
    message: str
    camera: NamedCamera | None
    values: Mapping[str, object]
