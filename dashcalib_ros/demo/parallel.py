"""Frames from several processes, in order, and with a bounded number in flight."""
from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from typing import TYPE_CHECKING, Literal

import cv2

from dashcalib_ros.demo.lens import Lens
from dashcalib_ros.demo.spec import DriveSpec
from dashcalib_ros.errors import WorkerError
from dashcalib_ros.frames import Frame

if TYPE_CHECKING:
    from dashcalib_ros.demo.drive import Drive

CHUNK = 4

# each worker's own drive, set once when the worker starts
_drive: Drive | None = None


def render_parallel(lens: Lens, spec: DriveSpec, first: int, last: int,
                    processes: int) -> Iterator[Frame]:
    """Yield frames first to last (not included) of a drive.

    Workers are spawned: a script that calls this needs `if __name__ == '__main__':`.
    Raises WorkerError when a worker dies.
    """
    context = multiprocessing.get_context('spawn')
    stop = context.Event()
    pool = ProcessPoolExecutor(processes, context, _start, (lens, spec, stop))
    pending: deque[Future[list[Frame]]] = deque()
    try:
        for start in range(first, last, CHUNK):
            with _deaf():
                pending.append(pool.submit(_render, start, min(start + CHUNK, last)))
            if len(pending) > 3 * processes:
                yield from pending.popleft().result()
        while pending:
            yield from pending.popleft().result()
    except BrokenProcessPool as error:
        raise WorkerError('a process that rendered died: free some memory, or use fewer '
                          'processes') from error
    finally:
        # whoever breaks off does not wait for what nobody will see
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)


def render_to_bag(drive: Drive, path: str | os.PathLike[str], processes: int = 2,
                  topic: str = '/camera/image_raw',
                  compressed: Literal['jpeg', 'png'] | None = None, quality: int = 90) -> None:
    """Render a whole drive into a new ROS 2 bag.

    path: the bag's folder, which must not exist yet. Raises OutputError or WorkerError.
    """
    from dashcalib_ros.frames.write import BagWriter
    with BagWriter(path, topic, compressed=compressed, quality=quality) as writer:
        for frame in drive.frames(processes=processes):
            writer.write(frame)


@contextmanager
def _deaf() -> Iterator[None]:
    """Have workers that start here not hear Ctrl-C: it is this process that ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_on(stop: Event) -> None:
    stop.wait()
    os._exit(1)


def _start(lens: Lens, spec: DriveSpec, stop: Event) -> None:
    """Prepare a worker."""
    global _drive
    threading.Thread(target=_end_on, args=(stop,), daemon=True).start()
    from dashcalib_ros.demo.drive import Drive
    cv2.setNumThreads(1)
    _drive = Drive(lens, spec)


def _render(first: int, last: int) -> list[Frame]:
    assert _drive is not None
    return [_drive.frame(index) for index in range(first, last)]
