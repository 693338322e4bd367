"""What every kind of input has in common."""
from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from dashcalib_ros.arrays import GreyImage
from dashcalib_ros.errors import InputError
from dashcalib_ros.frames.frame import Frame

#: index, stamp in ns, the image or why it could not be decoded, frame_id or ''
Picture = tuple[int, int, GreyImage | InputError, str]

IMAGE_SUFFIXES = frozenset(
    ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff', '.pgm', '.ppm', '.webp'))


def by_name(name: str) -> tuple[list[tuple[int, str]], str]:
    """Return a sort key for names in which numbers count as numbers: 2.png before 10.png."""
    parts = re.findall(r'[0-9]+|[^0-9]+', name)
    return [(int(part), '') if part[0] in '0123456789' else (-1, part) for part in parts], name


def os_error(path: Path, error: OSError) -> str:
    """Return a message for an input that cannot be read, with the cure."""
    if isinstance(error, FileNotFoundError):
        return f'{path} does not exist: check the path'
    if isinstance(error, PermissionError):
        where = error.filename or path
        return f'{where} may not be read: change its permissions (chmod a+rX) or its owner'
    return f'{path} cannot be read ({error.strerror}): check the disk or copy it again'


@dataclass
class Reading:
    """What went wrong in one pass over the images."""

    warnings: list[str] = field(default_factory=list)
    decoded: int = 0
    undecodable: int = 0
    first_failure: str = ''

    def failed(self, index: int, error: InputError) -> None:
        """Count an image that cannot be decoded."""
        self.undecodable += 1
        self.first_failure = self.first_failure or f'image {index}: {error}'

    def summary(self) -> tuple[str, ...]:
        """Return all warnings, one line each."""
        skipped = ([f'{self.undecodable} undecodable images were skipped ({self.first_failure})']
                   if self.undecodable else [])
        return (*self.warnings, *skipped)


class FrameSource(ABC):
    """The images of one drive: iterate over it, as often as you like, to get each Frame in turn.

    name: of the drive, for messages.
    count: how many images to expect (for a progress bar), None if unknown.
    topic: the bag's image topic; None for videos and folders.
    warnings: what the user should know about the input; complete after the last frame.

    Frames are read one by one; no memory grows with the drive. Their stamps always increase.
    Frame.index counts all images of the input, also those that were skipped.
    Iterating raises InputError when no image can be decoded or when their size changes.
    """

    _cure = 'check that it plays in another program, or record it again'

    def __init__(self, name: str, count: int | None, topic: str | None = None,
                 warnings: tuple[str, ...] = ()) -> None:
        self.name = name
        self.count = count
        self.topic = topic
        self._opening_warnings = warnings
        self._reading_warnings: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what the user should know, one line each; complete after the last frame."""
        return self._opening_warnings + self._reading_warnings

    def __iter__(self) -> Iterator[Frame]:
        reading = Reading()
        try:
            yield from self._frames(reading)
        except OSError as error:
            raise InputError(os_error(Path(self.name), error)) from error
        finally:
            self._reading_warnings = reading.summary()

    def _frames(self, reading: Reading) -> Iterator[Frame]:
        size: tuple[int, int] | None = None
        for index, stamp_ns, image, frame_id in self._pictures(reading):
            if isinstance(image, InputError):
                reading.failed(index, image)
                continue
            frame = Frame(index, stamp_ns, image, frame_id)
            size = size or frame.size
            if frame.size != size:
                raise InputError(
                    f'{self.name}: image {index} is {_by(frame.size)}, those before are '
                    f'{_by(size)}: a calibration holds for one size; split the drive there')
            reading.decoded += 1
            yield frame
        if not reading.decoded:
            raise InputError(self._no_image(reading))

    def _no_image(self, reading: Reading) -> str:
        reasons = [reading.first_failure] if reading.first_failure else reading.warnings
        why = '; '.join(reasons) or 'it has none'
        return f'{self.name} gave no image ({why}): {self._cure}'

    @abstractmethod
    def _pictures(self, reading: Reading) -> Iterator[Picture]:
        """Yield every image once, in order; add warnings for the user to reading."""


def _by(size: tuple[int, int]) -> str:
    return f'{size[0]}x{size[1]}'
