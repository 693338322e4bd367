# SPDX-License-Identifier: Apache-2.0
"""A turn, or another stretch of the drive that the calibration uses."""
from __future__ import annotations

from dataclasses import dataclass, field

from dashcalib_ros.input import Frame

# of the image width; kitti03's sharp turn has 0.050, its bends of 0.4 to 0.6 deg a frame 0.005
MIN_PROMINENCE = 0.0025


def is_turn(prominence: float) -> bool:
    """Return whether it is a turn's; another stretch of the drive has less."""
    return prominence >= MIN_PROMINENCE


@dataclass(frozen=True, order=True)
class TurnId:
    """Identifies a turn in one run. Turns of earlier drives sort before those of this one.

    of_this_drive: False for a stored turn of an earlier drive. number: the index of the center
    frame; for a stored turn, its place among the stored turns. clip: of a fleet that has it.
    """

    of_this_drive: bool
    number: int
    clip: str = field(default='', compare=False)

    @classmethod
    def at(cls, center: int) -> TurnId:
        """Return the turn of this drive at this frame."""
        return cls(True, center)

    @classmethod
    def stored(cls, place: int, clip: str = '') -> TurnId:
        """Return the turn of an earlier drive, or of a clip, at this place among those stored."""
        return cls(False, place, clip)

    def __str__(self) -> str:
        return (f'the turn at frame {self.number}' if self.of_this_drive
                else f'stored turn {self.number}')


@dataclass(frozen=True)
class Turn:
    """One turn and its images (paper, 3.1: the 2k + 1 images around a peak).

    center, first, last: indices of input frames; stamp_s: time of the center in s. prominence:
    topographic prominence of the filtered turning magnitude, as a share of the image width; of a
    stretch without a peak below the least of a turn, and larger the more it promises.
    frames: the images from first to last, thinned to the detector's rate, in order; empty once
    they are released: released_images is their number then.
    """

    center: int
    first: int
    last: int
    stamp_s: float
    prominence: float
    frames: tuple[Frame, ...] = ()
    released_images: int = 0

    @property
    def images(self) -> int:
        """Return the number of images, released ones too."""
        return len(self.frames) or self.released_images

    @property
    def id(self) -> TurnId:
        """Return the turn's identity."""
        return TurnId.at(self.center)
