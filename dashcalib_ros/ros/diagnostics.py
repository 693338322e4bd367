# SPDX-License-Identifier: Apache-2.0
"""Problems are counted and logged now and then; what the node does is in /diagnostics."""
from __future__ import annotations

import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from std_msgs.msg import Header

from dashcalib_ros.errors import one_line, visible
from dashcalib_ros.report import NamedCamera

# s between two lines of one kind of problem
EVERY_S = 10.0
# last lines that once() compares with
REMEMBERED = 100
# not STALE, which is for aggregators to say about a node that is silent
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Log:
    """A node's log, in which other people's names and texts cannot make lines of their own."""

    def __init__(self, node: Node) -> None:
        self._log = node.get_logger()

    def info(self, message: str) -> None:
        """Log for information."""
        self._log.info(visible(message))

    def warning(self, message: str) -> None:
        """Log a warning."""
        self._log.warning(visible(message))

    def error(self, message: str) -> None:
        """Log an error."""
        self._log.error(visible(message))


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
        self._logged_texts: deque[str] = deque(maxlen=REMEMBERED)

    def say(self, kind: str, text: str, times: int = 1) -> None:
        """Count a complaint, and log it unless its kind was logged in the last seconds."""
        self.counts[kind] += times
        at, before = self._logged.get(kind, (-self._every_s, 0))
        now = time.monotonic()
        if now - at < self._every_s:
            return
        unsaid = self.counts[kind] - before - 1
        self._logged[kind] = now, self.counts[kind]
        self._logged_texts.append(text)
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
        if text not in self._logged_texts:
            self._logged_texts.append(text)
            self._log(text)

    def total(self, kind: str, count: int, text: str) -> None:
        """Take over a count that is kept elsewhere; log when it has grown."""
        if count > self.counts[kind]:
            self.say(kind, text, count - self.counts[kind])


@dataclass(frozen=True)
class Health:
    """What a node reports of its calibration.

    state: in one word. level, message: where nothing else is wrong. camera: the one in use.
    values: further ones for /diagnostics, by their names. warnings: for the operator.
    """

    state: str
    level: bytes
    message: str
    camera: NamedCamera | None
    values: Mapping[str, object]
    warnings: Sequence[str] = ()


def diagnostic(node: Node, what: str, camera_name: str, level: bytes, message: str,
               values: Mapping[str, object]) -> DiagnosticArray:
    """Return what a node says about a camera, with the present time."""
    return DiagnosticArray(
        header=Header(stamp=node.get_clock().now().to_msg()),
        status=[DiagnosticStatus(
            level=level, message=message, hardware_id=camera_name,
            # of two nodes of one name, too, each has a status of its own
            name=f'{node.get_fully_qualified_name().strip("/")}: {what} ({camera_name})',
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])])
