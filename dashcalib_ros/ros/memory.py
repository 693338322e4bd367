"""Memory that is free goes back to the system, so that a node that runs for days stays small."""
from __future__ import annotations

import ctypes
from contextlib import suppress

# bytes; images are larger, most else is smaller
LARGE = 262_144
M_MMAP_THRESHOLD = -3


def give_images_back() -> None:
    """Have glibc return each image to the system as soon as it is freed.

    glibc maps large blocks on their own, but at the first one that is freed it raises its idea of
    large, up to 32 MB. From then on images lie in the heap among small things, which keeps them:
    360 MB after four turns of 1280x720 were reconstructed, instead of 155. Setting the threshold
    fixes it, for 8 % more of detection's time. Other C libraries are left as they are.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGE)
