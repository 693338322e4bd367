"""The table of input kinds; open_frames() finds the kind of a path.

Nothing here loads OpenCV or rosbags before a drive is opened: `--help` stays quick.
"""
from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dashcalib_ros.bags.names import METADATA, is_bag_file
from dashcalib_ros.errors import InputError
from dashcalib_ros.frames.source import IMAGE_SUFFIXES, FrameSource, os_error
from dashcalib_ros.limits import check_file, irregular_entry

# not whatever FFmpeg takes: it would play a text file
VIDEO_SUFFIXES = frozenset(
    ('.mp4', '.m4v', '.mov', '.avi', '.mkv', '.webm', '.ts', '.mts', '.m2ts', '.mpg', '.mpeg',
     '.wmv', '.flv', '.3gp', '.ogv', '.mjpg', '.mjpeg', '.h264', '.264', '.h265', '.265', '.hevc'))


def open_frames(path: str | os.PathLike[str], topic: str | None = None,
                fps: float | None = None) -> FrameSource:
    """Open a drive; its path tells the kind of input.

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
        if not place.is_dir():
            _check_readable(place)
        kind = next((kind for kind in KINDS if kind.fits(place)), None)
        if kind is None:
            raise InputError(_unknown(place))
        return kind.open(place, topic, fps)
    except OSError as error:
        raise InputError(os_error(place, error)) from error


@dataclass(frozen=True)
class InputKind:
    """A kind of input: fits() decides by the path, open() returns the images.

    open: takes the path, the topic and the rate, as open_frames() does; loads its libraries.
    """

    name: str
    fits: Callable[[Path], bool]
    open: Callable[[Path, str | None, float | None], FrameSource]


def _fits_bag(path: Path) -> bool:
    if path.is_dir():
        return any(entry.name == METADATA
                   or (is_bag_file(entry.name) and not irregular_entry(entry))
                   for entry in path.iterdir())
    return is_bag_file(path.name)


def _open_bag(path: Path, topic: str | None, fps: float | None) -> FrameSource:
    from dashcalib_ros.bags.source import BagSource
    return BagSource(path, topic, fps)


def _open_video(path: Path, topic: str | None, fps: float | None) -> FrameSource:
    from dashcalib_ros.frames.video import VideoSource
    return VideoSource(path, topic, fps)


def _open_folder(path: Path, topic: str | None, fps: float | None) -> FrameSource:
    from dashcalib_ros.frames.folder import FolderSource
    return FolderSource(path, topic, fps)


#: the first that fits is taken: a folder with a bag in it is no folder of images
KINDS = (
    InputKind('bag', _fits_bag, _open_bag),
    InputKind('video', lambda path: path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir(),
              _open_video),
    InputKind('folder of images', Path.is_dir, _open_folder),
)


def _check_readable(path: Path) -> None:
    """Raise InputError or OSError for a file that no reader can open, with our own message."""
    check_file(path)
    if path.stat().st_size == 0:
        raise InputError(f'{path} is empty: the recording or the copy failed; make it again')
    with path.open('rb'):
        pass


def _unknown(path: Path) -> str:
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return f'{path} is a single image: give the folder of all images of the drive'
    return (f'{path} is no kind of drive known here: give a bag (.mcap, .db3, .bag), '
            f'a video (.mp4, .avi, .mkv ...) or a folder of images')
