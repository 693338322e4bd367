# SPDX-License-Identifier: Apache-2.0
"""The kinds of inputs: open_frames() finds what its paths are, and joins several.

Nothing here loads OpenCV or rosbags before a drive is opened: `--help` stays quick.
"""
from __future__ import annotations

import glob
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from itertools import groupby, pairwise, zip_longest
from numbers import Real
from pathlib import Path

from dashcalib_ros.errors import InputError, Notice, counted
from dashcalib_ros.input.source import (
    IMAGE_SUFFIXES,
    METADATA,
    FrameSource,
    Picture,
    Reading,
    by_name,
    cameras_named,
    first_of,
    is_bag_file,
    os_error,
    size_text,
)
from dashcalib_ros.limits import check_file, path_of

# what is known by its name, where its content does not tell; not whatever FFmpeg takes: it would
# play a text file
VIDEO_SUFFIXES = frozenset(
    ('.mp4', '.m4v', '.mov', '.avi', '.mkv', '.webm', '.ts', '.mts', '.m2ts', '.mpg', '.mpeg',
     '.wmv', '.flv', '.3gp', '.ogv', '.mjpg', '.mjpeg', '.h264', '.264', '.h265', '.265', '.hevc',
     '.insv', '.360', '.asf', '.m2t', '.mod', '.vob'))
# how files begin that are bags, and videos
BAG_MARKS = re.compile(rb'\x89MCAP0\r\n|SQLite format 3\0|#ROSBAG V2')
VIDEO_MARKS = re.compile(
    # MP4 and QuickTime, but for pictures and sound
    rb'....(?:ftyp(?!heic|heix|mif1|avif|crx |M4A |M4B )|moov|mdat|wide)'
    rb'|RIFF....AVI |\x1aE\xdf\xa3|OggS|FLV\x01|\0\0\x01\xba'
    rb'|0&\xb2u\x8ef\xcf\x11'  # Windows Media
    rb'|(?:....)?(?:G.{187}){2}G|....(?:G.{191}){2}G',  # transport streams
    re.DOTALL)
MARK_BYTES = 400
# small copies that cameras leave beside their videos
PREVIEWS = re.compile(r'LRV_.*|.*\.(?:LRV|LRF)', re.IGNORECASE)

# how makers name what one camera records, without the ending: t is the time or the number of a
# recording, n of its part, c which camera of several it is; GX010001, GX020001, GX010002
MAKERS = {maker: re.compile(name, re.IGNORECASE) for maker, name in (
    ('GoPro names', r'G(?:OPR|[HXSP](?P<n>\d\d))(?P<t>\d{4})(?P<c>)'),
    ('DJI names', r'DJI_(?P<t>(?:\d{14})?)_?(?P<n>\d{4})(?P<c>).*'),
    ('Garmin names', r'GRMN(?P<t>)(?P<n>\d+)(?P<c>)'),
    ('Viofo names', r'(?P<t>\d{4}_?\d{4}_?\d{6})_(?P<n>\d{3,6})P?(?P<c>[A-Z]?)'),
    ('BlackVue names', r'(?P<t>\d{8}_\d{6})(?P<n>)_[A-Z](?P<c>[A-Z])[LS]?'),
    ('Insta360 names', r'(?:PRO_)?VID_(?P<t>\d{8}_\d{6})_(?P<c>\d\d)_(?P<n>\d+)(?:_\d+)?'),
    ('Vantrue names', r'(?P<t>\d{8}_\d{6})_(?P<n>\d+)_(?:[A-Z]_)?(?P<c>[ABC])'))}
# names of files in a message; of more only the first and the last are named
LISTED = 12
# missing files for each that is there, where they are numbered one by one
MOST_MISSING = 3


Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


def open_frames(path: Paths, *, topic: str | None = None, fps: float | None = None,
                start_s: float = 0.0, duration_s: float | None = None,
                stamps: str | os.PathLike[str] | None = None) -> FrameSource:
    """Open a recorded drive. The kind of input is detected from the content of the files.

    path: a ROS 2 bag (folder, .mcap, .db3, with or without zstd), a ROS 1 .bag, a video file, or a
    folder of images, ordered by time or name (2.png before 10.png). Several of these are one drive
    of one camera: a sequence, in its own order, or a folder of videos or bags, or a pattern
    (drives/*.mp4). The files of a folder or a pattern are ordered by the naming rule of the
    camera's maker, otherwise by time of recording, otherwise by name; a warning states which rule
    was used. So is a sequence in alphabetical order, as shells list it: 10.mp4, 2.mp4. A turn
    spans two files only if the second one continues the first one. A file that cannot be read is
    skipped, with a warning.
    topic: the image topic of a bag, needed only if the bag has several; or the number of a stream
    of a video ('2').
    fps: image rate in Hz, of a folder without times (default 10), or instead of a video's stamps.
    start_s, duration_s: part of the drive to use, in seconds; None: up to its end.
    stamps: a list of the times of a folder's images; None: it is looked for.

    Raises InputError if there is nothing to read, or if the topic is ambiguous.
    """
    _check_numbers(fps, start_s, duration_s)
    if topic is not None and not isinstance(topic, str):
        raise InputError('E-TOPIC-TYPE', f"topic must be a str, such as '/camera/image_raw' or "
                                         f"'2' for a video's stream, not {topic!r:.80}")
    groups = [_expanded(os.fspath(each)) for each in as_list(path)]
    if not groups:
        raise InputError('E-INPUT-MISSING',
                         'no input was given: pass a bag, a video or a folder of images')
    if stamps is not None:
        source = _with_stamps(groups, topic, fps, path_of(stamps))
    elif len(groups) == 1 and len(groups[0].paths) == 1:
        source = _open_one(groups[0].paths[0], topic, fps)
    else:
        source = _joined(groups, topic, fps)
    return source if not start_s and duration_s is None else source.excerpt(start_s, duration_s)


def _with_stamps(groups: Sequence[_Group], topic: str | None, fps: float | None, stamps: Path
                 ) -> FrameSource:
    from dashcalib_ros.input.folder import FolderSource
    places = [path for group in groups for path in group.paths]
    if len(places) != 1 or _opener_of(places[0]) is not FolderSource:
        raise InputError('E-STAMPS-NO-FOLDER', '--stamps is for one folder of images: bags and '
                                               'videos have their own; omit it')
    return FolderSource(places[0], topic, fps, stamps)


def as_list(path: Paths) -> list[str | os.PathLike[str]]:
    """Return the paths of a drive. Raises InputError for what is not a path."""
    given = ([path] if isinstance(path, (str, os.PathLike)) else
             list(path) if isinstance(path, Iterable) else [path])
    for each in given:
        path_of(each, 'pass a bag, a video, a folder of images, or a list of these')
    return given


def _check_numbers(fps: float | None, start_s: float, duration_s: float | None) -> None:
    if fps is not None and not (_is_number(fps) and 0 < fps <= 1000):
        raise InputError('E-INPUT-FPS', f'fps must be a number greater than 0 and at most 1000 '
                                        f'(Hz), not {fps!r:.80}')
    if not (_is_number(start_s) and start_s >= 0):
        raise InputError('E-INPUT-START',
                         f'the start must be a number of seconds from 0 on, not {start_s!r:.80}')
    if duration_s is not None and not (_is_number(duration_s) and duration_s > 0):
        raise InputError('E-INPUT-DURATION', f'the duration must be a number of seconds greater '
                                             f'than 0, not {duration_s!r:.80}')


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True)
class _Group:
    """The recordings that an argument names, by name; others: how many files are none."""

    where: str
    paths: list[Path]
    others: int = 0


def _expanded(text: str) -> _Group:
    _check_recorded(text)
    path = Path(text)
    try:
        if path.is_dir():
            return _in_folder(path)
    except OSError as error:
        raise os_error(path, error) from error
    if path.exists() or not glob.has_magic(text):
        return _Group(text, [path])
    found = sorted(named_like(text), key=lambda each: by_name(str(each)))
    known = _without_previews([each for each in found if _opener_of(each) is not None])
    if not known:
        raise (_unknown(found[0]) if found else
               InputError('E-INPUT-NO-MATCH', f'no file matches {text}: check the pattern'))
    return _Group(text, known, len(found) - len(known))


def _without_previews(paths: list[Path]) -> list[Path]:
    return [each for each in paths if not PREVIEWS.fullmatch(each.name)] or paths


def named_like(pattern: str) -> Iterator[Path]:
    """Yield what a pattern names, nothing hidden. ** follows no links: some lead upwards."""
    path = Path(pattern)
    try:
        for found in Path(path.anchor or '.').glob(str(path.relative_to(path.anchor))):
            if not any(map(_is_hidden, found.parts)) or any(map(_is_hidden, path.parts)):
                yield found
    except ValueError as error:
        raise InputError('E-INPUT-PATTERN',
                         f'{pattern} is not a valid pattern ({error}): correct it'
                         ) from error


def _is_hidden(part: str) -> bool:
    return part.startswith('.') and part not in ('.', '..')


def _in_folder(folder: Path) -> _Group:
    """Return a bag or a folder of images itself, or else the videos and bags that are in it."""
    if fits_bag(folder):
        return _Group(str(folder), [folder])
    entries = sorted(folder.iterdir(), key=lambda each: by_name(each.name))
    images = sum(map(_has_image_name, entries))
    found = _without_previews([
        each for each in entries if not (each.name.startswith('.') or _has_image_name(each))
        and (is_video(each) or (each.is_dir() and fits_bag(each)))])
    # cameras leave thumbnails beside their videos
    if not found or images > len(found):
        return _Group(str(folder), [folder])
    return _Group(str(folder), found, images)


def _joined(groups: Sequence[_Group], topic: str | None, fps: float | None) -> FrameSource:
    parts: list[FrameSource] = []
    warnings = [Notice('E-FILES-OTHER',
                       f'{group.where}: {counted(group.others, "other file")} skipped')
                for group in groups if group.others]
    failures: dict[Path, InputError] = {}
    for group in groups:
        opened = []
        for path in group.paths:
            try:
                opened.append(_open_one(path, topic, fps))
            except InputError as error:
                failures[path] = error
        if len(opened) > 1:
            opened, by = _ordered(opened)
            if (cameras := _cameras(opened)) > 1:
                raise InputError('E-INPUT-SEVERAL-CAMERAS', f'{group.where} has recordings of '
                                 f'{cameras} cameras ({_listed(opened)}): use a pattern that '
                                 f'matches the files of one camera')
            warnings.append(Notice(
                'E-FILES-ORDERED',
                f'{group.where}: {len(opened)} files, ordered by {by}: {_listed(opened)}'
                f'{_missing(opened)}'))
        parts += opened
    if len(parts) == len(groups):
        ordered, by = _ordered(sorted(parts, key=lambda each: by_name(each.name)))
        if by not in MAKERS and _as_shells_list(parts) and ordered != parts:
            parts = ordered
            warnings.append(Notice(
                'E-FILES-ORDERED', f'{len(parts)} files in alphabetical order are used ordered by '
                f'{by}: {_listed(parts)}{_missing(parts)}'))
        elif by in MAKERS and ordered != parts:
            warnings.append(Notice(
                'E-FILES-AS-GIVEN',
                f'the files are used in the order of the arguments; ordered by {by} they are '
                f'{_listed(ordered)}: pass their folder for that order'))
    if not parts:
        raise _all_failed(failures)
    skipped = [Notice('E-FILE-SKIPPED', f'one of the files is skipped: {each}')
               for each in failures.values()]
    return JoinedSource(_whole_bags(parts), (*warnings, *skipped))


# a file of a recording that is split: all else of their names is the same
PART_OF_BAG = re.compile(r'(?P<bag>.+)_[0-9]+\.(?:mcap|db3|bag)(?:\.zstd)?')


def _whole_bags(sources: Sequence[FrameSource]) -> list[FrameSource]:
    """Return sources in which files of one recording are one: they may overlap in time."""
    def recording(source: FrameSource) -> tuple[Path, str, str | None] | None:
        place = Path(source.name)
        part = PART_OF_BAG.fullmatch(place.name)
        return (place.parent, part['bag'], source.topic) if part and place.is_file() else None

    whole: list[FrameSource] = []
    for bag, group in groupby(sources, recording):
        parts = list(group)
        if bag is not None and len(parts) > 1:
            from dashcalib_ros.input.bag_storage import BagSource
            bags = [each for each in parts if isinstance(each, BagSource)]
            parts = [bags[0].with_more(bags[1:])] if len(bags) == len(parts) else parts
        whole += parts
    return whole


def _all_failed(failures: dict[Path, InputError]) -> InputError:
    reasons: dict[str, list[Path]] = {}
    for path, error in failures.items():
        words = str(error).replace(str(path), '').replace(path.name, '')
        reasons.setdefault(words, []).append(path)
    lines = [f'{failures[path]}{f" (the same for {more})" if more else ""}'
             for path, *rest in reasons.values() for more in [_names(rest)]]
    first = next(iter(failures.values()))
    return InputError(first.code, f'none of the files can be read: {"; ".join(lines)}')


def _as_shells_list(sources: Sequence[FrameSource]) -> bool:
    """Tell whether files are in alphabetical order, where numbers in their names tell another."""
    names = [source.name for source in sources]
    return names == sorted(names) != sorted(names, key=by_name)


def _ordered(sources: list[FrameSource]) -> tuple[list[FrameSource], str]:
    maker, *others = {_numbered(source)[0] for source in sources}
    if maker and not others:
        return sorted(sources, key=_numbered), maker
    begins = {source.name: source.begin_ns or 0 for source in sources}
    if 0 not in begins.values() and len(set(begins.values())) == len(sources):
        return sorted(sources, key=lambda each: begins[each.name]), 'the time of recording'
    return sources, 'name'


def _numbered(source: FrameSource) -> tuple[str, str, int, str]:
    """Return the maker by whose rule a recording is named, and its t, n and c."""
    for maker, name in MAKERS.items():
        if found := name.fullmatch(Path(source.name).stem):
            return (maker, found['t'].replace('_', ''), int(found['n'] or 0), found['c'].upper())
    return '', '', 0, ''


def _cameras(sources: Sequence[FrameSource]) -> int:
    by_maker = {camera for *_, camera in map(_numbered, sources)}
    return max(len(by_maker), cameras_named([source.name for source in sources]))


def _listed(sources: Sequence[FrameSource]) -> str:
    return _names([Path(source.name) for source in sources])


def _names(paths: Sequence[Path]) -> str:
    names = _told_apart(paths)
    return ', '.join(names if len(names) <= LISTED else [*names[:LISTED - 2], '...', names[-1]])


def _told_apart(paths: Sequence[Path]) -> list[str]:
    """Return the names of files; where some have the same, those of the folders that differ."""
    names = [path.name for path in paths]
    if len(set(paths)) != len(paths) or len(set(names)) == len(names):
        return names
    parts = [path.parts for path in paths]
    while len({each[-1] for each in parts}) == 1:
        parts = [each[:-1] for each in parts]
    while len({each[0] for each in parts}) == 1:
        parts = [each[1:] for each in parts]
    return ['/'.join(each) for each in parts]


def _missing(sources: Sequence[FrameSource]) -> str:
    parts = [re.split('([0-9]+)', name)
             for name in _told_apart([Path(source.name) for source in sources])]
    differ = [n for n, column in enumerate(zip_longest(*parts)) if len(set(column)) > 1]
    if len(differ) != 1 or differ[0] % 2 == 0:
        return ''
    place, digits = differ[0], parts[0][differ[0]]
    numbers = sorted(int(each[place]) for each in parts)
    steps = {b - a for a, b in pairwise(numbers)}
    absent = numbers[-1] - numbers[0] + 1 - len(numbers)
    if not 0 < absent <= MOST_MISSING * len(numbers) or (len(steps) == 1 and len(numbers) > 2):
        return ''  # numbers that are times, or every tenth
    width = len(digits) if digits.startswith('0') else 0
    names = [''.join([*parts[0][:place], f'{n:0{width}d}', *parts[0][place + 1:]])
             for n in range(numbers[0], numbers[-1]) if n not in numbers]
    return f'; missing: {first_of(names, LISTED)}'


def _open_one(place: Path, topic: str | None, fps: float | None) -> FrameSource:
    try:
        if not place.is_dir():
            check_file(place)
            if place.stat().st_size == 0:
                raise InputError('E-FILE-EMPTY', f'{place} is empty, because the recording or the '
                                 f'copy failed: record or copy it again')
            with place.open('rb'):
                pass  # a missing permission is reported in our own words
        opener = _opener_of(place)
        if opener is None:
            raise _unknown(place)
        return opener(place, topic, fps)
    except OSError as error:
        raise os_error(place, error) from error


def _opener_of(path: Path) -> Callable[[Path, str | None, float | None], FrameSource] | None:
    """Return what opens a kind of input; a folder with a bag in it is not a folder of images."""
    if fits_bag(path):
        from dashcalib_ros.input.bag_storage import BagSource
        return BagSource
    if is_video(path):
        from dashcalib_ros.input.video import VideoSource
        return VideoSource
    if path.is_dir():
        from dashcalib_ros.input.folder import FolderSource
        return FolderSource
    return None


def fits_bag(path: Path) -> bool:
    """Return whether a path is a bag: by what is in the folder or the file, else by its name."""
    if path.is_dir():
        return any(entry.name == METADATA
                   or (is_bag_file(entry.name) and entry.is_file())
                   for entry in path.iterdir())
    head = _head(path)
    return bool(BAG_MARKS.match(head)) or (is_bag_file(path.name) and not VIDEO_MARKS.match(head))


def is_video(path: Path) -> bool:
    """Return whether a path is a video: by what is in the file, else by its name."""
    if path.is_dir():
        return False
    head = _head(path)
    return bool(VIDEO_MARKS.match(head)) or (
        path.suffix.lower() in VIDEO_SUFFIXES and not BAG_MARKS.match(head))


def _head(path: Path) -> bytes:
    with suppress(OSError, ValueError):
        if path.is_file():
            with path.open('rb') as file:
                return file.read(MARK_BYTES)
    return b''


def _has_image_name(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES


def _check_recorded(text: str) -> None:
    if re.match(r'[a-z][a-z0-9+.-]+://', text, re.IGNORECASE):
        raise InputError(
            'E-INPUT-STREAM', f'{text} is a stream: record it first (ffmpeg -i {text} -c copy -t '
            f'900 drive.mp4) and pass that file, or publish it in ROS and run the node (ros2 run '
            f'dashcalib_ros calibrator)')
    if re.match(r'/dev/video\d', text):
        raise InputError(
            'E-INPUT-LIVE-CAMERA', f'{text} is a live camera: record it first (ffmpeg -f v4l2 -i '
            f'{text} -t 900 drive.mp4) and pass that file, or run v4l2_camera and the node (ros2 '
            f'run dashcalib_ros calibrator)')


def _unknown(path: Path) -> InputError:
    if _has_image_name(path):
        return InputError('E-INPUT-SINGLE-IMAGE', f'{path} is a single image: pass the folder of '
                          f'all images of the drive')
    return InputError('E-INPUT-UNKNOWN', f'{path} is not a recorded drive: pass a bag (.mcap, '
                      f'.db3, .bag), a video (.mp4, .avi, .mkv ...) or a folder of images')


# a later recording that begins within this goes on with the one before; split bags do
CONTINUES_NS = 1_000_000_000
# ns; the step to the next file after one with a single image
STEP_NS = 100_000_000


class JoinedSource(FrameSource):
    """The images of several sources, one after the other; index and stamps go on.

    No video or folder tells whether it follows the one before without a loss: each begins perhaps
    after a gap (Frame.perhaps_after_gap), and its stamps go on as if there was none. A bag's
    stamps are kept where they are later than those before; they tell where there is a gap.

    A source that cannot be read is left out, with a warning. Raises InputError where two that
    tell their size have different ones.
    """

    def __init__(self, parts: Sequence[FrameSource], warnings: tuple[Notice, ...] = ()) -> None:
        self._parts = tuple(parts)
        first = self._parts[0]
        sized = [(part.name, part.size) for part in self._parts if part.size is not None]
        for name, size in sized:
            if size != sized[0][1]:
                raise InputError(
                    'E-IMAGE-SIZE-CHANGES',
                    f'{name} has {size_text(size)} pixels and {sized[0][0]} has '
                    f'{size_text(sized[0][1])}: a calibration is valid for one image size; '
                    f'calibrate each size separately')
        if sized and len(stored := {part.stored_size for part in self._parts}) == 1:
            self.size, [self.stored_size] = sized[0][1], stored
        counts = [part.count for part in self._parts]
        lengths = [part.length_ns for part in self._parts]
        super().__init__(
            first.name + (f' and {len(self._parts) - 1} more' if len(self._parts) > 1 else ''),
            None if None in counts else sum(filter(None, counts)), first.topic,
            (*warnings, *_together([(part.name, part.warnings) for part in self._parts])))
        self.contradictions = tuple(dict.fromkeys(
            line for part in self._parts for line in part.contradictions))
        self.length_ns = None if None in lengths else sum(filter(None, lengths))
        self.recorded = first.recorded

    @property
    def begin_ns(self) -> int | None:
        """Return when the first recording began, None where that is not known."""
        return self._parts[0].begin_ns

    def _pictures(self, reading: Reading, start_ns: int = 0) -> Generator[Picture, None, None]:
        place = _Place(start_ns)
        by_part = []
        for part in self._parts:
            inner = Reading()
            try:
                with closing(place.pictures(part, inner)) as pictures:
                    yield from pictures
            except (InputError, OSError) as error:
                reading.warnings.append(Notice(
                    'E-FILE-SKIPPED',
                    f'{part.name} is skipped from image {inner.images} on: {error}'))
            by_part.append((part.name, inner.summary()))
            place.index += inner.images
        reading.images = place.index
        reading.warnings += _together(by_part)


class _Place:
    """Where the next source begins in the drive: index of its first image, and its time in ns.

    start_ns: of the excerpt, from the drive's first image on.
    """

    def __init__(self, start_ns: int) -> None:
        self.index = 0
        self._start_ns = start_ns
        self._first_ns: int | None = None
        self._next_ns = self._last_ns = 0
        self._recorded = False

    def pictures(self, part: FrameSource, reading: Reading) -> Generator[Picture, None, None]:
        left_ns = 0
        if not part.recorded:  # then it follows directly
            self._first_ns = self._next_ns if self._first_ns is None else self._first_ns
            left_ns = max(0, self._start_ns - (self._next_ns - self._first_ns))
        if part.length_ns is not None and part.length_ns <= left_ns:
            reading.images = part.count or 0
            self._next_ns += part.length_ns
            self._recorded = False
            return
        before: int | None = None
        with closing(part._pictures(reading, left_ns)) as pictures:
            for picture in pictures:
                if before is None:
                    shift_ns, gap, perhaps = self._joint(part, picture.stamp_ns)
                    before = picture.stamp_ns - STEP_NS
                stamp_ns = picture.stamp_ns + shift_ns
                self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
                self._last_ns = stamp_ns
                self._next_ns = stamp_ns + picture.stamp_ns - before
                before = picture.stamp_ns
                # what a bag has before the start is left out here; it is not decoded yet
                if stamp_ns - self._first_ns >= self._start_ns:
                    yield replace(picture, index=self.index + picture.index, stamp_ns=stamp_ns,
                                  file=part.name, after_gap=gap, perhaps_after_gap=perhaps)
                    gap = perhaps = False
        if before is None:
            self._next_ns += part.length_ns or 0  # all of it was before the excerpt
        self._recorded = part.recorded

    def _joint(self, part: FrameSource, stamp_ns: int) -> tuple[int, bool, bool]:
        """Return what is added to its stamps, whether there is a gap, whether there may be one."""
        if not part.recorded:
            return self._next_ns, False, self.index > 0
        if self.index == 0:
            return 0, False, False
        if not self._recorded:
            return self._next_ns - stamp_ns, False, True
        step_ns = stamp_ns - self._last_ns
        if step_ns > 0:
            return 0, step_ns > CONTINUES_NS, False
        return self._next_ns - stamp_ns, True, False


def _together(by_part: Sequence[tuple[str, Sequence[Notice]]]) -> tuple[Notice, ...]:
    """Return the warnings of all sources; what several say in the same words is said once."""
    first: dict[str, Notice] = {}
    counts: Counter[str] = Counter()
    for name, warnings in by_part:
        for warning in warnings:
            text = str(warning)
            words = text.replace(name, '')
            first.setdefault(words, warning if name in text
                             else Notice(warning.code, f'{name}: {warning}'))
            counts[words] += 1
    return tuple(line if counts[words] == 1 else
                 Notice(line.code, f'{line} (and {counts[words] - 1} more like it)')
                 for words, line in first.items())
