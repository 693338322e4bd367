# SPDX-License-Identifier: Apache-2.0
"""What every kind of input has in common: its frames, and how they are read."""
from __future__ import annotations

import copy
import re
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING

from dashcalib_ros.arrays import GreyImage, Pixels
from dashcalib_ros.errors import InputError, Notice, counted, shortened

if TYPE_CHECKING:
    from dashcalib_ros.camera import Camera

IMAGE_SUFFIXES = frozenset(
    ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff', '.pgm', '.ppm', '.webp'))

BAG_SUFFIXES = ('.mcap', '.db3', '.bag')
METADATA = 'metadata.yaml'
# of a name, by which it is not ordered
ENDING = re.compile(r'\.[a-zA-Z]\w*$')
# ns; what a stamp of 64 bits holds
LAST_NS = 2**63 - 1
# how others name the camera of several that record at a time: 2026-01-31_10-00-00-left_repeater,
# CH1_20260131, and one letter: NO20260131-100000-000123F, REC_2026_01_31_F, 260131_100000_001_FH
SIDE_WORD = re.compile(
    r'(?<![a-z])(?:front|back|rear|left|right|(?:in|out)side|interior|cabin|inner|driver|repeater'
    r'|pillar'
    r'|(?:ch|cam|camera|channel)[-_ ]?\d{1,2})(?![a-z0-9])')
SIDE_LETTER = re.compile(r'(?<=[\d_ -])([a-z])[hls]?$')
SIDES = frozenset('fbrli')
# images are further apart; stamps are rounded
CLOSE_NS = 1_000_000


def by_name(name: str) -> tuple[list[tuple[int, str]], str]:
    """Return a sort key for names in which numbers count as numbers: 2.png before 10.png.

    A name is before its copies: X.jpg, X (1).jpg, X (2).jpg.
    """
    parts = re.findall(r'[0-9]+|[^0-9]+', ENDING.sub('', name))
    return [(int(part), '') if part[0] in '0123456789' else (-1, part) for part in parts], name


def cameras_named(names: Sequence[str]) -> int:
    """Return of how many cameras these files are: what they differ in names a side of the car."""
    stems = {str(path.parent / path.stem).lower() for path in map(Path, names)}
    found = [(SIDE_WORD.sub('', stem), SIDE_WORD.findall(stem)) for stem in stems]
    letters: defaultdict[str, set[str]] = defaultdict(set)
    for rest, _ in found:
        if letter := SIDE_LETTER.search(rest):
            letters[rest[:letter.start()]].add(letter[1])
    cameras: defaultdict[str, set[str]] = defaultdict(set)
    for rest, side in found:
        letter = SIDE_LETTER.search(rest)
        others = letters[rest[:letter.start()]] if letter else set()
        # a to f are parts of one drive; some name the rear camera only
        if letter and others <= SIDES and (len(others) > 1 or others == {'r'}):
            rest, side = rest[:letter.start()], [*side, letter[1]]
        cameras[rest.strip('-_ ')].add(' '.join(side))
    return max(map(len, cameras.values()), default=0)


def size_text(size: tuple[int, int]) -> str:
    """Return (width, height) as messages have it."""
    return f'{size[0]}x{size[1]}'


def first_of(texts: Sequence[str], most: int = 3) -> str:
    """Return the first texts for a message, and dots where there are more."""
    return ', '.join(texts[:most]) + (' ...' if len(texts) > most else '')


def is_bag_file(name: str) -> bool:
    """Tell whether this is the name of a bag's storage file, compressed or not."""
    return name.lower().removesuffix('.zstd').removesuffix('.active').endswith(BAG_SUFFIXES)


def os_error(path: Path, error: OSError) -> InputError:
    """Return the error for an input that cannot be read."""
    if isinstance(error, FileNotFoundError):
        return InputError('E-FILE-MISSING', f'{path} does not exist: check the path')
    if isinstance(error, PermissionError):
        return InputError('E-FILE-PERMISSION', f'no permission to read {error.filename or path}: '
                          f'change its permissions (chmod a+rX) or its owner')
    return InputError('E-FILE-UNREADABLE', f'{path} cannot be read ({error.strerror}): check the '
                      f'disk, or copy it again')


# arrays cannot be compared: frames are the same, or not
@dataclass(frozen=True, eq=False)
class Frame:
    """One image of the drive.

    index: position among the images of the input, counted from 0.
    stamp_ns: time of exposure in nanoseconds (the stamp of the message header, or index / rate).
    image: (height, width) uint8, grey. It is not changed after the Frame is created.
    frame_id: that of the message header; empty if there is none.
    after_gap: images are missing before this one, or it belongs to another drive.
    perhaps_after_gap: first image of a file that may or may not continue the previous one, such as
    the next video of a dashcam; detect/continuity.py decides from the motion of the image.
    Raises InputError for a stamp that is not a finite number of 64 bits.
    """

    index: int
    stamp_ns: int
    image: GreyImage
    frame_id: str = ''
    after_gap: bool = False
    perhaps_after_gap: bool = False

    def __post_init__(self) -> None:
        # NaN is in no range
        if not (isinstance(self.stamp_ns, Real) and -LAST_NS <= self.stamp_ns <= LAST_NS):
            raise InputError('E-STAMP-INVALID', f'Frame.stamp_ns must be a number of nanoseconds '
                             f'that fits into 64 bits, not {shortened(repr(self.stamp_ns))}')

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height) in pixels."""
        return self.image.shape[1], self.image.shape[0]


@dataclass(frozen=True)
class Picture:
    """One image of the drive that is not decoded yet; index, stamp_ns and others as a Frame's.

    decode: returns the image, grey; with colour=True (h, w, 3) BGR where it has colours. Raises
    InputError where that is not possible. file: that it is in, where the drive has several.
    """

    index: int
    stamp_ns: int
    decode: Callable[..., Pixels]
    frame_id: str = ''
    after_gap: bool = False
    perhaps_after_gap: bool = False
    file: str = ''


@dataclass
class Reading:
    """What happened in one pass over the images.

    images: how many there were, also those that are not frames; complete after the last one.
    """

    warnings: list[Notice] = field(default_factory=list)
    images: int = 0
    undecodable: int = 0
    first_failure: InputError | None = None

    def failed(self, index: int, error: InputError, file: str = '') -> None:
        """Count an image that cannot be decoded."""
        self.undecodable += 1
        where = f'{file}: image {index}' if file else f'image {index}'
        self.first_failure = self.first_failure or InputError(error.code, f'{where}: {error}')

    def summary(self) -> tuple[Notice, ...]:
        """Return all warnings, one line each."""
        if not self.undecodable:
            return tuple(self.warnings)
        return (*self.warnings, Notice(
            'E-IMAGES-UNDECODABLE',
            f'{counted(self.undecodable, "undecodable image")} skipped ({self.first_failure})'))


class FrameSource(ABC):
    """The images of one drive. Iterating yields each Frame in order; it may be repeated.

    name: name of the drive, for messages.
    count: expected number of images (for a progress bar), None if unknown.
    topic: image topic of a bag; None for videos and folders.
    size: (width, height) in pixels if known before the first image, otherwise None. stored_size:
    size of the stored images if their pixels are not square, otherwise None.
    length_ns: length of the drive if its stamps start at 0, otherwise None.
    recorded: the stamps are times of recording, as in a bag. begin_ns: start of the recording,
    None if unknown.
    part: (x, y, width, height) that is used of each image, px; None: all of it.
    warnings: what the user should know about the input, one line each; complete after the last
    frame. contradictions: those that may explain why a drive is not sufficient, with the remedy.

    Frames are read one by one: memory does not grow with the drive. Their stamps always increase.
    Frame.index counts all images of the input, including skipped ones.
    Iterating raises InputError if no image can be decoded or if the image size changes.
    """

    size: tuple[int, int] | None = None
    stored_size: tuple[int, int] | None = None
    length_ns: int | None = None
    recorded = False
    contradictions: tuple[Notice, ...] = ()
    part: tuple[int, int, int, int] | None = None
    _remedy = 'check that another program can play it, or record it again'
    _start_ns = 0
    _duration_ns: int | None = None

    def __init__(self, name: str, count: int | None, topic: str | None = None,
                 warnings: tuple[Notice, ...] = ()) -> None:
        self.name = name
        self.count = self._promised = count
        self.topic = topic
        self._opening_warnings = warnings
        self._reading_warnings: tuple[Notice, ...] = ()

    @property
    def begin_ns(self) -> int | None:
        """Return when the recording began, None where that is not known."""
        return None

    @property
    def warnings(self) -> tuple[Notice, ...]:
        """Return what the user should know, one line each; complete after the last frame."""
        return self.contradictions + self._opening_warnings + self._reading_warnings

    def first_size(self) -> tuple[int, int]:
        """Return (width, height) of whole images as they are stored; reads one where needed."""
        whole = copy.copy(self)
        whole.part = None
        size = self.stored_size or (None if self.part else self.size)
        if size is None:
            with closing(iter(whole)) as frames:
                size = next(frames).size
        return size

    def stored(self, camera: Camera) -> Camera | None:
        """Return a camera of these images for the pictures as they are stored.

        None where that is the same.
        """
        return self._stretched(camera, self.size, self.stored_size)

    def shown(self, camera: Camera) -> Camera:
        """Return the camera of these images, of one for the pictures as they are stored."""
        return self._stretched(camera, self.stored_size, self.size) or camera

    @staticmethod
    def _stretched(camera: Camera, before: tuple[int, int] | None, after: tuple[int, int] | None
                   ) -> Camera | None:
        if before is None or after is None or camera.image_size != before:
            return None
        return camera.resized(after[0] / before[0], after, after[1] / before[1])

    def excerpt(self, start_s: float = 0.0, duration_s: float | None = None) -> FrameSource:
        """Return the part of the drive from start_s on, duration_s long; None: to its end."""
        part = copy.copy(self)
        part._start_ns = round(start_s * 1e9)
        part._duration_ns = None if duration_s is None else round(duration_s * 1e9)
        if self.count and self.length_ns:
            left = max(0, self.length_ns - part._start_ns)
            used = left if part._duration_ns is None else min(left, part._duration_ns)
            part.count = round(self.count * used / self.length_ns) or None
        else:
            part.count = None
        return part

    def cropped(self, left: int, top: int, width: int, height: int) -> FrameSource:
        """Return the same drive, of a part of each image."""
        source = copy.copy(self)
        source.part, source.size, source.stored_size = (left, top, width, height), (
            width, height), None
        return source

    def _cut(self, image: Pixels) -> Pixels:
        if self.part is None:
            return image
        left, top, width, height = self.part
        if (min(left, top) < 0 or min(width, height) < 1 or left + width > image.shape[1]
                or top + height > image.shape[0]):
            raise InputError('E-CROP-OUTSIDE',
                             f'{left},{top},{width},{height} is not a part of a picture of '
                             f'{image.shape[1]}x{image.shape[0]}; write X,Y,W,H in px: the top '
                             f'left corner of the part, and its size')
        return image[top:top + height, left:left + width].copy()

    def __iter__(self) -> Generator[Frame, None, None]:
        reading = Reading()
        try:
            yield from self._frames(reading)
        except OSError as error:
            raise os_error(Path(self.name), error) from error
        finally:
            self._reading_warnings = reading.summary()

    def in_colour(self, stamps_ns: Mapping[int, int]) -> dict[int, Pixels]:
        """Return images by their index, read again: (h, w, 3) BGR uint8, (h, w) of grey ones.

        stamps_ns: theirs, by index. What cannot be read again is left out.
        """
        found: dict[int, Pixels] = {}
        wanted = sorted(stamps_ns)
        # where stamps are counted from 0, the way to an image is short
        starts = ([(stamps_ns[index] - CLOSE_NS, index) for index in wanted]
                  if self.length_ns is not None else [(0, index) for index in wanted[-1:]])
        for start_ns, last in starts:
            with suppress(InputError, OSError), closing(
                    self._pictures(Reading(), max(0, start_ns))) as pictures:
                for picture in pictures:
                    if picture.index in stamps_ns:
                        found[picture.index] = self._cut(picture.decode(colour=True))
                    if picture.index >= last:
                        break
        return found

    def _frames(self, reading: Reading) -> Iterator[Frame]:
        size: tuple[int, int] | None = None
        after_gap = perhaps = False
        with closing(self._excerpted(reading)) as pictures:
            for picture in pictures:
                after_gap |= picture.after_gap
                perhaps |= picture.perhaps_after_gap
                try:
                    image = self._cut(picture.decode())
                except InputError as error:
                    reading.failed(picture.index, error, picture.file)
                    continue
                frame = Frame(picture.index, picture.stamp_ns, image, picture.frame_id, after_gap,
                              perhaps)
                size = size or frame.size
                if frame.size != size:
                    raise InputError(
                        'E-IMAGE-SIZE-CHANGES', f'{picture.file or self.name}: image '
                        f'{frame.index} has {size_text(frame.size)} pixels and the images before '
                        f'it have '
                        f'{size_text(size)}: a calibration is valid for one image size; split '
                        f'the drive there')
                after_gap = perhaps = False
                yield frame
        if size is None:
            raise self._no_image(reading)

    def _excerpted(self, reading: Reading) -> Generator[Picture, None, None]:
        first_ns: int | None = None
        with closing(self._pictures(reading, self._start_ns)) as pictures:
            for picture in pictures:
                first_ns = picture.stamp_ns if first_ns is None else first_ns
                passed = picture.stamp_ns - first_ns
                if self._duration_ns is not None and passed >= self._duration_ns:
                    return
                yield picture

    def _no_image(self, reading: Reading) -> InputError:
        if self._start_ns and not reading.undecodable and not reading.warnings:
            return InputError('E-INPUT-START-LATE', f'{self.name} has no image from '
                              f'{self._start_ns / 1e9:g} s on: use a smaller --start')
        # what is wrong with an image has a remedy of its own
        if failure := reading.first_failure:
            return InputError(failure.code, f'{self.name} has no readable image ({failure})')
        why = '; '.join(map(str, reading.warnings))
        return InputError('E-INPUT-NO-IMAGES', f'{self.name} has no readable image'
                          f'{f" ({why})" if why else ""}: {self._remedy}')

    @abstractmethod
    def _pictures(self, reading: Reading, start_ns: int = 0) -> Generator[Picture, None, None]:
        """Yield every image once, in order; add warnings and the number of images to reading.

        start_ns: what is earlier, counted from the drive's first image, is left out.
        """
