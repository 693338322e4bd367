# SPDX-License-Identifier: Apache-2.0
"""A worker in a child process: COLMAP aborts its process when a check fails.

The parent sends (function, arguments) and receives progress, then a result or an exception, each
as a pickle, and behind it its arrays as they are in memory: a turn's images are not copied.
The child is a plain `python -c`, not multiprocessing: a child that the latter spawns would import
the user's main script again.
"""
from __future__ import annotations

import contextlib
import io
import os
import pickle
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, Protocol, cast

from dashcalib_ros.errors import WorkerError
from dashcalib_ros.workers.memory import forget_file_pages, return_free_memory, reuse_image_buffers
from dashcalib_ros.workers.worker import THREAD_VARIABLES, Progress, WorkerDiedError

# not `-m`: it would import from the current folder first, and a random.py may lie there
START = ("import sys; sys.path[:1] = [] if sys.path[0] == '' else sys.path[:1]; "
         'from dashcalib_ros.workers.child import main; main()')
LOW_PRIORITY = 10
# s between two looks at a child that does not answer
LOOK_S = 1.0
# looks without a sign of life: a child of low priority may wait for the processor for seconds
LOOKS_TO_REPORT = 10
LOOKS_TO_KILL = 60
HEADER = struct.Struct('>Q')
PROTOCOL = pickle.HIGHEST_PROTOCOL
# a pickle, and the arrays that it leaves out
Parts = list[Any]


class ChildWorker:
    """One child process, started at its first call, and anew at the next call after it died.

    See Worker. A child that uses no processor time during a call hangs: on_trouble is called, and
    after LOOKS_TO_KILL looks the child is killed. One thread at a time may call; pid, kill() and
    close() may be used from any thread at any time.
    """

    def __init__(self, low_priority: bool = False, verbose: bool = False, threads: int = 1,
                 on_trouble: Callable[[str], None] = lambda text: None) -> None:
        """threads: of OpenCV, whose results do not depend on it.

        on_trouble: gets one line, in the thread that called.
        """
        self._low_priority = low_priority
        self._threads = threads
        self._verbose = verbose
        self._on_trouble = on_trouble
        self._process: subprocess.Popen[bytes] | None = None
        # of two threads, call()'s and close()'s, each writes its own before it reads the other's:
        # no process that close() does not see goes on, and no pipe that is in use is closed
        self._closed = False
        self._calling = False

    @property
    def pid(self) -> int | None:
        """Return the process id of the running child, None if there is none."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else None

    def call(self, function: Callable[..., Any], *arguments: Any,
             progress: Progress | None = None) -> Any:
        """Run a module-level function in the child; see Worker.call."""
        # pickle first: an error must not leave a part of the message in the pipe
        request = pack((function, arguments, progress is not None))
        self._calling = True
        try:
            process = self._running()
            try:
                kind, value = self._answer(process, request, progress)
            except BaseException:
                # for example Ctrl-C: the next call must not receive the answer to this one
                _end(process)
                raise
        finally:
            self._calling = False
        if kind == 'error':
            raise value
        return value

    def kill(self) -> None:
        """End the child at once; a call that waits for it raises WorkerDiedError."""
        process = self._process
        if process is not None:
            process.kill()
            process.wait()

    def close(self) -> None:
        """End the child for good."""
        self._closed = True
        self.kill()
        # if a call is running, it finds its child dead and closes the pipes itself
        if self._process is not None and not self._calling:
            _end(self._process)

    def _answer(self, process: subprocess.Popen[bytes], request: Parts,
                progress: Progress | None) -> tuple[str, Any]:
        try:
            send(_WatchedPipe(process, process.stdin, select.POLLOUT, self._on_trouble), request)
        except (OSError, ValueError) as error:
            raise _died(process) from error
        forget_file_pages()
        answers = _WatchedPipe(process, process.stdout, select.POLLIN, self._on_trouble)
        while True:
            try:
                kind, value = unpack(receive(answers))
            except (EOFError, OSError, ValueError, pickle.UnpicklingError) as error:
                raise _died(process) from error
            if kind != 'progress':
                return kind, value
            if progress is not None:
                progress(*value)

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is not None and self._process.poll() is not None:
            _end(self._process)
            self._process = None
        if self._process is None and not self._closed:
            self._process = self._start()
        if self._closed:
            if self._process is not None:
                _end(self._process)
            raise WorkerDiedError('E-CALIBRATOR-CLOSED', 'the calibrator is closed')
        assert self._process is not None
        return self._process

    def _start(self) -> subprocess.Popen[bytes]:
        environment = dict(os.environ)
        environment['PYTHONPATH'] = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
        environment.update(dict.fromkeys(THREAD_VARIABLES, '1'))
        command = [sys.executable, '-c', START, str(LOW_PRIORITY if self._low_priority else 0),
                   str(os.getpid()), str(self._threads)]
        try:
            process = subprocess.Popen(
                command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                env=environment, stderr=None if self._verbose else subprocess.DEVNULL)
        except OSError as error:
            raise WorkerError('E-WORKER-CANNOT-START',
                              f'cannot start the reconstruction process: {error}; check the free '
                              f'memory and the limit of processes (ulimit -u)') from error
        assert process.stdin is not None
        # a child that hangs does not read: writing must not block, so that it can be watched
        os.set_blocking(process.stdin.fileno(), False)
        return process


class _WatchedPipe:
    """The parent's end of a pipe: while it waits, it checks that the child uses processor time.

    Checks are counted, not seconds: there are none while this process is stopped or the machine
    is suspended.
    """

    def __init__(self, process: subprocess.Popen[bytes], pipe: IO[bytes] | None, event: int,
                 on_trouble: Callable[[str], None]) -> None:
        # unbuffered, as poll() does not see what was read ahead
        self._pipe = cast(io.FileIO, pipe)
        self._pid = process.pid
        self._poll = select.poll()
        self._poll.register(self._pipe, event)
        self._on_trouble = on_trouble

    def readinto(self, view: memoryview, /) -> int | None:
        self._wait()
        return self._pipe.readinto(view)

    def write(self, data: memoryview, /) -> int | None:
        self._wait()
        return self._pipe.write(data)

    def _wait(self) -> None:
        """Wait until the pipe is ready; raises WorkerDiedError when the child hangs."""
        looks, used = 0, None
        while not self._poll.poll(1000 * LOOK_S):
            before, used = used, _processor_time(self._pid)
            looks = looks + 1 if used is not None and used == before else 0
            silence = f'used no processor time for {looks * LOOK_S:.0f} s'
            if looks == LOOKS_TO_REPORT:
                self._on_trouble(
                    f'the reconstruction process {self._pid} {silence}; after '
                    f'{LOOKS_TO_KILL * LOOK_S:.0f} s it is ended and its work is repeated')
            elif looks >= LOOKS_TO_KILL:
                raise WorkerDiedError('E-WORKER-HANGS', f'the reconstruction process {self._pid} '
                                                        f'{silence} and was ended')


def _processor_time(pid: int) -> int | None:
    """Return the processor time of a process's main thread, in ticks; None if unknown.

    Only this thread counts: the one that watches the parent also runs in a hung child.
    """
    try:
        text = Path(f'/proc/{pid}/task/{pid}/stat').read_text('ascii', 'replace')
    except OSError:
        return None
    user, system = text.rpartition(')')[2].split()[11:13]
    return int(user) + int(system)


def _died(process: subprocess.Popen[bytes]) -> WorkerDiedError:
    _end(process)
    return WorkerDiedError(
        'E-WORKER-DIED',
        f'the reconstruction process died (exit code {process.returncode}); it is started '
        f'again. If it dies every time, free memory or lower scene.tracks')


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()


# messages, at both ends -----------------------------------------------------------------------


class Pipe(Protocol):
    """One end of a pipe; both methods may transfer fewer bytes than given."""

    def readinto(self, view: memoryview, /) -> int | None:
        """Read what is there into the view; return how many bytes."""

    def write(self, data: memoryview, /) -> int | None:
        """Write the beginning of data; return how many bytes."""


def pack(message: object) -> Parts:
    """Return the pickle and the arrays that it leaves out: views, no copies."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(message, PROTOCOL, buffer_callback=buffers.append)
    return [head, *(buffer.raw() for buffer in buffers)]


def unpack(parts: Parts) -> Any:
    """Return the message; its arrays can be written to."""
    return pickle.loads(parts[0], buffers=parts[1:])


def send(pipe: Pipe, parts: Parts) -> None:
    """Write a message; raises OSError or ValueError when nobody reads it."""
    _write(pipe, HEADER.pack(len(parts)))
    for part in parts:
        _write(pipe, HEADER.pack(len(part)))
        _write(pipe, part)


def receive(pipe: Pipe) -> Parts:
    """Read a message; raises EOFError, OSError or ValueError when its writer is gone."""
    (count,) = HEADER.unpack(_read(pipe, HEADER.size))
    return [_read(pipe, *HEADER.unpack(_read(pipe, HEADER.size))) for _ in range(count)]


def _write(pipe: Pipe, data: bytes | memoryview) -> None:
    view = memoryview(data)
    while view:
        view = view[pipe.write(view) or 0:]


def _read(pipe: Pipe, length: int) -> bytearray:
    data = bytearray(length)
    view = memoryview(data)
    while view:
        got = pipe.readinto(view)
        if got == 0:
            raise EOFError
        view = view[got or 0:]
    return data


# the child -----------------------------------------------------------------------------------


def main() -> None:
    """Answer calls; arguments: niceness, the parent's process id, OpenCV's threads."""
    niceness, parent, threads = (int(text) for text in sys.argv[1:4])
    # Ctrl-C reaches the whole process group: the parent ends the child if needed
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(niceness)
    reuse_image_buffers()
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
            return_free_memory()


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
        return WorkerError('E-UNEXPECTED', f'{type(error).__name__}: {error}')
    return error


def _watch_parent(parent: int) -> None:
    """End this process when its parent is gone, even in the middle of a call."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
