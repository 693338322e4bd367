"""The output folder: all files whole or none, and never a wrong calibration left to be loaded."""
from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from dashcalib_ros.errors import OutputError
from dashcalib_ros.intrinsics import Calibration
from dashcalib_ros.report.camera_yaml import CAMERA_NAME, calibration_yaml
from dashcalib_ros.report.page import report_html
from dashcalib_ros.report.result import result_json

ACCEPTED = 'calibration.yaml'
WEAK = 'calibration.weak.yaml'
PREVIOUS = 'calibration.previous.yaml'


def write_results(calibration: Calibration, out_dir: str | Path, camera_name: str = CAMERA_NAME,
                  created: str | None = None) -> tuple[Path, ...]:
    """Write the result's files into out_dir (made if need be) and return their paths.

    Always result.json and report.html. An accepted calibration goes to calibration.yaml, a weak
    one to calibration.weak.yaml, where no driver looks. Unless accepted, the calibration.yaml of
    an earlier run becomes calibration.previous.yaml. Everything is written to temporary files
    before the first file is replaced: no file is ever half-written. Raises OutputError.
    """
    folder = Path(out_dir)
    texts: dict[str, str] = {}
    level = calibration.verdict.level
    if level != 'refused':
        name = ACCEPTED if level == 'accepted' else WEAK
        texts[name] = calibration_yaml(calibration, camera_name, created)
    texts['result.json'] = result_json(calibration)
    texts['report.html'] = report_html(calibration)
    with _output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with _prepared(folder, texts) as prepared:
            if ACCEPTED not in texts and (folder / ACCEPTED).exists():
                (folder / ACCEPTED).replace(folder / PREVIOUS)
            for name, temporary in prepared.items():
                temporary.replace(folder / name)
            if WEAK not in texts:
                (folder / WEAK).unlink(missing_ok=True)
            _sync(folder)
    return tuple(folder / name for name in texts)


def write_text(path: str | Path, text: str) -> None:
    """Write one file, whole or not at all. Raises OutputError."""
    path = Path(path)
    with _output_errors(path.parent), _prepared(path.parent, {path.name: text}) as prepared:
        prepared[path.name].replace(path)
        _sync(path.parent)


def check_writable(out_dir: str | Path) -> None:
    """Make out_dir if need be and try to write there: better before a long run than after it.

    Raises OutputError.
    """
    folder = Path(out_dir)
    with _output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with _prepared(folder, {'writable': 'yes\n'}):
            pass


@contextmanager
def output_folder(out_dir: str | Path) -> Iterator[Path]:
    """Check the folder first; if nothing came of the work inside, take an empty new one away."""
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
def _prepared(folder: Path, texts: Mapping[str, str]) -> Iterator[dict[str, Path]]:
    """Write each text to a temporary file beside its final place; at the end, none is left."""
    temporary: dict[str, Path] = {}
    try:
        for name, text in texts.items():
            if (folder / name).is_dir():
                raise IsADirectoryError(errno.EISDIR, f'{name} is a folder there')
            temporary[name] = folder / f'.{name}.{secrets.token_hex(4)}.tmp'
            with temporary[name].open('xb') as stream:
                stream.write(text.encode('utf-8', 'replace'))
                stream.flush()
                os.fsync(stream.fileno())
        yield temporary
    finally:
        for leftover in temporary.values():
            leftover.unlink(missing_ok=True)


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
    """Make the renames in folder last, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
