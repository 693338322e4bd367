"""Messages that are packets of a video (H.264, H.265 and others) -> pictures.

A packet needs those before it, back to a key picture: whoever comes later waits for the next one.
"""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import av

from dashcalib_ros.errors import InputError, shortened
from dashcalib_ros.limits import PIXELS

# FFmpeg's names, by what is in those that messages have: libx264, hevc_nvenc, h265
CODECS = {'264': 'h264', 'avc1': 'h264', '265': 'hevc', 'hevc': 'hevc', 'av1': 'av1',
          'vp9': 'vp9'}
# pictures that a decoder may hold back at the most
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


class PacketDecoder:
    """Decodes packets in their order.

    waited: for how many packets there was no key picture before them.
    """

    def __init__(self) -> None:
        self.waited = 0
        self._begun = False
        self._codec = ''
        self._context: Any = None
        self._taken: dict[int, Any] = {}
        self._count = 0

    def take(self, codec: str, data: Any, about: Any) -> list[tuple[Any, av.VideoFrame]]:
        """Take a packet; return what is shown now, each with what was said about its packet.

        codec: FFmpeg's name. Raises InputError for a packet that is damaged.
        """
        if codec != self._codec:
            self._codec, self._begun = codec, False
            self._context = av.CodecContext.create(codec, 'r')
            self._context.options = {'max_pixels': str(PIXELS)}
            # by whole pictures they would be held back
            self._context.thread_type, self._context.thread_count = 'SLICE', THREADS
        packet = av.Packet(bytes(data))
        self._count += 1
        packet.pts = self._count
        self._taken[self._count] = about
        if len(self._taken) > HELD:
            del self._taken[next(iter(self._taken))]
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
        except (av.FFmpegError, ValueError) as error:
            if self._begun:
                raise InputError('E-VIDEO-PACKET',
                                 'a packet of the video is damaged: record it again') from error
            frames = []
        found = []
        for frame in frames:
            # before it, the decoder makes up what it has not seen
            self._begun |= bool(frame.key_frame)
            if self._begun and frame.pts in self._taken:
                found.append((self._taken.pop(frame.pts), frame))
        self.waited += packet is not None and not self._begun
        return found
