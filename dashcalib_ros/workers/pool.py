"""Turns are reconstructed in parallel by a few workers while the drive goes on."""
from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Set
from dataclasses import dataclass, field, replace
from typing import Any

from dashcalib_ros import reconstruct
from dashcalib_ros.arrays import Mask
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import Turn, TurnId
from dashcalib_ros.errors import DashcalibError, WorkerError, coded
from dashcalib_ros.reconstruct.scene import Draft, Scene, TurnPicture, picture_of
from dashcalib_ros.workers.memory import return_free_memory
from dashcalib_ros.workers.worker import Progress, Worker, WorkerDiedError

# if a worker dies on the same work this often, seconds apart, the work is the cause
ATTEMPTS = 5
# s between two looks at what is waited for, and between two calls of on_wait
LOOK_S, CALL_S = 0.2, 0.02
# s; before the second attempt, doubled before each further one
BACK_OFF_S = 1.0
LONGEST_BACK_OFF_S = 60.0


@dataclass(frozen=True)
class Job:
    """A turn to be reconstructed, and where its pictures show no ego vehicle (None: everywhere).

    draft: the result of the first half of the work, if done. failures: how often it failed.
    not_before: when to try again, in s of time.monotonic().
    """

    turn: Turn
    valid: Mask | None
    draft: Draft | None = None
    failures: int = 0
    not_before: float = 0.0

    @property
    def name(self) -> str:
        """Return the turn's name, for messages."""
        return str(self.turn.id)

    def drafted(self, draft: Draft) -> Job:
        """Return the job for the second half, with only the images that it needs."""
        keyframes = set(draft.tracks.frames.tolist())
        frames = tuple(frame for frame in self.turn.frames if frame.index in keyframes)
        return Job(replace(self.turn, frames=frames), self.valid, draft)

    def failed(self) -> Job:
        """Return the job after one more failure, with the time of the next attempt."""
        failures = self.failures + 1
        return replace(self, failures=failures,
                       not_before=time.monotonic() + back_off_s(failures))


def back_off_s(failures: int) -> float:
    """Return how long to wait after so many failures, at least one."""
    return min(BACK_OFF_S * 2.0**min(failures - 1, 30), LONGEST_BACK_OFF_S)


class Jobs:
    """The jobs by their turn; for one thread at a time.

    most: how many there may be; None: any number. With a limit, in a live drive, the most
    prominent turn comes first. Else drafts come before scenes, and longer turns before shorter
    ones, so that the workers end at about the same time.
    """

    def __init__(self, most: int | None) -> None:
        self._most = most
        self._jobs: dict[TurnId, Job] = {}

    def put(self, job: Job) -> Job | None:
        """Add a job; if there are too many, drop the least prominent one and return it."""
        self._jobs[job.turn.id] = job
        if self._most is None or len(self._jobs) <= self._most:
            return None
        worst = min(self._jobs.values(), key=lambda job: job.turn.prominence)
        return self._jobs.pop(worst.turn.id)

    def take(self) -> Job | None:
        """Take out the job that is next, None if none is due."""
        now = time.monotonic()
        due = [job for job in self._jobs.values() if job.not_before <= now]
        if not due:
            return None
        if self._most is not None:
            job = max(due, key=lambda job: job.turn.prominence)
        else:
            job = max(due, key=lambda job: (job.draft is None, job.turn.images))
        return self._jobs.pop(job.turn.id)

    def pause_s(self) -> float | None:
        """Return how long until the next job is due, s; None if no job waits for its time."""
        now = time.monotonic()
        return min((job.not_before - now for job in self._jobs.values() if job.not_before > now),
                   default=None)

    def turns(self) -> set[TurnId]:
        """Return the turns that wait."""
        return set(self._jobs)

    def keep_only(self, turns: Set[TurnId]) -> None:
        """Drop the jobs of all other turns, with their images."""
        self._jobs = {turn: job for turn, job in self._jobs.items() if turn in turns}


@dataclass(eq=False)
class Call:
    """A function that a worker is to run, and what came of it. news: progress not told yet."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    tells: bool
    news: deque[tuple[str, float]] = field(default_factory=deque)
    done: bool = False
    result: Any = None
    error: Exception | None = None


class ScenePool:
    """Reconstructs turns in the background, by config.threads workers.

    A turn is reconstructed in two jobs, its draft and its scene; other jobs may run in between.
    If its worker dies or raises, it is tried again after a while. Only a turn on which workers die
    repeatedly, although they start without it, counts as one without a scene.

    Each worker has a thread of the pool. All methods may be called from any thread; only wait()
    and run() wait for workers. The pool's threads call on_lost and on_trouble, which must not
    raise.
    """

    def __init__(self, config: Config, make_worker: Callable[[], Worker],
                 queue: int | None = None,
                 on_lost: Callable[[str], None] = lambda text: None,
                 on_trouble: Callable[[str], None] = lambda text: None,
                 keep_pictures: bool = False,
                 on_wait: Callable[[], bool] | None = None) -> None:
        """queue: how many turns may wait for a worker, with their images; None: any number.

        If there are more, as in a live drive, the least prominent counts as one without a scene.
        on_lost: called with a line when a turn is given up. on_trouble: called with a line when a
        worker failed and its work is tried again.
        keep_pictures: pictures() has one of each turn that is done. on_wait: called again and
        again, in the thread that waits, while wait() or run() waits; returns whether it did
        something, and is called again at once then.
        """
        self._config = config
        self._on_lost, self._on_trouble, self._on_wait = on_lost, on_trouble, on_wait
        self._workers = tuple(make_worker() for _ in range(config.threads))
        self._closed = threading.Event()
        self._threads: list[threading.Thread] = []
        # guards all that follows; held only briefly
        self._changed = threading.Condition()
        self._changes = 0
        # those that wait for a worker: they have priority over turns
        self._calls: deque[Call] = deque()
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
            self._start()
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

    @property
    def closed(self) -> bool:
        """Return whether close() was called."""
        return self._closed.is_set()

    def pids(self) -> list[int]:
        """Return the process ids of the workers that have one."""
        return [pid for worker in self._workers if (pid := worker.pid) is not None]

    def wait(self, until: Callable[[], bool]) -> None:
        """Wait until the condition holds, or the pool is closed.

        Raises each error of a turn's reconstruction once; the turn is tried again in any case.
        """
        def ended() -> bool:
            with self._changed:
                if self._errors:
                    raise self._errors.pop(min(self._errors))
            return self._closed.is_set() or until()

        self._wait(ended)

    def run(self, function: Callable[..., Any], *arguments: Any,
            progress: Progress | None = None) -> Any:
        """Run a function in the next free worker; see result()."""
        return self.result(self.begin(function, *arguments, tells=progress is not None), progress)

    def begin(self, function: Callable[..., Any], *arguments: Any, tells: bool = False) -> Call:
        """Have a function run in the next free worker, for result(); tells: with progress."""
        call = Call(function, arguments, tells)
        with self._changed:
            if not self._closed.is_set():
                self._start()
            self._calls.append(call)
            self._notify()
        return call

    def result(self, call: Call, progress: Progress | None = None) -> Any:
        """Wait for a function that was begun, and return its result; try again if a worker dies.

        progress: called in this thread. Raises what the function raises, and WorkerDiedError.
        """
        failures = 0
        while True:
            def ended(call: Call = call) -> bool:
                while call.news and progress is not None:
                    progress(*call.news.popleft())
                return call.done

            self._wait(ended)
            if call.done and call.error is None:
                return call.result
            error = call.error or WorkerDiedError('E-CALIBRATOR-CLOSED',
                                                  'the calibrator is closed')
            failures += 1
            if (not isinstance(error, WorkerDiedError) or self._closed.is_set()
                    or failures == ATTEMPTS):
                raise error
            self._on_trouble(coded(error))
            self._pause(back_off_s(failures))
            call = self.begin(call.function, *call.arguments, tells=call.tells)

    def drop(self, call: Call) -> None:
        """Have a function not run if it waits for a worker; its result is not wanted any more."""
        with self._changed:
            if call in self._calls:
                self._calls.remove(call)

    def close(self) -> None:
        """End every worker; a run() in another thread raises, a wait() returns."""
        self._closed.set()
        for worker in self._workers:
            worker.close()
        with self._changed:
            self._notify()
        for thread in self._threads:
            if thread.is_alive():  # else an interrupt came before it started
                thread.join(timeout=5)

    def _pause(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        self._wait(lambda: time.monotonic() >= end)

    def _wait(self, ended: Callable[[], bool]) -> None:
        """Wait until the condition holds, or the pool is closed."""
        while True:
            with self._changed:
                seen = self._changes
            if ended() or self._closed.is_set():
                return
            if self._on_wait is not None and self._on_wait():
                continue
            with self._changed:
                if self._changes == seen:
                    self._changed.wait(LOOK_S if self._on_wait is None else CALL_S)

    def _work(self, worker: Worker) -> None:
        # a function of its own: its variables must not keep a turn's images while it waits
        while self._work_once(worker):
            return_free_memory()

    def _work_once(self, worker: Worker) -> bool:
        """Wait for a call or a job, and have the worker do it; return False when closed."""
        with self._changed:
            while not self._closed.is_set() and not self._calls:
                if (job := self._jobs.take()) is not None:
                    break
                self._changed.wait(self._jobs.pause_s())
            else:
                job = None
            if self._closed.is_set():
                return False
            call = None if job else self._calls.popleft()
        if job is not None:
            self._reconstruct(worker, job)
        elif call is not None:
            self._answer(worker, call)
        with self._changed:
            self._notify()
        return True

    def _answer(self, worker: Worker, call: Call) -> None:
        def tell(stage: str, share: float) -> None:
            call.news.append((stage, share))
            with self._changed:
                self._notify()

        try:
            call.result = worker.call(call.function, *call.arguments,
                                      progress=tell if call.tells else None)
        except Exception as error:
            call.error = error
        call.done = True

    def _reconstruct(self, worker: Worker, job: Job) -> None:
        """Run a job: the draft of a turn, or its scene."""
        try:
            if job.draft is None:
                done = worker.call(reconstruct.draft, job.turn, self._config, job.valid)
            else:
                done = worker.call(reconstruct.finish, job.turn, self._config, job.draft)
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

    def _failed(self, worker: Worker, job: Job, error: Exception) -> None:
        """Have a turn tried again, or give it up."""
        if isinstance(error, WorkerDiedError) and job.failures % ATTEMPTS:
            self._try_again(job, error, report=False)
        elif isinstance(error, WorkerDiedError):
            try:
                worker.call(reconstruct.load)
            except Exception as reason:
                # the turn is not the cause: workers die without it, too
                self._try_again(job, WorkerError(
                    'E-WORKER-CANNOT-LOAD',
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
                'E-TURN-FAILED',
                f'reconstruction of {job.name} failed: {type(error).__name__}: {error}'))

    def _try_again(self, job: Job, error: Exception, report: bool = True) -> None:
        """Put a job back; report: wait() raises the error."""
        with self._changed:
            if self._closed.is_set() or job.turn.id not in self._unbuilt:
                return
            if report:
                self._errors[job.turn.id] = error
            self._put(job)
        self._on_trouble(f'{coded(error)}; {job.name} is tried again')

    # with the lock held (a thread may take a Condition's lock again)

    def _start(self) -> None:
        if not self._threads:
            self._threads = [threading.Thread(target=self._work, args=(worker,), daemon=True)
                             for worker in self._workers]
            for thread in self._threads:
                thread.start()

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
