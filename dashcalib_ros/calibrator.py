"""The whole story: frames -> motion -> turns -> scenes -> one camera, its sigmas and a verdict."""
from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import TracebackType

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError, WorkerError
from dashcalib_ros.frames import Frame
from dashcalib_ros.frames.shrink import shrink, shrink_factor, shrink_mask
from dashcalib_ros.intrinsics import Calibration
from dashcalib_ros.intrinsics.conclude import Evidence, conclude
from dashcalib_ros.intrinsics.solve import solve_scenes
from dashcalib_ros.motion import MotionEstimator
from dashcalib_ros.reconstruction.scene import Scene
from dashcalib_ros.reconstruction.workshop import Workshop
from dashcalib_ros.turns import Turn, TurnDetector

Mask = npt.NDArray[np.bool_]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Status:
    """Where the calibrator stands after a frame.

    frames: pushed so far. turns: in the bank. built: how many scenes a calibration would use now,
    at the most those wanted; centers: of their turns. yaw_deg: their sum.
    magnitude: the newest filtered turning magnitude, of the image width.
    """

    frames: int
    turns: int
    built: int
    yaw_deg: float
    magnitude: float
    standing: bool
    centers: tuple[int, ...] = ()


class Calibrator:
    """Learns a camera from the turns of a drive.

    push() the frames as they come; calibrate() when enough turns have gathered, or at the end.
    push() and calibrate() may be called from two threads: push() never waits for a calibration.
    close() ends the child processes; a Calibrator is also a context manager.
    """

    def __init__(self, config: Config | None = None, mask: Mask | None = None,
                 verbose: bool = False, live: bool = False) -> None:
        """mask: (h, w), False where the ego vehicle is.

        live: children run at low priority, and push() never waits for them; offline it does, so
        that few turns are in memory at a time.
        """
        self._config = config or Config()
        self._live = live
        if mask is not None:
            size = mask.shape[1], mask.shape[0]
            mask = shrink_mask(mask, shrink_factor(size, self._config.max_width))
        self._motion = MotionEstimator(self._config.motion, self._config.mask, mask)
        # a turn without a scene needs another to give way to, and --turns may ask for many
        turns = self._config.turns
        self._detector = TurnDetector(
            replace(turns, capacity=max(turns.capacity, turns.wanted)))
        self._workshop = Workshop(self._config, low_priority=live, verbose=verbose)
        self._lock = threading.Lock()
        self._size: tuple[int, int] | None = None
        self._frames = 0
        self._standing = False
        self._detect_s = 0.0
        self._closed = False
        self._started = time.monotonic()

    def push(self, frame: Frame) -> Status:
        """Take the next frame; raises InputError when its size differs from the first one's."""
        started = time.monotonic()
        with self._lock:
            if self._size is None:
                self._size = frame.size
            elif frame.size != self._size:
                raise InputError(
                    f'the image size changes from {self._size[0]}x{self._size[1]} to '
                    f'{frame.size[0]}x{frame.size[1]} at frame {frame.index}: calibrate each size '
                    f'on its own')
            self._frames += 1
            small = shrink(frame, shrink_factor(frame.size, self._config.max_width))
            motion = self._motion.push(small)
            if motion is not None:
                self._standing = motion.standing
                if self._detector.push(small, motion):
                    self._submit()
        self._detect_s += time.monotonic() - started
        if not self._live:
            self._workshop.wait(lambda: self._workshop.waiting <= 2 * self._config.threads)
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
            self._submit()
        started = time.monotonic()
        tell('reconstructing turns', 0.0)
        scenes = self._wanted_scenes(tell)
        solution = None
        if scenes:
            solution = self._workshop.run(solve_scenes, scenes, self._config, progress=tell)
            used = {scene.center for scene in solution.scenes} if solution else set()
            for scene in scenes:
                if scene.center not in used:
                    self._workshop.reject(scene.center)
        ended = time.monotonic()
        with self._lock:
            evidence = Evidence(
                image_size=self._size or (0, 0), frames=self._frames,
                turns=self._detector.turns(), built=self._workshop.scenes(),
                magnitudes=self._detector.magnitudes(), mask=self._motion.valid(),
                shrink=shrink_factor(self._size or (1, 1), self._config.max_width),
                timing={'detect': self._detect_s, 'calibrate': ended - started,
                        'total': ended - self._started})
            warnings = self._motion.warnings()
        return replace(conclude(solution, evidence, self._config), warnings=warnings)

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
        scenes = self._workshop.scenes()
        with self._lock:
            # as calibrate() chooses: a turn without a scene gives way to the next
            built = [scene for turn in self._detector.turns()
                     if (scene := scenes.get(turn.center)) is not None][:self._config.turns.wanted]
            return Status(self._frames, len(self._detector.turns()), len(built),
                          sum(scene.yaw_deg for scene in built), self._detector.magnitude,
                          self._standing, tuple(scene.center for scene in built))

    def child_pids(self) -> list[int]:
        """Return the process ids of the children that run now."""
        return self._workshop.pids()

    def close(self) -> None:
        """End the child processes; a calibrate() in another thread raises WorkerError."""
        self._closed = True
        self._workshop.close()

    def __enter__(self) -> Calibrator:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def _submit(self, replace_failed: bool = False) -> None:
        """Have the best turns built.

        A turn's images are handed over when it is submitted, and not when it is built: what
        becomes of turns that overlap it must not depend on how fast the children are. For the same
        reason others are tried in the place of turns that gave no scene only when a calibration
        is asked for (replace_failed).
        """
        turns = self._detector.turns()
        built = self._workshop.scenes()
        self._workshop.keep_only({turn.center for turn in turns})
        places = self._config.turns.wanted
        for turn in turns:
            if replace_failed and turn.center in built and built[turn.center] is None:
                continue
            if places == 0:
                return
            places -= 1
            if turn.frames:
                self._workshop.submit(turn, self._motion.valid())
                self._detector.release(turn.center)

    def _wanted_scenes(self, tell: Progress) -> list[Scene]:
        """Return the scenes of the best turns; a turn without a scene gives way to the next."""
        while True:
            total = max(self._workshop.waiting, 1)

            def idle(total: int = total) -> bool:
                tell('reconstructing turns', 1 - self._workshop.waiting / total)
                return self._workshop.waiting == 0

            self._workshop.wait(idle)
            if self._closed:
                raise WorkerError('the calibrator was closed while it calibrated')
            with self._lock:
                self._submit(replace_failed=True)
                if self._workshop.waiting:
                    continue
                built = self._workshop.scenes()
                scenes = [scene for turn in self._detector.turns()
                          if (scene := built.get(turn.center)) is not None]
            return scenes[:self._config.turns.wanted]
