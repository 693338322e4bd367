# SPDX-License-Identifier: Apache-2.0
"""The output folder: files are complete or absent, and no driver can load a wrong calibration."""
from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from dashcalib_ros.errors import InputError, Notice, OutputError, spared
from dashcalib_ros.formats import calibration_yaml, load_camera, result_json
from dashcalib_ros.formats.ros import CAMERA_NAME
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.report.page import report_html
from dashcalib_ros.report.wording import ACCEPTED, WEAK, file_of
from dashcalib_ros.whole_files import FULL, prepared, remove_leftovers, sync, write_whole

RESULT = 'result.json'
REPORT = 'report.html'
TRUTH = 'truth.json'
PROBE = 'writable'
# the files of an output folder
NAMES = (ACCEPTED, WEAK, RESULT, REPORT, TRUTH, PROBE)


@dataclass(frozen=True)
class Written:
    """The files written; set_aside: the new path of an earlier calibration, None if none.

    lost: a line for each part of the report that could not be made, or for all of it.
    """

    files: tuple[Path, ...]
    set_aside: Path | None = None
    lost: tuple[Notice, ...] = ()


def write_results(calibration: CalibrationData, out_dir: str | os.PathLike[str],
                  camera_name: str = CAMERA_NAME,
                  created: str | None = None, truth: NamedCamera | None = None,
                  place: str | None = None) -> Written:
    """Write the result's files into out_dir, which is made if needed, and return their paths.

    First comes result.json. An accepted calibration goes to calibration.yaml, a weak one to
    calibration.weak.yaml, which no driver loads. An existing calibration.yaml is set aside unless
    this one is accepted, and no file of another program is overwritten or removed. All this is
    written to temporary files before the first file is replaced: no file is ever half-written.
    Then comes report.html: where it cannot be made or written, there is none, and a line says so.
    truth: for the report, where it is known. place: where the folder will be found, None: there.
    Raises OutputError.
    """
    folder = Path(out_dir)
    texts: dict[str, str] = {}
    if calibration.verdict.level != 'refused':
        texts[file_of(calibration.verdict)] = calibration_yaml(calibration, camera_name, created)
    texts[RESULT] = result_json(calibration)
    with _output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with prepared(folder, {name: text.encode('utf-8', 'replace')
                                for name, text in texts.items()}) as temporary:
            moved = None
            if ACCEPTED not in texts or not _is_ours(folder / ACCEPTED):
                moved = set_aside(folder / ACCEPTED)
            if not _is_ours(folder / WEAK):
                if WEAK in texts:
                    moved = set_aside(folder / WEAK) or moved
            elif WEAK not in texts:
                (folder / WEAK).unlink()
            for name, path in temporary.items():
                path.replace(folder / name)
            # until there is this one's, there is none: it would be that of another result
            if not (folder / REPORT).is_dir():
                (folder / REPORT).unlink(missing_ok=True)
            sync(folder)
    files = tuple(folder / name for name in texts)
    lost: list[Notice] = []
    page = spared(REPORT, lost, report_html, calibration, truth, place or str(out_dir), lost)
    if page is not None:
        try:
            write_text(folder / REPORT, page)
            files += (folder / REPORT,)
        except OutputError as error:
            lost.append(Notice('E-REPORT-NOT-WRITTEN', f'there is no {REPORT}, but all other '
                               f'files are there: {error}'))
    return Written(files, moved, tuple(lost))


def write_text(path: str | Path, text: str | bytes) -> None:
    """Write one file, completely or not at all. Raises OutputError."""
    path = Path(path)
    with _output_errors(path.parent):
        write_whole(path, text if isinstance(text, bytes) else text.encode('utf-8', 'replace'))
        sync(path.parent)


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
        raise OutputError('E-FILE-NOT-MOVED',
                          f'{path} could not be moved aside: {error.strerror or error}; move it '
                          f'yourself, or allow writing to {path.parent}') from error
    sync(path.parent)
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


def check_writable(out_dir: str | os.PathLike[str]) -> None:
    """Make out_dir if needed and try to write there, before a long run and not after it.

    Temporary files of a killed run are removed. Raises OutputError.
    """
    folder = Path(out_dir)
    with _output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder, NAMES)
        with prepared(folder, {PROBE: b'yes\n'}):
            pass


@contextmanager
def output_folder(out_dir: str | os.PathLike[str]) -> Iterator[Path]:
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


def _is_ours(path: Path) -> bool:
    try:
        return load_camera(path).verdict is not None
    except InputError:
        return False


@contextmanager
def _output_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise _cannot_write(folder, error) from error


def _cannot_write(folder: Path, error: OSError) -> OutputError:
    what = f'cannot write to {folder}: {error.strerror or error}; '
    if error.errno in FULL:
        return OutputError('E-DISK-FULL', what + 'free some space or choose another output folder')
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return OutputError('E-NOT-WRITABLE', what + 'choose an output folder you may write to')
    if error.errno in (errno.EEXIST, errno.ENOTDIR, errno.EISDIR):
        return OutputError('E-NAME-TAKEN', what + 'something else has that name: rename it or '
                           'choose another output folder')
    return OutputError('E-CANNOT-WRITE', what + 'choose another output folder')
