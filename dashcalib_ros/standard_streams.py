# SPDX-License-Identifier: Apache-2.0
"""stdin, stdout and stderr, which may be closed, full, or without a reader.

What other people named and wrote is in our lines: its control characters are written out here.
"""
from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import Any

from dashcalib_ros.errors import OutputError, visible

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


def own_stderr() -> None:
    """Keep stderr for our own lines: what native libraries print on it is dropped.

    libjpeg says `Corrupt JPEG data` there, and not of which file. For a process of our own.
    """
    if sys.stderr is None:
        return
    with suppress(OSError, ValueError):
        # sys.stderr goes on with another descriptor
        own = os.dup(STDERR)
        sys.stderr = os.fdopen(own, 'w', 1, sys.stderr.encoding, sys.stderr.errors)
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, STDERR)
        os.close(null)


def write_stdout(text: str, styled: bool = False) -> None:
    """Print text and a newline. It is not an error if the reader has ended (head, less).

    styled: it has a terminal's colours, and its texts are visible() already. Raises OutputError
    when stdout is closed or full.
    """
    text = text if styled else _visible(text)
    with suppress(AttributeError, ValueError):
        sys.stdout.reconfigure(errors='replace')  # type: ignore[union-attr]
    try:
        sys.stdout.write(text + '\n')
        sys.stdout.flush()
    except BrokenPipeError:
        _discard(sys.stdout)
    except (AttributeError, ValueError) as error:
        # AttributeError: it is None; ValueError: it was closed by this process
        raise OutputError('E-STDOUT-CLOSED', 'stdout is closed; connect it to a terminal, a file '
                                             'or a pipe') from error
    except OSError as error:
        _discard(sys.stdout)
        raise OutputError('E-STDOUT-UNWRITABLE',
                          f'cannot write to stdout: {error.strerror or error}; redirect the '
                          f'output to another place') from error


def write_stderr(text: str, styled: bool = False) -> None:
    """Print text and a newline; nothing is raised if stderr cannot be written.

    styled: as write_stdout()'s.
    """
    try:
        sys.stderr.write((text if styled else _visible(text)) + '\n')
        sys.stderr.flush()
    except (AttributeError, ValueError):
        pass
    except OSError:
        _discard(sys.stderr)


def _visible(text: str) -> str:
    return '\n'.join(map(visible, text.split('\n')))


def _discard(stream: Any) -> None:
    """Let the stream's remaining text go to /dev/null.

    Otherwise the interpreter's last flush fails, and its exit code is 120.
    """
    with suppress(OSError, ValueError, AttributeError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)
