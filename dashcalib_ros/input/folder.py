# SPDX-License-Identifier: Apache-2.0
"""The images of a folder as a drive: their order and their times."""
from __future__ import annotations

import re
from bisect import bisect_left
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from itertools import islice, pairwise
from math import nan
from pathlib import Path
from statistics import median

from dashcalib_ros.arrays import Pixels
from dashcalib_ros.errors import InputError, Notice, counted
from dashcalib_ros.input.source import (
    IMAGE_SUFFIXES,
    LAST_NS,
    FrameSource,
    Picture,
    Reading,
    by_name,
    cameras_named,
    first_of,
)
from dashcalib_ros.input.stamps import SECOND_NS
from dashcalib_ros.input.times import (
    DATE,
    LACKING,
    MOSTLY,
    STEPS_NS,
    dated,
    dated_ns,
    in_ns,
    numbers_in,
    paired,
    rising,
    stamps_in,
    unit_of,
)
from dashcalib_ros.limits import (
    CLIP_FILES,
    DIGITS,
    LIST_BYTES,
    PICTURE_BYTES,
    read_file,
    read_lines,
)

DEFAULT_FPS = 10.0  # Hz; the rate the paper works at


class FolderSource(FrameSource):
    """The images of a folder, with their times.

    They are ordered by their times, else by name; numbers in names count as numbers: 2.png before
    10.png. The times are those of a list beside them, or their names, else number / fps.
    Raises InputError for a folder without images.
    """

    def __init__(self, path: Path, topic: str | None = None, fps: float | None = None,
                 stamps: Path | None = None) -> None:
        """stamps: the list of the times; None: one in the folder or beside it."""
        names = [entry.name for entry in path.iterdir()]
        images = sorted(filter(_is_image, names), key=by_name)
        self._path = path
        if not images:
            raise _no_images(path, names)
        if (cameras := cameras_named(images)) > 1:
            raise InputError('E-INPUT-SEVERAL-CAMERAS', f'{path} has images of {cameras} cameras '
                             f'({first_of(images)}): put the images of one camera into a '
                             f'separate folder')
        times = times_of(path, images, fps, stamps)
        self._names, self._stamps_ns = times.names, times.stamps_ns
        self._begin_s, self.recorded = times.begin_s, times.recorded
        warnings = list(times.notices)
        if topic is not None:
            warnings.append(Notice('E-TOPIC-IGNORED', f'{path} is a folder of images: the topic '
                                   f'{topic} is ignored'))
        if turned := self._turned():
            warnings.append(Notice(
                'E-IMAGES-ROTATED', f'{path} has images that are {turned} by their EXIF '
                f'orientation: the calibration is valid for the images as they are shown'))
        super().__init__(str(path), len(self._names), warnings=tuple(warnings))
        if not self.recorded:
            self.length_ns = times.length_ns

    @property
    def begin_ns(self) -> int | None:
        """Return when the first image was taken, None where neither list nor names tell it."""
        return (self._stamps_ns[0] if self.recorded else
                None if self._begin_s is None else self._begin_s * SECOND_NS)

    def _turned(self) -> str:
        from dashcalib_ros.input.decode import turned_text
        with suppress(InputError):  # raised again when it is read
            return turned_text(read_file(self._path / self._names[0], PICTURE_BYTES), '')
        return ''

    def _pictures(self, reading: Reading, start_ns: int = 0) -> Generator[Picture, None, None]:
        from dashcalib_ros.input.decode import BitDepth, decode_file
        depth = BitDepth()
        reading.images = len(self._names)

        def image(name: str, colour: bool = False) -> Pixels:
            return decode_file(read_file(self._path / name, PICTURE_BYTES, name), depth, name,
                               colour)

        for index in range(bisect_left(self._stamps_ns, self._stamps_ns[0] + start_ns),
                           len(self._names)):
            yield Picture(index, self._stamps_ns[index], partial(image, self._names[index]))


def _is_image(name: str) -> bool:
    return Path(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith('.')


def _no_images(path: Path, names: list[str]) -> InputError:
    if not names:
        return InputError('E-FOLDER-EMPTY',
                          f'{path} is empty: pass a folder of images, a bag or a video')
    return InputError('E-FOLDER-NO-IMAGES', f'{path} has no images (png, jpg, bmp, tif, pgm, ppm, '
                      f'webp) and is not a bag: it has {first_of(sorted(names))}; pass the folder '
                      f'or the file with the images')


@dataclass(frozen=True)
class Times:
    """The images of a folder in their order, and their times in ns, rising.

    recorded: as FrameSource's; else they begin at 0, and the drive is length_ns long. begin_s:
    when it began, to the second, where only that is known; s since 1970.
    """

    names: list[str]
    stamps_ns: list[int]
    recorded: bool = False
    length_ns: int = 0
    begin_s: int | None = None
    notices: tuple[Notice, ...] = ()


def times_of(path: Path, names: Sequence[str], fps: float | None, stamps: Path | None = None
             ) -> Times:
    """Return the times of a folder's images.

    names: in their order; fps: that was given, in Hz; stamps: the list to use. Raises InputError
    where its times cannot be assigned.
    """
    stems = [Path(name).stem for name in names]
    listed, unused = _listed(path, names, stems, stamps)
    if stamps is not None and listed is None:
        raise InputError('E-STAMPS-UNUSED', f'{stamps}: its times cannot be assigned to the '
                         f'{len(names)} images of {path}: write a line for each image, its name '
                         f'and its time in seconds')
    named = None if listed is not None and (listed.by_name or stamps) else stamps_in(stems)
    if named is not None and (named.clear or fps is None):
        return _recorded(path, names, named.ns, f'their names, in {named.unit}',
                         'the images', fps)
    if listed is not None:
        return _recorded(path, names, listed.stamps_ns, f'those in {listed.file.name}',
                         listed.file.name, fps)
    notices = [Notice(
        'E-TIMES-UNUSED', f'{path}: {file} is not used, its times cannot be assigned to the '
        f'{len(names)} images: write a line for each image, its name and its time in seconds')
        for file in unused]
    begin_s, rate = _by_the_second(stems)
    if fps is None and rate is not None:
        notices.append(Notice(
            'E-RATE-NAMED', f'{path} has {rate:.4g} images per second by the times in their '
            f'names, and they are taken as evenly spaced: specify another rate with --fps'))
    elif fps is None:
        notices.append(Notice(
            'E-RATE-ASSUMED', f'{path} has no image rate, and {DEFAULT_FPS:g} images per second '
            f'are assumed: specify another rate with --fps'))
    places, counted_out = _places(path, names, numbers_in(stems))
    used = fps or rate or DEFAULT_FPS
    return Times(
        list(names), [round(place * 1e9 / used) for place in places], False,
        round((places[-1] + 1) * 1e9 / used), begin_s, (*notices, *counted_out))


def _recorded(path: Path, names: Sequence[str], stamps_ns: Sequence[int | None], where: str,
              what: str, fps: float | None) -> Times:
    """Return the images that have a time in its order. where, what: it is, for messages."""
    known = sorted(((ns, place) for place, ns in enumerate(stamps_ns) if ns is not None))
    kept = [known[0]] + [b for a, b in pairwise(known) if b[0] > a[0]]
    stamps = [ns for ns, _ in kept]
    step = round(median(b - a for a, b in pairwise(stamps)))
    rate = f'{1e9 / step:.4g} images per second'
    notices = [Notice(
        'E-TIMES-READ', f'{path}: the times of the images are {where} ({rate})')
        if fps is None else Notice(
        'E-FPS-IGNORED', f'{path}: the times of the images are {where} ({rate}), and --fps '
        f'{fps:g} is ignored: rename {what} to use it')]
    if len(kept) < len(names):
        notices.append(Notice(
            'E-IMAGES-UNTIMED', f'{path}: {counted(len(names) - len(kept), "image")} skipped: '
            f'without a time, or with the same time as another one'))
    recorded = stamps[0] != 0
    return Times([names[place] for _, place in kept], stamps, recorded, stamps[-1] + step,
                 notices=tuple(notices))


def _by_the_second(stems: Sequence[str]) -> tuple[int | None, float | None]:
    """Return when names with whole seconds begin, and their images per second; None: unknown."""
    dates = [dated(stem) for stem in stems]
    seconds = [date[0] for date in dates if date is not None]
    if len(seconds) < len(stems):
        return None, None
    # the first and the last second are not complete
    counts = Counter(seconds)
    inner = [counts[second] for second in range(min(counts) + 1, max(counts))
             ] if max(counts) - min(counts) < len(seconds) else []
    return min(counts), sum(inner) / len(inner) if inner and min(inner) > 1 else None


def _places(path: Path, names: Sequence[str], numbers: Sequence[int | None]
            ) -> tuple[Sequence[int], tuple[Notice, ...]]:
    """Return the images' places in an evenly spaced drive: numbers may leave out some."""
    even = range(len(names))
    known = [number for number in numbers if number is not None]
    steps = [b - a for a, b in pairwise(known)]
    if len(known) < len(names) or len(set(steps)) < 2:
        return even, ()
    step, count = Counter(steps).most_common(1)[0]
    if count < MOSTLY * len(steps) or any(each % step for each in steps):
        return even, (Notice(
            'E-NUMBERS-UNEVEN', f'{path}: the numbers in the names rise by {min(steps)} to '
            f'{max(steps)}, and evenly spaced images are assumed: write their times to times.txt '
            f'in this folder, a line for each image with its name and its time in seconds'),)
    lost = [each // step - 1 for each in steps]
    after = names[next(place for place, each in enumerate(lost) if each)]
    return [(number - known[0]) // step for number in known], (Notice(
        'E-IMAGES-MISSING', f'{path}: {counted(sum(lost), "image")} missing by the numbers in the '
        f'names, the first after {after}: their time is kept'),)


# names of lists of times, and of those of other sensors; others that are used name each image
TIMES, OTHERS = (re.compile(words, re.IGNORECASE) for words in (
    r'time|stamp|^(?:data|frames?|images?|rgb|color|colour)$',
    r'imu|gps|gnss|oxts|lidar|velo|depth|odom|pose|radar|events?|ground'))
SUFFIXES = frozenset(('.txt', '.csv', '.tsv', '.times', '.timestamps'))
# headings of columns that are times
TIME_HEADING = re.compile(r'time|stamp|^t$|^sec|^ns', re.IGNORECASE)
NUMBER = re.compile(r'[-+]?\d*[.,]?\d+(?:e[-+]?\d{1,3})?|\d+\.', re.IGNORECASE)
# lists that are looked at
LISTS = 50


@dataclass(frozen=True)
class _List:
    """Times of a folder's images by a file. by_name: it names the images."""

    file: Path
    stamps_ns: Sequence[int | None]
    by_name: bool


def _listed(path: Path, names: Sequence[str], stems: Sequence[str], given: Path | None = None
            ) -> tuple[_List | None, list[str]]:
    """Return the list of the images' times, and those of no use. given: the only one."""
    unused: list[str] = []
    found: list[_List] = []
    numbers = numbers_in(stems)
    for file in islice(_candidates(path), LISTS) if given is None else (given,):
        if given is None and OTHERS.search(file.stem):
            continue
        try:
            table = _Table([_cells(line) for line in
                            islice(read_lines(file, LIST_BYTES), CLIP_FILES)])
        except InputError:
            if given is not None:
                raise
            continue
        naming = table.naming(names, stems, path.name)
        is_times = (bool(TIMES.search(file.stem)) or file.stem == path.name
                    or given is not None)
        if len(table.filled) < 2 or not (is_times or naming):
            continue
        stamps_ns = table.stamps(naming, numbers, is_times)
        if stamps_ns is not None:
            found.append(_List(file, stamps_ns, naming is not None))
        elif is_times and len(names) > 1:
            unused.append(file.name)
    return min(found, key=lambda each: not each.by_name, default=None), unused


def _candidates(path: Path) -> Iterator[Path]:
    for folder in (path, path.resolve().parent):
        with suppress(OSError):
            yield from sorted(each for each in folder.iterdir() if each.suffix.lower() in SUFFIXES
                              and not each.name.startswith('.') and each.is_file())


def _cells(line: str) -> list[str]:
    # a date and its time are one
    line = DATE.sub(lambda found: found[0].replace(' ', 'T'), line.strip().lstrip('#').strip())
    mark = next((each for each in ';\t,' if each in line), None)
    return [cell.strip().strip('"\'') for cell in line.split(mark)] if line else []


def _value(cell: str) -> Decimal | None:
    """Return a number, or a date and time in s since 1970; None for another text."""
    if len(cell) <= DIGITS and NUMBER.fullmatch(cell):
        value = Decimal(cell.replace(',', '.'))
        return value if abs(value) <= LAST_NS else None
    ns = dated_ns(cell)
    return None if ns is None else Decimal(ns).scaleb(-9)


def _whole(value: Decimal | None) -> int | None:
    return None if value is None or value % 1 else int(value)


class _Table:
    """A list's lines as cells; empty ones count, too. heading: of its columns, if there is one."""

    def __init__(self, rows: list[list[str]]) -> None:
        first = next((place for place, row in enumerate(rows)
                      if any(_value(cell) is not None for cell in row)), len(rows))
        # a first line may be empty as its image is missing
        first = first if any(rows[:first]) else 0
        self.rows = rows[first:]
        while self.rows and not self.rows[-1]:
            self.rows.pop()
        self.filled = [row for row in self.rows if row]
        self.width = Counter(map(len, self.filled)).most_common(1)[0][0] if self.filled else 0
        self.heading = next((row for row in rows[first - 1::-1] if len(row) == self.width),
                            []) if first else []

    def column(self, column: int) -> list[str]:
        return [row[column] if len(row) > column else '' for row in self.rows]

    def naming(self, names: Sequence[str], stems: Sequence[str], folder: str
               ) -> list[int | None] | None:
        """Return the line of each image, where a column names them; None where none does."""
        image_of = {text: image for texts in (stems, names) for image, text in enumerate(texts)}
        best: dict[int, int] = {}
        for column in range(self.width):
            found: dict[int, int] = {}
            for line, cell in enumerate(self.column(column)):
                above, _, name = cell.rpartition('/')
                if name in image_of and above.rpartition('/')[2] in ('', '.', folder):
                    found.setdefault(image_of[name], line)
            best = max(best, found, key=len)
        return ([best.get(image) for image in range(len(names))]
                if len(best) >= (1 - LACKING) * len(names) else None)

    def stamps(self, naming: Sequence[int | None] | None, numbers: Sequence[int | None],
               is_times: bool) -> Sequence[int | None] | None:
        """Return the times of the images in ns; None where they are not known.

        naming: as naming() has it; numbers: in the images' names; is_times: by the list's name.
        """
        headed = [column for column, name in enumerate(self.heading) if TIME_HEADING.search(name)]
        for column in headed or range(self.width if is_times or not self.heading else 0):
            values = [_value(cell) for cell in self.column(column)]
            if sum(value is not None for value in values) < (1 - LACKING) * len(self.filled):
                continue
            if not headed and [*map(_whole, values)] == [*numbers]:
                continue
            read = in_ns(values, unit_of(self.heading[column]) if headed else
                         'seconds' if dated(self.filled[0][column]) else '')
            stamps_ns = None if read is None else (
                [None if line is None else read.ns[line] for line in naming] if naming
                else self._by_number(read.ns, numbers))
            if stamps_ns is not None and _is_drive(stamps_ns):
                kept = set(rising([nan if ns is None else ns for ns in stamps_ns]))
                if naming and headed:
                    return stamps_ns
                if len(kept) >= (1 - LACKING) * len(stamps_ns):
                    return [ns if place in kept else None for place, ns in enumerate(stamps_ns)]
        return None

    def _by_number(self, lines: Sequence[int | None], numbers: Sequence[int | None]
                   ) -> Sequence[int | None] | None:
        for column in range(self.width):
            line_of = {int(cell): line for line, cell in enumerate(self.column(column))
                       if cell.isdecimal() and len(cell) <= DIGITS}
            if len(line_of) == len(self.filled) and set(numbers) <= line_of.keys():
                return [lines[line_of[number]] for number in numbers if number is not None]
        return paired(numbers, lines)


def _is_drive(stamps_ns: Sequence[int | None]) -> bool:
    known = sorted(ns for ns in stamps_ns if ns is not None)
    steps = [b - a for a, b in pairwise(known)]
    return (bool(steps) and len(known) >= (1 - LACKING) * len(stamps_ns)
            and STEPS_NS[0] <= median(steps) <= STEPS_NS[1])
