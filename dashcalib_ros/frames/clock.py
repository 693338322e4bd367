"""Stamps of messages -> stamps that always increase."""
from __future__ import annotations

SET_BACK_NS = 1_000_000_000  # a stamp further behind is no late image but another clock


class Clock:
    """The time of one stream's images.

    The header's stamps count. If the first is zero the driver does not set them, and the times at
    which the recorder received the images count instead. An image that is not later than the one
    before is a repetition or came late: it gets no stamp. When the clock is set back by more
    than a second, time goes on from where it was.

    repeated, received, jumps_ns: how often each of these happened, for the warnings.
    """

    def __init__(self) -> None:
        self.received = False
        self.repeated = 0
        self.jumps_ns: list[int] = []
        self._last: int | None = None
        self._step = 0
        self._shift = 0

    def stamp(self, header_ns: int, receive_ns: int) -> int | None:
        """Return the image's time in nanoseconds, or None when it must be skipped."""
        if self._last is None:
            self.received = header_ns == 0
            self._last = receive_ns if self.received else header_ns
            return self._last
        now = (receive_ns if self.received else header_ns) + self._shift
        behind = self._last - now
        if behind > SET_BACK_NS:
            self.jumps_ns.append(behind)
            self._shift += behind + self._step
            now = self._last + self._step
        if now <= self._last:
            self.repeated += 1
            return None
        self._step, self._last = now - self._last, now
        return now

    def warnings(self) -> list[str]:
        """Return what the user should know about the stamps, one line each."""
        lines = []
        if self.received:
            lines.append('the image headers have no stamps: the times of reception were taken')
        if self.repeated:
            lines.append(f'{self.repeated} images were skipped: their stamps are not later than '
                         f'those before')
        if self.jumps_ns:
            most = max(self.jumps_ns) / 1e9
            lines.append(f'the clock was set back {len(self.jumps_ns)} times, by up to '
                         f'{most:.1f} s: time was taken to go on')
        return lines
