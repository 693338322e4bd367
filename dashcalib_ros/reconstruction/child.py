"""A child process that does the heavy calls: COLMAP aborts its process when a check fails.

The parent sends (function, arguments) and receives progress, then a result or an exception,
pickled over pipes; arrays go beside the pickle, so that a turn's images are not copied to be sent.
The child is a plain `python -c`, not multiprocessing: a child that the latter spawns would import
the user's main script again.
"""
from __future__ import annotations

import contextlib
import os
import pickle
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from dashcalib_ros.errors import WorkerError

HEADER = struct.Struct('>Q')
PROTOCOL = pickle.HIGHEST_PROTOCOL
# not `-m`: it would import from the current folder first, and a random.py may lie there
START = ("import sys; sys.path[:1] = [] if sys.path[0] == '' else sys.path[:1]; "
         'from dashcalib_ros.reconstruction.child import main; main()')
# libraries that would otherwise start a thread for every core
THREAD_VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')
LOW_PRIORITY = 10

Progress = Callable[[str, float], None]
Parts = list[Any]


class ChildDiedError(WorkerError):
    """The child process ended in the middle of a call."""


class Child:
    """One child process; started at its first call, and again at the next call after it died.

    Calls come from one thread at a time; kill() may come from any.
    """

    def __init__(self, low_priority: bool = False, verbose: bool = False, threads: int = 1
                 ) -> None:
        """threads: of OpenCV, whose results do not depend on it."""
        self._low_priority = low_priority
        self._threads = threads
        self._verbose = verbose
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False
        self._guard = threading.Lock()

    @property
    def pid(self) -> int | None:
        """Return the process id of the running child, None if there is none."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else None

    def call(self, function: Callable[..., Any], *arguments: Any,
             progress: Progress | None = None) -> Any:
        """Run a module-level function in the child and return what it returns.

        progress: given on to the function as its last argument `progress`, called in the parent.
        Raises what the function raises, and ChildDiedError if the child ends before it answers.
        """
        # what cannot be sent fails here, before anything is on its way
        request = _packed((function, arguments, progress is not None))
        process = self._running()
        try:
            kind, value = self._answer(process, request, progress)
        except BaseException:
            # Ctrl-C, say: the answer to this call must not be taken for one to the next
            self._end(process)
            raise
        if kind == 'error':
            raise value
        return value

    def _answer(self, process: subprocess.Popen[bytes], request: Parts,
                progress: Progress | None) -> tuple[str, Any]:
        assert process.stdin is not None and process.stdout is not None
        try:
            _write(process.stdin, request)
        except (OSError, ValueError) as error:
            raise self._died(process) from error
        while True:
            try:
                kind, value = _receive(process.stdout)
            except (EOFError, OSError, ValueError, pickle.UnpicklingError) as error:
                raise self._died(process) from error
            if kind != 'progress':
                return kind, value
            if progress is not None:
                progress(*value)

    def _died(self, process: subprocess.Popen[bytes]) -> ChildDiedError:
        self._end(process)
        return ChildDiedError(
            f'the reconstruction process died (exit code {process.returncode}); it is started '
            f'again at the next try. If it dies each time, free memory or set '
            f'scene.tracks lower')

    def kill(self) -> None:
        """End the child at once; a call that waits for it raises ChildDiedError."""
        if self._process is not None:
            self._end(self._process)

    def _end(self, process: subprocess.Popen[bytes]) -> None:
        with contextlib.suppress(OSError):
            process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError, ValueError):
                    pipe.close()

    def close(self) -> None:
        """End the child for good."""
        with self._guard:
            self._closed = True
            self.kill()

    def _running(self) -> subprocess.Popen[bytes]:
        with self._guard:
            if self._closed:
                raise ChildDiedError('the calibrator is closed')
            if self._process is None or self._process.poll() is not None:
                self._process = self._start()
            return self._process

    def _start(self) -> subprocess.Popen[bytes]:
        environment = dict(os.environ)
        environment['PYTHONPATH'] = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
        environment.update({name: '1' for name in THREAD_VARIABLES})
        command = [sys.executable, '-c', START, str(LOW_PRIORITY if self._low_priority else 0),
                   str(os.getpid()), str(self._threads)]
        try:
            return subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment,
                stderr=None if self._verbose else subprocess.DEVNULL)
        except OSError as error:
            raise WorkerError(f'cannot start the reconstruction process: {error}; '
                              f'check memory and process limits (ulimit -u)') from error


def _packed(message: object) -> Parts:
    """Return the pickle, and the arrays that it leaves out: views, no copies."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(message, PROTOCOL, buffer_callback=buffers.append)
    return [head, *(buffer.raw() for buffer in buffers)]


def _unpacked(parts: Parts) -> Any:
    return pickle.loads(parts[0], buffers=parts[1:])


def _write(pipe: BinaryIO | Any, parts: Parts) -> None:
    pipe.write(HEADER.pack(len(parts)))
    for part in parts:
        pipe.write(HEADER.pack(len(part)))
        pipe.write(part)
    pipe.flush()


def _receive(pipe: BinaryIO | Any) -> Any:
    return _unpacked(_read(pipe))


def _read(pipe: BinaryIO | Any) -> Parts:
    (count,) = HEADER.unpack(_filled(pipe, HEADER.size))
    return [_filled(pipe, *HEADER.unpack(_filled(pipe, HEADER.size))) for _ in range(count)]


def _filled(pipe: Any, length: int) -> bytearray:
    """Read so many bytes: they can be written to, as the arrays made of them."""
    data = bytearray(length)
    view, read = memoryview(data), 0
    while read < length:
        got = pipe.readinto(view[read:])
        if not got:
            raise EOFError
        read += got
    return data


def _portable(error: Exception) -> Exception:
    """Return the error, or one that says the same if the parent could not be given it."""
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


def main() -> None:
    """Answer calls until the parent closes the pipe."""
    # Ctrl-C reaches the whole terminal group: the parent decides what becomes of the child
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(int(sys.argv[1]))
    threading.Thread(target=_watch_parent, args=(int(sys.argv[2]),), daemon=True).start()
    requests = sys.stdin.buffer
    # libraries may print: they get stderr, the answers keep the pipe
    answers = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)

    import cv2
    cv2.setNumThreads(int(sys.argv[3]))

    def report(stage: str, done: float) -> None:
        _write(answers, _packed(('progress', (stage, done))))

    with contextlib.suppress(EOFError):
        while True:
            # nothing of a call is kept for the time until the next
            _write(answers, _answered(_read(requests), report))


def _answered(request: Parts, report: Progress) -> Parts:
    try:
        function, arguments, wants_progress = _unpacked(request)
        extra = {'progress': report} if wants_progress else {}
        return _packed(('result', function(*arguments, **extra)))
    except Exception as error:
        return _packed(('error', _portable(error)))
