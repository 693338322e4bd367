"""A worker without a process of its own: for debuggers, for tests, and inside another worker."""
from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any

from dashcalib_ros.errors import WorkerError
from dashcalib_ros.workers.worker import THREAD_VARIABLES, Progress, WorkerDiedError

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
            raise WorkerError('inline, results are the same only with one thread for numpy: set '
                              + ' '.join(f'{name}=1' for name in THREAD_VARIABLES)
                              + ' in the environment before Python starts')
        self._closed = False

    def call(self, function: Callable[..., Any], *arguments: Any,
             progress: Progress | None = None) -> Any:
        """Run a function here; see Worker.call."""
        with _ONE_AT_A_TIME:
            if self._closed:
                raise WorkerDiedError('the calibrator is closed')
            extra = {} if progress is None else {'progress': progress}
            return function(*arguments, **extra)

    def close(self) -> None:
        """Refuse further calls; a running one continues to its end."""
        self._closed = True
