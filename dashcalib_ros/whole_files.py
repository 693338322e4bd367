"""Files that are whole or absent, whenever a process or the power ends."""
from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO


def write_whole(path: Path, data: bytes) -> None:
    """Write one file, completely or not at all. Raises OSError."""
    with prepared(path.parent, {path.name: data}) as temporary:
        temporary[path.name].replace(path)


@contextmanager
def prepared(folder: Path, contents: Mapping[str, bytes]) -> Iterator[dict[str, Path]]:
    """Write each content to a temporary file beside its final place.

    Those left are removed, and those of the same names that killed processes left.
    """
    temporary: dict[str, Path] = {}
    remove_leftovers(folder, contents)
    with ExitStack() as stack:
        for name, content in contents.items():
            if (folder / name).is_dir():
                raise IsADirectoryError(errno.EISDIR, f'{name} is a folder there')
            temporary[name], stream = stack.enter_context(_temporary_file(folder, name))
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        yield temporary


@contextmanager
def _temporary_file(folder: Path, name: str) -> Iterator[tuple[Path, BinaryIO]]:
    """Open a new file and lock it; at the end, remove it if it is still there."""
    while True:
        path = folder / f'.{name}.{secrets.token_hex(4)}.tmp'
        try:
            with path.open('xb') as stream:
                with suppress(OSError):  # not every file system has locks
                    fcntl.flock(stream, fcntl.LOCK_EX)
                # another process may have removed it as a leftover before it was locked
                if os.fstat(stream.fileno()).st_nlink:
                    yield path, stream
                    return
        finally:
            path.unlink(missing_ok=True)


def remove_leftovers(folder: Path, names: Collection[str]) -> None:
    """Remove the temporary files of these names that killed processes left in a folder.

    A running process has its own files locked: they stay.
    """
    ours = re.compile(rf'\.({"|".join(map(re.escape, names))})\.[0-9a-f]{{8}}\.tmp')
    with suppress(OSError):
        for path in list(folder.iterdir()):
            if ours.fullmatch(path.name) and path.is_file() and not path.is_symlink():
                with suppress(OSError), path.open('r+b') as stream:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    path.unlink()


def sync(folder: Path) -> None:
    """Make the renames in folder survive a power failure, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
