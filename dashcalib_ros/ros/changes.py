"""The changes of the camera in use, as its turns show them: each is told once in the log."""
from __future__ import annotations

from rclpy.impl.rcutils_logger import RcutilsLogger

from dashcalib_ros.judge import Change, Monitor


class Changes:
    """confirmed: by two turns or more; suspected: by one. The log gets the confirmed ones only."""

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
