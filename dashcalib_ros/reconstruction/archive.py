"""Reconstructed turns on disk, so that short trips add up (config: turns.store).

One file for each turn, written whole under a name that nobody else takes, and never changed: any
number of processes may share the folder. What is no turn of this camera is left out and left
alone.
"""
from __future__ import annotations

import errno
import io
import os
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dashcalib_ros.errors import InputError, one_line
from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.chain import Structure
from dashcalib_ros.reconstruction.scene import Profile, Scene
from dashcalib_ros.reconstruction.tracks import Tracks

# of the files; another layout needs another number
FORMAT = 2
# bytes; a turn has a few hundred thousand
LARGEST = 16_000_000
# s; a clock that is past this (in 2001) tells the date: equal times are the same moment
DATES_S = 1e9
# s; what was being written longer ago than this never will be whole
ABANDONED_S = 3600.0


@dataclass(frozen=True)
class Origin:
    """What a turn's pictures were: size (width, height) of the input, how often it was shrunk.

    frame_id: of their headers; empty where the input has none, which fits any.
    """

    image_size: tuple[int, int]
    shrink: int
    frame_id: str = ''

    def fits(self, other: Origin) -> bool:
        """Tell whether both may be of one camera."""
        frames = {self.frame_id, other.frame_id} - {''}
        return (self.image_size, self.shrink) == (other.image_size, other.shrink) and (
            len(frames) < 2)

    def __str__(self) -> str:
        frame = f' in frame {self.frame_id!r}' if self.frame_id else ''
        return f'{self.image_size[0]}x{self.image_size[1]} shrunk by {self.shrink}{frame}'


@dataclass(frozen=True)
class StoredTurn:
    """A scene and what is remembered of its turn: time of the centre in s, and prominence."""

    scene: Scene
    stamp_s: float
    prominence: float

    def repeats(self, scene: Scene) -> bool:
        """Tell whether a scene is of the same pictures."""
        return np.array_equal(self.scene.tracks.xy, scene.tracks.xy, equal_nan=True)

    def happened(self, stamp_s: float, half_width_s: float) -> bool:
        """Tell whether the turn was at this time; of clocks that tell no date nobody knows."""
        return min(self.stamp_s, stamp_s) > DATES_S and abs(self.stamp_s - stamp_s) < half_width_s


class Archive:
    """The folder and what was found in it. Nothing is raised: troubles are warned of.

    turns: of earlier drives, by the numbers -1, -2, ...: centres count the frames of this drive.
    Whoever uses it guards it; the files have a lock of their own, as writing may take long.
    """

    def __init__(self, folder: str, capacity: int, half_width_s: float,
                 warn: Callable[[str], None]) -> None:
        """folder: empty for none at all; ~ is expanded.

        capacity: how many turns of one camera it holds at the most. half_width_s: turns nearer to
        each other in time are the same.
        """
        self.turns: dict[int, StoredTurn] = {}
        self._folder = Path(folder)
        self._off = not folder
        try:
            self._folder = self._folder.expanduser()
        except RuntimeError:  # no folder named ~user is to be made here
            self._off = True
            warn(f'turns cannot be stored in {folder} (there is no such home folder); set '
                 f'turns.store to a path without ~')
        self._writing = threading.Lock()
        self._capacity = capacity
        self._half_width_s = half_width_s
        self._warn = warn
        self._warned = False
        self._origin: Origin | None = None
        # the file and the prominence in it, by the turn's key; '' is one that others pushed out
        self._own: dict[int, tuple[str, float]] = {}
        # what the files tell of themselves; None: nothing of use
        self._known: dict[str, tuple[Origin, float] | None] = {}

    def load(self, origin: Origin, use: bool = True) -> None:
        """Find the turns of this camera, the most prominent first.

        use: False begins without them; they stay where they are.
        """
        self._origin = origin
        if self._off or not use:
            return
        found: list[tuple[str, StoredTurn]] = []
        bad: list[str] = []
        others: list[Origin] = []
        for name in self._listed():
            try:
                of, turn = _read(self._folder / name)
            except FileNotFoundError:
                continue  # another process removed it
            except InputError as error:
                bad.append(str(error))
                self._known[name] = None
                continue
            self._known[name] = of, turn.prominence
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
                key = -1 - len(self.turns)
                self.turns[key] = replace(turn, scene=replace(turn.scene, center=key))
                self._own[key] = name, turn.prominence

    def drop_repeated(self, stamps_s: Iterable[float], scenes: Iterable[Scene] = ()) -> bool:
        """Drop what this drive shows again, by its time or its pictures: evidence counts once.

        Returns whether any turn was dropped.
        """
        times, pictures = list(stamps_s), list(scenes)
        repeated = [key for key, turn in self.turns.items()
                    if any(turn.happened(at_s, self._half_width_s) for at_s in times)
                    or any(turn.repeats(scene) for scene in pictures)]
        for key in repeated:
            del self.turns[key]
        return bool(repeated)

    def mirror(self, snapshot: Callable[[], Mapping[int, StoredTurn]]) -> None:
        """Have the folder hold these turns, and none else that were given or loaded before.

        snapshot: asked when nobody else writes; the newest one is the last one.
        """
        if self._off:
            return
        with self._writing:
            if not self._off:
                self._hold(snapshot())

    def clear(self) -> None:
        """Remove the turns that were given or loaded; from now on there is no folder.

        Before load() it is not known whose they are: all turns go.
        """
        if self._off:
            return
        with self._writing:
            if self._origin is None:
                self._own = {n: (name, 0.0) for n, name in enumerate(self._listed())
                             if _heading(self._folder / name) is not None}
            self._hold({})
            self._off = True

    def _hold(self, turns: Mapping[int, StoredTurn]) -> None:
        for key in self._own.keys() - turns.keys():
            self._remove(self._own.pop(key)[0])
        wrote = False
        for key, turn in turns.items():
            name, prominence = self._own.get(key, (None, 0.0))
            if name == '' or (name and prominence == turn.prominence):
                continue
            try:
                self._own[key] = self._write(turn), turn.prominence
            except OSError as error:
                self._fail(error)
                return
            wrote = True
            if name:
                self._remove(name)  # its prominence has grown
        if wrote:
            self._push_out()

    def _listed(self) -> list[str]:
        """Return the names of all files that may be turns."""
        try:
            for leftover in self._folder.glob('.turn-*.tmp'):
                if time.time() - leftover.stat().st_mtime > ABANDONED_S:
                    leftover.unlink()
        except OSError:
            pass  # another process's, or not ours to remove
        try:
            return sorted(path.name for path in self._folder.iterdir() if path.suffix == '.npz')
        except FileNotFoundError:
            return []
        except OSError as error:
            self._fail(error)
            return []

    def _report(self, bad: list[str], others: list[Origin], origin: Origin) -> None:
        if bad:
            self._warn(f'{_count(bad)} in {self._folder} left out: {bad[0]}; delete what is no '
                       f'stored turn')
        if others:
            self._warn(f'{_count(others)} in {self._folder} left out: of images {others[0]}, '
                       f'these are {origin}; give each camera a folder of its own in turns.store')

    def _write(self, turn: StoredTurn) -> str:
        assert self._origin is not None
        name = f'turn-{secrets.token_hex(8)}.npz'
        data = io.BytesIO()
        np.savez_compressed(data, **_arrays(turn, self._origin))
        self._folder.mkdir(parents=True, exist_ok=True)
        temporary = self._folder / f'.{name}.tmp'
        try:
            with temporary.open('xb') as stream:
                stream.write(data.getbuffer())
                stream.flush()
                os.fsync(stream.fileno())
            temporary.replace(self._folder / name)
        finally:
            with suppress(OSError):
                temporary.unlink()
        self._known[name] = self._origin, turn.prominence
        return name

    def _push_out(self) -> None:
        """Remove the least prominent of what is too much; other processes write here, too."""
        assert self._origin is not None
        ranked: list[tuple[float, str]] = []
        for name in self._listed():
            if name not in self._known:
                self._known[name] = _heading(self._folder / name)
            about = self._known[name]
            if about is not None and about[0].fits(self._origin):
                ranked.append((-about[1], name))
        ranked.sort()
        for _, name in ranked[self._capacity:]:
            self._remove(name)
            for key, (own, prominence) in self._own.items():
                if own == name:
                    self._own[key] = '', prominence

    def _remove(self, name: str) -> None:
        if not name:
            return
        try:
            (self._folder / name).unlink(missing_ok=True)
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        """Warn once: the same will go wrong for every turn."""
        if self._warned:
            return
        self._warned = True
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        self._warn(f'turns cannot be stored in {self._folder} ({error.strerror or error}); '
                   + ('free some space' if full else 'set turns.store to a folder you may write '
                                                     'to'))


def _count(files: list[Any]) -> str:
    return '1 file is' if len(files) == 1 else f'{len(files)} files are'


def _arrays(turn: StoredTurn, origin: Origin) -> dict[str, Any]:
    scene = turn.scene
    values = {
        'format': FORMAT, 'image_size': origin.image_size, 'shrink': origin.shrink,
        'frame_id': origin.frame_id, 'stamp_s': turn.stamp_s, 'prominence': turn.prominence,
        'frames': scene.tracks.frames, 'xy': scene.tracks.xy, 'size': scene.tracks.image_size,
        'stamps_ns': scene.tracks.stamps_ns,
        'rotations': scene.structure.rotations, 'translations': scene.structure.translations,
        'points': scene.structure.points, 'registered': scene.structure.registered,
        'used': scene.structure.used, 'camera': scene.camera.params,
        'ratios': scene.profile.ratios, 'costs': scene.profile.costs,
        'observations': scene.profile.observations}
    return {name: np.asarray(value) for name, value in values.items()}


def _heading(path: Path) -> tuple[Origin, float] | None:
    """Return a file's origin and prominence, None for what is no stored turn."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return _origin(data), float(_array(data, 'prominence', float, ()))
    except Exception:  # as in _read
        return None


def _read(path: Path) -> tuple[Origin, StoredTurn]:
    """Return what a file holds; the scene has the centre 0.

    Raises InputError for what is no stored turn, FileNotFoundError for what is gone.
    """
    try:
        if path.stat().st_size > LARGEST:
            raise ValueError('it is too large')
        with np.load(path, allow_pickle=False) as data:
            origin, turn = _origin(data), _turn(data)
        small = tuple(side // max(origin.shrink, 1) for side in origin.image_size)
        if turn.scene.tracks.image_size != small:
            raise ValueError('its numbers make no scene')
        return origin, turn
    except FileNotFoundError:
        raise
    except Exception as error:
        # a file that anything may have happened to: numpy, zipfile and zlib raise all kinds
        what = error.strerror if isinstance(error, OSError) else None
        raise InputError(f'{path.name} cannot be used ({what or one_line(error, 120)})') from error


def _origin(data: Mapping[str, npt.NDArray[Any]]) -> Origin:
    if 'format' not in data:
        raise ValueError('it is no stored turn')
    if (number := int(_array(data, 'format', int, ()))) != FORMAT:
        raise ValueError(f'it has format {number}, this version has {FORMAT}')
    width, height = (int(side) for side in _array(data, 'image_size', int, (2,)))
    return Origin((width, height), int(_array(data, 'shrink', int, ())),
                  str(_array(data, 'frame_id', str, ())))


def _turn(data: Mapping[str, npt.NDArray[Any]]) -> StoredTurn:
    """Return the turn; raises ValueError unless every number is what the core relies on."""
    xy = np.asarray(data['xy'])
    k, t = xy.shape[:2] if xy.ndim == 3 else (0, 0)
    tracks = Tracks(
        _array(data, 'frames', np.int64, (k,)), _array(data, 'xy', float, (k, t, 2), nan=True),
        (int(data['size'][0]), int(data['size'][1])),
        _array(data, 'stamps_ns', np.int64, (k,)))
    structure = Structure(
        _array(data, 'rotations', float, (k, 3, 3)), _array(data, 'translations', float, (k, 3)),
        _array(data, 'points', float, (t, 3), nan=True), _array(data, 'registered', bool, (k,)),
        _array(data, 'used', bool, (k, t)))
    ratios = _array(data, 'ratios', float, (np.size(data['ratios']),))
    profile = Profile(ratios, _array(data, 'costs', float, ratios.shape),
                      int(_array(data, 'observations', int, ())))
    camera = Camera.centred(tracks.image_size, 1.0).with_params(
        _array(data, 'camera', float, (6,)))
    prominence = float(_array(data, 'prominence', float, ()))
    seen = structure.used.any() and tracks.seen[structure.used].all()
    points = np.isfinite(structure.points[structure.used.any(axis=0)]).all()
    if not (min(camera.fx, camera.fy, prominence) > 0 and ratios.size and ratios.min() > 0
            and (np.diff(ratios) > 0).all() and seen and points):
        raise ValueError('its numbers make no scene')
    scene = Scene(0, tracks, structure, camera, profile)
    return StoredTurn(scene, float(_array(data, 'stamp_s', float, ())), prominence)


def _array(data: Mapping[str, npt.NDArray[Any]], name: str, kind: Any, shape: tuple[int, ...],
           nan: bool = False) -> npt.NDArray[Any]:
    """Return an array of this kind and shape, finite unless nan is allowed; or ValueError."""
    array = np.asarray(data[name])
    same = np.dtype(kind).kind
    if array.dtype.kind != same or array.shape != shape:
        raise ValueError(f'{name} is {array.dtype} of {array.shape}')
    if same == 'f' and not nan and not np.isfinite(array).all():
        raise ValueError(f'{name} is not finite')
    return array if same == 'U' else array.astype(kind)
