"""The interface of workers: they run a function in this process or in another one."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from dashcalib_ros.errors import WorkerError

Progress = Callable[[str, float], None]

# these set the number of threads in numpy's libraries, by default one for every core; with more
# than one, the order of sums changes, and with it a result's last digits
THREAD_VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')


class WorkerDiedError(WorkerError):
    """The worker died before it answered, or is closed."""


class Worker(Protocol):
    """Runs one function at a time. Results do not depend on the kind of worker."""

    @property
    def pid(self) -> int | None:
        """Return the process id of the worker, None if it has no process of its own now."""

    def call(self, function: Callable[..., Any], *arguments: Any,
             progress: Progress | None = None) -> Any:
        """Run a module-level function, which must not change its arguments; return its result.

        progress: passed to the function as its keyword argument `progress`; called in the calling
        thread. Raises what the function raises, and WorkerDiedError if the worker dies before it
        answers. One thread at a time may call.
        """

    def close(self) -> None:
        """End the worker for good; may be called from any thread, also during a call."""
