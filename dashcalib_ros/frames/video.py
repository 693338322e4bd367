"""A video file as a drive."""
from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

import dashcalib_ros.frames.quiet  # noqa: F401
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
        if turn:
            warnings.append(f'{path} says to turn its pictures by {turn} degrees: '
                            f'the calibration is for the turned pictures')
        super().__init__(str(path), count or None, warnings=tuple(warnings))

    def _pictures(self, reading: Reading) -> Iterator[Picture]:
        index = 0
        with _capture(self._path) as video:
            while True:
                found, image = video.read()
                if not found:
                    break
                grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
                yield index, round(index * 1e9 / self._rate), np.asarray(grey, np.uint8), ''
                index += 1
        # some containers only estimate how many pictures they hold
        if self.count and index < 0.99 * self.count - 1:
            reading.warnings.append(
                f'the video is cut off or damaged: read {index} of {self.count} images; '
                f'{self.count - index} are lost')


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
