"""Turns are reconstructed in parallel by a few workers while the drive goes on."""
from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Set
from typing import Any

from dashcalib_ros import stages
from dashcalib_ros.arrays import Mask
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import Turn, TurnId
from dashcalib_ros.errors import DashcalibError, WorkerError
from dashcalib_ros.reconstruct.picture import TurnPicture, picture_of
from dashcalib_ros.reconstruct.scene import Draft, Scene
from dashcalib_ros.workers.jobs import Job, Jobs, back_off_s
from dashcalib_ros.workers.worker import Progress, Worker, WorkerDiedError

# if a worker dies on the same work this often, seconds apart, the work is the cause
ATTEMPTS = 5


class ScenePool:
    """Reconstructs turns in the background, by config.threads workers.

    A turn is reconstructed in two jobs, its draft and its scene; other jobs may run in between.
    If its worker dies or raises, it is tried again after a while. Only a turn on which workers die
    repeatedly, although they start without it, counts as one without a scene.

    All methods may be called from any thread. A thread that calls wait() or run() must not hold a
    lock that the callbacks, `until` or `progress` take; the other methods do not wait for workers.
    The pool's threads call the callbacks without holding a lock; callbacks must not raise.
    """

    def __init__(self, config: Config, make_worker: Callable[[], Worker],
                 queue: int | None = None, on_built: Callable[[], None] = lambda: None,
                 on_lost: Callable[[str], None] = lambda text: None,
                 on_trouble: Callable[[str], None] = lambda text: None,
                 keep_pictures: bool = False) -> None:
        """queue: how many turns may wait for a worker, with their images; None: any number.

        If there are more, as in a live drive, the least prominent counts as one without a scene.
        on_built: called when a turn is done. on_lost: called with a line when a turn is given up.
        on_trouble: called with a line when a worker failed and its work is tried again.
        keep_pictures: pictures() has one of each turn that is done.
        """
        self._config = config
        self._on_built, self._on_lost, self._on_trouble = on_built, on_lost, on_trouble
        self._workers = tuple(make_worker() for _ in range(config.threads))
        self._closed = threading.Event()
        self._threads: list[threading.Thread] = []
        # guards all that follows; held only briefly
        self._changed = threading.Condition()
        self._changes = 0
        self._free = list(self._workers)
        # how many run() calls wait for a worker: they have priority over turns
        self._borrowers = 0
        self._jobs = Jobs(queue)
        # all turns without a result, also those that a worker has now
        self._unbuilt: set[TurnId] = set()
        self._scenes: dict[TurnId, Scene | None] = {}
        self._keep_pictures = keep_pictures
        self._pictures: dict[TurnId, TurnPicture] = {}
        # those that wait() has not raised yet
        self._errors: dict[TurnId, Exception] = {}

    def submit(self, turn: Turn, valid: Mask | None) -> None:
        """Have a turn reconstructed; one that was submitted before is not done again."""
        with self._changed:
            known = turn.id in self._unbuilt or turn.id in self._scenes
            if self._closed.is_set() or known:
                return
            if not self._threads:
                self._threads = [threading.Thread(target=self._work, daemon=True)
                                 for _ in self._workers]
                for thread in self._threads:
                    thread.start()
            self._unbuilt.add(turn.id)
            self._put(Job(turn, valid))

    def keep_only(self, turns: Set[TurnId]) -> None:
        """Drop the scenes and the jobs of all other turns."""
        with self._changed:
            self._unbuilt &= turns
            self._jobs.keep_only(turns)
            for turn in (self._scenes.keys() | self._errors.keys()) - turns:
                self._scenes.pop(turn, None)
                self._errors.pop(turn, None)
                self._pictures.pop(turn, None)

    def reject(self, turn: TurnId) -> None:
        """Take out a scene that does not fit the others; its turn counts as one without."""
        with self._changed:
            self._scenes[turn] = None

    def unbuilt(self) -> frozenset[TurnId]:
        """Return the turns that are not done yet."""
        with self._changed:
            return frozenset(self._unbuilt)

    def scenes(self) -> dict[TurnId, Scene | None]:
        """Return the results by turn: scenes, None for a turn that gave none."""
        with self._changed:
            return dict(self._scenes)

    def pictures(self) -> dict[TurnId, TurnPicture]:
        """Return a picture of each turn that is done; none unless they are to be kept."""
        with self._changed:
            return dict(self._pictures)

    def pids(self) -> list[int]:
        """Return the process ids of the workers that have one."""
        return [pid for worker in self._workers if (pid := worker.pid) is not None]

    def wait(self, until: Callable[[], bool]) -> None:
        """Wait until the condition holds, or the pool is closed.

        Raises each error of a turn's reconstruction once; the turn is tried again in any case.
        """
        while True:
            with self._changed:
                seen = self._changes
                if self._errors:
                    raise self._errors.pop(min(self._errors))
                if self._closed.is_set():
                    return
            if until():
                return
            with self._changed:
                if self._changes == seen:
                    self._changed.wait(0.2)

    def run(self, function: Callable[..., Any], *arguments: Any,
            progress: Progress | None = None) -> Any:
        """Run a function in the next free worker; try again if the worker dies.

        progress: called in this thread. Raises what the function raises, and WorkerDiedError.
        """
        failures = 0
        while True:
            try:
                with self._borrowed() as worker:
                    return worker.call(function, *arguments, progress=progress)
            except WorkerDiedError as error:
                failures += 1
                if self._closed.is_set() or failures == ATTEMPTS:
                    raise
                self._on_trouble(str(error))
            self._closed.wait(back_off_s(failures))

    def close(self) -> None:
        """End every worker; a run() in another thread raises, a wait() returns."""
        self._closed.set()
        for worker in self._workers:
            worker.close()
        with self._changed:
            self._notify()
        for thread in self._threads:
            thread.join(timeout=5)

    @contextlib.contextmanager
    def _borrowed(self) -> Iterator[Worker]:
        with self._changed:
            self._borrowers += 1
            while not self._free and not self._closed.is_set():
                self._changed.wait()
            self._borrowers -= 1
            if not self._free:
                raise WorkerDiedError('the calibrator is closed')
            worker = self._free.pop()
        try:
            yield worker
        finally:
            self._give_back(worker)

    def _give_back(self, worker: Worker) -> None:
        with self._changed:
            self._free.append(worker)
            self._notify()

    def _work(self) -> None:
        # a function of its own: its variables must not keep a turn's images while it waits
        while self._work_once():
            pass

    def _work_once(self) -> bool:
        """Wait for a job and a free worker, and run the job; return False when closed."""
        with self._changed:
            while (job := self._next()) is None:
                if self._closed.is_set():
                    return False
                self._changed.wait(self._jobs.pause_s())
            worker = self._free.pop()
        try:
            self._reconstruct(worker, job)
        finally:
            self._give_back(worker)
        return True

    def _next(self) -> Job | None:
        spare = len(self._free) > self._borrowers
        return self._jobs.take() if spare and not self._closed.is_set() else None

    def _reconstruct(self, worker: Worker, job: Job) -> None:
        """Run a job: the draft of a turn, or its scene."""
        try:
            if job.draft is None:
                done = worker.call(stages.draft, job.turn, self._config, job.valid)
            else:
                done = worker.call(stages.finish, job.turn, self._config, job.draft)
        except Exception as error:
            self._failed(worker, job.failed(), error)
            return
        if isinstance(done, Draft):
            with self._changed:
                if job.turn.id in self._unbuilt:
                    self._put(job.drafted(done))
            return
        picture = picture_of(job.turn, done) if self._keep_pictures else None
        self._settle(job.turn.id, done, picture)
        self._on_built()

    def _failed(self, worker: Worker, job: Job, error: Exception) -> None:
        """Have a turn tried again, or give it up."""
        if isinstance(error, WorkerDiedError) and job.failures % ATTEMPTS:
            self._try_again(job, error, report=False)
        elif isinstance(error, WorkerDiedError):
            try:
                worker.call(stages.load)
            except Exception as reason:
                # the turn is not the cause: workers die without it, too
                self._try_again(job, WorkerError(
                    f'no reconstruction process can start: {reason}; --verbose shows its output'))
            else:
                # the other turns can still be used
                self._settle(job.turn.id, None)
                self._on_lost(f'{job.name} ended the reconstruction process {job.failures} times '
                              f'and was left out')
        elif isinstance(error, DashcalibError):
            self._try_again(job, error)
        else:
            self._try_again(job, WorkerError(
                f'reconstruction of {job.name} failed: {type(error).__name__}: {error}'))

    def _try_again(self, job: Job, error: Exception, report: bool = True) -> None:
        """Put a job back; report: wait() raises the error."""
        with self._changed:
            if self._closed.is_set() or job.turn.id not in self._unbuilt:
                return
            if report:
                self._errors[job.turn.id] = error
            self._put(job)
        self._on_trouble(f'{error}; {job.name} is tried again')

    # with the lock held (a thread may take a Condition's lock again)

    def _put(self, job: Job) -> None:
        dropped = self._jobs.put(job)
        if dropped is not None:
            self._settle(dropped.turn.id, None)
        self._notify()

    def _settle(self, turn: TurnId, scene: Scene | None,
                picture: TurnPicture | None = None) -> None:
        with self._changed:
            # keep_only() may have dropped it meanwhile
            if turn in self._unbuilt:
                self._unbuilt.remove(turn)
                self._errors.pop(turn, None)
                self._scenes[turn] = scene
                if picture is not None:
                    self._pictures[turn] = picture

    def _notify(self) -> None:
        self._changes += 1
        self._changed.notify_all()
