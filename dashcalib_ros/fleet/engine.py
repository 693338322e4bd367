"""Where tasks run: in one child process, or on Ray's workers, here or on a cluster.

A task that ends its worker (COLMAP aborts, the system is out of memory) is tried again, up to
`attempts` times; then its outcome is Died, and the others go on.
"""
from __future__ import annotations

import math
import os
import sys
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dashcalib_ros.errors import DashcalibError, WorkerError, one_line
from dashcalib_ros.fleet.storage import needs
from dashcalib_ros.fleet.tasks import one_thread
from dashcalib_ros.workers.child import ChildWorker
from dashcalib_ros.workers.worker import THREAD_VARIABLES, Worker, WorkerDiedError

# tasks that are handed to Ray for each of its processors: enough that none waits
AHEAD = 3
# s between two looks at what Ray has done
LOOK_S = 1.0
# s between two counts of its processors
COUNT_S = 5.0


@dataclass(frozen=True)
class Task:
    """A module-level function and its arguments. key: tells whose outcome it is."""

    key: tuple[str, str]
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Died:
    """A task that ended its worker each time. attempts: how often. reason: the last one."""

    attempts: int
    reason: str


def _known(error: Exception) -> DashcalibError:
    """Return a task's error; one that nobody expected must not end the tasks of others."""
    if isinstance(error, DashcalibError):
        return error
    return WorkerError(f'{type(error).__name__}: {one_line(error)}; this is a defect of '
                       f'dashcalib: report it with the clip')


class Engine(ABC):
    """Runs tasks; outcomes come in any order."""

    def __init__(self, attempts: int) -> None:
        self._waiting: deque[Task] = deque()
        self._attempts = attempts

    def submit(self, task: Task, first: bool = False) -> None:
        """Take a task; first: before all that wait."""
        (self._waiting.appendleft if first else self._waiting.append)(task)

    @abstractmethod
    def outcomes(self) -> Iterator[tuple[tuple[str, str], Any]]:
        """Yield (key, result), until no task is left; tasks may be submitted meanwhile.

        A result is what the function returned, the DashcalibError that it raised, or Died.
        """

    @abstractmethod
    def close(self) -> None:
        """End the workers."""


class OneWorker(Engine):
    """One worker, one task after the other; see Engine."""

    def __init__(self, attempts: int, worker: Worker | None = None) -> None:
        """worker: a child process where None is given."""
        super().__init__(attempts)
        self._worker = worker or ChildWorker()

    def outcomes(self) -> Iterator[tuple[tuple[str, str], Any]]:
        """Yield the outcomes; see Engine."""
        while self._waiting:
            task = self._waiting.popleft()
            yield task.key, self._outcome(task)

    def _outcome(self, task: Task) -> Any:
        reason = ''
        for _ in range(self._attempts):
            try:
                return self._worker.call(task.function, *task.arguments)
            except WorkerDiedError as error:
                reason = one_line(error)
            except Exception as error:
                return _known(error)
        return Died(self._attempts, reason)

    def close(self) -> None:
        """End the worker."""
        self._worker.close()


class RayEngine(Engine):
    """Ray's workers, one thread and one task each; see Engine.

    A task whose node was lost is tried again without being counted: that is no fault of its own.
    """

    def __init__(self, attempts: int, memory_mb: int, workers: int | None = None,
                 address: str | None = None) -> None:
        """workers: processes of this machine, by default one a core. address: of a cluster.

        Raises ConfigError without Ray, WorkerError where it does not start.
        """
        super().__init__(attempts)
        self._ray = needs('ray', 'several workers (--workers 1 does without)')
        self._running: dict[Any, Task] = {}
        self._died: dict[tuple[str, str], int] = {}
        self._lost_nodes = 0
        self._places, self._counted_at = 0, -math.inf
        environment = {name: '1' for name in THREAD_VARIABLES}
        if not address:
            # as a child process finds it; another machine has other paths
            environment['PYTHONPATH'] = os.pathsep.join(path or str(Path.cwd())
                                                        for path in sys.path)
        os.environ.setdefault('RAY_USAGE_STATS_ENABLED', '0')
        options: dict[str, Any] = {'address': address} if address else {
            'num_cpus': workers or os.cpu_count(), 'include_dashboard': False}
        try:
            self._ours = not self._ray.is_initialized()
            if self._ours:
                self._ray.init(log_to_driver=False, logging_level='ERROR', configure_logging=True,
                               runtime_env={'env_vars': environment}, **options)
        except Exception as error:  # of many kinds, none of them ours
            where = f'at {address}' if address else 'on this machine'
            raise WorkerError(f'Ray does not start {where} ({one_line(error)}); check the '
                              f'address, or use --workers 1') from error
        self._remote = self._ray.remote(num_cpus=1, max_retries=0, memory=memory_mb * 2**20)(
            one_thread)

    def outcomes(self) -> Iterator[tuple[tuple[str, str], Any]]:
        """Yield the outcomes; see Engine. Raises WorkerError when Ray itself has ended."""
        while self._waiting or self._running:
            try:
                self._hand_over()
                ready, _ = self._ray.wait(list(self._running), timeout=LOOK_S)
                done = [(task, self._outcome(reference, task)) for reference in ready
                        for task in [self._running.pop(reference)]]
            except Exception as error:  # of many kinds, none of them ours
                raise WorkerError(f'Ray has ended ({one_line(error)}); start the command again: '
                                  f'what is done stays') from error
            for task, outcome in done:
                if outcome is None:
                    self.submit(task, first=True)
                else:
                    yield task.key, outcome[0]

    def _hand_over(self) -> None:
        if time.monotonic() - self._counted_at > COUNT_S:
            # nodes come and go
            cores = int(self._ray.cluster_resources().get('CPU', 1))
            self._places, self._counted_at = AHEAD * max(1, cores), time.monotonic()
        while self._waiting and len(self._running) < self._places:
            task = self._waiting.popleft()
            self._running[self._remote.remote(task.function, *task.arguments)] = task

    def _outcome(self, reference: Any, task: Task) -> tuple[Any] | None:
        """Return a task's outcome, None where it is to be tried again."""
        errors = self._ray.exceptions
        try:
            return (self._ray.get(reference),)
        except errors.RayTaskError as error:
            return (_known(error.cause or error),)
        except errors.LocalRayletDiedError:
            raise
        except (errors.NodeDiedError, errors.ObjectLostError, errors.RaySystemError):
            return None
        except (errors.WorkerCrashedError, errors.OutOfMemoryError) as error:
            if self._node_was_lost():
                return None
            count = self._died[task.key] = self._died.get(task.key, 0) + 1
            return (Died(count, one_line(error)),) if count >= self._attempts else None
        except errors.RayError as error:
            return (WorkerError(one_line(error)),)

    def _node_was_lost(self) -> bool:
        """Return whether a node of the cluster died since the last look."""
        dead = sum(not node['Alive'] for node in self._ray.nodes())
        more = dead > self._lost_nodes
        self._lost_nodes = dead
        return more

    def close(self) -> None:
        """End the workers that were started here."""
        if self._ours:
            self._ray.shutdown()
