"""The output folder: files are complete or absent, and no driver can load a wrong calibration."""
from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
import stat
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.judge import Calibration
from dashcalib_ros.report.camera_file import load_camera
from dashcalib_ros.report.camera_yaml import CAMERA_NAME, calibration_yaml
from dashcalib_ros.report.named_camera import NamedCamera
from dashcalib_ros.report.page import report_html
from dashcalib_ros.report.result import result_json

ACCEPTED = 'calibration.yaml'
WEAK = 'calibration.weak.yaml'
RESULT = 'result.json'
REPORT = 'report.html'
TRUTH = 'truth.json'
PROBE = 'writable'
# the files of an output folder
NAMES = (ACCEPTED, WEAK, RESULT, REPORT, TRUTH, PROBE)


@dataclass(frozen=True)
class Written:
    """The files written; set_aside: the new path of an earlier calibration.yaml, None if none."""

    files: tuple[Path, ...]
    set_aside: Path | None = None


def write_results(calibration: Calibration, out_dir: str | Path, camera_name: str = CAMERA_NAME,
                  created: str | None = None, truth: NamedCamera | None = None) -> Written:
    """Write the result's files into out_dir, which is made if needed, and return their paths.

    result.json and report.html are always written. An accepted calibration goes to
    calibration.yaml, a weak one to calibration.weak.yaml, which no driver loads. An existing
    calibration.yaml is set aside unless this one is accepted, and always if it is another
    program's. Everything is written to temporary files before the first file is replaced: no file
    is ever half-written. truth: for the report, where it is known. Raises OutputError.
    """
    folder = Path(out_dir)
    texts: dict[str, str] = {}
    level = calibration.verdict.level
    name = ACCEPTED if level == 'accepted' else WEAK
    if level != 'refused':
        texts[name] = calibration_yaml(calibration, camera_name, created)
    texts[RESULT] = result_json(calibration)
    texts[REPORT] = report_html(calibration, truth, folder / name)
    with _output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with _prepared(folder, {name: text.encode('utf-8', 'replace')
                                for name, text in texts.items()}) as prepared:
            moved = None
            if ACCEPTED not in texts or not _is_ours(folder / ACCEPTED):
                moved = set_aside(folder / ACCEPTED)
            for name, temporary in prepared.items():
                temporary.replace(folder / name)
            if WEAK not in texts:
                (folder / WEAK).unlink(missing_ok=True)
            _sync(folder)
    return Written(tuple(folder / name for name in texts), moved)


def write_text(path: str | Path, text: str | bytes) -> None:
    """Write one file, completely or not at all. Raises OutputError."""
    path = Path(path)
    with _output_errors(path.parent):
        write_whole(path, text if isinstance(text, bytes) else text.encode('utf-8', 'replace'))
        _sync(path.parent)


def write_whole(path: Path, data: bytes) -> None:
    """Write one file, completely or not at all. Raises OSError."""
    with _prepared(path.parent, {path.name: data}) as prepared:
        prepared[path.name].replace(path)


def set_aside(path: Path) -> Path | None:
    """Rename a file to NAME.previous.yaml, NAME.previous.2.yaml, ...: the first name that is free.

    Returns the new path, None if there was no file. No file is ever overwritten. Raises
    OutputError.
    """
    try:
        if stat.S_ISDIR(path.lstat().st_mode):
            return None  # a folder can be neither loaded nor overwritten
        target = _new_backup(path)
        try:
            path.replace(target)
        except BaseException:
            target.unlink()
            raise
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise OutputError(f'{path} could not be moved aside: {error.strerror or error}; move it '
                          f'yourself, or allow writing to {path.parent}') from error
    _sync(path.parent)
    return target


def _new_backup(path: Path) -> Path:
    """Make an empty file of the first free name, so that no other process takes it."""
    number = 1
    while True:
        ending = '.previous' if number == 1 else f'.previous.{number}'
        target = path.with_name(f'{path.stem}{ending}{path.suffix}')
        try:
            target.open('xb').close()
            return target
        except FileExistsError:
            number += 1


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


def check_writable(out_dir: str | Path) -> None:
    """Make out_dir if needed and try to write there, before a long run and not after it.

    Temporary files of a killed run are removed. Raises OutputError.
    """
    folder = Path(out_dir)
    with _output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder, NAMES)
        with _prepared(folder, {PROBE: b'yes\n'}):
            pass


@contextmanager
def output_folder(out_dir: str | Path) -> Iterator[Path]:
    """Check the folder first; remove it if the work inside fails and it is new and empty."""
    folder = Path(out_dir)
    existed = folder.exists()
    try:
        check_writable(folder)
        yield folder
    except BaseException:
        if not existed:
            with suppress(OSError):
                folder.rmdir()
        raise


@contextmanager
def _prepared(folder: Path, contents: Mapping[str, bytes]) -> Iterator[dict[str, Path]]:
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


def _is_ours(path: Path) -> bool:
    """Return whether a calibration file was written by this package: ours have a verdict."""
    try:
        return load_camera(path).verdict is not None
    except InputError:
        return False


@contextmanager
def _output_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror or error}; '
                          f'{_cure(error)}') from error


def _cure(error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return 'free some space or choose another output folder'
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return 'choose an output folder you may write to'
    if error.errno in (errno.EEXIST, errno.ENOTDIR, errno.EISDIR):
        return 'something else has that name: move it or choose another output folder'
    return 'choose another output folder'


def _sync(folder: Path) -> None:
    """Make the renames in folder survive a power failure, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
