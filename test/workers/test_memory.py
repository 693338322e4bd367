# SPDX-License-Identifier: Apache-2.0
"""Freed images go back to the system."""
from __future__ import annotations

import errno
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np
import pytest

from dashcalib_ros.workers.memory import forget_file_pages, in_a_file, mapped_copy

ROOT = Path(__file__).parents[2]
CODE = """
import os, sys
import numpy as np
from dashcalib_ros.workers.memory import (
    mapped_copy, return_free_memory, reuse_image_buffers)
reuse_image_buffers()
keep = mapped_copy if sys.argv[1] == 'apart' else np.copy

def resident_mb():
    return int(open('/proc/self/statm').read().split()[1]) * os.sysconf('SC_PAGE_SIZE') / 1e6

before = resident_mb()
np.ones(20_000_000, np.uint8)  # the first large block that is freed
images, between = [], []
for n in range(100):
    images.append(keep(np.ones(1_000_000, np.uint8)))
    between.append(bytearray(100_000))  # keeps the heap from shrinking
del images
if sys.argv[1] == 'returned':
    return_free_memory()
print(resident_mb() - before - 10)
"""
FILE_CODE = """
import os
import numpy as np
from dashcalib_ros.workers.memory import forget_file_pages, in_a_file

def resident_mb():
    return int(open('/proc/self/statm').read().split()[1]) * os.sysconf('SC_PAGE_SIZE') / 1e6

images = [np.full((1000, 1000), n, np.uint8) for n in range(100)]
before = resident_mb()
images = in_a_file(images)
stored = resident_mb()
assert [int(image.max()) for image in images] == list(range(100))
read = resident_mb()
forget_file_pages()
print(before - stored, read - stored, resident_mb() - stored)
"""


@pytest.mark.skipif(not sys.platform.startswith('linux'), reason='reads /proc')
def test_kept_images_go_back_to_the_system_when_they_are_freed():
    kept = {}
    for choice in ('apart', 'returned', 'in the heap'):
        done = subprocess.run([sys.executable, '-c', CODE, choice], cwd=ROOT, text=True,
                              capture_output=True, check=True, timeout=60)
        kept[choice] = float(done.stdout)
    assert kept['apart'] < 10 and kept['returned'] < 20
    if kept['in the heap'] < 60:
        pytest.skip('this C library gives memory back by itself')


def test_pages_are_used_again_when_no_view_is_left():
    first = mapped_copy(np.full((30, 40), 1, np.uint8))
    view = first[10:20, ::2]
    place = first.ctypes.data
    del first
    assert mapped_copy(np.full((30, 40), 2, np.uint8)).ctypes.data != place
    assert (view == 1).all()
    del view
    places = {mapped_copy(np.full((30, 40), 3, np.uint8)).ctypes.data for _ in range(2)}
    assert place in places
    assert (mapped_copy(np.full((3, 4), 4, np.uint8)) == 4).all()


@pytest.mark.skipif(not sys.platform.startswith('linux'), reason='reads /proc')
def test_images_in_a_file_take_no_memory():
    done = subprocess.run([sys.executable, '-c', FILE_CODE], cwd=ROOT, text=True,
                          capture_output=True, check=True, timeout=60)
    given_back, read, left = map(float, done.stdout.split())
    assert given_back > 80 and read > 80 and left < 20


def test_images_in_a_file_are_the_same():
    images = [np.random.default_rng(n).integers(0, 256, (n + 3, 7), np.uint8) for n in range(4)]
    images.append(images[0][:, ::2])
    stored = in_a_file(images)
    forget_file_pages()
    for image, other in zip(images, stored, strict=True):
        assert np.array_equal(image, other) and not other.flags.writeable
    assert in_a_file([]) == []


def test_pages_are_forgotten_while_another_thread_stores_images():
    before, ended = sys.getswitchinterval(), threading.Event()

    def store():
        while not ended.is_set():
            kept = [in_a_file([np.zeros((2, 2), np.uint8)]) for _ in range(20)]
            del kept

    sys.setswitchinterval(1e-6)
    thread = threading.Thread(target=store)
    thread.start()
    try:
        for _ in range(5000):
            forget_file_pages()
    finally:
        ended.set()
        thread.join()
        sys.setswitchinterval(before)


def test_images_stay_in_memory_where_the_disk_is_full(monkeypatch):
    def full(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    images = [np.zeros((4, 5), np.uint8)]
    monkeypatch.setattr(tempfile, 'TemporaryFile', full)
    assert in_a_file(images)[0] is images[0]
