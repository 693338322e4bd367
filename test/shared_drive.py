# SPDX-License-Identifier: Apache-2.0
"""A drive with two turns, of which the truth is known, rendered once for all tests of a run."""
from __future__ import annotations

import fcntl
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from dashcalib_ros.config import Config
from dashcalib_ros.demo import Drive, DriveSpec, Lens, Turn
from dashcalib_ros.input import Frame

LENS = Lens.of(640, 360, 80.0, -0.25, 0.06, offset=(6.0, -4.0), aspect=1.003)
SPEC = DriveSpec(turns=(Turn(85.0), Turn(-80.0)), rate=6.0, straight_m=20.0, lead_m=24.0, seed=3)

# images: the first so many have one turn, and so have those from there on
ONE_TURN, OTHER_TURN = 58, 45
# enough for this drive, and quick
QUICK = Config().replace({
    'turns.wanted': 2, 'tracks.points': 350, 'scene.tracks': 250, 'scene.profile_tracks': 150,
    'scene.keyframes': 20, 'scene.profile_keyframes': 10, 'intrinsics.profile_tracks': 40})


class SharedDrive(Drive):
    """The drive, with pictures from a file.

    path: the file; it is rendered where there is none, by one process. changes: of SPEC; what
    hides the world, as a bonnet does.
    """

    def __init__(self, path: Path, **changes: bool) -> None:
        super().__init__(LENS, replace(SPEC, **changes))
        self.path = path
        with path.with_suffix('.lock').open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                whole = path.with_suffix('.part.npy')
                np.save(whole, [frame.image for frame in Drive(LENS, SPEC).frames()])
                whole.rename(path)
        self._images = np.load(path)

    def frame(self, index: int) -> Frame:
        image = self._images[index].astype(np.float32)
        self.overlay.apply(image, self.stamp_ns(index))
        return Frame(index, self.stamp_ns(index), np.rint(image).astype(np.uint8))

    def frames(self, first: int = 0, last: int | None = None,
               processes: int = 1) -> Iterator[Frame]:
        return super().frames(first, last)
