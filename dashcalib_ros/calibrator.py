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
from dashcalib_ros.intrinsics.calibration import StoredTurnSummary
from dashcalib_ros.intrinsics.conclude import Evidence, conclude
from dashcalib_ros.intrinsics.solve import solve_scenes
from dashcalib_ros.motion import MotionEstimator
from dashcalib_ros.reconstruction.archive import Archive, Origin, StoredTurn
from dashcalib_ros.reconstruction.scene import Scene
from dashcalib_ros.reconstruction.workshop import Workshop
from dashcalib_ros.turns import Turn, TurnDetector

Mask = npt.NDArray[np.bool_]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Status:
    """Where the calibrator stands after a frame.

    frames: pushed so far. turns: in the bank and stored. built: how many scenes a calibration
    would use now, at the most those wanted; centers: of their turns, stored ones have negative
    numbers. yaw_deg: their sum. stored: how many turns are of earlier drives.
    magnitude: the newest filtered turning magnitude, of the image width.
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
        self._live = live
        if mask is not None:
            size = mask.shape[1], mask.shape[0]
            mask = shrink_mask(mask, shrink_factor(size, self._config.max_width))
        self._motion = MotionEstimator(self._config.motion, self._config.mask, mask)
        # a turn without a scene needs another to give way to, and --turns may ask for many
        turns = self._config.turns
        capacity = max(turns.capacity, turns.wanted)
        # how many turns are used: more than wanted once these have left a result weak
        self._places = turns.wanted
        self._detector = TurnDetector(replace(turns, capacity=capacity))
        self._workshop = Workshop(self._config, low_priority=live, verbose=verbose,
                                  queue=turns.wanted if live else None, on_built=self._store_turns)
        self._archive = Archive(turns.store, capacity, turns.half_width, self._on_trouble)
        self._use_stored = use_stored
        self._warnings: list[str] = []
        self._warn = warn
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
                self._archive.load(Origin(
                    frame.size, shrink_factor(frame.size, self._config.max_width),
                    frame.frame_id), self._use_stored)
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
        calibration = self._calibrated(started, tell, final)
        most = max(self._config.turns.at_most, self._config.turns.wanted)
        if calibration.verdict.level == 'weak' and self._places < most and self._has_more():
            self._places = most
            calibration = self._calibrated(started, tell, final)
        return calibration

    def _calibrated(self, started: float, tell: Progress, final: bool) -> Calibration:
        """Return what the turns that have a place say together."""
        tell('reconstructing turns', 0.0)
        # what is told of turns that are not used must not depend on who is first
        scenes, stored = self._wanted_scenes(tell, everything=final or not self._live)
        solution = None
        used: set[int] = set()
        if scenes:
            solution = self._workshop.run(solve_scenes, scenes, self._config, progress=tell)
            used = {scene.center for scene in solution.scenes} if solution else set()
            for scene in scenes:
                if scene.center not in used:
                    self._reject(scene.center)
            self._store_turns()
        ended = time.monotonic()
        with self._lock:
            evidence = Evidence(
                image_size=self._size or (0, 0), frames=self._frames,
                turns=self._detector.turns(), built=self._workshop.scenes(),
                magnitudes=self._detector.magnitudes(), mask=self._motion.valid(),
                shrink=shrink_factor(self._size or (1, 1), self._config.max_width),
                timing={'detect': self._detect_s, 'calibrate': ended - started,
                        'total': ended - self._started})
            warnings = (*self._motion.warnings(), *self._warnings)
        return replace(conclude(solution, evidence, self._config), warnings=warnings,
                       stored_turns=tuple(_summary(turn, used) for turn in stored.values()))

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
            built = self._built()[:self._places]
            stored = len(self._archive.turns)
            return Status(self._frames, len(self._detector.turns()) + stored, len(built),
                          sum(scene.yaw_deg for scene in built), self._detector.magnitude,
                          self._standing, tuple(scene.center for scene in built), stored)

    def forget_stored(self) -> None:
        """Drop the turns of earlier drives, on disk too: the camera is not what it was."""
        with self._lock:
            self._archive.turns.clear()
        self._store_turns()

    def clear_store(self) -> None:
        """Remove all turns of this calibrator from turns.store; it stores no others."""
        self._archive.clear()

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

    # of these, the ranked, built, submit and undecided ones need the lock

    def _ranked(self) -> list[int]:
        """Return all turns, the most prominent first: this drive's by their centres."""
        found = [(-turn.prominence, turn.center) for turn in self._detector.turns()]
        found += [(-turn.prominence, key) for key, turn in self._archive.turns.items()]
        return [key for _, key in sorted(found)]

    def _built(self) -> list[Scene]:
        """Return the scenes there are, best first: a turn without one gives way to the next."""
        scenes = {**self._workshop.scenes(),
                  **{key: turn.scene for key, turn in self._archive.turns.items()}}
        return [scene for key in self._ranked() if (scene := scenes.get(key)) is not None]

    def _submit(self, replace_failed: bool = False) -> None:
        """Have the best turns built; live, all: a scene is a fiftieth of its images.

        A turn's images are chosen for good when it is confirmed, and not when it is built: what
        becomes of turns that overlap it must depend neither on how fast the children are, nor on
        whether the drive is live. For the same reason others are tried in the place of turns that
        gave no scene only when a calibration is asked for (replace_failed).
        """
        turns = {turn.center: turn for turn in self._detector.turns()}
        self._archive.drop_repeated(turn.stamp_s for turn in turns.values())
        built = self._workshop.scenes()
        self._workshop.keep_only(set(turns))
        places = self._places
        for key in self._ranked():
            turn = turns.get(key)
            if turn is not None and (places > 0 or self._live) and turn.frames:
                self._workshop.submit(turn, self._motion.valid())
                self._detector.release(key)
            elif turn is not None:
                self._detector.fix(key)
            if not (replace_failed and key in built and built[key] is None):
                places -= 1

    def _has_more(self) -> bool:
        """Tell whether there are turns beyond those that have a place."""
        with self._lock:
            return len(self._ranked()) > self._places

    def _undecided(self) -> bool:
        """Tell whether a turn that is not built yet may be among the best."""
        unbuilt = self._workshop.unbuilt()
        built = {scene.center for scene in self._built()}
        candidates = [key for key in self._ranked() if key in unbuilt or key in built]
        return any(key in unbuilt for key in candidates[:self._places])

    def _wanted_scenes(self, tell: Progress, everything: bool
                       ) -> tuple[list[Scene], dict[int, StoredTurn]]:
        """Return the scenes of the best turns, and the stored turns they were chosen among.

        everything: wait for the scenes of the other turns, too.
        """
        while True:
            total = max(self._workshop.waiting, 1)

            def ready(total: int = total) -> bool:
                waiting = self._workshop.waiting
                tell('reconstructing turns', max(0.0, 1 - waiting / total))
                if everything or not waiting:
                    return waiting == 0
                with self._lock:
                    return not self._undecided()

            self._workshop.wait(ready)
            if self._closed:
                raise WorkerError('the calibrator was closed while it calibrated')
            with self._lock:
                # only now: what is submitted meanwhile must not depend on the children's speed
                own = [scene for scene in self._workshop.scenes().values() if scene is not None]
                self._archive.drop_repeated((), own)
                self._submit(replace_failed=True)
                if not self._undecided() and not (everything and self._workshop.waiting):
                    return self._built()[:self._places], self._archive.turns.copy()

    def _reject(self, key: int) -> None:
        """Take out a scene that does not fit the others."""
        with self._lock:
            if self._archive.turns.pop(key, None) is None:
                self._workshop.reject(key)

    def _store_turns(self) -> None:
        """Have turns.store hold the scenes there are; whoever calls must not have the lock."""
        def snapshot() -> dict[int, StoredTurn]:
            with self._lock:
                built = self._workshop.scenes()
                own = {turn.center: StoredTurn(scene, turn.stamp_s, turn.prominence)
                       for turn in self._detector.turns()
                       if (scene := built.get(turn.center)) is not None}
                return {**self._archive.turns, **own}

        self._archive.mirror(snapshot)

    def _on_trouble(self, text: str) -> None:
        self._warnings.append(text)
        self._warn(text)


def _summary(turn: StoredTurn, used: set[int]) -> StoredTurnSummary:
    scene = turn.scene
    return StoredTurnSummary(scene.center, turn.stamp_s, turn.prominence, scene.yaw_deg,
                             len(scene.tracks.frames), scene.center in used)
