"""A video file as a drive."""
from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
import numpy as np

import dashcalib_ros.frames.quiet  # noqa: F401
from dashcalib_ros.arrays import GreyImage
from dashcalib_ros.errors import InputError
from dashcalib_ros.frames.source import FrameSource, Picture, Reading
from dashcalib_ros.limits import check_pixels


class VideoSource(FrameSource):
    """The pictures of a video file, as a player shows them: turned as its metadata says.

    Stamps are index / rate; fps, if given, replaces the video's own rate.
    Raises InputError for a file that is no video, and for a video without a rate.
    """

    def __init__(self, path: Path, topic: str | None = None, fps: float | None = None) -> None:
        self._path = path
        warnings = [f'{path} is a video: topic {topic} is ignored'] if topic is not None else []
        with _capture(path) as video:
            self._rate = fps or _rate(video, path)
            count = int(max(0.0, min(video.get(cv2.CAP_PROP_FRAME_COUNT), 1e9)))
            turn = int(video.get(cv2.CAP_PROP_ORIENTATION_META))
            self.size = (int(video.get(cv2.CAP_PROP_FRAME_WIDTH)),
                         int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        if turn:
            warnings.append(f'{path} says to turn its pictures by {turn} degrees: '
                            f'the calibration is for the turned pictures')
        super().__init__(str(path), count or None, warnings=tuple(warnings))
        self.length_ns = round(count * 1e9 / self._rate) if count else None

    def _pictures(self, reading: Reading, start_ns: int = 0) -> Generator[Picture, None, None]:
        index = math.ceil(start_ns * self._rate / 1e9)
        reading.images = min(index, self._promised or index)
        with _capture(self._path) as video:
            found = _skip(video, index)
            while found and video.grab():
                reading.images = index + 1
                yield Picture(index, round(index * 1e9 / self._rate), partial(_grey, video))
                index += 1
        if not found:
            return
        # some containers only estimate how many pictures they hold
        if self._promised and index < 0.99 * self._promised - 1:
            reading.warnings.append(
                f'the video is cut off or damaged: read {index} of {self._promised} images; '
                f'{self._promised - index} are lost')


def _skip(video: cv2.VideoCapture, index: int) -> bool:
    """Make the next picture the one with this index; return False where the video ends before."""
    if index == 0:
        return True
    # seeking decodes only what follows the last complete picture before it
    if video.set(cv2.CAP_PROP_POS_FRAMES, index) and video.get(cv2.CAP_PROP_POS_FRAMES) == index:
        return True
    video.set(cv2.CAP_PROP_POS_FRAMES, 0)
    return all(video.grab() for _ in range(index))


def _grey(video: cv2.VideoCapture) -> GreyImage:
    """Return the picture that was grabbed. Raises InputError where it cannot be decoded."""
    found, image = video.retrieve()
    if not found:
        raise InputError('the picture cannot be decoded: convert the video '
                         '(ffmpeg -i IN -c:v libx264 OUT.mp4)')
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    return np.asarray(grey, np.uint8)


def _rate(video: cv2.VideoCapture, path: Path) -> float:
    rate = float(video.get(cv2.CAP_PROP_FPS))
    if not (math.isfinite(rate) and 0 < rate <= 1000):
        raise InputError(f'{path} says {rate:g} images per second: give the rate with --fps')
    return rate


@contextmanager
def _capture(path: Path) -> Iterator[cv2.VideoCapture]:
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not video.isOpened():
            raise InputError(
                f'{path} is no video that can be played, or it is cut off: copy it again, '
                f'or convert it (ffmpeg -i IN -c:v libx264 OUT.mp4)')
        check_pixels(int(video.get(cv2.CAP_PROP_FRAME_WIDTH)),
                     int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)), str(path))
        yield video
    finally:
        video.release()
