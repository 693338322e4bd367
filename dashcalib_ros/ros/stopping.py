"""SIGINT and SIGTERM end the node cleanly, however often and whenever they come."""
from __future__ import annotations

import signal
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopping:
    """Takes both signals without raising anything; `requested` tells that one came.

    rclpy's own handlers, installed later by rclpy.init, end the spinning and call these too.
    """

    def __init__(self) -> None:
        self.requested = False
        for name in SIGNALS:
            signal.signal(name, self._request)

    def ignore_signals(self) -> None:
        """Let no signal disturb the interpreter's own end, where the default is to die by it."""
        for name in SIGNALS:
            signal.signal(name, signal.SIG_IGN)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
