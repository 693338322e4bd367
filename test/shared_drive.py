# SPDX-License-Identifier: Apache-2.0
"""A drive with two turns, of which the truth is known, rendered and calibrated once for a run."""
from __future__ import annotations

import fcntl
import pickle
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from dashcalib_ros.config import Config
from dashcalib_ros.demo import Drive, DriveSpec, Lens, Turn
from dashcalib_ros.input import Frame
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.report import Calibration

LENS = Lens.of(640, 360, 80.0, -0.25, 0.06, offset=(6.0, -4.0), aspect=1.003)
SPEC = DriveSpec(turns=(Turn(85.0), Turn(-80.0)), rate=6.0, straight_m=20.0, lead_m=24.0, seed=3)

# images: the first so many have one turn, and so have those from there on
ONE_TURN, OTHER_TURN = 58, 45
# enough for this drive, and quick: other tests have the other cores, and a process takes a second
# to start
QUICK = Config().replace({
    'workers': 1, 'turns.wanted': 2, 'tracks.points': 350, 'scene.tracks': 250,
    'scene.profile_tracks': 150, 'scene.keyframes': 20, 'scene.profile_keyframes': 10,
    'intrinsics.profile_tracks': 40})


def made_once(path: Path, make: Callable[[Path], None]) -> Path:
    """Have a file made where there is none, by one process; the others wait for it."""
    with path.with_suffix('.lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            part = path.with_suffix(f'.part{path.suffix}')
            make(part)
            part.rename(path)
    return path


def calibrated(frames: Iterable[Frame]) -> Calibration:
    with Calibrator(QUICK) as calibrator:
        for frame in frames:
            calibrator.push(frame)
        return calibrator.calibrate()


def shared_calibration(drive: SharedDrive) -> Calibration:
    """Return what comes of the drive with QUICK, from a file beside its pictures."""
    path = made_once(drive.path.with_suffix('.pickle'),
                     lambda part: part.write_bytes(pickle.dumps(calibrated(drive.frames()))))
    return pickle.loads(path.read_bytes())


class SharedDrive(Drive):
    """The drive, with pictures from a file.

    path: the file; it is rendered where there is none, by one process. changes: of SPEC; what
    hides the world, as a bonnet does.
    """

    def __init__(self, path: Path, **changes: bool) -> None:
        super().__init__(LENS, replace(SPEC, **changes))
        self.path = made_once(path, lambda part: np.save(
            part, [frame.image for frame in Drive(LENS, SPEC).frames()]))
        self._images = np.load(path)

    def frame(self, index: int) -> Frame:
        image = self._images[index].astype(np.float32)
        self.overlay.apply(image, self.stamp_ns(index))
        return Frame(index, self.stamp_ns(index), np.rint(image).astype(np.uint8))

    def frames(self, first: int = 0, last: int | None = None,
               processes: int = 1) -> Iterator[Frame]:
        return super().frames(first, last)
