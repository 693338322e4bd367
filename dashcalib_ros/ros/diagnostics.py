"""What goes wrong is counted and logged now and then; what the node does is in /diagnostics."""
from __future__ import annotations

import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.impl.rcutils_logger import RcutilsLogger

from dashcalib_ros.errors import one_line
from dashcalib_ros.judge import Change, Monitor, Verdict
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.ros.background import Activity
from dashcalib_ros.ros.state import sigma_text

# s between two lines of one kind of problem
EVERY_S = 10.0
# last lines that once() compares with
REMEMBERED = 100
# s; a camera that is silent for longer has stopped
SILENT_S = 5.0
OK, WARN, ERROR, STALE = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR,
                          DiagnosticStatus.STALE)


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
        text = f'the node goes on after {type(error).__name__}: {one_line(error)}'
        if place in self._places:
            self.say(kind, text)
            return
        self._places.add(place)
        self.counts[kind] += 1
        self._log('\n'.join([text, *traceback.format_exception(error)]).rstrip())

    def once(self, text: str) -> None:
        """Log a line unless it was logged before."""
        if text not in self._said:
            self._said.append(text)
            self._log(text)

    def total(self, kind: str, count: int, text: str) -> None:
        """Take over a count that is kept elsewhere; log when it has grown."""
        if count > self.counts[kind]:
            self.say(kind, text, count - self.counts[kind])


class Changes:
    """The changes of the camera in use, as its turns show them: each is told once in the log.

    confirmed: by two turns or more; suspected: by one. The log gets the confirmed ones only.
    """

    def __init__(self, log: RcutilsLogger) -> None:
        self.confirmed: tuple[Change, ...] = ()
        self.suspected: tuple[Change, ...] = ()
        self._log = log

    @property
    def misfit(self) -> str:
        """Return why the calibration no longer fits the camera, '' where it does."""
        return next((str(each) for each in self.confirmed if each.kind == 'lens'), '')

    @property
    def texts(self) -> tuple[str, ...]:
        """Return the confirmed changes in words."""
        return tuple(map(str, self.confirmed))

    def take(self, monitor: Monitor) -> None:
        """Take what the turns so far show."""
        known = {each.kind for each in self.confirmed}
        self.confirmed = monitor.changes
        self.suspected = tuple(each for each in (monitor.lens, monitor.mount)
                               if each is not None and not each.confirmed)
        for change in self.confirmed:
            # rclpy takes one severity for each line of code
            if change.kind in known:
                continue
            if change.kind == 'lens':
                self._log.warning(str(change))
            else:
                self._log.info(str(change))
        if 'lens' in known and not self.misfit:
            self._log.info('the newest turns fit the calibration again')

    def forget(self) -> None:
        """Begin anew: another calibration is in use, or none."""
        self.confirmed = self.suspected = ()


@dataclass(frozen=True)
class Health:
    """What a node says of its calibration. level, message: where nothing is wrong.

    published: the camera that is published now. confirmed: False for one of a file until turns
    agree with it. error: more than a warning. check, check_reasons: of a driver's calibration.
    counts: of the node's own kind, and words.
    """

    state: str
    level: bytes
    message: str
    published: NamedCamera | None = None
    confirmed: bool = True
    error: str = ''
    file: str = ''
    check: str = ''
    check_reasons: tuple[str, ...] = ()
    counts: Mapping[str, int | str] = field(default_factory=dict)


def silence(topic: str, listening: bool, silent_s: float | None) -> tuple[bytes, str] | None:
    """Return level and message where no images come; silent_s: since the last one."""
    if not listening:
        return WARN, 'inactive: the node subscribes no images until it is activated'
    if silent_s is None or silent_s > SILENT_S:
        return STALE, f'no image on {topic} {since_text(silent_s)}'
    return None


def since_text(silent_s: float | None) -> str:
    """Return since when there are no images, None: none came."""
    return 'yet' if silent_s is None else f'for {silent_s:.0f} s'


def turns_text(activity: Activity, wanted: int) -> str:
    """Return '2 of 5 turns, 179° of yaw'."""
    status = activity.status
    return f'{min(status.built, wanted)} of {wanted} turns, {status.yaw_deg:.0f}° of yaw'


def diagnostic_status(silence: tuple[bytes, str] | None, activity: Activity, wanted: int,
                      verdict: Verdict | None, changes: Changes, warnings: list[str],
                      health: Health, further: Mapping[str, object]) -> DiagnosticStatus:
    """Return the status of one camera, without its name. further: values beside these."""
    if silence is not None:
        level, message = silence
    elif health.error:
        level, message = ERROR, health.error
    elif warnings or changes.misfit:
        level = WARN
        message = f'{health.state}: {warnings[0]}' if warnings else changes.misfit
    else:
        level, message = health.level, health.message
    status, published = activity.status, health.published
    sigma = published.sigma if published else None
    values = {
        'state': health.state,
        'stage': activity.stage,
        'turns found': status.turns,
        'turns stored': status.stored,
        'turns built': status.built,
        'turns wanted': wanted,
        'yaw (deg)': f'{status.yaw_deg:.0f}',
        'percent': min(100, round(100 * status.built / wanted)),
        'turning magnitude': f'{status.magnitude:.4f}',
        'standing': status.standing,
        'verdict': verdict.level if verdict else '',
        'reasons': '; '.join(verdict.reasons) if verdict else '',
        'published': sigma_text(published) if published else 'nothing',
        'calibration': ('' if published is None
                        else 'confirmed' if health.confirmed else 'unconfirmed'),
        'camera model': published.camera.model if published else '',
        'sigma fx (px)': f'{sigma["fx"]:.3f}' if sigma else '',
        'file': health.file,
        'warnings': '; '.join(warnings),
        'check': health.check,
        'check reasons': '; '.join(health.check_reasons),
        'change': '; '.join(changes.texts),
        'suspected change': '; '.join(map(str, changes.suspected)),
        **further,
    }
    return DiagnosticStatus(
        level=level, message=message,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
