"""The car's motion at one image."""
from __future__ import annotations

from dataclasses import dataclass

from dashcalib_ros.arrays import Floats32


@dataclass(frozen=True)
class Motion:
    """Motion at one image, measured over the triplet of images that ends with it.

    index, stamp_ns: of the image. center, center_ns: index and stamp of the triplet's middle
    image, which the magnitude belongs to; None before there is a triplet.
    magnitude: turning magnitude, of the image width (see epipoles.py); 0 when standing, NaN when
    no epipole is found. standing: the picture does not move. moved_px: how far the median point
    moved since the last processed image, at full resolution. points: how many were tracked.
    after_gap: the tracking began anew: nothing from here on belongs to what was before.
    """

    index: int
    stamp_ns: int
    magnitude: float
    standing: bool
    moved_px: float
    points: int = 0
    center: int | None = None
    center_ns: int | None = None
    after_gap: bool = False


@dataclass(frozen=True)
class TrackedPoints:
    """The points in the newest image, (n, 2) px of the full image: now, and one spacing before.

    before is equal to now for points that are new.
    """

    before: Floats32
    now: Floats32
