"""A turn: the stretch of the drive that calibrates."""
from __future__ import annotations

from dataclasses import dataclass

from dashcalib_ros.frames.frame import Frame


@dataclass(frozen=True)
class Turn:
    """One turn and its images (paper, 3.1: the 2k + 1 images around a peak).

    center, first, last: indices of input frames; stamp_s: time of the centre in seconds.
    prominence: topographic prominence of the filtered turning magnitude, of the image width.
    frames: the images from first to last, thinned to the detector's rate, in order; empty once
    released, when only their number, released_images, is remembered.
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
        """Return how many images the turn has."""
        return len(self.frames) or self.released_images
