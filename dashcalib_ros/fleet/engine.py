# SPDX-License-Identifier: Apache-2.0
"""Where tasks run: in child processes of this machine, or on the workers of a Ray cluster.

A task that ends its worker (COLMAP aborts, the system is out of memory) is tried again, up to
`attempts` times; then its outcome is a DiedError, and the others go on.
"""
from __future__ import annotations

import math
import os
import resource
import time
from abc import ABC, abstractmethod
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

from dashcalib_ros.errors import DashcalibError, OutputError, WorkerError, one_line
from dashcalib_ros.fleet.storage import needs
from dashcalib_ros.whole_files import remove_leftovers
from dashcalib_ros.workers.worker import (
    THREAD_VARIABLES,
    InlineWorker,
    Worker,
    WorkerDiedError,
)

# tasks that are handed to Ray for each of its processors: enough that none waits
AHEAD = 3
# s between two looks at what Ray has done
LOOK_S = 1.0
# s between two counts of its processors
COUNT_S = 5.0


@dataclass
class Task:
    """A module-level function and its arguments.

    about: whose outcome it is, for the caller. deaths: how often it ended its worker.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    about: Any
    deaths: int = 0


class DiedError(WorkerError):
    """A task ended its worker each time."""


class Engine(ABC):
    """Runs tasks; outcomes come in any order.

    cpu_s: of the tasks so far, by their function. peak_mb: largest memory of one worker.
    here: the workers see this machine's files.
    """

    here = True

    def __init__(self, attempts: int) -> None:
        self.cpu_s: defaultdict[str, float] = defaultdict(float)
        self.peak_mb = 0.0
        self._attempts = attempts
        self._waiting: deque[Task] = deque()
        self._running: dict[Any, Task] = {}

    def submit(self, task: Task, first: bool = False) -> None:
        """Take a task; first: before all that wait."""
        (self._waiting.appendleft if first else self._waiting.append)(task)

    def outcomes(self) -> Iterator[tuple[Any, Any]]:
        """Yield (about, outcome), until no task is left; tasks may be submitted meanwhile.

        An outcome is what the function returned, or the DashcalibError that it raised. Raises
        OutputError: where there is no room for results, no others are wanted.
        """
        while self._waiting or self._running:
            places = self._places()
            while self._waiting and len(self._running) < places:
                task = self._waiting.popleft()
                self._running[self._start(task)] = task
            for handle, found in self._ended():
                task = self._running.pop(handle)
                if isinstance(found, WorkerDiedError):
                    task.deaths += 1
                    found = None if task.deaths < self._attempts else DiedError(
                        'E-TASK-DIED', f'its worker process died {task.deaths} times: '
                                       f'{one_line(found)}')
                if found is None:
                    self.submit(task, first=True)
                elif isinstance(found, OutputError):
                    raise found
                elif isinstance(found, BaseException):
                    yield task.about, _known(found)
                else:
                    result, cpu_s, peak_mb = found
                    self.cpu_s[task.function.__name__] += cpu_s
                    self.peak_mb = max(self.peak_mb, peak_mb)
                    yield task.about, result

    @abstractmethod
    def _places(self) -> int:
        """Return how many tasks may be started at a time."""

    @abstractmethod
    def _start(self, task: Task) -> Any:
        """Start a task; return its handle."""

    @abstractmethod
    def _ended(self) -> list[tuple[Any, Any]]:
        """Return the handles of tasks that have ended; wait a little where there are none.

        Beside each: what measured() returned or raised, None where that was no fault of the task.
        """

    @abstractmethod
    def close(self) -> None:
        """End the workers."""


def _known(error: BaseException) -> DashcalibError:
    """Return a task's error; one that nobody expected must not end the tasks of others."""
    if isinstance(error, DashcalibError):
        return error
    if not isinstance(error, Exception):
        raise error  # such as Ctrl-C
    return WorkerError('E-UNEXPECTED', f'{type(error).__name__}: {one_line(error)}; this is a '
                                       f'defect of dashcalib: report it with the clip')


def measured(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float, float]:
    """Return a task's result, the processor time that it took, s, and its process's memory, MB."""
    before = time.process_time()
    result = function(*arguments)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return result, time.process_time() - before, peak_mb


class LocalEngine(Engine):
    """Workers of this machine, such as child processes; see Engine."""

    def __init__(self, attempts: int, workers: Sequence[Worker]) -> None:
        super().__init__(attempts)
        self._workers = tuple(workers)
        self._threads = ThreadPoolExecutor(len(self._workers))
        self._idle: SimpleQueue[Worker] = SimpleQueue()
        for worker in self._workers:
            self._idle.put(worker)

    def _places(self) -> int:
        return len(self._workers)

    def _start(self, task: Task) -> Future[Any]:
        return self._threads.submit(self._call, task)

    def _call(self, task: Task) -> Any:
        worker = self._idle.get()
        try:
            return worker.call(measured, task.function, *task.arguments)
        finally:
            self._idle.put(worker)

    def _ended(self) -> list[tuple[Any, Any]]:
        done = wait(self._running, return_when=FIRST_COMPLETED).done
        return [(future, future.exception() or future.result()) for future in done]

    def close(self) -> None:
        """End the workers; calls that run end with an error."""
        for worker in self._workers:
            worker.close()
        self._threads.shutdown(wait=False)
        # a child that was killed leaves its copy of a packed or remote clip
        remove_leftovers()


class RayEngine(Engine):
    """A cluster's workers, one thread and one task each; see Engine.

    A task whose node was lost is tried again without being counted: that is not its own fault.
    """

    here = False

    def __init__(self, attempts: int, memory_mb: int, address: str) -> None:
        """Raise ConfigError without Ray, WorkerError where the cluster cannot be reached."""
        super().__init__(attempts)
        self._ray = needs('ray', 'clusters (--address)')
        self._lost_nodes = 0
        self._most, self._counted_at = 0, -math.inf
        os.environ.setdefault('RAY_USAGE_STATS_ENABLED', '0')
        variables = {'env_vars': dict.fromkeys(THREAD_VARIABLES, '1')}
        try:
            self._ray.init(address, log_to_driver=False, logging_level='ERROR',
                           configure_logging=True, runtime_env=variables)
        except Exception as error:  # of many kinds, none of them ours
            raise WorkerError('E-RAY-NOT-REACHABLE',
                              f'there is no Ray cluster at {address} ({one_line(error)}); check '
                              f'the address, or omit --address') from error
        self._remote = self._ray.remote(num_cpus=1, max_retries=0, memory=memory_mb * 2**20)(
            _in_one_thread)

    def outcomes(self) -> Iterator[tuple[Any, Any]]:
        """Yield the outcomes; see Engine. Raises WorkerError when Ray itself has ended."""
        try:
            yield from super().outcomes()
        except OutputError:
            raise
        except Exception as error:  # of many kinds, none of them ours
            raise WorkerError('E-RAY-ENDED',
                              f'Ray has ended ({one_line(error)}); start the command again: it '
                              f'continues where it stopped') from error

    def _places(self) -> int:
        if time.monotonic() - self._counted_at > COUNT_S:
            # nodes come and go
            cores = int(self._ray.cluster_resources().get('CPU', 1))
            self._most, self._counted_at = AHEAD * max(1, cores), time.monotonic()
        return self._most

    def _start(self, task: Task) -> Any:
        return self._remote.remote(task.function, *task.arguments)

    def _ended(self) -> list[tuple[Any, Any]]:
        ready, _ = self._ray.wait(list(self._running), timeout=LOOK_S)
        return [(handle, self._found(handle)) for handle in ready]

    def _found(self, handle: Any) -> Any:
        errors = self._ray.exceptions
        try:
            return self._ray.get(handle)
        except errors.RayTaskError as error:
            return error.cause or error
        except errors.LocalRayletDiedError:
            raise
        except (errors.NodeDiedError, errors.ObjectLostError, errors.RaySystemError):
            return None
        except (errors.WorkerCrashedError, errors.OutOfMemoryError) as error:
            return None if self._node_was_lost() else WorkerDiedError('E-WORKER-DIED',
                                                                      one_line(error))
        except errors.RayError as error:
            return WorkerError('E-RAY-TASK-FAILED', one_line(error))

    def _node_was_lost(self) -> bool:
        dead = sum(not node['Alive'] for node in self._ray.nodes())
        more = dead > self._lost_nodes
        self._lost_nodes = dead
        return more

    def close(self) -> None:
        """Leave the cluster."""
        self._ray.shutdown()


def _in_one_thread(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float, float]:
    """Measure a task in this process, which must have one thread for numpy; raises WorkerError."""
    import cv2
    cv2.setNumThreads(1)
    found: tuple[Any, float, float] = InlineWorker().call(measured, function, *arguments)
    return found
