"""SIGINT and SIGTERM end the node cleanly, at any time and any number of times."""
from __future__ import annotations

import signal
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopping:
    """Handles both signals without raising; `requested` is True after one of them.

    rclpy's own handlers, installed later by rclpy.init, end the spinning and call these too.
    """

    def __init__(self) -> None:
        self.requested = False
        for name in SIGNALS:
            signal.signal(name, self._request)

    def ignore_signals(self) -> None:
        """Ignore both signals while the interpreter ends: by default they would kill it."""
        for name in SIGNALS:
            signal.signal(name, signal.SIG_IGN)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
