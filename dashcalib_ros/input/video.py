# SPDX-License-Identifier: Apache-2.0
"""A video file as a drive."""
from __future__ import annotations

import errno
import os
import struct
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from functools import partial
from itertools import islice
from pathlib import Path

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from av.video.reformatter import ColorRange, VideoReformatter

from dashcalib_ros.arrays import Pixels
from dashcalib_ros.errors import InputError, Notice, shortened
from dashcalib_ros.input.source import FrameSource, Picture, Reading, size_text
from dashcalib_ros.input.stamps import SECOND_NS, StampGate
from dashcalib_ros.limits import check_pixels

# FFmpeg's names; it would also play text, and scripts that name other files
FORMATS = 'mov,matroska,avi,mpegts,mpeg,mpegvideo,asf,flv,ogg,mjpeg,h264,hevc,m4v'
# FFmpeg's flag of files that have no clock: the times that it gives are made up
NO_TIMES = 0x80
# what follows the decoder is slower than four of its threads; each holds pictures
THREADS = min(4, os.cpu_count() or 1)
# pictures at the beginning whose times tell the rate; one of them can be decoded
LOOKED_AT = 100
# of an MP4 that are looked at: it has some five, and a fragmented one begins with its index
BOXES = 1000
# of the rate that the video says, by which --fps may be off
ALIKE = 0.02
# of the pictures that a video promises, by its length and its rate or by their number
COMPLETE = 0.9, 0.99

# of the two sides of a pixel; DVRs leave out every second row or column
MOST_STRETCH = 4.0
# what the shape of a picture leaves of square pixels, as sizes are whole numbers
ALMOST_SQUARE = 0.02
SQUARE = (1.0, 1.0)
# FFmpeg's flags of a stream of pictures that is not a video
THUMBNAILS = int(Disposition.attached_pic | Disposition.timed_thumbnails)

# luma of television's range, 16 to 235 -> 0 to 255
FULL = np.clip(np.rint((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)


class VideoSource(FrameSource):
    """The pictures of a video file, as a player shows them: turned and stretched as it says.

    topic: the number of the stream, where it has several; None: the one that players take. Stamps
    are the pictures' own times, counted from the first one; with fps they are index / fps.
    Raises InputError for a file that is not a video, and for one without time stamps or fps.
    """

    def __init__(self, path: Path, topic: str | None = None, fps: float | None = None) -> None:
        self._path, self._fps = path, fps
        self._stream, warnings = _chosen(path, topic)
        with _opened(path, self._stream) as (container, stream):
            timed = not container.format.flags & NO_TIMES
            if not (fps or timed):
                raise InputError('E-VIDEO-NO-TIMES',
                                 f'{path} has no time stamps: specify its rate '
                                 f'with --fps')
            first, times = None, []
            for packet in islice(_packets(container, stream), LOOKED_AT):
                times.append(_time_ns(packet))
                first = first or next(filter(None, _decoded(packet)), None)
            if first is None:
                raise _unplayable(path)
            turn = -first.rotation % 360
            self._stretch = _stretch(stream, path, warnings)
            self.size, stored = (each[::-1] if turn % 180 else each for each in (
                _stretched(first, self._stretch), (first.width, first.height)))
            self._first_ns = _time_ns(first) or 0
            rate = _rate([time for time in times if time is not None]) if timed else 0.0
            length_s = _length_s(container, stream) if timed else 0.0
            count = stream.frames or round(length_s * rate) or None
            self._complete = COMPLETE[bool(stream.frames)]
            self._created = container.metadata.get('creation_time', '')
        if self.size != stored:
            self.stored_size = stored
            warnings.append(Notice(
                'E-PIXELS-NOT-SQUARE', f'{path} has pixels that are not square: its images of '
                f'{size_text(stored)} pixels are scaled to {size_text(self.size)}, as players '
                f'show them'))
        if turn:
            warnings.append(Notice(
                'E-IMAGES-ROTATED', f'{path} has a rotation flag of {turn} degrees: the '
                f'calibration is valid for the rotated images'))
        super().__init__(str(path), count, warnings=tuple(warnings))
        if fps and rate and abs(fps / rate - 1) > ALIKE:
            self.contradictions = (Notice(
                'E-INPUT-CONTRADICTED',
                f'{path} has {rate:.4g} images per second, but --fps {fps:g} replaces its time '
                f'stamps', 'omit --fps unless the time stamps are wrong'),)
        self.length_ns = round(((count or 0) / fps if fps else length_s) * 1e9) or None

    @property
    def begin_ns(self) -> int | None:
        """Return when the file says that it was recorded, None where it does not."""
        try:
            created = datetime.fromisoformat(self._created.replace('Z', '+00:00'))
        except ValueError:
            return None
        # a camera whose clock was never set begins in 1904, 1970 or 2000
        return None if created.year <= 2000 else round(created.timestamp()) * SECOND_NS

    def _pictures(self, reading: Reading, start_ns: int = 0) -> Generator[Picture, None, None]:
        gate, picture = StampGate(), FramePicture(self._stretch)
        read, index = self._before(start_ns) if start_ns else (0, 0)
        reading.images = index
        with _opened(self._path, self._stream) as (container, stream):
            for packet in islice(_packets(container, stream), read, None):
                read += packet.size > 0  # the last one has nothing in it
                for frame in _decoded(packet):
                    stamp_ns = self._stamp_ns(_time_ns(frame), index) if frame else None
                    index += 1
                    reading.images = index
                    if frame is None or stamp_ns is None:
                        reading.failed(index - 1, _undecodable())
                        continue
                    # later by a second, as the gate takes 0 for no stamp
                    stamp_ns = gate.take(stamp_ns + SECOND_NS, 0)
                    if stamp_ns is not None and stamp_ns - SECOND_NS >= start_ns:
                        yield Picture(index - 1, stamp_ns - SECOND_NS, partial(picture, frame))
        reading.warnings += gate.warnings()
        promised = self._promised or 0
        if read < self._complete * promised - 1:
            reading.warnings.append(Notice(
                'E-VIDEO-TRUNCATED', f'the video is truncated or damaged: {read} of {promised} '
                f'images were read, {promised - read} are lost'))

    def _stamp_ns(self, time_ns: int | None, index: int) -> int | None:
        if self._fps:
            return round(index * 1e9 / self._fps)
        return None if time_ns is None else time_ns - self._first_ns

    def _before(self, start_ns: int) -> tuple[int, int]:
        """Return how many packets, and how many pictures, may be skipped: nothing is decoded.

        They end at a picture that needs none before it. A seek would not tell the index.
        """
        skipped = index = shown = 0
        key_ns = 0
        with _opened(self._path, self._stream) as (container, stream):
            for place, packet in enumerate(_packets(container, stream)):
                time_ns = _time_ns(packet)
                if time_ns is None or packet.is_discard:
                    continue
                if packet.is_keyframe:
                    if (self._stamp_ns(time_ns, shown) or 0) > start_ns:
                        break
                    skipped, index, key_ns = place, shown, time_ns
                elif time_ns < key_ns:
                    index += 1  # it comes after the key picture, and is shown before it
                shown += 1
        return skipped, index


class FramePicture:
    """Frame -> picture, as a player shows it; BGR with colour=True. Raises InputError.

    stretch: by how much its columns and rows are stretched.
    """

    def __init__(self, stretch: tuple[float, float] = SQUARE) -> None:
        self._reformatter = VideoReformatter()
        self._stretch = stretch

    def __call__(self, frame: av.VideoFrame, colour: bool = False) -> Pixels:
        """Return (h, w) grey, or (h, w, 3) BGR with colour=True where there is colour."""
        check_pixels(*_stretched(frame, self._stretch))
        kind = frame.format
        image: Pixels
        try:
            if colour:
                image = self._reformatter.reformat(frame, format='bgr24', threads=1).to_ndarray()
            elif kind.is_planar and not kind.is_rgb and kind.components[0].bits == 8:
                # quicker, to the same values
                luma = frame.planes[0]
                rows = np.frombuffer(memoryview(luma), np.uint8).reshape(-1, luma.line_size)
                image = rows[:frame.height, :frame.width]
                full = frame.color_range == ColorRange.JPEG
                image = image.copy() if full else cv2.LUT(image, FULL)
            else:
                # one thread: by default each frame has as many as the machine has cores
                image = self._reformatter.reformat(frame, format='gray', threads=1).to_ndarray()
        except (av.FFmpegError, ValueError) as error:
            raise _undecodable() from error
        if self._stretch != SQUARE:
            # Lanczos moves edges between the pixels least
            image = cv2.resize(image, _stretched(frame, self._stretch),
                               interpolation=cv2.INTER_LANCZOS4)
        return np.ascontiguousarray(np.rot90(image, frame.rotation // 90), np.uint8)


def _stretch(stream: av.VideoStream, path: Path, warnings: list[Notice]) -> tuple[float, float]:
    """Return by how much columns and rows are stretched; the longer side of a pixel stays."""
    aspect = stream.sample_aspect_ratio or stream.codec_context.sample_aspect_ratio
    ratio = float(aspect) if aspect else 1.0
    if aspect and not 1 / MOST_STRETCH <= ratio <= MOST_STRETCH:
        warnings.append(Notice(
            'E-PIXELS-ASSUMED-SQUARE', f'{path} has a pixel aspect ratio of {aspect.numerator}:'
            f'{aspect.denominator}, which no camera has: square pixels are assumed'))
        return SQUARE
    if abs(ratio - 1) <= ALMOST_SQUARE:
        return SQUARE
    return max(ratio, 1.0), max(1 / ratio, 1.0)


def _stretched(frame: av.VideoFrame, stretch: tuple[float, float]) -> tuple[int, int]:
    return round(frame.width * stretch[0]), round(frame.height * stretch[1])


def _packets(container: InputContainer, stream: av.VideoStream
             ) -> Iterator[av.Packet[av.VideoStream]]:
    """Yield the coded pictures up to where the file is damaged, and an empty packet at its end."""
    with suppress(av.FFmpegError):
        yield from container.demux(stream)


def _decoded(packet: av.Packet[av.VideoStream]) -> Sequence[av.VideoFrame | None]:
    """Return the pictures that a packet completes; None is one that cannot be decoded."""
    try:
        return packet.decode()
    except av.FFmpegError:
        return [None]


def _time_ns(of: av.VideoFrame | av.Packet[av.VideoStream]) -> int | None:
    time = of.pts if of.pts is not None else of.dts
    return round(time * of.time_base * SECOND_NS) if time is not None and of.time_base else None


def _rate(times_ns: Sequence[int]) -> float:
    """Return the mean rate of pictures at these times, Hz; 0 where it is not known."""
    span_ns = max(times_ns, default=0) - min(times_ns, default=0)
    return (len(times_ns) - 1) * 1e9 / span_ns if span_ns else 0.0


def _length_s(container: InputContainer, stream: av.VideoStream) -> float:
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    # a Matroska file's is counted from 0, wherever its first picture is
    return max(0, (container.duration or 0) - max(0, container.start_time or 0)) / av.time_base


def _chosen(path: Path, topic: str | None) -> tuple[int | None, list[Notice]]:
    """Return the number of the wanted stream, and what is to be said about the choice."""
    with _opened(path) as (container, best):
        streams = _streams(container)
        there = ', '.join(f'{n}: {size_text((each.width, each.height))}'
                          for n, each in enumerate(streams, 1))
        if topic is None:
            taken = next((n for n, each in enumerate(streams, 1) if each.index == best.index), 1)
            return None, [Notice(
                'E-VIDEO-STREAMS', f'{path} has {len(streams)} video streams ({there}): stream '
                f'{taken} is used; choose another one with --stream')] * (len(streams) > 1)
        if topic.isdecimal() and 1 <= int(topic[:9]) <= len(streams):
            return int(topic), []
        if len(streams) > 1 or topic.isdecimal():
            raise InputError('E-VIDEO-STREAM', f'{path} has no video stream {shortened(topic)!r} '
                             f'({there}): choose one with --stream')
    return None, [Notice('E-TOPIC-IGNORED', f'{path} is a video: the topic {topic} is ignored')]


def _streams(container: InputContainer) -> list[av.VideoStream]:
    return [each for each in container.streams.video if not each.disposition & THUMBNAILS]


@contextmanager
def _opened(path: Path, number: int | None = None
            ) -> Iterator[tuple[InputContainer, av.VideoStream]]:
    """Open a video and its stream of this number, counted from 1; None: the best one."""
    try:
        container = av.open(f'file:{path}', options={'format_whitelist': FORMATS})
    except (av.FFmpegError, ValueError) as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOENT, errno.EACCES):
            raise
        raise _unplayable(path) from error
    with container:
        stream = (container.streams.best('video') if number is None else
                  _streams(container)[number - 1])
        if not isinstance(stream, av.VideoStream):
            raise _unplayable(path)
        stream.codec_context.thread_type = 'AUTO'
        stream.codec_context.thread_count = THREADS
        check_pixels(stream.codec_context.width, stream.codec_context.height, str(path))
        yield container, stream


def _unplayable(path: Path) -> InputError:
    if _lacks_index(path):
        return InputError('E-VIDEO-NO-INDEX',
                          f'{path} has no index (moov): the camera lost power, '
                          f'or the copy was interrupted; copy it again, or rebuild the index from '
                          f'a complete video of the same camera (untrunc COMPLETE.mp4 '
                          f'{path.name})')
    return InputError('E-VIDEO-UNREADABLE', f'{path} is not a video that can be played, or it is '
                      f'truncated: copy it again, or convert it (ffmpeg -i IN -c:v libx264 '
                      f'OUT.mp4)')


def _lacks_index(path: Path) -> bool:
    """Return whether an MP4 has pictures, but not where they are: that is written at its end."""
    size, at, pictures = path.stat().st_size, 0, False
    with path.open('rb') as file:
        for _ in range(BOXES):
            if at + 16 > size:
                break
            file.seek(at)
            length, name, long = struct.unpack('>I4sQ', file.read(16))
            if name == b'moov' or not name.isalnum():
                return False
            pictures |= name == b'mdat'
            length = long if length == 1 else length
            if length < 8:  # up to the end of the file
                break
            at += length
    return pictures


def _undecodable() -> InputError:
    return InputError('E-VIDEO-UNDECODABLE', 'the image cannot be decoded: convert the video '
                      '(ffmpeg -i IN -c:v libx264 OUT.mp4)')
