"""The whole story: frames -> motion -> turns -> scenes -> one camera, its sigmas and a verdict."""
from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from types import TracebackType

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError
from dashcalib_ros.frames import Frame
from dashcalib_ros.frames.shrink import shrink, shrink_factor, shrink_mask
from dashcalib_ros.intrinsics import Calibration
from dashcalib_ros.intrinsics.agreement import evidence_of
from dashcalib_ros.intrinsics.conclude import Evidence, conclude
from dashcalib_ros.intrinsics.solution import Solution
from dashcalib_ros.intrinsics.solve import solve_scenes
from dashcalib_ros.motion import MotionEstimator
from dashcalib_ros.reconstruction.archive import Origin
from dashcalib_ros.reconstruction.collection import Progress, SceneCollection
from dashcalib_ros.turns import Turn, TurnDetector

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Status:
    """Where the calibrator stands after a frame.

    frames: pushed so far. turns: in the bank and stored. built: how many scenes a calibration
    would begin with now; centers: of their turns, stored ones have negative numbers. yaw_deg:
    their sum. stored: how many turns are of earlier drives. magnitude: the newest filtered
    turning magnitude, of the image width.
    """

    frames: int
    turns: int
    built: int
    yaw_deg: float
    magnitude: float
    standing: bool
    centers: tuple[int, ...] = ()
    stored: int = 0


class Calibrator:
    """Learns a camera from the turns of a drive.

    push() the frames as they come; calibrate() when enough turns have gathered, or at the end.
    push() and calibrate() may be called from two threads: push() never waits for a calibration.
    close() ends the child processes; a Calibrator is also a context manager.
    """

    def __init__(self, config: Config | None = None, mask: Mask | None = None,
                 verbose: bool = False, live: bool = False, use_stored: bool = True,
                 warn: Callable[[str], None] = lambda text: None) -> None:
        """mask: (h, w), False where the ego vehicle is.

        live: children run at low priority, and push() never waits for them; offline it does, so
        that few turns are in memory at a time. use_stored: False begins without the turns in
        turns.store, and adds to them. warn: told of each trouble with turns.store, one line, from
        any thread; the result's warnings have them, too.
        """
        self._config = config or Config()
        self._use_stored = use_stored
        if mask is not None:
            size = mask.shape[1], mask.shape[0]
            mask = shrink_mask(mask, shrink_factor(size, self._config.max_width))
        # of all that push() and calibrate() share; SceneCollection tells who takes it when
        self._lock = threading.Lock()
        self._motion = MotionEstimator(self._config.motion, self._config.mask, mask)
        # a turn without a scene needs another to give way to, and --turns may ask for many
        turns = self._config.turns
        self._detector = TurnDetector(replace(turns, capacity=max(turns.capacity, turns.wanted)))
        self._scenes = SceneCollection(self._config, self._detector, self._motion.valid,
                                       self._lock, live, verbose, warn)
        self._size: tuple[int, int] | None = None
        self._frames = 0
        self._standing = False
        self._detect_s = 0.0
        self._started = time.monotonic()

    def push(self, frame: Frame) -> Status:
        """Take the next frame; raises InputError when its size differs from the first one's."""
        started = time.monotonic()
        with self._lock:
            factor = self._take_size(frame)
            self._frames += 1
            small = shrink(frame, factor)
            motion = self._motion.push(small)
            if motion is not None:
                self._standing = motion.standing
                if self._detector.push(small, motion):
                    self._scenes.submit()
        self._detect_s += time.monotonic() - started
        self._scenes.make_room()
        return self.status()

    def calibrate(self, progress: Progress | None = None, final: bool = True) -> Calibration:
        """Adjust the best turns' scenes together and judge the result.

        final: the drive is over, and its last turn may end here; no push() may follow.
        progress: told of each stage by name and the share done.
        """
        tell = progress or (lambda stage, done: None)
        with self._lock:
            if final:
                self._detector.finish()
            self._scenes.submit()
        started = time.monotonic()
        calibration = self._solved(tell, final, started)
        # more turns, where those wanted leave the result weak
        if calibration.verdict.level == 'weak' and self._scenes.widen():
            calibration = self._solved(tell, final, started)
        return calibration

    def _solved(self, tell: Progress, final: bool, started: float) -> Calibration:
        """Return what the turns that have a place say together."""
        tell('reconstructing turns', 0.0)
        scenes, stored = self._scenes.wanted(tell, final)
        solution: Solution | None = None
        if scenes:
            # step 1: one focal length; step 2: all six, with priors from step 1
            solution = self._scenes.workshop.run(
                solve_scenes, scenes, self._config, progress=tell)
            self._scenes.reject({scene.center for scene in scenes}
                                - evidence_of(solution, self._config.verdict))
            self._scenes.store()
        ended = time.monotonic()
        with self._lock:
            size = self._size or (0, 0)
            evidence = Evidence(
                image_size=size, shrink=shrink_factor(size, self._config.max_width),
                frames=self._frames, turns=self._detector.turns(),
                built=self._scenes.workshop.scenes(), magnitudes=self._detector.magnitudes(),
                mask=self._motion.valid(),
                timing={'detect': self._detect_s, 'calibrate': ended - started,
                        'total': ended - self._started},
                warnings=(*self._motion.warnings(), *self._scenes.warnings), stored=stored)
        return conclude(solution, evidence, self._config)

    def turns(self) -> tuple[Turn, ...]:
        """Return the bank's turns, the most prominent first."""
        with self._lock:
            return self._detector.turns()

    def finish(self) -> None:
        """End detection: the drive is over. Only turns() and calibrate() may follow."""
        with self._lock:
            self._detector.finish()

    def status(self) -> Status:
        """Return where the calibrator stands."""
        with self._lock:
            chosen, stored = self._scenes.chosen(), len(self._scenes.stored())
            return Status(self._frames, len(self._detector.turns()) + stored, len(chosen),
                          sum(scene.yaw_deg for scene in chosen), self._detector.magnitude,
                          self._standing, tuple(scene.center for scene in chosen), stored)

    def reject(self, keys: Iterable[int]) -> None:
        """Take turns out, by centre or a stored one's key: they are of a camera that has gone."""
        self._scenes.reject(keys)
        self._scenes.store()

    def forget_stored(self) -> None:
        """Drop the turns of earlier drives, on disk too: the camera is not what it was."""
        self._scenes.forget_stored()

    def clear_store(self) -> None:
        """Remove all turns of this calibrator from turns.store; it stores no others."""
        self._scenes.clear_store()

    def child_pids(self) -> list[int]:
        """Return the process ids of the children that run now."""
        return self._scenes.workshop.pids()

    def close(self) -> None:
        """End the child processes; a calibrate() in another thread raises WorkerError."""
        self._scenes.close()

    def __enter__(self) -> Calibrator:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def _take_size(self, frame: Frame) -> int:
        """Return by what factor to shrink a frame; raises InputError for another size."""
        factor = shrink_factor(frame.size, self._config.max_width)
        if self._size is None:
            self._size = frame.size
            self._scenes.load(Origin(frame.size, factor, frame.frame_id), self._use_stored)
        elif frame.size != self._size:
            raise InputError(
                f'the image size changes from {self._size[0]}x{self._size[1]} to '
                f'{frame.size[0]}x{frame.size[1]} at frame {frame.index}: calibrate each size '
                f'on its own')
        return factor
