"""Whether the messages of a stream are of one camera, judged by what they share."""
from __future__ import annotations

from collections.abc import Callable
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

    def take(self, source: T, check: Callable[[], object] = lambda: None
             ) -> Literal['first', 'same', 'stray', 'changed']:
        """Take the next message's source.

        check: raises InputError, which goes on to the caller, for a damaged message: such a one
        is no sign of a change. It is called for few messages: not for those of the present source,
        nor for strays between them.
        """
        if source == self.current:
            self._run = 0
            return 'same'
        if self.current is None:
            check()
            self.current = source
            return 'first'
        run = self._run + 1 if source == self._other else 1
        self._other, self._run = source, 0
        if run > 1:
            check()
        self._run = run
        if run < LASTING:
            return 'stray'
        self.previous, self.current, self._run = self.current, source, 0
        return 'changed'
