"""What every kind of input has in common, and the choice between them."""
from __future__ import annotations

import math
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from dashcalib_ros.errors import InputError
from dashcalib_ros.frames.frame import Frame, GreyImage

#: index, stamp in nanoseconds, and the image or the reason why it could not be decoded
Picture = tuple[int, int, GreyImage | InputError]

IMAGE_SUFFIXES = frozenset(
    ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff', '.pgm', '.ppm', '.webp'))
# not whatever FFmpeg takes: it would play a text file
VIDEO_SUFFIXES = frozenset(
    ('.mp4', '.m4v', '.mov', '.avi', '.mkv', '.webm', '.ts', '.mts', '.m2ts', '.mpg', '.mpeg',
     '.wmv', '.flv', '.3gp', '.ogv', '.mjpg', '.mjpeg', '.h264', '.264', '.h265', '.265', '.hevc'))
BAG_SUFFIXES = ('.mcap', '.db3', '.bag')


def open_frames(path: str | os.PathLike[str], topic: str | None = None,
                fps: float | None = None) -> FrameSource:
    """Open a drive, whatever it is stored in; the path decides.

    path: a ROS 2 bag (folder, .mcap, .db3, zstd or not), a ROS 1 .bag, a video file, or a folder
    of images, which are taken in the order of their names (2.png before 10.png).
    topic: the image topic of a bag; needed only when it has several.
    fps: images per second of a folder (default 10), or instead of what a video says (Hz).

    Raises InputError when there is nothing to read, or several topics and no choice among them.
    """
    if fps is not None and not (math.isfinite(fps) and 0 < fps <= 1000):
        raise InputError(f'fps must be above 0 and at most 1000, not {fps!r}')
    place = Path(path)
    try:
        return _open(place, topic, fps)
    except OSError as error:
        raise InputError(_os_error(place, error)) from error


def _open(path: Path, topic: str | None, fps: float | None) -> FrameSource:
    if path.is_dir():
        names = [entry.name for entry in path.iterdir()]
        if any(name == 'metadata.yaml' or is_bag_file(name) for name in names):
            return _bag(path, topic, fps)
        from dashcalib_ros.frames.folder import FolderSource
        return FolderSource(path, topic, fps)
    if path.stat().st_size == 0:
        raise InputError(f'{path} is empty: the recording or the copy failed; make it again')
    with path.open('rb'):
        pass  # a file that may not be read says so here, before any reader has its own words
    if is_bag_file(path.name):
        return _bag(path, topic, fps)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise InputError(f'{path} is a single image: give the folder of all images of the drive')
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise InputError(f'{path} is no kind of drive known here: give a bag (.mcap, .db3, .bag), '
                         f'a video (.mp4, .avi, .mkv ...) or a folder of images')
    from dashcalib_ros.frames.video import VideoSource
    return VideoSource(path, topic, fps)


def _bag(path: Path, topic: str | None, fps: float | None) -> FrameSource:
    from dashcalib_ros.frames.bag import BagSource
    return BagSource(path, topic, fps)


def is_bag_file(name: str) -> bool:
    """Tell whether this is the name of a bag's storage file, compressed or not."""
    return name.lower().removesuffix('.zstd').removesuffix('.active').endswith(BAG_SUFFIXES)


def by_name(name: str) -> tuple[list[tuple[int, str]], str]:
    """Sort names with this key and their numbers count as numbers: 2.png before 10.png."""
    parts = re.findall(r'[0-9]+|[^0-9]+', name)
    return [(int(part), '') if part[0] in '0123456789' else (-1, part) for part in parts], name


def _os_error(path: Path, error: OSError) -> str:
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

    name: what the drive is called, for the user to read.
    count: how many images to expect (for a progress bar), or None when nobody knows.
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
            raise InputError(_os_error(Path(self.name), error)) from error
        finally:
            self._reading_warnings = reading.summary()

    def _frames(self, reading: Reading) -> Iterator[Frame]:
        size: tuple[int, int] | None = None
        for index, stamp_ns, image in self._pictures(reading):
            if isinstance(image, InputError):
                reading.failed(index, image)
                continue
            frame = Frame(index, stamp_ns, image)
            size = size or frame.size
            if frame.size != size:
                raise InputError(
                    f'{self.name}: image {index} is {_by(frame.size)}, those before are '
                    f'{_by(size)}: a calibration holds for one size; split the drive there')
            reading.decoded += 1
            yield frame
        if not reading.decoded:
            raise InputError(self._nothing(reading))

    def _nothing(self, reading: Reading) -> str:
        reasons = [reading.first_failure] if reading.first_failure else reading.warnings
        why = '; '.join(reasons) or 'it has none'
        return f'{self.name} gave no image ({why}): {self._cure}'

    @abstractmethod
    def _pictures(self, reading: Reading) -> Iterator[Picture]:
        """Yield every image once, in order; put what the user should know into reading."""


def _by(size: tuple[int, int]) -> str:
    return f'{size[0]}x{size[1]}'
