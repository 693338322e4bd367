# SPDX-License-Identifier: Apache-2.0
"""The packets of a video -> messages of images, decoded in a thread of their own."""
from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from std_msgs.msg import Header

from dashcalib_ros.errors import InputError, coded
from dashcalib_ros.input.packets import PacketDecoder, codec_of
from dashcalib_ros.input.video import FramePicture

# packets that wait for the decoder; with more, all are dropped and the next key frame is awaited
WAITING = 60


class VideoDecoding:
    """Makes each packet that it is given a grey sensor_msgs/Image, in all that is read of one.

    Nothing ever waits for the decoder but its thread. dropped: packets that came too fast.
    """

    def __init__(self, shown: Callable[[Any], None], failed: Callable[[str], None]) -> None:
        """shown, failed: called in the decoder's thread, with an image or with what is wrong."""
        self.dropped = 0
        self._shown, self._failed = shown, failed
        self._decoder, self._picture = PacketDecoder(), FramePicture()
        self._packets: deque[Any] = deque()
        self._anew = self._closed = False
        # guards the three before
        self._filled = threading.Condition()
        self._thread = threading.Thread(target=self._run, name='video', daemon=True)
        self._thread.start()

    @property
    def waited(self) -> int:
        """Return how many packets came without a key frame before them."""
        return self._decoder.waited

    def put(self, message: Any) -> None:
        """Take a packet."""
        with self._filled:
            if len(self._packets) >= WAITING:
                self.dropped += len(self._packets)
                self._packets.clear()
                self._anew = True
            self._packets.append(message)
            self._filled.notify()

    def close(self) -> None:
        """End the thread."""
        with self._filled:
            self._closed = True
            self._filled.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._filled:
                self._filled.wait_for(lambda: self._packets or self._closed)
                if self._closed:
                    return
                message = self._packets.popleft()
                if self._anew:
                    self._decoder, self._anew = PacketDecoder(), False
            try:
                for image in self._images(message):
                    self._shown(image)
            except Exception as error:  # also what PyAV lets out: the next packet may be sound
                self._failed(coded(error))

    def _images(self, message: Any) -> list[Any]:
        codec = codec_of(message)
        if codec is None:
            raise InputError('E-NOT-A-VIDEO-PACKET',
                             'a message is not a video packet: set image_transport:=compressed')
        header = getattr(message, 'header', None)
        if header is None:  # of foxglove_msgs
            header = Header(stamp=message.timestamp, frame_id=message.frame_id)
        found = []
        for about, frame in self._decoder.take(codec, message.data, header):
            picture = self._picture(frame)
            height, width = picture.shape
            found.append(SimpleNamespace(
                header=about, encoding='mono8', is_bigendian=0, width=width, height=height,
                step=width, data=picture.reshape(-1)))
        return found
