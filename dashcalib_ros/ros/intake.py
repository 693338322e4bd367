"""What arrives: which images are the camera's, what is wrong with the others, and what is missing.

All of this runs in the executor's thread. It reads no pixels, but of images that tell of another
camera than before: damaged ones must not be believed.
"""
from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.decode import message_size
from dashcalib_ros.input.stamps import StampGate
from dashcalib_ros.ros.complaints import Complaints
from dashcalib_ros.ros.detecting import whole
from dashcalib_ros.ros.stream import Source, SourceWatch

CURES = {
    'lost': 'images are lost between the camera and this node (gaps in the stamps): give the '
            "camera driver's process config/fastdds_large_images.xml, or publish reliable or "
            'compressed images',
    'dropped': 'images are dropped because detection does not keep up: set motion.rate, '
               'motion.width or motion.points lower',
    'repeated': 'images have stamps that are not later than those before: is there a second '
                'publisher on the topic?',
    'unstamped': 'images without a stamp among others that have one: repair the camera driver',
    'set_back': 'the stamps were set back (a bag that loops?): tracking begins anew, the turns '
                'are kept',
}


class Intake:
    """Takes the messages of the camera's topic. received: how many there were.

    changed: called with the source before (None at first) and the present one, when images of
    another camera come. Before that, the image that shows the change is not accepted.
    """

    def __init__(self, rate: float, complaints: Complaints,
                 changed: Callable[[Source | None, Source], None]) -> None:
        """rate: Hz, of the images that are used."""
        self.received = 0
        self._complaints = complaints
        self._changed = changed
        self._watch: SourceWatch[Source] = SourceWatch()
        self._stamps = StampGate(rate)
        self._last: float | None = None

    @property
    def source(self) -> Source | None:
        """Return what the camera's images have in common, None before the first."""
        return self._watch.current

    @property
    def silent_s(self) -> float | None:
        """Return the time since the last image in s, None before the first."""
        return None if self._last is None else time.monotonic() - self._last

    def take(self, message: Any) -> tuple[int, Source] | None:
        """Take a message; return its number and source, None if it is not of the camera."""
        index, self.received = self.received, self.received + 1
        self._last = time.monotonic()
        try:
            source = Source(message_size(message), message.header.frame_id)
            what = self._watch.take(source, lambda: whole(message, source.size))
        except InputError as error:
            self._complaints.say('undecodable', str(error))
            return None
        if what == 'stray':
            self._complaints.say('strays', f'an image is {source}, the camera is '
                                           f'{self.source}: is there a second publisher?')
            return None
        if what != 'same':
            self._changed(self._watch.previous, source)
        return index, source

    def stamp_ns(self, message: Any) -> int | None:
        """Return the image's stamp, None for an image that is not needed or comes too late."""
        stamp = message.header.stamp
        return self._stamps.take(stamp.sec * 10**9 + stamp.nanosec, time.monotonic_ns())

    def forget(self) -> None:
        """Begin anew with the stamps: turns and tracks were dropped."""
        self._stamps.forget()

    def complain(self, dropped: int) -> None:
        """Tell what went wrong since the last call; dropped: images dropped by the detection."""
        stamps = self._stamps
        for kind, count in (('lost', stamps.lost), ('dropped', dropped),
                            ('repeated', stamps.repeated), ('unstamped', stamps.zero),
                            ('set_back', stamps.set_back)):
            self._complaints.total(kind, count, CURES[kind])
