"""Actions that other threads leave for the executor's thread."""
from __future__ import annotations

import queue
from collections.abc import Callable
from contextlib import suppress

from rclpy.node import Node


class Mailbox:
    """A guard condition wakes the executor, whose thread then runs what was put in, in order.

    failed: called in that thread with what an action raised.
    """

    def __init__(self, node: Node, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._actions: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.wake = node.create_guard_condition(self._empty)

    def put(self, action: Callable[[], None]) -> None:
        """Let the executor's thread run an action; may be called from any thread."""
        self._actions.put(action)
        with suppress(RuntimeError):  # rclpy's, when the context is shut down already
            self.wake.trigger()

    def blocked(self) -> bool:
        """Return whether rclpy calls no callback any more, after an exception of its own."""
        return not self.wake.callback_group.can_execute(self.wake)

    def _empty(self) -> None:
        while True:
            try:
                action = self._actions.get_nowait()
            except queue.Empty:
                return
            try:
                action()
            except Exception as error:
                # the other actions must not wait for the next trigger
                self._failed(error)
