"""Turns are made into scenes side by side, in child processes, while the drive goes on."""
from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import Config
from dashcalib_ros.errors import DashcalibError, WorkerError
from dashcalib_ros.reconstruction.child import Child, ChildDiedError
from dashcalib_ros.reconstruction.scene import Draft, Scene
from dashcalib_ros.turns.turn import Turn

Mask = npt.NDArray[np.bool_]
# a child that dies on the same turn so often will die on it again
ATTEMPTS = 3
BACK_OFF_S = 1.0


@dataclass(frozen=True)
class _Job:
    """A turn to be built, and where its pictures show no ego vehicle (None: everywhere).

    draft: the first half of the work, once it is done.
    """

    turn: Turn
    valid: Mask | None
    draft: Draft | None = None

    def with_draft(self, draft: Draft) -> _Job:
        """Return what is left to do, with the images that it needs."""
        keyframes = set(draft.tracks.frames.tolist())
        frames = tuple(frame for frame in self.turn.frames if frame.index in keyframes)
        return _Job(replace(self.turn, frames=frames), self.valid, draft)


class Workshop:
    """Builds scenes in the background. All methods may be called from any thread.

    A turn is built in two halves, its draft and its scene. Live, the most prominent turn is built
    first. Else the drafts come first, the longest turn's before others, so that the children end
    at about the same time. A turn stays until its scene is there: a child that dies loses nothing.
    """

    def __init__(self, config: Config, low_priority: bool = False, verbose: bool = False,
                 queue: int | None = None, on_built: Callable[[], None] = lambda: None,
                 on_lost: Callable[[str], None] = lambda text: None) -> None:
        """queue: how many turns may wait for a child, with their images; None: any number.

        With more, the least prominent of them counts as one without a scene: the drive is live.
        on_built: called from a thread of the workshop whenever a child is done with a turn; raises
        nothing.
        on_lost: the same, when a turn is given up because it ends every child; gets one line.
        """
        self._config = config
        self._queue = queue
        self._on_built, self._on_lost = on_built, on_lost
        # the last turn of an odd number has all cores to itself
        threads = 1 if low_priority else config.threads
        self._children = [Child(low_priority, verbose, threads) for _ in range(config.threads)]
        # by the turn's centre; those that a child has begun are in none of the two
        self._jobs: dict[int, _Job] = {}
        self._failed: dict[int, _Job] = {}
        self._threads: list[threading.Thread] = []
        self._changed = threading.Condition()
        self._scenes: dict[int, Scene | None] = {}
        self._waiting: set[int] = set()
        self._error: Exception | None = None
        self._changes = 0
        self._closed = False
        self._ended = threading.Event()
        self._solver = Child(low_priority, verbose)
        self._solving = threading.Lock()

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
            self._jobs[turn.center] = _Job(turn, valid)
            if self._queue is not None and len(self._jobs) > self._queue:
                worst = min(self._jobs.values(), key=lambda job: job.turn.prominence)
                self._jobs.pop(worst.turn.center)
                self._settle(worst.turn.center, None)
            self._changed.notify_all()

    def keep_only(self, centers: Set[int]) -> None:
        """Drop the scenes, and the wish for scenes, of all other turns."""
        with self._changed:
            self._waiting &= centers
            # and their images with them
            for jobs in (self._jobs, self._failed):
                for center in jobs.keys() - centers:
                    del jobs[center]
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

    def unbuilt(self) -> frozenset[int]:
        """Return the centres of the turns that are not built yet."""
        with self._changed:
            return frozenset(self._waiting)

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
                    self._jobs.update(self._failed)
                    self._failed.clear()
                    self._changed.notify_all()
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
                with self._solving:
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
        for child in (*self._children, self._solver):
            child.close()
        for thread in self._threads:
            thread.join(timeout=5)

    def _work(self, child: Child) -> None:
        # a thread that waits must not hold the images of the turn before
        while (built := self._begin_next(child)) is not None:
            if built:
                self._on_built()
            if not self._jobs and self._waiting:
                self._warm()

    def _warm(self) -> None:
        """Start the process of run() while another child builds the last turn."""
        # who is held by a lock until a solution is there builds no turn meanwhile
        if self._solver.pid is None and self._solving.acquire(blocking=False):
            try:
                with contextlib.suppress(DashcalibError):
                    self._solver.call(load_all)
            finally:
                self._solving.release()

    def _begin_next(self, child: Child) -> bool | None:
        """Do the next half of a turn; return whether it was the second, None when closed."""
        with self._changed:
            while not self._jobs and not self._closed:
                self._changed.wait()
            if self._closed:
                return None
            job = max(self._jobs.values(), key=self._urgency)
            del self._jobs[job.turn.center]
        built, error = self._built(child, job)
        center = job.turn.center
        with self._changed:
            # it may have left the bank meanwhile
            if center in self._waiting:
                if error is not None:
                    self._error = error
                    self._failed[center] = job
                elif isinstance(built, Draft):
                    self._jobs[center] = job.with_draft(built)
                else:
                    self._settle(center, built)
            self._changes += 1
            self._changed.notify_all()
        return not isinstance(built, Draft)

    def _urgency(self, job: _Job) -> tuple[float, ...]:
        if self._queue is not None:
            return (job.turn.prominence,)
        return job.draft is None, job.turn.images

    def _settle(self, center: int, scene: Scene | None) -> None:
        self._waiting.discard(center)
        self._scenes[center] = scene

    def _built(self, child: Child, job: _Job
               ) -> tuple[Draft | Scene | None, Exception | None]:
        for attempt in range(ATTEMPTS):
            try:
                if job.draft is None:
                    return child.call(draft_turn, job.turn, self._config, job.valid), None
                return child.call(build_turn, job.turn, self._config, job.draft), None
            except ChildDiedError:
                if self._closed:
                    return None, None
                if attempt < ATTEMPTS - 1:
                    self._ended.wait(BACK_OFF_S * 2**attempt)
            except DashcalibError as error:
                return None, error
            except Exception as error:
                return None, WorkerError(f'reconstruction of the turn at frame {job.turn.center} '
                                         f'failed: {type(error).__name__}: {error}')
        try:
            child.call(load_all)
        except ChildDiedError as error:
            # not the turn is to blame, and neither are the pictures
            return None, None if self._closed else WorkerError(
                f'no reconstruction process can live here: {error}; --verbose shows what it says')
        # a turn that kills the child every time is no evidence; the others still are
        self._on_lost(f'the turn at frame {job.turn.center} ended the reconstruction process '
                      f'{ATTEMPTS} times and was left out')
        return None, None


def load_all() -> None:
    """Run in the child: load what a turn needs."""
    import dashcalib_ros.reconstruction.build  # noqa: F401


def draft_turn(turn: Turn, config: Config, valid: Mask | None) -> Draft | None:
    """Run in the child: COLMAP is loaded there only."""
    from dashcalib_ros.reconstruction.build import draft_scene
    with _hopeless_pictures_give_none(turn):
        return draft_scene(turn, config.tracks, config.scene, valid, config.seed)


def build_turn(turn: Turn, config: Config, draft: Draft) -> Scene | None:
    """Run in the child: COLMAP is loaded there only."""
    from dashcalib_ros.reconstruction.build import finish_scene
    with _hopeless_pictures_give_none(turn):
        return finish_scene(turn, draft, config.scene, config.seed)


@contextlib.contextmanager
def _hopeless_pictures_give_none(turn: Turn) -> Iterator[None]:
    """Hopeless pictures make hopeless equations: such a turn has no scene, others may have."""
    import cv2
    try:
        yield
    except (np.linalg.LinAlgError, cv2.error) as error:
        # seen with --verbose; anybody else is told which turns were not reconstructed
        print(f'the turn at frame {turn.center} gives no scene: {error}', file=sys.stderr)
