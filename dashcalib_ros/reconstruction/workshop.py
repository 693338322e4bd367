"""Turns are made into scenes side by side, in child processes, while the drive goes on."""
from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
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
        self._closed = False
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

    def forget(self, center: int) -> None:
        """Drop a scene whose turn is no longer wanted."""
        with self._changed:
            self._scenes.pop(center, None)

    @property
    def waiting(self) -> int:
        """Return how many turns are not built yet."""
        return len(self._waiting)

    def scenes(self) -> dict[int, Scene | None]:
        """Return what has been built, by the turn's centre; None where no scene came of it."""
        with self._changed:
            return dict(self._scenes)

    def wait(self, until: Callable[[], bool]) -> None:
        """Wait until the condition holds; raises what a worker raised."""
        with self._changed:
            while not until() and self._error is None and not self._closed:
                self._changed.wait(0.2)
            if self._error is not None:
                error, self._error = self._error, None
                raise error

    def run(self, function: Callable[..., Any], *arguments: Any,
            progress: Callable[[str, float], None] | None = None) -> Any:
        """Run a function in a child of its own; a child that dies is tried again."""
        for attempt in range(ATTEMPTS):
            try:
                return self._solver.call(function, *arguments, progress=progress)
            except ChildDiedError:
                if self._closed or attempt == ATTEMPTS - 1:
                    raise
                time.sleep(BACK_OFF_S * 2**attempt)
        raise AssertionError('unreachable')

    def pids(self) -> list[int]:
        """Return the process ids of the children that run."""
        found = [child.pid for child in (*self._children, self._solver)]
        return [pid for pid in found if pid is not None]

    def close(self) -> None:
        """End every child; what waits for one is told that the calibrator is closed."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for _ in self._threads:
            self._jobs.put(None)
        for child in (*self._children, self._solver):
            child.close()
        for thread in self._threads:
            thread.join(timeout=5)

    def _work(self, child: Child) -> None:
        # here and not above: only a process that reconstructs loads COLMAP; this names it
        while (job := self._jobs.get()) is not None and not self._closed:
            turn, valid = job
            scene, error = self._built(child, turn, valid)
            with self._changed:
                self._waiting.discard(turn.center)
                if error is None:
                    self._scenes[turn.center] = scene
                else:
                    self._error = error
                self._changed.notify_all()

    def _built(self, child: Child, turn: Turn, valid: Mask | None
               ) -> tuple[Scene | None, Exception | None]:
        for attempt in range(ATTEMPTS):
            try:
                return child.call(build_turn, turn, self._config, valid), None
            except ChildDiedError:
                if self._closed:
                    return None, None
                time.sleep(BACK_OFF_S * 2**attempt)
            except DashcalibError as error:
                return None, error
            except Exception as error:
                return None, WorkerError(f'reconstruction of the turn at frame {turn.center} '
                                         f'failed: {type(error).__name__}: {error}')
        # a turn that kills the child every time is no evidence; the others still are
        return None, None


def build_turn(turn: Turn, config: Config, valid: Mask | None) -> Scene | None:
    """Run in the child: COLMAP is loaded there only."""
    from dashcalib_ros.reconstruction.build import build_scene
    return build_scene(turn, config.tracks, config.scene, valid, config.seed)
