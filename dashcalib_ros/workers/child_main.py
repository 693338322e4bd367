"""The main function of a child process: it answers calls until its parent closes the pipe."""
from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys
import threading
import time

from dashcalib_ros.errors import WorkerError
from dashcalib_ros.workers.messages import PROTOCOL, Parts, pack, receive, send, unpack
from dashcalib_ros.workers.worker import Progress


def main() -> None:
    """Answer calls; arguments: niceness, the parent's process id, OpenCV's threads."""
    niceness, parent, threads = (int(text) for text in sys.argv[1:4])
    # Ctrl-C reaches the whole process group: the parent ends the child if needed
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(niceness)
    threading.Thread(target=_watch_parent, args=(parent,), daemon=True).start()
    requests = os.fdopen(os.dup(0), 'rb')
    # libraries may print: they get stderr, as the pipe is for answers only
    answers = os.fdopen(os.dup(1), 'wb', buffering=0)
    os.dup2(2, 1)

    import cv2
    cv2.setNumThreads(threads)

    def report(stage: str, done: float) -> None:
        send(answers, pack(('progress', (stage, done))))

    with contextlib.suppress(EOFError):
        while True:
            # no variable keeps a call's arguments in memory until the next call
            send(answers, _answer(receive(requests), report))


def _answer(request: Parts, report: Progress) -> Parts:
    try:
        function, arguments, wants_progress = unpack(request)
        extra = {'progress': report} if wants_progress else {}
        return pack(('result', function(*arguments, **extra)))
    except Exception as error:
        return pack(('error', _portable(error)))


def _portable(error: Exception) -> Exception:
    """Return the error, or a WorkerError with its text if it cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error, PROTOCOL))
    except Exception:
        return WorkerError(f'{type(error).__name__}: {error}')
    return error


def _watch_parent(parent: int) -> None:
    """End this process when its parent is gone, even in the middle of a call."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
