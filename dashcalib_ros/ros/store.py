"""The last accepted calibration on disk, by default where camera_info_manager finds it."""
from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.limits import YAML_BYTES, read_text
from dashcalib_ros.report import set_aside, write_text
from dashcalib_ros.ros.kept import Kept, Whose, implausible
from dashcalib_ros.whole_files import remove_leftovers


class Store:
    """One file of one node. If another program has written it, it is set aside, never overwritten.

    While a node has it, no other node reads or writes it: a file beside it is locked.
    """

    def __init__(self, path: Path, whose: Whose) -> None:
        self.path = path
        self._whose = whose
        self._lock: int | None = None
        # the text that this node last read or wrote: a different one is another program's
        self._text: str | None = None
        # the text of a calibration that was given up, but could not be moved aside
        self._given_up: str | None = None
        remove_leftovers(self.path.parent, (self.path.name,))

    def claim(self) -> bool:
        """Take the file unless another node has it; return whether this node has it."""
        if self._lock is not None:
            return True
        real = Path(os.path.realpath(self.path))
        with suppress(OSError):
            real.parent.mkdir(parents=True, exist_ok=True)
        # where nothing can be written, the file itself
        for path, flags in ((real.with_name(f'.{real.name}.lock'), os.O_CREAT), (real, 0)):
            try:
                lock = os.open(path, os.O_RDONLY | os.O_NONBLOCK | flags, 0o644)
            except OSError:
                continue
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                os.close(lock)
                if isinstance(error, BlockingIOError):
                    return False
                continue  # not every file system has locks
            self._lock = lock
            return True
        return True

    def close(self) -> None:
        """Leave the file to other nodes."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def taken(self) -> str:
        """Return the line for the operator where another node has the file, else ''."""
        if self.claim():
            return ''
        return (f'another node uses {self.path}: this one neither publishes nor writes it; set '
                f'camera_name or camera_info_url to give each a file of its own')

    @property
    def given_up(self) -> bool:
        """Return whether the file still has a calibration that was given up."""
        return self._given_up is not None and self._read() == self._given_up

    def load(self) -> Kept | None:
        """Return the calibration, None if there is no file.

        Raises InputError when it is damaged, was given up, is another node's, another tool's (that
        has no sigma to compare with), or another camera's. One that no lens can have is set aside.
        """
        self._text = None
        if self.taken:
            raise InputError(self.taken)
        with suppress(OSError):  # reading fails, too, and raises InputError below
            if not self._exists():
                return None
        try:
            text = read_text(self.path, YAML_BYTES)
            kept = Kept.read(text, self.path, self._whose)
        except (InputError, ValueError, OverflowError) as error:
            raise InputError(f'{self.path} is ignored: {error}') from error
        if text == self._given_up:
            raise InputError(f'{self.path} is ignored: it was given up, but could not be moved '
                             f'aside; remove it')
        if why := implausible(kept.camera):
            try:
                end = f'it is now {set_aside(self.path)}'
            except OutputError as error:
                end = str(error)
            raise InputError(f'{self.path} is not used: {why}; {end}')
        self._text = text
        # its sigma may be what was edited
        return replace(kept, camera=replace(kept.camera, sigma=None)) if kept.edited else kept

    def save(self, kept: Kept) -> Path | None:
        """Write it, completely or not at all. Raises OutputError.

        Returns the new path of another program's file, None if there was none.
        """
        if self.taken:
            raise OutputError(self.taken)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f'cannot make {self.path.parent}: {error.strerror}; set '
                              f'camera_info_url to a place you may write to') from error
        ours = self._text is not None and self._read() == self._text
        moved = None if ours else set_aside(self.path)
        write_text(self.path, kept.text)
        self._text, self._given_up = kept.text, None
        return moved

    def update(self, kept: Kept) -> None:
        """Write it where the file is still what this node read or wrote. Raises OutputError."""
        if self._text is not None and self._read() == self._text and self.claim():
            write_text(self.path, kept.text)
            self._text = kept.text

    def retire(self) -> Path | None:
        """Set the file aside, so that it is not loaded again; return its new path.

        None if there was no file. Raises OutputError when it could not be moved: this process
        does not load it again then, but the next start of the node does; and where another node
        has it.
        """
        if self.taken:
            raise OutputError(self.taken)
        try:
            moved = set_aside(self.path)
        except OutputError:
            self._given_up = self._read()
            raise
        self._text = self._given_up = None
        return moved

    def _exists(self) -> bool:
        try:
            self.path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        return True

    def _read(self) -> str | None:
        try:
            return read_text(self.path, YAML_BYTES)
        except InputError:
            return None
