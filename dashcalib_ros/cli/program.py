# SPDX-License-Identifier: Apache-2.0
"""main: from arguments to an exit code; here known errors become one line on stderr."""
from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any, NoReturn

from dashcalib_ros.cli.arguments import (
    BAD_INPUT,
    COMMANDS,
    INTERRUPTED,
    PROGRAM,
    VERBOSE,
    arguments_of,
    make_parser,
)
from dashcalib_ros.errors import DashcalibError, InputError, OutputError, WorkerError
from dashcalib_ros.standard_streams import open_closed_streams, own_stderr, write_stderr
from dashcalib_ros.workers.worker import prepare_process


def command() -> NoReturn:
    """Run main() as a process of its own, the installed command."""
    if VERBOSE[0] not in sys.argv:
        own_stderr()
    warnings.showwarning = _show_warning
    try:
        code = main()
    except Exception as error:
        # a defect of ours; Python's own exit code, 1, would be an answer: the calibration is wrong
        write_stderr(''.join(traceback.format_exception(error)).rstrip())
        code = _fail(DashcalibError(
            'E-DEFECT', f'this is a defect of dashcalib_ros ({type(error).__name__}): report it '
                        f'with the lines above, and with the input if you can'))
    if code == INTERRUPTED:
        # Ctrl-C in the middle of a lock's own code leaves it locked: no thread is waited for
        os._exit(code)
    sys.exit(code)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    write_stderr(f'{PROGRAM}: warning: {message}')


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code; argv: arguments without the program's name."""
    open_closed_streams()
    prepare_process()
    # the handler is set inside try: a signal may also come while it is set or restored
    try:
        parser = make_parser()
        _complete(parser)
        args = parser.parse_args(arguments_of(sys.argv[1:] if argv is None else argv))
        # SIGTERM unwinds the program as Ctrl-C does, so that everything is closed
        with handling(signal.default_int_handler, signal.SIGTERM):
            # imported only here: --help must not wait for numpy and OpenCV
            from dashcalib_ros.whole_files import remove_leftovers
            from dashcalib_ros.workers.memory import reuse_image_buffers
            remove_leftovers()
            reuse_image_buffers()
            command = getattr(import_module(COMMANDS[args.command].module), args.command)
            code: int = command(args)
            return code
    except SystemExit as end:  # argparse's way to end after --help and --version
        return end.code if isinstance(end.code, int) else BAD_INPUT
    except DashcalibError as error:
        return _fail(error)
    except KeyboardInterrupt:
        # `python -m` ends with SIGINT instead of our exit code when an interrupt, caught or not,
        # came out of exec('text'), as dataclasses call it on import; the next exec() resets that
        exec('pass')
        return _interrupted()
    except RuntimeError as error:
        # what Condition.wait() makes of Ctrl-C in the middle of its own code: its lock is free
        if not isinstance(error.__context__, KeyboardInterrupt):
            raise
        return _interrupted()
    except ModuleNotFoundError as error:
        if not error.name or error.name.startswith('dashcalib_ros'):
            raise
        return _fail(InputError('E-PACKAGE-MISSING', f'the Python package {error.name} is '
                                                     f'missing; install it with pip'))
    except MemoryError:
        return _fail(WorkerError('E-OUT-OF-MEMORY', 'out of memory; close other programs or lower '
                                                    'turns.capacity'))
    except BrokenPipeError:
        return _fail(OutputError('E-OUTPUT-CLOSED', 'the program that reads the output has ended'))
    except OSError as error:
        return _fail(_os_error(error))


def _complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell and end, if it asks for the completions of a command line."""
    if '_ARGCOMPLETE' not in os.environ:
        return
    with suppress(ImportError):
        import argcomplete
        argcomplete.autocomplete(parser)


@contextmanager
def handling(handler: Any, *signals: signal.Signals) -> Iterator[None]:
    """Handle signals in another way for a while; only the main thread may."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before: dict[signal.Signals, Any] = {each: signal.signal(each, handler) for each in signals}
    try:
        yield
    finally:
        for each, earlier in before.items():
            signal.signal(each, earlier)


def _fail(error: DashcalibError) -> int:
    code = f' [{error.code}]' if error.code else ''
    write_stderr(f'{PROGRAM}: error: {" ".join(str(error).split())}{code}')
    return BAD_INPUT


def _interrupted() -> int:
    write_stderr(f'{PROGRAM}: error: interrupted')
    return INTERRUPTED


def _os_error(error: OSError) -> DashcalibError:
    where = f' ({error.filename})' if error.filename else ''
    from dashcalib_ros.whole_files import FULL
    if error.errno in FULL:
        return OutputError('E-DISK-FULL', f'no space is left on the disk{where}; free some, or '
                                          f'set TMPDIR to another disk')
    return InputError('E-FILE-ACCESS', f'{error.strerror or error}{where}; check the path and its '
                                       f'permissions')
