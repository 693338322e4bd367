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
    after_gap: images are missing before it, or it is of another drive.
    perhaps_after_gap: the first of another file that may or may not go on where the one before
    ended, as the next video of a dashcam; how the picture moves tells (motion/continuity.py).
    """

    index: int
    stamp_ns: int
    image: GreyImage
    frame_id: str = ''
    after_gap: bool = False
    perhaps_after_gap: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height) in pixels."""
        return self.image.shape[1], self.image.shape[0]
