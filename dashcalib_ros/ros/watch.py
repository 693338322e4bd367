"""Watches a camera in use over all banks of turns: each new turn is read once."""
from __future__ import annotations

from dashcalib_ros.detect import TurnId
from dashcalib_ros.judge import Monitor
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.ros.bank import Bank
from dashcalib_ros.ros.news import Watched
from dashcalib_ros.status import Status


class Watch:
    """What turns say of a camera in use. Used by the calibrating thread only.

    A bank begins empty after each complete calibration; what the turns of the banks before it
    said is kept, so that a change that was found is not forgotten.
    """

    def __init__(self, camera: NamedCamera | None) -> None:
        """camera: None where there is none in use, and nothing is read."""
        self.camera = camera
        self._bank = -1
        self._tried: frozenset[TurnId] = frozenset()
        self._before: Monitor | None = None
        self._now: Monitor | None = None

    def read(self, bank: Bank, status: Status) -> Watched | None:
        """Read the turns that were reconstructed since the last call; None if there are none.

        Raises what Calibrator.watch() raises; the same turns alone are not tried again then.
        """
        if self.camera is None:
            return None
        if bank.number != self._bank:
            self._bank, self._tried, self._before = bank.number, frozenset(), self._now
        turns = frozenset(status.reconstructed)
        if turns <= self._tried:
            return None
        self._tried |= turns
        found = bank.calibrator.watch(self.camera.camera, self.camera.sigma)
        self._now = found if self._before is None else _continued(self._before, found)
        return Watched(self.camera, self._now)


def _continued(before: Monitor, found: Monitor) -> Monitor:
    """Return the state of an earlier bank after the turns of a later one."""
    for reading in found.readings:
        before = before.after(reading)
    return before
