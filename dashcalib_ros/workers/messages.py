"""Messages between a worker's two processes: a pickle, and its arrays as separate buffers.

Arrays are sent as they are in memory, so that a turn's images are not copied.
"""
from __future__ import annotations

import pickle
import struct
from typing import Any, Protocol

HEADER = struct.Struct('>Q')
PROTOCOL = pickle.HIGHEST_PROTOCOL

#: a pickle, and the arrays that it leaves out
Parts = list[Any]


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
