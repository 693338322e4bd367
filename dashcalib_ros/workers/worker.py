# SPDX-License-Identifier: Apache-2.0
"""Workers run a function in another process (child.py), or in this one, as debuggers want it."""
from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any, Protocol

from dashcalib_ros.errors import WorkerError
from dashcalib_ros.limits import PIXELS

Progress = Callable[[str, float], None]

# these set the number of threads in numpy's libraries, by default one for every core; with more
# than one, the order of sums changes, and with it a result's last digits
THREAD_VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')


def prepare_process() -> None:
    """Set what libraries read as they are loaded, unless the user did; for programs of our own.

    numpy's have one thread: the matrices here are small, and a second one does little but wait,
    at full speed. OpenCV decodes no larger pictures than we do, and does not report every defect
    of a file on stderr: what a user must know comes as our own errors.
    """
    for name, value in {**dict.fromkeys(THREAD_VARIABLES, '1'), 'OPENCV_LOG_LEVEL': 'SILENT',
                        'OPENCV_IO_MAX_IMAGE_PIXELS': str(PIXELS)}.items():
        os.environ.setdefault(name, value)


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


# for all inline calls of this process: Ceres' results change if two solvers run at a time
_ONE_AT_A_TIME = threading.Lock()


class InlineWorker:
    """Runs functions in the calling thread; see Worker.

    COLMAP aborts this process when one of its checks fails. A running call cannot be ended:
    close() only prevents the next one.
    """

    pid = None

    def __init__(self) -> None:
        """Raise WorkerError where results would differ from a child's, which has these set."""
        if any(os.environ.get(name) != '1' for name in THREAD_VARIABLES):
            raise WorkerError('E-NUMPY-THREADS',
                              'inline, results are the same only with one thread for numpy: set '
                              + ' '.join(f'{name}=1' for name in THREAD_VARIABLES)
                              + ' in the environment before Python starts')
        self._closed = False

    def call(self, function: Callable[..., Any], *arguments: Any,
             progress: Progress | None = None) -> Any:
        """Run a function here; see Worker.call."""
        with _ONE_AT_A_TIME:
            if self._closed:
                raise WorkerDiedError('E-CALIBRATOR-CLOSED', 'the calibrator is closed')
            extra = {} if progress is None else {'progress': progress}
            return function(*arguments, **extra)

    def close(self) -> None:
        """Refuse further calls; a running one continues to its end."""
        self._closed = True


def load_solving(engine: str) -> None:
    """Import what a worker needs until the solution, the engine too."""
    import dashcalib_ros.solve.joint  # noqa: F401
    from dashcalib_ros.reconstruct import load
    load(engine)


def load_judging() -> None:
    """Import what judges a result, and what that may need: it takes half a second."""
    from scipy import optimize, special  # noqa: F401
    from scipy.spatial import transform  # noqa: F401

    import dashcalib_ros.judge.conclude  # noqa: F401


def load_all(engine: str) -> None:
    """Import what a worker of a live drive needs until the result."""
    load_judging()
    load_solving(engine)
