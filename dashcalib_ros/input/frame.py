"""An image of the drive, as every kind of input gives it to the core."""
from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

from dashcalib_ros.arrays import GreyImage
from dashcalib_ros.errors import InputError, shortened

# ns; what a stamp of 64 bits holds
LAST_NS = 2**63 - 1


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
    Raises InputError for a stamp that is no finite number of 64 bits.
    """

    index: int
    stamp_ns: int
    image: GreyImage
    frame_id: str = ''
    after_gap: bool = False
    perhaps_after_gap: bool = False

    def __post_init__(self) -> None:
        # NaN is in no range
        if not (isinstance(self.stamp_ns, Real) and -LAST_NS <= self.stamp_ns <= LAST_NS):
            raise InputError(f'Frame.stamp_ns must be a number of nanoseconds, not '
                             f'{shortened(repr(self.stamp_ns))}')

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height) in pixels."""
        return self.image.shape[1], self.image.shape[0]
