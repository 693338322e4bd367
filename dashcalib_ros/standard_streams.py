"""stdin, stdout and stderr, which may be closed, full, or without a reader."""
from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import Any

from dashcalib_ros.errors import OutputError

STDOUT, STDERR = 1, 2


def open_closed_streams() -> None:
    """Put /dev/null in the place of closed standard streams.

    Otherwise the next file that is opened gets the free descriptor, and what native code prints is
    written into it. sys.stdout and sys.stderr stay None, as Python sets them.
    """
    for number in (0, STDOUT, STDERR):
        try:
            os.fstat(number)
        except OSError:
            # a new descriptor gets the lowest free number: this one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)


def write_stdout(text: str) -> None:
    """Print text and a newline. It is no error if the reader has ended (head, less).

    Raises OutputError when stdout is closed or full.
    """
    with suppress(AttributeError, ValueError):
        sys.stdout.reconfigure(errors='replace')  # type: ignore[union-attr]
    try:
        sys.stdout.write(text + '\n')
        sys.stdout.flush()
    except BrokenPipeError:
        _discard(sys.stdout, STDOUT)
    except (AttributeError, ValueError) as error:
        # AttributeError: it is None; ValueError: it was closed by this process
        raise OutputError('stdout is closed; give it a terminal, a file or a pipe') from error
    except OSError as error:
        _discard(sys.stdout, STDOUT)
        raise OutputError(f'cannot write to stdout: {error.strerror or error}; send the output '
                          f'to another place') from error


def write_stderr(line: str) -> None:
    """Print text and a newline; nothing is raised if stderr cannot be written."""
    try:
        sys.stderr.write(line + '\n')
        sys.stderr.flush()
    except (AttributeError, ValueError):
        pass
    except OSError:
        _discard(sys.stderr, STDERR)


def _discard(stream: Any, number: int) -> None:
    """Let the stream's remaining text go to /dev/null.

    Otherwise the interpreter's last flush fails, and its exit code is 120.
    """
    with suppress(OSError, ValueError, AttributeError):
        if stream.fileno() == number:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, number)
            os.close(null)
