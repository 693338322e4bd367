"""Whether the images of a stream are of one camera, judged by their headers.

This runs in the image callback, so that no pixels are read.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

# images in a row of another size or frame that count as a change: those of a second publisher
# alternate with the first one's
LASTING = 10


@dataclass(frozen=True)
class Source:
    """What all images of one camera share: size (width, height) in px, and frame_id."""

    size: tuple[int, int]
    frame_id: str

    def __str__(self) -> str:
        return f'{self.size[0]}x{self.size[1]} in frame {self.frame_id!r}'


class SourceWatch:
    """Distinguishes a changed camera from single stray images. previous: before the change."""

    def __init__(self) -> None:
        self.current: Source | None = None
        self.previous: Source | None = None
        self._other: Source | None = None
        self._run = 0

    def take(self, source: Source) -> Literal['first', 'same', 'stray', 'changed']:
        """Take the next image's source."""
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
