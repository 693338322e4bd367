# SPDX-License-Identifier: Apache-2.0
"""Files here and on object stores, read and written whole: paths, and URLs such as s3://.

Only URLs need fsspec. A manifest may be a stranger's: of the many things that fsspec opens, only
stores are opened, and no message or table has the credentials of a URL.
"""
from __future__ import annotations

import hashlib
import os
import posixpath
import re
import stat as stat_module
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from dashcalib_ros.errors import (
    ConfigError,
    DashcalibError,
    InputError,
    OutputError,
    one_line,
)
from dashcalib_ros.input.inputs import named_like
from dashcalib_ros.limits import CLIP_BYTES, CLIP_FILES, check_file, read_file
from dashcalib_ros.whole_files import FULL, temporary_folder, write_whole

URL = re.compile(r'[a-z][a-z0-9+.-]+://')
SCHEMES = ('s3', 'gs', 'az', 'abfs', 'http', 'https')
# before the @; a key may have slashes, and what follows a host's colon may be its port. Of a store
# of Azure a name without a colon is that of the container
CREDENTIALS = re.compile(r'(?<=://)(?:[^/?#]*@|[^/@:?#]*:(?!\d+(?:[/?#]|$))[^@]*@)')
CONTAINER = re.compile(r'(?:az|abfs)://[^/:@]*@')
# bytes of one of our own files
LARGEST = 2**28
# by which an object store shows that a file changed
CHANGES = ('size', 'ETag', 'etag', 'mtime', 'created', 'LastModified', 'generation')


def is_url(place: str) -> bool:
    """Return whether a place is a URL, and not a path of this machine."""
    return URL.match(place) is not None


def joined(folder: str, name: str) -> str:
    """Return a name relative to a folder; a name that is a URL or absolute stands for itself."""
    return name if is_url(name) else posixpath.join(folder, name)


def masked(place: str) -> str:
    """Return a place as it may be shown: a URL without credentials, and a hash for its query."""
    if '://' not in place:
        return place
    container = CONTAINER.match(place)
    known = container.end() if container else 0
    text = place[:known] + CREDENTIALS.sub('***@', place[known:])
    name = bare(text)
    query = hashlib.sha256(os.fsencode(text[len(name):])).hexdigest()[:8]
    return name if name == text else f'{name}?***{query}'


def bare(place: str) -> str:
    """Return a URL without its query, which may be a signature; a path is itself."""
    return re.split('[?#]', place)[0] if '://' in place else place


def is_pattern(place: str) -> bool:
    """Return whether a place is a glob."""
    return any(sign in place for sign in '*?[')


def listed(place: str) -> list[str]:
    """Return the files and folders that a folder has, or that a glob finds, sorted."""
    if is_url(place):
        system, path = _system(place)
        scheme = place.partition('://')[0]
        with _store_errors('list', place):
            found = system.glob(path) if is_pattern(path) else system.ls(path, detail=False)
        return sorted(name if is_url(name) else f'{scheme}://{name}' for name in found)
    if is_pattern(place):
        return sorted(map(str, named_like(place)))
    return sorted(str(entry) for entry in Path(place).iterdir() if not entry.name.startswith('.'))


def is_folder(place: str) -> bool:
    """Return whether a place is a folder of this machine, or one of an object store.

    The web has none: to fsspec a page is one as soon as it has a link.
    """
    if not is_url(place):
        return Path(place).is_dir()
    system, path = _system(place)
    with _store_errors('read', place):
        return not is_url(path) and bool(system.isdir(path))


def clip_files(path: Path) -> list[tuple[Path, os.stat_result]]:
    """Return the regular files that a clip may be made of, sorted: itself, or a folder's.

    A folder may have bags that are folders. Raises InputError beyond limits, OSError.
    """
    if not path.is_dir():
        check_file(path, limit=CLIP_BYTES)
        return [(path, path.stat())]
    found: list[tuple[Path, os.stat_result]] = []
    size = 0
    for each in (*path.iterdir(), *path.glob('*/*')):
        with suppress(OSError):  # such as a link to nothing
            about = each.stat()
            if stat_module.S_ISREG(about.st_mode):
                found.append((each, about))
                size += about.st_size
        if size > CLIP_BYTES or len(found) > CLIP_FILES:
            raise InputError('E-CLIP-TOO-LARGE',
                             f'{path} has more than {CLIP_FILES} files or {CLIP_BYTES >> 30} GB: '
                             f'check that it is one clip')
    return sorted(found, key=lambda pair: pair[0])


def stamp(place: str) -> str | None:
    """Return a text that changes with a file, or with any file of a folder; None without one."""
    if is_url(place):
        stamps = _stored_stamps(place)
    else:
        try:
            # the time of change is also that of a file put in its place, whose others are older
            stamps = [f'{os.path.relpath(file, place)}: {about.st_size} {about.st_mtime_ns} '
                      f'{about.st_ctime_ns}' for file, about in clip_files(Path(place))]
        except InputError as error:
            return str(error)  # until it is something else
        except (OSError, ValueError):
            return None
    text = '\n'.join(stamps)
    return hashlib.sha256(os.fsencode(text)).hexdigest()[:32] if stamps else None


def _stored_stamps(url: str) -> list[str]:
    system, path = _system(url)
    entries: dict[str, Any] = {}
    with _store_errors('read', url), suppress(FileNotFoundError):
        about = system.info(path)
        entries = {'.': about} if about.get('type') != 'directory' else {
            name.removeprefix(path): each
            for name, each in system.find(path, maxdepth=2, detail=True).items()}
    return [f'{name}: ' + ' '.join(f'{each[key]}' for key in CHANGES if each.get(key) is not None)
            for name, each in sorted(entries.items())]


@contextmanager
def local_copy(place: str) -> Iterator[Path]:
    """Copy what a URL names to the scratch disk (TMPDIR) and remove it later; a path is itself.

    Raises InputError, OSError where the scratch disk is full.
    """
    if not is_url(place):
        yield Path(place)
        return
    system, path = _system(place)
    with temporary_folder() as scratch:
        copy = scratch / (posixpath.basename(bare(path).rstrip('/')) or 'clip')
        with _store_errors('copy', place):
            if is_folder(place):
                system.get(path, str(copy), recursive=True)
            else:
                system.get_file(path, str(copy))  # get() takes a query for a pattern
        yield copy


def read(place: str, limit: int = LARGEST) -> bytes | None:
    """Return a file's bytes, None where there is none; raises InputError beyond the limit."""
    if not is_url(place):
        return read_file(Path(place), limit) if Path(place).exists() else None
    system, path = _system(place)
    data = None
    with _store_errors('read', place), suppress(FileNotFoundError):
        data = bytes(system.cat_file(path, start=0, end=limit + 1))
    if data is not None and len(data) > limit:
        raise InputError('E-FILE-TOO-LARGE', f'{masked(place)} is larger than '
                                             f'{limit / 2**20:.0f} MB: check that it is the right '
                                             f'file')
    return data


def write(place: str, data: bytes) -> None:
    """Write a file: others see all of it or nothing. Raises OutputError."""
    try:
        if is_url(place):
            system, path = _system(place)
            system.pipe_file(path, data)  # object stores show complete objects only
        else:
            Path(place).parent.mkdir(parents=True, exist_ok=True)
            write_whole(Path(place), data)
    except DashcalibError:
        raise
    except Exception as error:  # stores have errors of their own
        what = f'cannot write {masked(place)}: {_reason(error, place)}'
        if getattr(error, 'errno', None) in FULL:
            raise OutputError('E-DISK-FULL', f'{what}; free some space and start the command '
                                             f'again: it continues where it stopped') from error
        raise OutputError('E-OUTPUT-NOT-WRITABLE',
                          f'{what}; choose an output folder that you may write to') from error


def remove(place: str) -> None:
    """Remove a file, if there is one."""
    with suppress(FileNotFoundError):
        if is_url(place):
            system, path = _system(place)
            system.rm_file(path)
        else:
            Path(place).unlink()


@contextmanager
def _store_errors(what: str, url: str) -> Iterator[None]:
    """Raise InputError for what stores raise, each errors of its own; OSError for a full disk."""
    try:
        yield
    except Exception as error:
        if getattr(error, 'errno', None) in FULL:
            raise
        raise InputError('E-ADDRESS-UNREADABLE',
                         f'cannot {what} {masked(url)} ({_reason(error, url)}); check the address '
                         f'and your access to it') from error


def _reason(error: Exception, place: str) -> str:
    """Return why a place cannot be used; what a library says may have the place's credentials."""
    reason = getattr(error, 'strerror', None) or one_line(error)
    return reason if masked(place) == place else type(error).__name__


def _system(url: str) -> tuple[Any, str]:
    scheme, _, rest = url.partition('://')
    if scheme not in SCHEMES or '://' in rest or '::' in url:
        raise InputError('E-ADDRESS-REFUSED', f'{masked(url)} is not opened: use a path, or one '
                                              f'address of {", ".join(SCHEMES)}')
    fsspec = needs('fsspec', f'{scheme}:// addresses')
    try:
        system, path = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise InputError('E-ADDRESS-UNKNOWN',
                         f'cannot use {masked(url)} ({_reason(error, url)}); install what fsspec '
                         f'needs for it') from error
    return system, str(path)


def needs(library: str, what: str) -> ModuleType:
    """Import a library of the extra; raises ConfigError that says how to install it."""
    try:
        return import_module(library)
    except ImportError as error:
        raise ConfigError('E-EXTRA-NOT-INSTALLED',
                          f"{what} need {library}: pip install '.[fleet]' in the folder of "
                          f'this package ({one_line(error)})') from error


def has(library: str) -> bool:
    """Return whether a library of the extra can be imported; not if NumPy is too old for it."""
    try:
        import_module(library)
    except ImportError:
        return False
    return True
