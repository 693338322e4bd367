"""Turns are made into scenes side by side, in child processes, while the drive goes on."""
from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Set
from typing import Any

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import Config
from dashcalib_ros.errors import DashcalibError, WorkerError
from dashcalib_ros.reconstruction.child import Child, ChildDiedError
from dashcalib_ros.reconstruction.scene import Scene
from dashcalib_ros.turns.turn import Turn

Mask = npt.NDArray[np.bool_]
# a child that dies on the same turn so often will die on it again
ATTEMPTS = 3
BACK_OFF_S = 1.0


class Workshop:
    """Builds scenes in the background. All methods may be called from any thread.

    A turn stays in the queue until its scene is there: a child that dies loses nothing.
    """

    def __init__(self, config: Config, low_priority: bool = False, verbose: bool = False) -> None:
        self._config = config
        self._children = [Child(low_priority, verbose) for _ in range(config.threads)]
        self._jobs: queue.SimpleQueue[tuple[Turn, Mask | None] | None] = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._changed = threading.Condition()
        self._scenes: dict[int, Scene | None] = {}
        self._waiting: set[int] = set()
        self._error: Exception | None = None
        self._failed: list[tuple[Turn, Mask | None]] = []
        self._changes = 0
        self._closed = False
        self._ended = threading.Event()
        self._solver = Child(low_priority, verbose)

    def submit(self, turn: Turn, valid: Mask | None) -> None:
        """Have a turn built; a turn that was submitted before is not built again."""
        with self._changed:
            if self._closed or turn.center in self._waiting or turn.center in self._scenes:
                return
            self._waiting.add(turn.center)
            if not self._threads:
                self._threads = [threading.Thread(target=self._work, args=(child,), daemon=True)
                                 for child in self._children]
                for thread in self._threads:
                    thread.start()
            self._jobs.put((turn, valid))

    def keep_only(self, centers: Set[int]) -> None:
        """Drop the scenes, and the wish for scenes, of all other turns."""
        with self._changed:
            self._waiting &= centers
            self._scenes = {center: scene for center, scene in self._scenes.items()
                            if center in centers}

    def reject(self, center: int) -> None:
        """Take out a scene that does not fit the others; its turn counts as one without."""
        with self._changed:
            self._scenes[center] = None

    @property
    def waiting(self) -> int:
        """Return how many turns are not built yet."""
        return len(self._waiting)

    def scenes(self) -> dict[int, Scene | None]:
        """Return what has been built, by the turn's centre; None where no scene came of it."""
        with self._changed:
            return dict(self._scenes)

    def wait(self, until: Callable[[], bool]) -> None:
        """Wait until the condition holds; raises what a worker raised.

        The turn that it was raised for is tried again, for whoever waits next.
        The condition is asked without a lock: it may take the caller's own, or show progress.
        """
        while True:
            with self._changed:
                seen = self._changes
                if self._error is not None:
                    error, self._error = self._error, None
                    for job in self._failed:
                        self._jobs.put(job)
                    self._failed.clear()
                    raise error
                if self._closed:
                    return
            if until():
                return
            with self._changed:
                if self._changes == seen:
                    self._changed.wait(0.2)

    def run(self, function: Callable[..., Any], *arguments: Any,
            progress: Callable[[str, float], None] | None = None) -> Any:
        """Run a function in a child of its own; a child that dies is tried again."""
        for attempt in range(ATTEMPTS):
            try:
                return self._solver.call(function, *arguments, progress=progress)
            except ChildDiedError:
                if self._closed or attempt == ATTEMPTS - 1:
                    raise
                self._ended.wait(BACK_OFF_S * 2**attempt)
        raise AssertionError('unreachable')

    def pids(self) -> list[int]:
        """Return the process ids of the children that run."""
        found = [child.pid for child in (*self._children, self._solver)]
        return [pid for pid in found if pid is not None]

    def close(self) -> None:
        """End every child; what waits for one is told that the calibrator is closed."""
        with self._changed:
            self._closed = True
            self._ended.set()
            self._changed.notify_all()
        for _ in self._threads:
            self._jobs.put(None)
        for child in (*self._children, self._solver):
            child.close()
        for thread in self._threads:
            thread.join(timeout=5)

    def _work(self, child: Child) -> None:
        while (job := self._jobs.get()) is not None and not self._closed:
            turn, valid = job
            if turn.center not in self._waiting:
                continue
            scene, error = self._built(child, turn, valid)
            with self._changed:
                if error is not None:
                    self._error = error
                    self._failed.append(job)
                elif turn.center in self._waiting:
                    self._waiting.remove(turn.center)
                    self._scenes[turn.center] = scene
                self._changes += 1
                self._changed.notify_all()

    def _built(self, child: Child, turn: Turn, valid: Mask | None
               ) -> tuple[Scene | None, Exception | None]:
        for attempt in range(ATTEMPTS):
            try:
                return child.call(build_turn, turn, self._config, valid), None
            except ChildDiedError:
                if self._closed or attempt == ATTEMPTS - 1:
                    break
                self._ended.wait(BACK_OFF_S * 2**attempt)
            except DashcalibError as error:
                return None, error
            except Exception as error:
                return None, WorkerError(f'reconstruction of the turn at frame {turn.center} '
                                         f'failed: {type(error).__name__}: {error}')
        # a turn that kills the child every time is no evidence; the others still are
        return None, None


def build_turn(turn: Turn, config: Config, valid: Mask | None) -> Scene | None:
    """Run in the child: COLMAP is loaded there only."""
    import cv2

    from dashcalib_ros.reconstruction.build import build_scene
    try:
        return build_scene(turn, config.tracks, config.scene, valid, config.seed)
    except (np.linalg.LinAlgError, cv2.error):
        # hopeless pictures make hopeless equations: such a turn has no scene, the others still may
        return None
