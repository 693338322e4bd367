# SPDX-License-Identifier: Apache-2.0
"""Messages that are packets of a video (H.264, H.265 and others) -> pictures.

A packet needs those before it, back to a key picture: whoever comes later waits for the next one.
"""
from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import av
from av.codec.codec import UnknownCodecError

from dashcalib_ros.errors import InputError, one_line, shortened
from dashcalib_ros.limits import PIXELS

# FFmpeg's names, by what is in those that messages have: libx264, hevc_nvenc, h265
CODECS = {'264': 'h264', 'avc1': 'h264', '265': 'hevc', 'hevc': 'hevc', 'av1': 'av1',
          'vp9': 'vp9', 'vp8': 'vp8', 'libvpx': 'vp8'}
# decoders that need no hardware, of codecs whose own does
SOFTWARE = {'av1': ('libdav1d', 'libaom-av1', 'libgav1')}
# what a packet with a key picture has
KEYS = {codec: re.compile(pattern, re.DOTALL) for codec, pattern in {
    'h264': rb'\x00\x00\x01[\x25\x45\x65]', 'hevc': rb'\x00\x00\x01[\x20-\x2b]',
    'av1': rb'\A(?:\x12\x00)?\x0a', 'vp9': rb'\A[\x80-\x83\x90-\x93\xa0-\xa3\xb0\xb1]',
    'vp8': rb'\A...\x9d\x01\x2a'}.items()}
# maximum number of pictures that a decoder may hold back
HELD = 64
THREADS = 2


def codec_of(message: Any) -> str | None:
    """Return FFmpeg's name of the codec of a video's packet; None for a picture of its own.

    Raises InputError for a packet whose codec is not supported.
    """
    packet = hasattr(message, 'pts')
    name = str(message.encoding if packet else getattr(message, 'format', ''))
    kind = name.lower().partition(';')[0]
    found = next((codec for part, codec in CODECS.items() if part in kind), None)
    if found is None and packet:
        raise InputError('E-VIDEO-CODEC', f'video packets of {shortened(repr(name))} are not '
                         f'supported: publish h264 or hevc')
    return found


def _decoder(codec: str) -> Any:
    for name in (*SOFTWARE.get(codec, ()), codec):
        with suppress(UnknownCodecError):
            return av.CodecContext.create(name, 'r')
    raise InputError('E-VIDEO-CODEC', f'this FFmpeg cannot decode {codec}: publish h264 or hevc')


class PacketDecoder:
    """Decodes packets in their order.

    waited: for how many packets there was no key picture before them that could be decoded.
    """

    def __init__(self) -> None:
        self.waited = 0
        self._begun = self._keyed = False
        self._codec = ''
        self._context: Any = None
        self._taken: dict[int, Any] = {}
        self._count = 0

    def take(self, codec: str, data: Any, about: Any) -> list[tuple[Any, av.VideoFrame]]:
        """Take a packet; return what is shown now, each with what was said about its packet.

        codec: FFmpeg's name. Raises InputError for a packet that cannot be decoded.
        """
        if codec != self._codec:
            self._codec, self._begun, self._keyed = codec, False, False
            self._context = _decoder(codec)
            self._context.options = {'max_pixels': str(PIXELS)}
            # by whole pictures they would be held back
            self._context.thread_type, self._context.thread_count = 'SLICE', THREADS
        data = bytes(data)
        packet = av.Packet(data)
        self._count += 1
        packet.pts = self._count
        self._taken[self._count] = about
        if len(self._taken) > HELD:
            del self._taken[next(iter(self._taken))]
        self._keyed |= bool(KEYS[codec].search(data))
        self.waited += not (self._begun or self._keyed)
        return self._shown(packet)

    def rest(self) -> list[tuple[Any, av.VideoFrame]]:
        """Return what was held back."""
        if self._context is None or not self._context.is_open:
            return []
        try:
            return self._shown(None)
        except InputError:
            return []

    def _shown(self, packet: av.Packet[Any] | None) -> list[tuple[Any, av.VideoFrame]]:
        try:
            frames: Sequence[av.VideoFrame] = self._context.decode(packet)
        except av.InvalidDataError as error:
            if self._begun or self._keyed:
                self._keyed = False  # what depends on it waits for the next one
                raise InputError('E-VIDEO-PACKET',
                                 'a packet of the video is damaged: record it again') from error
            frames = []
        except (av.FFmpegError, ValueError) as error:
            raise InputError(
                'E-VIDEO-DECODER', f"FFmpeg's decoder {self._context.name} fails "
                f'({one_line(error)}): convert the video to H.264') from error
        found = []
        for frame in frames:
            # before it, the decoder makes up what it has not seen
            self._begun |= bool(frame.key_frame)
            if self._begun and frame.pts in self._taken:
                found.append((self._taken.pop(frame.pts), frame))
        return found
