# SPDX-License-Identifier: Apache-2.0
"""Frames from several processes, in order, and with a bounded number in flight."""
from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any, Protocol

import cv2

from dashcalib_ros.errors import WorkerError
from dashcalib_ros.input import Frame

CHUNK = 4


class Renderer(Protocol):
    """What a worker renders with."""

    def frame(self, index: int) -> Frame:
        """Render one frame."""


# each worker's own renderer, set once when the worker starts
_renderer: Renderer | None = None


def render_parallel(make_renderer: Callable[[], Renderer], first: int, last: int,
                    processes: int) -> Iterator[Frame]:
    """Yield frames first to last (not included).

    make_renderer: called once in each worker; it must be picklable.
    Workers are spawned: a script that calls this needs `if __name__ == '__main__':`.
    Raises WorkerError when a worker dies.
    """
    context = multiprocessing.get_context('spawn')
    # a pipe, not an event: Event.set() waits for ever for a worker that died in Event.wait()
    stopped, stop = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(processes, context, _start, (make_renderer, stopped))
    pending: deque[Future[list[Frame]]] = deque()
    try:
        for start in range(first, last, CHUNK):
            with _sigint_blocked():
                pending.append(pool.submit(_render, start, min(start + CHUNK, last)))
            if len(pending) > 3 * processes:
                yield from pending.popleft().result()
        while pending:
            yield from pending.popleft().result()
    except BrokenProcessPool as error:
        raise WorkerError('E-RENDERER-DIED', 'a process that renders ended unexpectedly: free '
                                             'some memory, or use fewer processes') from error
    finally:
        # a caller that stops early must not wait for frames that it does not need
        stop.close()
        pool.shutdown(wait=True, cancel_futures=True)
        stopped.close()


@contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Workers that start here ignore Ctrl-C: this process ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_on(stopped: Connection[Any, Any]) -> None:
    with suppress(EOFError, OSError):
        stopped.recv()
    os._exit(1)


def _start(make_renderer: Callable[[], Renderer], stopped: Connection[Any, Any]) -> None:
    """Prepare a worker."""
    global _renderer
    threading.Thread(target=_end_on, args=(stopped,), daemon=True).start()
    cv2.setNumThreads(1)
    _renderer = make_renderer()


def _render(first: int, last: int) -> list[Frame]:
    assert _renderer is not None
    return [_renderer.frame(index) for index in range(first, last)]
