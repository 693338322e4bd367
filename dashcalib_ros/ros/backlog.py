"""A bounded queue that drops its oldest item when full: put() never waits."""
from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar('T')


class Backlog(Generic[T]):
    """Between the image callback and the detecting thread. dropped: number of items dropped."""

    def __init__(self, capacity: int) -> None:
        self.dropped = 0
        self._items: deque[T] = deque(maxlen=capacity)
        # the Backlog's own lock: guards dropped, _items and _closed
        self._changed = threading.Condition()
        self._closed = False

    def put(self, item: T) -> None:
        """Append an item; drop the oldest if the queue is full."""
        with self._changed:
            if len(self._items) == self._items.maxlen:
                self.dropped += 1
            self._items.append(item)
            self._changed.notify()

    def get(self) -> T | None:
        """Wait for the oldest item and take it; None when closed."""
        with self._changed:
            while not self._items and not self._closed:
                self._changed.wait()
            return None if self._closed else self._items.popleft()

    def clear(self) -> None:
        """Remove all items, without counting them as dropped."""
        with self._changed:
            self._items.clear()

    def close(self) -> None:
        """Let get() return None from now on."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
