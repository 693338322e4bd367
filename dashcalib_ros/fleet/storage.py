"""Files here and on object stores, read and written whole: paths, and URLs such as s3://.

Only URLs need fsspec.
"""
from __future__ import annotations

import errno
import hashlib
import importlib
import os
import posixpath
import re
import shutil
import stat as stat_module
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from dashcalib_ros.errors import ConfigError, InputError, OutputError, one_line
from dashcalib_ros.input.inputs import named_like
from dashcalib_ros.limits import CLIP_BYTES, CLIP_FILES, check_file, read_file
from dashcalib_ros.whole_files import write_whole

URL = re.compile(r'[a-z][a-z0-9+.-]+://')


def is_url(place: str) -> bool:
    """Return whether a place is a URL, and not a path of this machine."""
    return URL.match(place) is not None


def joined(folder: str, name: str) -> str:
    """Return a name relative to a folder; a name that is a URL or absolute stands for itself."""
    if is_url(name) or Path(name).is_absolute():
        return name
    return posixpath.join(folder, name) if is_url(folder) else str(Path(folder) / name)


def parent(place: str) -> str:
    """Return the folder that a file is in."""
    return posixpath.dirname(place) if is_url(place) else str(Path(place).parent)


def listed(pattern: str) -> list[str]:
    """Return the files and folders that a folder has, or that a glob finds, sorted."""
    if is_url(pattern):
        system, path = _system(pattern)
        scheme = pattern.partition('://')[0]
        try:
            found = (system.glob(path) if _is_glob(path) else system.ls(path, detail=False))
        except Exception as error:  # each kind of store has errors of its own
            raise InputError(f'cannot list {pattern} ({one_line(error)}); check the address and '
                             f'your access to it') from error
        return sorted(f'{scheme}://{name}' for name in found)
    if _is_glob(pattern):
        return sorted(map(str, named_like(pattern)))
    return sorted(str(entry) for entry in Path(pattern).iterdir()
                  if not entry.name.startswith('.'))


def _is_glob(pattern: str) -> bool:
    return any(sign in pattern for sign in '*?[')


def is_folder(place: str) -> bool:
    """Return whether a place is a folder of this machine, or one of an object store."""
    if not is_url(place):
        return Path(place).is_dir()
    system, path = _system(place)
    return bool(system.isdir(path))


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
            raise InputError(f'{path} has more than {CLIP_FILES} files or {CLIP_BYTES >> 30} GB: '
                             f'is it one clip?')
    return sorted(found, key=lambda pair: pair[0])


def stamp(place: str) -> str | None:
    """Return a text that changes with a file, or with any file of a folder; None without one."""
    if is_url(place):
        system, path = _system(place)
        try:
            about = system.info(path)
            entries = {'.': about} if about.get('type') != 'directory' else {
                name.removeprefix(path): each
                for name, each in system.find(path, maxdepth=2, detail=True).items()}
        except FileNotFoundError:
            return None
        except Exception as error:
            raise InputError(f'cannot read {place} ({one_line(error)})') from error
        return _joined_stamps((name, ' '.join(
            f'{each[key]}' for key in ('size', 'ETag', 'etag', 'mtime', 'created', 'LastModified',
                                       'generation') if each.get(key) is not None))
            for name, each in sorted(entries.items()))
    here = Path(place)
    try:
        files = clip_files(here)
    except InputError as error:
        return str(error)  # until it is something else
    except (OSError, ValueError):
        return None
    # the time of change is also that of a file put in its place, whose other times are older
    return _joined_stamps((os.path.relpath(file, here), f'{about.st_size} {about.st_mtime_ns} '
                           f'{about.st_ctime_ns}') for file, about in files)


def _joined_stamps(stamps: Iterable[tuple[str, str]]) -> str:
    text = '\n'.join(f'{name}: {each}' for name, each in stamps)
    return hashlib.sha256(os.fsencode(text)).hexdigest()[:32]


@contextmanager
def local_copy(place: str) -> Iterator[Path]:
    """Copy what a URL names to the scratch disk (TMPDIR) and remove it later; a path is itself.

    Raises InputError, OSError where the scratch disk is full.
    """
    if not is_url(place):
        yield Path(place)
        return
    system, path = _system(place)
    scratch = Path(tempfile.mkdtemp(prefix='dashcalib-'))
    try:
        copy = scratch / posixpath.basename(path.rstrip('/'))
        try:
            system.get(path, str(copy), recursive=system.isdir(path))
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise
            raise InputError(f'cannot copy {place} ({one_line(error)})') from error
        except Exception as error:
            raise InputError(f'cannot copy {place} ({one_line(error)})') from error
        yield copy
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def read(place: str, limit: int) -> bytes | None:
    """Return a file's bytes, None where there is none; raises InputError beyond the limit."""
    try:
        if is_url(place):
            system, path = _system(place)
            data = bytes(system.cat_file(path, start=0, end=limit + 1))
        else:
            return read_file(Path(place), limit) if Path(place).exists() else None
    except FileNotFoundError:
        return None
    except InputError:
        raise
    except Exception as error:
        raise InputError(f'cannot read {place} ({one_line(error)})') from error
    if len(data) > limit:
        raise InputError(f'{place} is larger than {limit / 2**20:.0f} MB: is it the right file?')
    return data


@dataclass(frozen=True)
class Folder:
    """An output folder: its files appear whole or not at all. place: a path or a URL."""

    place: str

    def read(self, name: str, limit: int = 2**28) -> bytes | None:
        """Return a file's bytes, None where there is none; raises InputError."""
        return read(joined(self.place, name), limit)

    def exists(self, name: str) -> bool:
        """Return whether there is such a file."""
        if is_url(self.place):
            system, path = _system(joined(self.place, name))
            return bool(system.exists(path))
        return (Path(self.place) / name).is_file()

    def write(self, name: str, data: bytes) -> None:
        """Write a file: others see all of it or nothing. Raises OutputError."""
        place = joined(self.place, name)
        try:
            if is_url(place):
                system, path = _system(place)
                system.pipe_file(path, data)  # object stores show complete objects only
            else:
                Path(place).parent.mkdir(parents=True, exist_ok=True)
                write_whole(Path(place), data)
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            raise OutputError(
                f'cannot write {place}: {error.strerror or one_line(error)}; '
                + ('free some space, and start again: what is done stays' if full
                   else 'choose an output folder you may write to')) from error

    def remove(self, name: str) -> None:
        """Remove a file, if there is one."""
        if is_url(self.place):
            system, path = _system(joined(self.place, name))
            with suppress(FileNotFoundError):
                system.rm_file(path)
        else:
            (Path(self.place) / name).unlink(missing_ok=True)


def _system(url: str) -> tuple[Any, str]:
    """Return fsspec's file system of a URL, and the path there; raises InputError."""
    fsspec = needs('fsspec', f'{url.partition("://")[0]}:// addresses')
    try:
        system, path = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise InputError(f'cannot use {url} ({one_line(error)})') from error
    if 'file' in system.protocol:
        raise InputError(f'{url} is a file of this machine: give its path')
    return system, str(path)


def needs(library: str, what: str) -> ModuleType:
    """Import a library of the extra; raises ConfigError that says how to install it."""
    found = has(library)
    if found is None:
        raise ConfigError(f"{what} need {library}: install it with pip install "
                          f"'dashcalib_ros[fleet]'")
    return found


def has(library: str) -> ModuleType | None:
    """Import a library of the extra, if it is installed."""
    try:
        return importlib.import_module(library)
    except ModuleNotFoundError as error:
        if error.name != library.partition('.')[0]:
            raise
        return None
