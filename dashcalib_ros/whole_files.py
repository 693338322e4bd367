# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or absent, whenever a process or the power ends.

What is not whole yet has a temporary name and is locked: nothing locks it any more once its
process was killed, and the next one that begins the same removes it.
"""
from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

# that there is no room: on the disk, for this user, or for a file of this size (ulimit -f)
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# of temporary folders, wherever they are
FOLDER = 'dashcalib'


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
                raise IsADirectoryError(errno.EISDIR, f'{name} is a folder')
            temporary[name], stream = stack.enter_context(_temporary_file(folder, name))
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        yield temporary


@contextmanager
def _temporary_file(folder: Path, name: str) -> Iterator[tuple[Path, BinaryIO]]:
    """Open a new file and lock it; at the end, remove it if it is still there."""
    while True:
        path = folder / _temporary(name)
        try:
            with path.open('xb') as stream:
                if _locked(stream.fileno(), path):
                    yield path, stream
                    return
        finally:
            path.unlink(missing_ok=True)


@contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Make a folder, and remove it at the end; those that killed processes left are removed, too.

    parent: where; it is made if needed, and removed at the end if it was and is empty. None: on
    the scratch disk (TMPDIR). Raises OSError.
    """
    parent = Path(tempfile.gettempdir()) if parent is None else parent
    remove_leftovers(parent)
    missing = [each for each in (parent, *parent.parents) if not each.exists()]
    try:
        parent.mkdir(parents=True, exist_ok=True)
        while True:
            path = parent / _temporary(FOLDER)
            path.mkdir(0o700)
            handle = os.open(path, os.O_RDONLY)
            try:
                if _locked(handle, path):
                    yield path
                    return
            finally:
                shutil.rmtree(path, ignore_errors=True)
                os.close(handle)
    finally:
        with suppress(OSError):
            for each in missing:
                each.rmdir()


def _temporary(name: str) -> str:
    return f'.{name}.{secrets.token_hex(4)}.tmp'


def _locked(handle: int, path: Path) -> bool:
    """Lock what was just made; return False where it was removed as a leftover before."""
    with suppress(OSError):  # not every file system has locks
        fcntl.flock(handle, fcntl.LOCK_EX)
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(handle), path.lstat())
    return False


def remove_leftovers(folder: Path | None = None,
                     names: Collection[str] | re.Pattern[str] = (FOLDER,)) -> None:
    """Remove what killed processes of this user left in a folder under temporary names.

    folder: None: the scratch disk (TMPDIR). names: of the files; of temporary folders where they
    are omitted. A running process has its own locked: they stay.
    """
    name = names.pattern if isinstance(names, re.Pattern) else '|'.join(map(re.escape, names))
    ours = re.compile(rf'\.({name})\.[0-9a-f]{{8}}\.tmp')
    with suppress(OSError):
        for path in list((folder or Path(tempfile.gettempdir())).iterdir()):
            if ours.fullmatch(path.name):
                with suppress(OSError):
                    _remove_unlocked(path)


def _remove_unlocked(path: Path) -> None:
    """Remove a file or a folder of this user that no process has locked. Raises OSError."""
    about = path.lstat()
    is_folder = stat.S_ISDIR(about.st_mode)
    if about.st_uid != os.geteuid() or not (is_folder or stat.S_ISREG(about.st_mode)):
        return
    handle = os.open(path, (os.O_RDONLY if is_folder else os.O_RDWR) | os.O_NOFOLLOW)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if is_folder:
            shutil.rmtree(path)
        else:
            path.unlink()
    finally:
        os.close(handle)


def sync(folder: Path) -> None:
    """Make the renames in folder survive a power failure, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
