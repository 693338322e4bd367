# SPDX-License-Identifier: Apache-2.0
"""A few workers reconstruct turns, and do what is waited for, while the drive goes on."""
from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from dashcalib_ros import reconstruct
from dashcalib_ros.arrays import Mask
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import Turn, TurnId
from dashcalib_ros.errors import DashcalibError, Notice, WorkerError, coded
from dashcalib_ros.reconstruct.scene import Draft, Scene, TurnPicture, picture_of
from dashcalib_ros.workers.child import ChildWorker
from dashcalib_ros.workers.memory import return_free_memory
from dashcalib_ros.workers.worker import (
    InlineWorker,
    Progress,
    Worker,
    WorkerDiedError,
    load_all,
    load_judging,
    load_solving,
)

# if a worker dies in the same call this often, seconds apart, the call may be the cause
ATTEMPTS = 5
# s between two looks at what is waited for, and between two calls of on_wait
LOOK_S, ON_WAIT_S = 0.2, 0.02
# s; before the second attempt, doubled before each further one
BACK_OFF_S = 1.0
LONGEST_BACK_OFF_S = 60.0
# turns that wait for a worker in a live drive, each with up to 61 images: 56 MB of 1280x720. On a
# busy machine five of them were more than half of the node's memory
LIVE_QUEUE = 2
# of a call that somebody waits for
HIGHEST = (math.inf,)


@dataclass(eq=False)
class Call:
    """A function for a worker, and what came of it.

    reports: whether it has a parameter `progress`; news: what it reported and nobody took yet.
    turn: whose draft or scene it makes; None for a function that somebody waits for. priority:
    the greatest is next. failures: how often it failed. not_before: when to try again, in s of
    time.monotonic(). error: why it failed; of a turn, which is tried again, until wait() raised
    it.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    reports: bool = False
    turn: Turn | None = None
    priority: tuple[float, ...] = HIGHEST
    running: bool = False
    failures: int = 0
    not_before: float = 0.0
    news: deque[tuple[str, float]] = field(default_factory=deque)
    done: bool = False
    result: Any = None
    error: Exception | None = None


def back_off_s(failures: int) -> float:
    """Return how long to wait after so many failures, at least one."""
    return min(BACK_OFF_S * 2.0**min(failures - 1, 30), LONGEST_BACK_OFF_S)


class ScenePool:
    """Reconstructs turns in the background, by config.workers workers, and runs other functions.

    A turn takes two calls, its draft and its scene; other calls may run in between. A call whose
    worker dies is tried again after a while; so is a turn's that raises. Only a call in which
    workers die repeatedly, although they start without it, is given up: its turn counts as one
    without a scene.

    Each worker has a thread of the pool. All methods may be called from any thread; only wait(),
    run() and result() wait for workers. The pool's threads call on_trouble, which must not raise.

    lost: a line for each turn that was given up.
    """

    def __init__(self, config: Config, make_worker: Callable[[], Worker],
                 load: Callable[[], object], queue: int | None = None,
                 on_trouble: Callable[[str], None] = lambda text: None,
                 keep_pictures: bool = False,
                 on_wait: Callable[[], bool] | None = None) -> None:
        """load: imports what the calls need; each worker begins with it.

        queue: how many turns may wait for a worker, with their images; None: any number. If there
        are more, as in a live drive, the least prominent counts as one without a scene.
        on_trouble: called with a line when a worker failed and its work is tried again, and when
        a turn is given up.
        keep_pictures: pictures() has one of each turn that is done. on_wait: called again and
        again, in the thread that waits, while wait(), run() or result() waits; returns whether it
        did something, and is called again at once then.
        """
        self._config = config
        self._load = load
        self._queue = queue
        self._keep_pictures = keep_pictures
        self.lost: list[Notice] = []
        self._on_trouble, self._on_wait = on_trouble, on_wait
        self._workers = tuple(make_worker() for _ in range(config.workers))
        self._closed = threading.Event()
        self._threads: list[threading.Thread] = []
        # guards all that follows; held only briefly
        self._changed = threading.Condition()
        self._changes = 0
        # all that have no outcome yet, also those that a worker has now
        self._calls: list[Call] = []
        self._scenes: dict[TurnId, Scene | None] = {}
        self._pictures: dict[TurnId, TurnPicture] = {}

    # turns ------------------------------------------------------------------------------------

    def submit(self, turn: Turn, valid: Mask | None) -> None:
        """Have a turn reconstructed; one that was submitted before is not done again.

        valid: where its pictures show no ego vehicle; None: everywhere.
        """
        with self._changed:
            if turn.id not in self._scenes and turn.id not in self.unbuilt():
                self._put(self._half(reconstruct.draft, turn, valid))

    def keep_only(self, turns: Set[TurnId]) -> None:
        """Drop the scenes and the calls of all other turns, with their images."""
        with self._changed:
            self._calls = [call for call in self._calls
                           if call.turn is None or call.turn.id in turns]
            for turn in self._scenes.keys() - turns:
                del self._scenes[turn]
                self._pictures.pop(turn, None)

    def unbuilt(self) -> frozenset[TurnId]:
        """Return the turns that are not done yet."""
        with self._changed:
            return frozenset(call.turn.id for call in self._calls if call.turn is not None)

    def scenes(self) -> dict[TurnId, Scene | None]:
        """Return the results by turn: scenes, None for a turn that gave none."""
        with self._changed:
            return dict(self._scenes)

    def pictures(self) -> dict[TurnId, TurnPicture]:
        """Return a picture of each turn that is done; none unless they are to be kept."""
        with self._changed:
            return dict(self._pictures)

    def wait(self, until: Callable[[], bool]) -> None:
        """Wait until the condition holds, or the pool is closed.

        Raises each error of a turn's reconstruction once; the turn is tried again in any case.
        """
        def ended() -> bool:
            with self._changed:
                for call in self._calls:
                    if call.error is not None:
                        error, call.error = call.error, None
                        raise error
            return until()

        self._wait(ended)

    def wait_for_turns(self, progress: Progress, enough: Callable[[], bool]) -> None:
        """Wait until all turns are done, or these are enough; raises as wait() does.

        progress: called with the stage and the share done. Raises WorkerError when closed.
        """
        total = max(len(self.unbuilt()), 1)

        def ready() -> bool:
            waiting = len(self.unbuilt())
            progress('reconstructing turns', max(0.0, 1 - waiting / total))
            return not waiting or enough()

        self.wait(ready)
        self.check_open()

    # other functions --------------------------------------------------------------------------

    def run(self, function: Callable[..., Any], *arguments: Any,
            progress: Progress | None = None) -> Any:
        """Run a function in the next free worker; see result()."""
        return self.result(self.begin(function, *arguments, reports=progress is not None),
                           progress)

    def begin(self, function: Callable[..., Any], *arguments: Any, reports: bool = False) -> Call:
        """Have a function run in the next free worker, for result(); reports: its progress."""
        call = Call(function, arguments, reports)
        with self._changed:
            self._put(call)
        return call

    def result(self, call: Call, progress: Progress | None = None) -> Any:
        """Wait for a function that was begun, and return its result.

        progress: called in this thread. Raises what the function raises, WorkerDiedError where
        workers die of it or the pool is closed, and WorkerError where none can start.
        """
        def ended() -> bool:
            done = call.done  # before its last news are taken
            while call.news and progress is not None:
                progress(*call.news.popleft())
            return done

        self._wait(ended)
        if call.done and call.error is None:
            return call.result
        self.check_open()
        assert call.error is not None
        raise call.error

    def drop(self, call: Call) -> None:
        """Have a function not run, or not again: its result is not wanted any more."""
        with self._changed:
            self._calls = [each for each in self._calls if each is not call]

    # the workers ------------------------------------------------------------------------------

    def start(self) -> None:
        """Have the workers import what they need, before there is work for them."""
        with self._changed:
            if not self._threads and not self._closed.is_set():
                self._threads = [threading.Thread(target=self._work, args=(worker,), daemon=True)
                                 for worker in self._workers]
                for thread in self._threads:
                    thread.start()

    def check_open(self) -> None:
        """Raise WorkerDiedError where close() was called."""
        if self._closed.is_set():
            raise WorkerDiedError('E-CALIBRATOR-CLOSED', 'the calibrator is closed')

    def pids(self) -> list[int]:
        """Return the process ids of the workers that have one."""
        return [pid for worker in self._workers if (pid := worker.pid) is not None]

    def close(self) -> None:
        """End every worker; a result() in another thread raises, a wait() returns."""
        self._closed.set()
        for worker in self._workers:
            worker.close()
        with self._changed:
            self._calls.clear()  # they have images
            self._notify()
        for thread in self._threads:
            if thread.is_alive():  # else an interrupt came before it started
                thread.join(timeout=5)

    def _wait(self, ended: Callable[[], bool]) -> None:
        while True:
            with self._changed:
                seen = self._changes
            if ended() or self._closed.is_set():
                return
            if self._on_wait is not None and self._on_wait():
                continue
            with self._changed:
                if self._changes == seen:
                    self._changed.wait(LOOK_S if self._on_wait is None else ON_WAIT_S)

    def _work(self, worker: Worker) -> None:
        with suppress(Exception):  # the first call will say what is wrong
            worker.call(self._load)
        # a function of its own: its variables must not keep a turn's images while it waits
        while self._work_once(worker):
            return_free_memory()

    def _work_once(self, worker: Worker) -> bool:
        """Wait for a call, and have the worker do it; return False when closed."""
        call = None
        with self._changed:
            while not self._closed.is_set() and (call := self._take()) is None:
                self._changed.wait(self._pause_s())
        if call is None:
            return False
        self._attempt(worker, call)
        with self._changed:
            self._notify()
        return True

    def _attempt(self, worker: Worker, call: Call) -> None:
        def report(stage: str, share: float) -> None:
            call.news.append((stage, share))
            with self._changed:
                self._notify()

        try:
            call.result = worker.call(call.function, *call.arguments,
                                      progress=report if call.reports else None)
        except Exception as error:
            self._failed(worker, call, error)
        else:
            self._succeeded(call)

    def _succeeded(self, call: Call) -> None:
        turn, result = call.turn, call.result
        if turn is not None and isinstance(result, Draft):
            keyframes = set(result.tracks.frames.tolist())
            frames = tuple(frame for frame in turn.frames if frame.index in keyframes)
            second = self._half(reconstruct.finish, replace(turn, frames=frames), result)
            with self._changed:
                if call in self._calls:
                    self._calls.remove(call)
                    self._put(second)
            return
        picture = picture_of(turn, result) if turn is not None and self._keep_pictures else None
        self._end(call, picture)

    def _failed(self, worker: Worker, call: Call, error: Exception) -> None:
        call.failures += 1
        if isinstance(error, WorkerDiedError):
            if call.failures % ATTEMPTS:
                self._try_again(call, error)
                return
            try:
                worker.call(self._load)
            except Exception as reason:
                # the call is not the cause: workers die without it, too
                error = WorkerError('E-WORKER-CANNOT-LOAD', f'no reconstruction process can '
                                    f'start: {reason}; --verbose shows its output')
        if call.turn is None:
            call.error = error
            self._end(call)
        elif isinstance(error, WorkerDiedError):
            # the other turns can still be used
            self._end(call)
            self.lost.append(Notice(
                'E-TURN-LEFT-OUT', f'{call.turn.id} ended the reconstruction process '
                                   f'{call.failures} times and was left out'))
            self._on_trouble(str(self.lost[-1]))
        else:
            if not isinstance(error, DashcalibError):
                error = WorkerError('E-TURN-FAILED', f'reconstruction of {call.turn.id} failed: '
                                                     f'{type(error).__name__}: {error}')
            call.error = error
            self._try_again(call, error)

    def _try_again(self, call: Call, error: Exception) -> None:
        with self._changed:
            if self._closed.is_set() or call not in self._calls:
                return
            self._calls.remove(call)
            call.running, call.not_before = False, time.monotonic() + back_off_s(call.failures)
            self._put(call)
        what = 'its work' if call.turn is None else call.turn.id
        self._on_trouble(f'{coded(error)}; {what} is tried again')

    def _half(self, function: Callable[..., Any], turn: Turn, given: Mask | Draft | None) -> Call:
        """Return one half of a turn's reconstruction.

        Live, the most prominent turn comes first. Else drafts come before scenes, and longer turns
        before shorter ones, so that the workers end at about the same time.
        """
        priority = ((function is reconstruct.draft, turn.images) if self._queue is None
                    else (turn.prominence,))
        return Call(function, (turn, self._config, given), turn=turn, priority=priority)

    # with the lock held (a thread may take a Condition's lock again)

    def _put(self, call: Call) -> None:
        if self._closed.is_set():
            return
        self.start()
        self._calls.append(call)
        waiting = [each for each in self._calls if each.turn is not None and not each.running]
        if self._queue is not None and len(waiting) > self._queue:
            self._end(min(waiting, key=lambda each: each.priority))
        self._notify()

    def _take(self) -> Call | None:
        """Return the call that is next, None if none is due."""
        now = time.monotonic()
        due = [call for call in self._calls if not call.running and call.not_before <= now]
        if not due:
            return None
        call = max(due, key=lambda call: call.priority)
        call.running = True
        return call

    def _pause_s(self) -> float | None:
        now = time.monotonic()
        return min((max(call.not_before - now, 0.0) for call in self._calls if not call.running),
                   default=None)

    def _end(self, call: Call, picture: TurnPicture | None = None) -> None:
        with self._changed:
            call.done = True
            # keep_only() may have dropped it meanwhile
            if call in self._calls:
                self._calls.remove(call)
                if call.turn is not None:
                    self._scenes[call.turn.id] = call.result
                    if picture is not None:
                        self._pictures[call.turn.id] = picture

    def _notify(self) -> None:
        self._changes += 1
        self._changed.notify_all()


def pool_of(config: Config, live: bool, verbose: bool, inline: bool,
            on_trouble: Callable[[str], None], on_wait: Callable[[], bool] | None) -> ScenePool:
    """Return the pool of a Calibrator, whose parameters these are."""
    if live:
        # nothing else runs during an import: while images come, some would be lost
        load_judging()
    return ScenePool(
        config, InlineWorker if inline else partial(
            ChildWorker, live, verbose, config.workers, on_trouble),
        partial(load_all if live else load_solving, config.reconstruct.used),
        queue=LIVE_QUEUE if live else None, on_trouble=on_trouble,
        keep_pictures=not live, on_wait=on_wait)
