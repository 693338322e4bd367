# SPDX-License-Identifier: Apache-2.0
"""A folder of reconstructed turns, so that short trips add up (config: turns.store).

There is one file for each turn. It is written completely under a unique name, and never changed:
any number of processes may share the folder. Files that are not turns of this camera are not used
and not changed.
"""
from __future__ import annotations

import errno
import os
import re
import secrets
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.errors import InputError, Notice, counted, one_line
from dashcalib_ros.limits import read_file
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.store.scene_file import (
    LARGEST,
    SUFFIX,
    Origin,
    SceneFile,
    StoredTurn,
    decoded,
    encoded,
)
from dashcalib_ros.whole_files import remove_leftovers, write_whole

# names of turns' files
NAMES = re.compile(rf'turn-[0-9a-f]{{16}}{re.escape(SUFFIX)}')


class TurnStore:
    """A folder of turns, and those of this camera that were found in it.

    Problems are reported by warn; nothing is raised.

    turns: of earlier drives.
    """

    def __init__(self, folder: str, capacity: int, half_width_s: float,
                 warn: Callable[[Notice], None]) -> None:
        """folder: empty for none at all; ~ is expanded.

        capacity: largest number of turns of one camera. half_width_s: turns that are nearer in
        time are the same turn.
        """
        self.turns: dict[TurnId, StoredTurn] = {}
        self._folder = Path(folder)
        self._off = not folder
        try:
            self._folder = self._folder.expanduser()
        except RuntimeError:  # ~user of an unknown user: do not make a folder of that name
            self._off = True
            warn(Notice('E-STORE-HOME', f'turns cannot be stored in {folder} (that home folder '
                        f'does not exist); set turns.store to a path without ~'))
        self._capacity = capacity
        self._half_width_s = half_width_s
        self._warn = warn
        self._warned = False
        self._origin: Origin | None = None
        # by the turn's key: its file, '' if it was removed for more prominent ones, and the
        # prominence in it
        self._files: dict[TurnId, tuple[str, float]] = {}
        # origin and prominence by file; None for a file that cannot be used
        self._headers: dict[str, tuple[Origin, float] | None] = {}

    def load(self, origin: Origin, use: bool = True) -> None:
        """Load the turns of this camera, the most prominent first.

        use: False does not load them; their files stay.
        """
        self._origin = origin
        if self._off or not use:
            return
        found: list[tuple[str, StoredTurn]] = []
        bad: list[str] = []
        others: list[Origin] = []
        for name in self._names():
            try:
                of, turn = self._read(name)
            except InputError as error:
                if os.path.lexists(self._folder / name):  # or another process removed it
                    bad.append(str(error))
                continue
            if of.fits(origin):
                found.append((name, turn))
            else:
                others.append(of)
        self._report(bad, others, origin)
        found.sort(key=lambda each: (-each[1].prominence, each[1].stamp_s, each[0]))
        for name, turn in found:
            if any(turn.repeats(other.scene) or turn.happened(other.stamp_s, self._half_width_s)
                   for other in self.turns.values()):
                self._remove(name)
            elif len(self.turns) < self._capacity:
                key = TurnId.stored(len(self.turns))
                self.turns[key] = replace(turn, scene=replace(turn.scene, turn=key))
                self._files[key] = name, turn.prominence

    def drop_repeated(self, stamps_s: Iterable[float], scenes: Iterable[Scene] = ()) -> bool:
        """Drop turns that are also in this drive, by time or pictures: no turn may count twice.

        Returns whether any turn was dropped.
        """
        times, pictures = list(stamps_s), list(scenes)
        repeated = [key for key, turn in self.turns.items()
                    if any(turn.happened(at_s, self._half_width_s) for at_s in times)
                    or any(turn.repeats(scene) for scene in pictures)]
        for key in repeated:
            del self.turns[key]
        return bool(repeated)

    def mirror(self, turns: Mapping[TurnId, StoredTurn]) -> None:
        """Write these turns to the folder; remove others that were written or loaded before."""
        if not self._off:
            self._write_all(turns)

    def clear(self) -> None:
        """Remove the turns that were written or loaded; the folder is not used any more.

        Before load() their camera is not known: all turns are removed.
        """
        if self._off:
            return
        if self._origin is None:
            self._files = {TurnId.stored(n): (name, 0.0) for n, name in enumerate(self._names())
                         if self._header(name) is not None}
        self._write_all({})
        self._off = True

    def _write_all(self, turns: Mapping[TurnId, StoredTurn]) -> None:
        for key in self._files.keys() - turns.keys():
            self._remove(self._files.pop(key)[0])
        wrote = False
        for key, turn in turns.items():
            name, prominence = self._files.get(key, (None, 0.0))
            if name == '' or (name and prominence == turn.prominence):
                continue
            try:
                self._files[key] = self._write(turn), turn.prominence
            except OSError as error:
                self._warn_once(error)
                return
            wrote = True
            if name:
                self._remove(name)  # its prominence has grown
        if wrote:
            self._remove_excess()

    def _names(self) -> list[str]:
        remove_leftovers(self._folder, NAMES)
        try:
            return sorted(path.name for path in self._folder.iterdir() if path.suffix == SUFFIX)
        except FileNotFoundError:
            return []
        except OSError as error:
            self._warn_once(error)
            return []

    def _report(self, bad: list[str], others: list[Origin], origin: Origin) -> None:
        if bad:
            more = f' and {len(bad) - 3} more' if len(bad) > 3 else ''
            self._warn(Notice(
                'E-STORE-FILES', f'{counted(len(bad), "file")} in {self._folder} skipped: '
                f'{", ".join(bad[:3])}{more}; delete files that are not stored turns'))
        if others:
            self._warn(Notice(
                'E-STORE-OTHER-CAMERA', f'{counted(len(others), "file")} in {self._folder} '
                f'skipped: the images were {others[0]}, but these are {origin}; use a separate '
                f'folder for each camera in turns.store'))

    def _read(self, name: str) -> tuple[Origin, StoredTurn]:
        self._headers[name] = None
        data = read_file(self._folder / name, LARGEST, name)
        try:
            file = decoded(data)
            [turn] = file.turns
        except ValueError as error:
            raise InputError('E-TURN-FILE',
                             f'{name} cannot be used ({one_line(error)})') from error
        self._headers[name] = file.origin, turn.prominence
        return file.origin, turn

    def _header(self, name: str) -> tuple[Origin, float] | None:
        if name not in self._headers:
            with suppress(InputError):
                self._read(name)
        return self._headers[name]

    def _write(self, turn: StoredTurn) -> str:
        assert self._origin is not None
        name = f'turn-{secrets.token_hex(8)}{SUFFIX}'
        self._folder.mkdir(parents=True, exist_ok=True)
        write_whole(self._folder / name, encoded(SceneFile(self._origin, (turn,), 1)))
        self._headers[name] = self._origin, turn.prominence
        return name

    def _remove_excess(self) -> None:
        """Remove the least prominent turns beyond the capacity, also those of other processes."""
        assert self._origin is not None
        ranked: list[tuple[float, str]] = []
        for name in self._names():
            about = self._header(name)
            if about is not None and about[0].fits(self._origin):
                ranked.append((-about[1], name))
        ranked.sort()
        for _, name in ranked[self._capacity:]:
            self._remove(name)
            for key, (own, prominence) in self._files.items():
                if own == name:
                    self._files[key] = '', prominence

    def _remove(self, name: str) -> None:
        if not name:
            return
        try:
            (self._folder / name).unlink(missing_ok=True)
        except OSError as error:
            self._warn_once(error)

    def _warn_once(self, error: OSError) -> None:
        """Warn once: the same error will come for every turn."""
        if self._warned:
            return
        self._warned = True
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        self._warn(Notice(
            'E-STORE-NOT-WRITABLE',
            f'turns cannot be stored in {self._folder} ({error.strerror or error}); '
            + ('free some disk space' if full else
               'set turns.store to a folder with write permission')))
