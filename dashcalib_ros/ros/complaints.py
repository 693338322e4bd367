"""What goes wrong is counted always and logged now and then, each kind by itself."""
from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable

EVERY_S = 10.0
# lines that once() compares with
REMEMBERED = 100


class Complaints:
    """counts: how often each kind was said, whether or not it was logged."""

    def __init__(self, log: Callable[[str], object], every_s: float = EVERY_S) -> None:
        self.counts: Counter[str] = Counter()
        self._log = log
        self._every_s = every_s
        self._logged: dict[str, tuple[float, int]] = {}
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

    def once(self, text: str) -> None:
        """Log what holds from now on, unless it was logged before."""
        if text not in self._said:
            self._said.append(text)
            self._log(text)

    def total(self, kind: str, count: int, text: str) -> None:
        """Take a count that is kept elsewhere; log when it has grown."""
        if count > self.counts[kind]:
            self.say(kind, text, count - self.counts[kind])
