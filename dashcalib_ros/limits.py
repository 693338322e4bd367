# SPDX-License-Identifier: Apache-2.0
"""Limits for all files and messages from outside: sizes, depths and numbers of values.

All code that reads such input checks it here first. Input beyond a limit raises InputError before
memory or time is spent on it. What comes from outside takes 1 GB of memory at most beside the
pictures that are worked on, but for a fleet's manifest (10 kB for each camera), and time that
grows with its size and no faster.
"""
from __future__ import annotations

import itertools
import json
import os
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import SEEK_END, TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO

from dashcalib_ros.errors import InputError

# px; 8K has 33 million
PIXELS = 50_000_000
# px; no JPEG has a longer side
SIDE = 65_535
# of one encoded picture or one unpacked message: 50 million raw pixels of 4 bytes fit
PICTURE_BYTES = MESSAGE_BYTES = 2**28
# of one encoded picture, as each takes its time however small it is: passes over a JPEG (6 to 20
# in progressive ones), packed texts of a PNG (0 to 4), its parts (25,000 of 8 kB for 50 million
# raw pixels of 4 bytes), and entries of a TIFF's directory (20)
JPEG_SCANS, PNG_TEXTS, PNG_PARTS, TIFF_ENTRIES = 100, 16, 50_000, 1000
# of one unpacked chunk of a bag: recorders end it at about 1 MB, or after one large message
CHUNK_BYTES = MESSAGE_BYTES + 2**25
# of one record of an MCAP as it is stored: a chunk, or a file that is attached
RECORD_BYTES = 2**29
# of the chunks of an MCAP that overlap in time: all are in memory at once
OVERLAPPING_BYTES = 2**29
# of the index of a bag, which takes 12 times as much in memory, and topics of a bag
INDEX_BYTES, TOPICS = 2**26, 10_000
# steps of SQLite for a byte of a database: reading a whole bag five times takes one
SQLITE_STEPS = 20
# of a calibration, a configuration or the metadata.yaml of 3000 files
YAML_BYTES = 2**20
# of a result.json: it has about 100 kB; nuScenes' cameras have 5 MB
JSON_BYTES = 2**23
# of a bag's message in JSON: a raw 4K picture; in memory other values take 20 times as much
JSON_MESSAGE_BYTES = 2**25
# of a segmentation network: ONNX keeps no larger ones in one file
MODEL_BYTES = 2**31
# values in a YAML text, repetitions by aliases included: as many as 1 MB can have
YAML_VALUES = 300_000
# levels of a YAML text: a metadata.yaml has 6
YAML_DEPTH = 30
# of a clip of a fleet, in so many files: a day of 4K video, or of images at 10 Hz
CLIP_BYTES, CLIP_FILES = 2**38, 1_000_000
# of a list of the times of a folder's images
LIST_BYTES = 2**27
# of a CSV of motion sensors: ten hours of a gyro at 100 Hz
MOTION_BYTES = 2**29
# of a GPX: ten hours at 10 Hz; its levels, and names of elements and attributes: some have 50
GPX_BYTES, GPX_DEPTH, GPX_NAMES = 2**27, 30, 1000
# characters of a line of a CSV, or of a file of stamps
LINE = 2**18
# of one file of a KITTI oxts folder, and how many there may be
OXTS_BYTES, OXTS_FILES = 2**12, 1_000_000
# of a table of a fleet's clips, and its rows
MANIFEST_BYTES, MANIFEST_ROWS = 2**28, 1_000_000
# of the arrays of an .npz that may be part of a calibration, and how many an .npz may have
ARRAY_BYTES, ARRAYS = 2**22, 1000
# px, or a coefficient, of a camera; a rational model's may be thousands
LENS_NUMBER = 1e7
# digits of a number in a text: a float has 17 digits and at most 308 zeros
DIGITS = 300
# times the size of a .zstd file, or of a bag whose chunks are packed, once unpacked: raw pictures
# have 2 to 10, rendered ones 50
UNPACKED_RATIO = 200
# bytes to which any such file may be unpacked, however small it is
UNPACKED_LEAST = 2**28
# bytes that unpacking leaves free on the disk
FREE_BYTES = 2**30

# bytes in which a zip file's end is, of its end without a comment, and of an entry of its list
ZIP_TAIL, ZIP_END, ZIP_ENTRY = 2**16 + 22, 22, 200


def check_pixels(width: int, height: int, what: str = 'an image') -> None:
    """Raise InputError unless a picture of this size is within limits."""
    if width <= 0 or height <= 0:
        raise InputError('E-IMAGE-SIZE', f'{what} has the impossible size {width}x{height}: check '
                         f'the camera driver or the recording')
    if width * height > PIXELS or max(width, height) > SIDE:
        raise InputError('E-IMAGE-TOO-LARGE',
                         f'{what} has {width}x{height} pixels; the limits are '
                         f'{PIXELS // 10**6} million pixels and {SIDE} per side: reduce its size')


def path_of(given: object, remedy: str = 'pass the path of a file or of a folder') -> Path:
    """Return the path that a user gave. Raises InputError for what is none, or an empty one."""
    if not isinstance(given, (str, os.PathLike)):
        raise InputError('E-PATH-TYPE',
                         f'a path must be a str or a Path, not {given!r:.80}: {remedy}')
    if given == '':  # Path('') would be the current folder
        raise InputError('E-PATH-EMPTY', f'the path is empty: {remedy}; the current folder is .')
    return Path(given)


def check_file(path: Path, what: str = '', limit: int | None = None) -> None:
    """Raise InputError unless this is a regular file, of `limit` bytes at most; or OSError.

    what: the file's name in errors. Reading a pipe would block, and a device has no end.
    """
    try:
        about = path.stat()
    except ValueError as error:  # a name with a zero byte in it
        raise FileNotFoundError(2, 'No such file or directory', str(path)) from error
    if not stat.S_ISREG(about.st_mode):
        raise InputError('E-FILE-NOT-REGULAR', f'cannot read {what or path}: it is a folder, a '
                         f'pipe or a device, not a regular file; check the path')
    if limit is not None and about.st_size > limit:
        raise _too_large(what or str(path), limit)


def read_file(path: Path, limit: int, what: str = '') -> bytes:
    """Return the bytes of a regular file, `limit` at most; raises InputError."""
    what = what or str(path)
    with _opened(path, limit, what) as file:
        data = file.read(limit + 1)  # files of /proc have no size, and files may grow
    if len(data) > limit:
        raise _too_large(what, limit)
    return data


@contextmanager
def _opened(path: Path, limit: int, what: str) -> Iterator[BinaryIO]:
    try:
        check_file(path, what, limit)
        with path.open('rb') as file:
            yield file
    except FileNotFoundError as error:
        raise InputError('E-FILE-MISSING',
                         f'cannot read {what}: it does not exist; check the path') from error
    except OSError as error:
        raise InputError('E-FILE-UNREADABLE', f'cannot read {what} ({error.strerror}); check the '
                         f'path and its permissions') from error


def _too_large(what: str, limit: int) -> InputError:
    return InputError('E-FILE-TOO-LARGE', f'cannot read {what}: it is larger than '
                      f'{limit / 2**20:.0f} MB; check that it is the right file')


def read_text(path: Path, limit: int, what: str = '') -> str:
    """Return the text of a regular file of `limit` bytes at most; raises InputError."""
    data = read_file(path, limit, what)
    try:
        return data.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise _no_text(what or str(path)) from error


def read_lines(path: Path, limit: int, what: str = '') -> Iterator[str]:
    """Yield the lines of a text file of `limit` bytes at most; raises InputError.

    One line at a time is in memory. One that is longer than LINE comes in parts.
    """
    what = what or str(path)
    left = limit
    try:
        with _opened(path, limit, what) as file, TextIOWrapper(file, 'utf-8-sig') as text:
            while line := text.readline(LINE):
                left -= len(line)
                if left < 0:
                    raise _too_large(what, limit)
                yield line.removesuffix('\n')
    except UnicodeDecodeError as error:
        raise _no_text(what) from error


def _no_text(what: str) -> InputError:
    return InputError('E-FILE-NOT-TEXT',
                      f'cannot read {what}: it is not a text file (UTF-8); check the path')


def parse_yaml(text: str, what: str) -> Any:
    """Return the content of a YAML text; raises InputError, in which `what` names the text.

    Aliases (*name) may repeat values within limits.
    """
    import yaml

    if len(text) > YAML_BYTES:
        raise InputError('E-YAML-TOO-LARGE',
                         f'{what} has more than {YAML_BYTES / 2**20:.0f} MB of '
                         f'YAML; check that it is the right file')
    try:
        # 20 times as fast where libyaml is
        loader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)(text)
        root = loader.get_single_node()
        if root is None:
            return None
        _check_values(root, what)
        return loader.construct_document(root)
    except InputError:
        raise
    except Exception as error:  # a wrong tag or number makes PyYAML raise nearly anything
        mark = getattr(error, 'problem_mark', None)
        # libyaml calls the end the line after the last
        where = f' at line {min(mark.line, text.count(chr(10))) + 1}' if mark else ''
        raise InputError('E-YAML-INVALID',
                         f'{what} is not valid YAML{where}; correct it') from error


def _check_values(root: Any, what: str) -> None:
    for count, (node, level) in enumerate(_nodes(root), 1):
        if count > YAML_VALUES or level > YAML_DEPTH:
            raise InputError('E-YAML-TOO-LARGE', f'{what} is not usable YAML: with its aliases it '
                             f'has more than {YAML_VALUES} values or {YAML_DEPTH} levels; check '
                             f'that it is the right file')
        if (node.id == 'scalar' and len(node.value) > DIGITS
                and node.tag.endswith((':int', ':float'))):
            raise InputError('E-YAML-NUMBER',
                             f'{what} is not usable YAML: a number has more than '
                             f'{DIGITS} digits; correct it')


def _nodes(root: Any, level: int = 1) -> Iterator[tuple[Any, int]]:
    """Yield PyYAML's nodes and their levels; aliases are followed, also in circles."""
    yield root, level
    if root.id != 'scalar':
        for node in itertools.chain(*root.value) if root.id == 'mapping' else root.value:
            yield from _nodes(node, level + 1)


def check_npz(file: BinaryIO, parts: int) -> None:
    """Raise ValueError for a file of more parts, or packed as numpy packs none.

    zipfile takes memory for each part in its list, and with other kinds any amount to unpack one.
    """
    size = file.seek(0, SEEK_END)
    file.seek(max(0, size - ZIP_TAIL))
    tail = file.read()
    end = tail.rfind(b'PK\5\6')
    if end < 0 or len(tail) - end < ZIP_END or b'PK\6\7' in tail[max(0, end - 20):end]:
        raise ValueError('it is not an .npz file, or it is truncated')
    if int.from_bytes(tail[end + 12:end + 16], 'little') > parts * ZIP_ENTRY:
        raise ValueError('it has too many parts')
    file.seek(0)
    with zipfile.ZipFile(file) as packed:
        if len(packed.infolist()) > parts:
            raise ValueError('it has too many parts')
        if any(each.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
               for each in packed.infolist()):
            raise ValueError('its compression method is not supported')
    file.seek(0)


def parse_json(text: str, what: str) -> Any:
    """Return the content of a JSON text; raises InputError, in which `what` names the text."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError('E-JSON-INVALID',
                         f'{what} is not valid JSON ({error}); write it again') from error
