"""An image of the drive, as every kind of input gives it to the core."""
from __future__ import annotations

from dataclasses import dataclass

from dashcalib_ros.arrays import GreyImage


@dataclass(frozen=True)
class Frame:
    """One image of the drive.

    index: position among the input's frames, counted from 0.
    stamp_ns: time of exposure in nanoseconds (the message header's stamp, or index / rate).
    image: (height, width) uint8, grey. Never written to after the Frame is made.
    frame_id: the message header's; empty where there is none.
    after_gap: it does not continue the one before, as the first of another video file.
    """

    index: int
    stamp_ns: int
    image: GreyImage
    frame_id: str = ''
    after_gap: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height) in pixels."""
        return self.image.shape[1], self.image.shape[0]
