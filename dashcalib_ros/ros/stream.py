"""Whether the messages of a stream are of one camera, judged by what they share.

This runs in the image callback, so that no pixels are read.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

# messages in a row of another size, frame or calibration that count as a change: those of a
# second publisher alternate with the first one's
LASTING = 10
T = TypeVar('T')


@dataclass(frozen=True)
class Source:
    """What all images of one camera share: size (width, height) in px, and frame_id."""

    size: tuple[int, int]
    frame_id: str

    def __str__(self) -> str:
        return f'{self.size[0]}x{self.size[1]} in frame {self.frame_id!r}'


class SourceWatch(Generic[T]):
    """Distinguishes a changed camera from single stray messages. previous: before the change.

    T: what the messages of one camera share.
    """

    def __init__(self) -> None:
        self.current: T | None = None
        self.previous: T | None = None
        self._other: T | None = None
        self._run = 0

    def take(self, source: T) -> Literal['first', 'same', 'stray', 'changed']:
        """Take the next message's source."""
        if source == self.current:
            self._run = 0
            return 'same'
        if self.current is None:
            self.current = source
            return 'first'
        self._run = self._run + 1 if source == self._other else 1
        self._other = source
        if self._run < LASTING:
            return 'stray'
        self.previous, self.current, self._run = self.current, source, 0
        return 'changed'
