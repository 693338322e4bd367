"""Reconstructed turns on disk, so that short trips add up (config: turns.store).

There is one file for each turn. It is written completely under a unique name, and never changed:
any number of processes may share the folder. Files that are no turns of this camera are not used
and not changed.
"""
from __future__ import annotations

import errno
import io
import math
import os
import secrets
import stat
import threading
import time
import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from dashcalib_ros.camera import MODELS, camera_of
from dashcalib_ros.errors import InputError, one_line
from dashcalib_ros.frames.scale import FULL_SIZE, Scale
from dashcalib_ros.reconstruction.scene import Profile, Scene
from dashcalib_ros.reconstruction.structure import Structure
from dashcalib_ros.reconstruction.tracks import Tracks
from dashcalib_ros.turns.turn import TurnId

# of the files; a changed layout needs a new number
FORMAT = 3
# bytes of a file; a turn has a few hundred thousand
LARGEST = 16_000_000
# bytes that a file's arrays may take in memory; a turn's take a few million
LARGEST_UNPACKED = 64_000_000
# with other kinds the unpacker may take any amount of memory
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# s; later stamps (this is in 2001) are dates, so that equal stamps mean the same moment
DATES_S = 1e9
# s; temporary files older than this are left over from a killed process
ABANDONED_S = 3600.0


@dataclass(frozen=True)
class Origin:
    """Where a turn is from: image size (width, height) of the input, and how it was resized.

    frame_id: of the image headers; an empty one, of inputs without, fits any.
    """

    image_size: tuple[int, int]
    scale: Scale = FULL_SIZE
    frame_id: str = ''

    def fits(self, other: Origin) -> bool:
        """Return whether both may be of one camera."""
        frames = {self.frame_id, other.frame_id} - {''}
        return (self.image_size, self.scale) == (other.image_size, other.scale) and (
            len(frames) < 2)

    def __str__(self) -> str:
        frame = f' in frame {self.frame_id!r}' if self.frame_id else ''
        return f'{self.image_size[0]}x{self.image_size[1]} {self.scale}{frame}'


@dataclass(frozen=True)
class StoredTurn:
    """A scene with its turn's time (stamp of the centre in s) and prominence."""

    scene: Scene
    stamp_s: float
    prominence: float

    def repeats(self, scene: Scene) -> bool:
        """Return whether a scene is of the same pictures."""
        return np.array_equal(self.scene.tracks.xy, scene.tracks.xy, equal_nan=True)

    def happened(self, stamp_s: float, half_width_s: float) -> bool:
        """Return whether the turn was at this time; False if a stamp is no date."""
        return min(self.stamp_s, stamp_s) > DATES_S and abs(self.stamp_s - stamp_s) < half_width_s


class TurnStore:
    """A folder of turns, and those of this camera that were found in it.

    Problems are reported by warn; nothing is raised.

    turns: of earlier drives.
    One thread at a time may use `turns`, load() and drop_repeated(); mirror() and clear() are for
    any thread that holds no lock that `snapshot` takes, as writing may take long.
    """

    def __init__(self, folder: str, capacity: int, half_width_s: float,
                 warn: Callable[[str], None]) -> None:
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
            warn(f'turns cannot be stored in {folder} (there is no such home folder); set '
                 f'turns.store to a path without ~')
        # guards the files, _own and _known
        self._writing = threading.Lock()
        self._capacity = capacity
        self._half_width_s = half_width_s
        self._warn = warn
        self._warned = False
        self._origin: Origin | None = None
        # by the turn's key: its file, '' if it was removed for more prominent ones, and the
        # prominence in it
        self._own: dict[TurnId, tuple[str, float]] = {}
        # origin and prominence by file; None for a file that cannot be used
        self._known: dict[str, tuple[Origin, float] | None] = {}

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
                key = TurnId.stored(len(self.turns))
                self.turns[key] = replace(turn, scene=replace(turn.scene, turn=key))
                self._own[key] = name, turn.prominence

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

    def mirror(self, snapshot: Callable[[], Mapping[TurnId, StoredTurn]]) -> None:
        """Write these turns to the folder; remove others that were written or loaded before.

        snapshot: returns the turns; called when no other thread writes, so that the last call
        writes the newest ones.
        """
        if self._off:
            return
        with self._writing:
            if not self._off:
                self._write_all(snapshot())

    def clear(self) -> None:
        """Remove the turns that were written or loaded; the folder is not used any more.

        Before load() their camera is not known: all turns are removed.
        """
        if self._off:
            return
        with self._writing:
            if self._origin is None:
                self._own = {TurnId.stored(n): (name, 0.0) for n, name in enumerate(self._listed())
                             if _heading(self._folder / name) is not None}
            self._write_all({})
            self._off = True

    def _write_all(self, turns: Mapping[TurnId, StoredTurn]) -> None:
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
            self._remove_excess()

    def _listed(self) -> list[str]:
        """Return the names of all files that may be turns."""
        try:
            for leftover in self._folder.glob('.turn-*.tmp'):
                if time.time() - leftover.stat().st_mtime > ABANDONED_S:
                    leftover.unlink()
        except OSError:
            pass  # of another process, or without the permission to remove it
        try:
            return sorted(path.name for path in self._folder.iterdir() if path.suffix == '.npz')
        except FileNotFoundError:
            return []
        except OSError as error:
            self._fail(error)
            return []

    def _report(self, bad: list[str], others: list[Origin], origin: Origin) -> None:
        if bad:
            more = f' and {len(bad) - 3} more' if len(bad) > 3 else ''
            self._warn(f'{_count(bad)} in {self._folder} left out: {", ".join(bad[:3])}{more}; '
                       f'delete what is no stored turn')
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

    def _remove_excess(self) -> None:
        """Remove the least prominent turns beyond the capacity, also those of other processes."""
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
        """Warn once: the same error will come for every turn."""
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
    values = {
        'format': FORMAT, 'image_size': origin.image_size, 'shrink': origin.scale.shrink,
        'enlarge': origin.scale.enlarge, 'frame_id': origin.frame_id}
    return {**{name: np.asarray(value) for name, value in values.items()}, **turn_arrays(turn)}


def turn_arrays(turn: StoredTurn) -> dict[str, npt.NDArray[Any]]:
    """Return a turn as plain arrays by name; turn_of() is the inverse."""
    scene = turn.scene
    values = {
        'stamp_s': turn.stamp_s, 'prominence': turn.prominence,
        'frames': scene.tracks.frames, 'xy': scene.tracks.xy, 'size': scene.tracks.image_size,
        'stamps_ns': scene.tracks.stamps_ns,
        'rotations': scene.structure.rotations, 'translations': scene.structure.translations,
        'points': scene.structure.points, 'registered': scene.structure.registered,
        'used': scene.structure.used, 'camera': scene.camera.params,
        'camera_model': scene.camera.model,
        'ratios': scene.profile.ratios, 'costs': scene.profile.costs,
        'observations': scene.profile.observations}
    return {name: np.asarray(value) for name, value in values.items()}


def _heading(path: Path) -> tuple[Origin, float] | None:
    """Return a file's origin and prominence, None if it is no stored turn."""
    try:
        data = _loaded(path)
        return _origin(data), float(_array(data, 'prominence', float, ()))
    except Exception:  # as in _read
        return None


def _read(path: Path) -> tuple[Origin, StoredTurn]:
    """Return a file's origin and turn; the turn's identity is that of stored turn 0.

    Raises InputError if it is no stored turn, FileNotFoundError if it was removed.
    """
    try:
        data = _loaded(path)
        origin, turn = _origin(data), turn_of(data)
        if turn.scene.tracks.image_size != origin.scale.size(origin.image_size):
            raise ValueError('its numbers are no valid scene')
        return origin, turn
    except Exception as error:
        if isinstance(error, FileNotFoundError) and not path.is_symlink():
            raise
        # for a damaged file numpy, zipfile and zlib raise errors of all kinds
        what = error.strerror if isinstance(error, OSError) else None
        raise InputError(f'{path.name} cannot be used ({what or one_line(error, 120)})') from error


def _loaded(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return a file's arrays; raises ValueError, among others, before it takes much memory."""
    # not blocking: opening a FIFO would wait for its writer
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), 'rb') as stream:
        about = os.fstat(stream.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise ValueError('it is no regular file')
        return arrays_in(stream, about.st_size)


def arrays_in(stream: BinaryIO, size: int, largest: int = LARGEST,
              largest_unpacked: int = LARGEST_UNPACKED) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an npz file of this size in bytes, without pickle.

    Raises ValueError, among others, before it takes more memory than largest_unpacked.
    """
    if size > largest:
        raise ValueError('it is too large')
    with zipfile.ZipFile(stream) as members:
        _check_sizes(members, largest_unpacked)
    stream.seek(0)
    with np.load(stream, allow_pickle=False) as data:
        return dict(data)


def _check_sizes(members: zipfile.ZipFile, largest_unpacked: int) -> None:
    """Raise ValueError when the arrays would take too much memory, or more than they fill."""
    found = members.infolist()
    if sum(member.file_size for member in found) > largest_unpacked:
        raise ValueError('it is too large when unpacked')
    for member in found:
        if member.compress_type not in COMPRESSIONS:
            raise ValueError('it is compressed in an unknown way')
        with members.open(member) as stream:
            version = npy.read_magic(stream)
            read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, _, dtype = read(stream)
            # numpy allocates the size in the header before it reads
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise ValueError(f'{member.filename} is smaller than its header says')


def _origin(data: Mapping[str, npt.NDArray[Any]]) -> Origin:
    if 'format' not in data:
        raise ValueError('it is no stored turn')
    if (number := int(_array(data, 'format', int, ()))) != FORMAT:
        raise ValueError(f'it has format {number}, this version has {FORMAT}')
    width, height = (int(side) for side in _array(data, 'image_size', int, (2,)))
    # older files do not have it: nothing was enlarged
    enlarge = int(_array(data, 'enlarge', int, ())) if 'enlarge' in data else 1
    scale = Scale(int(_array(data, 'shrink', int, ())), enlarge)
    if min(scale.shrink, scale.enlarge) < 1:
        raise ValueError('its numbers are no valid scene')
    return Origin((width, height), scale, str(_array(data, 'frame_id', str, ())))


def turn_of(data: Mapping[str, npt.NDArray[Any]]) -> StoredTurn:
    """Return the turn; raises ValueError, or KeyError, unless it is valid for the core."""
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
    name = str(_array(data, 'camera_model', str, ()))
    count = len(MODELS[name].names()) if name in MODELS else 0
    camera = camera_of(name, tracks.image_size, _array(data, 'camera', float, (count,)))
    prominence = float(_array(data, 'prominence', float, ()))
    seen = structure.used.any() and tracks.seen[structure.used].all()
    points = np.isfinite(structure.points[structure.used.any(axis=0)]).all()
    if not (min(camera.fx, camera.fy, prominence) > 0 and ratios.size and ratios.min() > 0
            and (np.diff(ratios) > 0).all() and seen and points):
        raise ValueError('its numbers are no valid scene')
    scene = Scene(TurnId.stored(0), tracks, structure, camera, profile)
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
