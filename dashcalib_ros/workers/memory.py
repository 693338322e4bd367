# SPDX-License-Identifier: Apache-2.0
"""Where images are in memory: what lasts for one message is reused, what is kept is apart.

glibc maps large blocks separately and returns them as soon as they are freed. Every image then
costs the system new pages, three times over (received, converted, grey): a third of the node's
processor time. Kept in the heap they are reused; but then those that wait in a turn for seconds
lie among small blocks, and are never returned by themselves. So the node copies these out of it,
and every process returns free pages after each turn.

Offline, the pictures of turns that wait for better ones, or for being needed, lie in a file.
"""
from __future__ import annotations

import ctypes
import mmap
import tempfile
import weakref
from collections import deque
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from dashcalib_ros.arrays import GreyImage

# glibc's names for its settings, and bytes: the largest block that is not mapped, what may lie
# free at the heap's end, and how many heaps there are
M_MMAP_THRESHOLD, LARGEST = -3, 2**25
M_TRIM_THRESHOLD, FREE = -1, 2**24
M_ARENA_MAX, HEAPS = -8, 1


def reuse_image_buffers() -> None:
    """Have glibc keep the buffers of images; nothing is done with other C libraries.

    It is for processes that call return_free_memory() after each task: without that, solutions
    take 1.2 to 1.4 times as long.
    """
    with suppress(AttributeError, OSError):
        library = ctypes.CDLL(None)
        for setting, value in ((M_MMAP_THRESHOLD, LARGEST), (M_TRIM_THRESHOLD, FREE),
                               (M_ARENA_MAX, HEAPS)):
            library.mallopt(setting, value)


def return_free_memory() -> None:
    """Give the pages that are free within glibc's heaps back to the system.

    Without this, a turn's images stay with the process after they are freed.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


# pages of copies that were freed. New ones from the system take ten times as long as the copying,
# and a drive needs some as fast as it frees others
_spare: deque[mmap.mmap] = deque(maxlen=4)


def mapped_copy(image: GreyImage) -> GreyImage:
    """Return a copy in pages of its own.

    Once the copy and its views are freed, the next copy uses its pages, or the system gets them.
    """
    try:
        pages = _spare.pop()
    except IndexError:
        pages = mmap.mmap(-1, image.nbytes)
    if len(pages) != image.nbytes:
        pages = mmap.mmap(-1, image.nbytes)
    owner = np.frombuffer(pages, np.uint8)
    weakref.finalize(owner, _spare.append, pages).atexit = False
    copy = owner.reshape(image.shape)
    copy[:] = image
    return copy


# pages of files that hold images, by id(); its valuerefs() may be called while another thread adds
# some, which a WeakSet does not allow
_in_files: weakref.WeakValueDictionary[int, mmap.mmap] = weakref.WeakValueDictionary()


def in_a_file(images: Sequence[GreyImage]) -> list[GreyImage]:
    """Return the images, read-only, in a temporary file, which ends with them.

    They stay in memory where the disk has no room.
    """
    try:
        with tempfile.TemporaryFile() as file:
            for image in images:
                file.write(image.tobytes())
            file.flush()
            pages = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError):
        return list(images)
    _in_files[id(pages)] = pages
    starts = np.cumsum([0, *(image.nbytes for image in images)])[:-1]
    return [np.frombuffer(pages, np.uint8, image.nbytes, start).reshape(image.shape)
            for image, start in zip(images, starts, strict=True)]


def forget_file_pages() -> None:
    """Drop what was read from the files of images: the next look at them reads it again.

    Any thread may call it.
    """
    for reference in _in_files.valuerefs():
        if (pages := reference()) is not None:
            pages.madvise(mmap.MADV_DONTNEED)
