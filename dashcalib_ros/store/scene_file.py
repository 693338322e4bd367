# SPDX-License-Identifier: Apache-2.0
"""Scenes in a file, without pictures: turns.store and fleets write, read and check the same.

The format (docs/fleet.md): an .npz without pickle, with a JSON text `about` and arrays for each
turn. Files come from other machines: what is not a scene that this package could have made raises,
before it takes much memory.
"""
from __future__ import annotations

import io
import json
import math
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from dashcalib_ros.camera import MODELS, camera_of
from dashcalib_ros.detect.edges import IMAGES, KNOTS, MOST, Lines
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.errors import one_line, shortened
from dashcalib_ros.input import scale
from dashcalib_ros.input.scale import FULL_SIZE, Scale
from dashcalib_ros.limits import check_npz, check_pixels
from dashcalib_ros.problem.observations import Structure, Tracks
from dashcalib_ros.reconstruct.scene import Profile, Scene, Start, errors_px

# a layout that older readers misunderstand needs a new number
FORMAT = 1
SUFFIX = '.npz'
# bytes of a file, and of its arrays in memory; a turn has a few hundred thousand
LARGEST, LARGEST_UNPACKED = 2**25, 2**27
# turns of a file, arrays of a turn, lines of warnings: beyond what any setting makes
MOST_TURNS, MOST_ARRAYS, MOST_WARNINGS = 50, 50, 100
# keyframes times tracks of a turn, and focal lengths of its profile: likewise
MOST_PLACES, MOST_RATIOS = 2_000_000, 1000
# upright lines of a recording
MOST_LINES = IMAGES * MOST
# s; later stamps (this is in 2001) are dates, so that equal stamps mean the same moment
DATES_S = 1e9
# s; the last date that ROS's stamps in ns have
LAST_S = 9.2e9
# px; tracks are float32 in the file
SAME_PX = 1e-3
# of the image width: what a camera that explains anything may have
LEAST_FOCAL, MOST_FOCAL, MOST_COEFFICIENT = 0.02, 50.0, 1e3
# of a rotation's product with its transpose
ORTHOGONAL = 1e-6
# units of a scene, which has some tens; points of parallel rays come to 1e12
FARTHEST, FARTHEST_POINT = 1e6, 1e15

Arrays = Mapping[str, npt.NDArray[Any]]
INVALID = 'its numbers are not a valid scene'


@dataclass(frozen=True)
class Origin:
    """Where turns are from: image size (width, height) of the input, and how it was resized.

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
        mine, other = self.scene.tracks.xy, scene.tracks.xy
        return mine.shape == other.shape and np.allclose(
            mine, other, rtol=0, atol=SAME_PX, equal_nan=True)

    def happened(self, stamp_s: float, half_width_s: float) -> bool:
        """Return whether the turn was at this time; False if a stamp is not a date."""
        return min(self.stamp_s, stamp_s) > DATES_S and abs(self.stamp_s - stamp_s) < half_width_s


@dataclass(frozen=True)
class SceneFile:
    """The reconstructed turns of a recording, in the order of time.

    found: turns that were found, also those that could not be reconstructed. content, settings:
    hexadecimal hashes of what it was made from, '' where unknown. frames, seconds: of the input.
    lines: upright ones of the whole recording; None where they were not looked for.
    """

    origin: Origin
    turns: tuple[StoredTurn, ...]
    found: int = 0
    content: str = ''
    settings: str = ''
    frames: int = 0
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()
    lines: Lines | None = None


def encoded(file: SceneFile) -> bytes:
    """Return the file's bytes; the same turns give the same bytes."""
    origin = file.origin
    about = {
        'format': FORMAT, 'content': file.content, 'settings': file.settings,
        'image_size': origin.image_size, 'frame_id': origin.frame_id,
        'scale': {'shrink': origin.scale.shrink, 'enlarge': origin.scale.enlarge},
        'frames': file.frames, 'seconds': file.seconds, 'found': file.found,
        'warnings': [shortened(line, 300) for line in file.warnings[:MOST_WARNINGS]],
        'turns': [{'center': turn.scene.turn.number, 'stamp_s': turn.stamp_s,
                   'prominence': turn.prominence} for turn in file.turns]}
    arrays: dict[str, Any] = {'about': np.asarray(json.dumps(about, sort_keys=True))}
    for n, turn in enumerate(file.turns):
        tracks, structure = turn.scene.tracks, turn.scene.structure
        values = {
            'frames': tracks.frames, 'xy': tracks.xy.astype(np.float32),
            'stamps_ns': tracks.stamps_ns, 'rotations': structure.rotations,
            'translations': structure.translations, 'points': structure.points,
            'registered': structure.registered, 'used': structure.used}
        own = {'': Start(turn.scene.profile, turn.scene.camera),
               **{f'rival{m}.': start for m, start in enumerate(turn.scene.rivals)}}
        for prefix, start in own.items():
            values.update({f'{prefix}{name}': np.asarray(value) for name, value in {
                'camera': start.camera.params, 'camera_model': start.camera.model,
                'ratios': start.profile.ratios, 'costs': start.profile.costs,
                'observations': start.profile.observations}.items()})
        arrays.update({f'turn{n}.{name}': value for name, value in values.items()})
    if file.lines is not None:
        arrays |= {'lines.points': file.lines.points, 'lines.stamps_s': file.lines.stamps_s}
    data = io.BytesIO()
    np.savez_compressed(data, allow_pickle=False, **arrays)
    return data.getvalue()


def decoded(data: bytes) -> SceneFile:
    """Return what a file's bytes hold; raises ValueError, on one line, for anything else."""
    try:
        with np.errstate(all='ignore'):
            return _file(_arrays_in(data))
    except Exception as error:  # damaged files raise errors of all kinds
        missing = 'it lacks ' if isinstance(error, KeyError) else ''
        raise ValueError(missing + one_line(error, 120)) from error


def _arrays_in(data: bytes) -> Arrays:
    if len(data) > LARGEST:
        raise ValueError('it is too large')
    check_npz(io.BytesIO(data), MOST_TURNS * MOST_ARRAYS)
    with zipfile.ZipFile(io.BytesIO(data)) as members:
        _check_sizes(members)
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


def _check_sizes(members: zipfile.ZipFile) -> None:
    """Raise ValueError when the arrays would take too much memory, or more than they fill."""
    found = members.infolist()
    if sum(member.file_size for member in found) > LARGEST_UNPACKED:
        raise ValueError('it is too large when unpacked')
    for member in found:
        with members.open(member) as stream:
            version = npy.read_magic(stream)
            read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, _, dtype = read(stream)
            # numpy allocates the size in the header before it reads
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise ValueError(f'{member.filename} is smaller than its header indicates')


def _file(arrays: Arrays) -> SceneFile:
    if 'about' not in arrays:
        raise ValueError('it is not a file of turns, or it has an older format')
    about = json.loads(str(_array(arrays, 'about', str, ())))
    if about['format'] != FORMAT:
        number = shortened(str(about['format']), 20)
        raise ValueError(f'it has format {number}, but this version reads {FORMAT}')
    origin = _origin(about)
    listed = about['turns']
    _check(isinstance(listed, list) and len(listed) <= MOST_TURNS)
    turns = []
    for n, turn in enumerate(listed):
        # files of older versions list turns without a scene, too
        if turn.get('scene', True) is True:
            scene = _scene(arrays, f'turn{n}.', origin, _count(turn['center']))
            turns.append(StoredTurn(scene, _real(turn['stamp_s'], LAST_S),
                                    _real(turn['prominence'])))
    _check(all(isinstance(line, str) for line in about['warnings']))
    _check(all(turn.prominence > 0 for turn in turns)
           and len({turn.scene.turn for turn in turns}) == len(turns))
    return SceneFile(
        origin, tuple(turns), max(_count(about.get('found', len(listed))), len(turns)),
        _hexadecimal(about['content']), _hexadecimal(about['settings']), _count(about['frames']),
        _real(about['seconds'], LAST_S), tuple(
            shortened(line, 300) for line in about['warnings'][:MOST_WARNINGS]),
        _lines(arrays, origin))


def _origin(about: Mapping[str, Any]) -> Origin:
    width, height = (_count(side) for side in about['image_size'])
    check_pixels(width, height, 'it')
    shrink, enlarge = (_count(about['scale'][name]) for name in ('shrink', 'enlarge'))
    _check(1 <= shrink <= width and 1 <= enlarge <= scale.MOST and 1 in (shrink, enlarge))
    frame_id = about.get('frame_id', '')
    _check(isinstance(frame_id, str) and len(frame_id) <= 1000)
    return Origin((width, height), Scale(shrink, enlarge), frame_id)


def _lines(arrays: Arrays, origin: Origin) -> Lines | None:
    if 'lines.points' not in arrays:
        return None
    count = len(arrays['lines.points'])
    _check(count <= MOST_LINES)
    size = origin.scale.size(origin.image_size)
    lines = Lines(
        _array(arrays, 'lines.points', np.float32, (count, KNOTS, 2), most=2.0 * max(size)),
        _array(arrays, 'lines.stamps_s', float, (count,), most=LAST_S))
    _check((np.diff(lines.stamps_s) >= 0).all())
    return lines


def _scene(arrays: Arrays, prefix: str, origin: Origin, center: int) -> Scene:
    own = {name.removeprefix(prefix): values for name, values in arrays.items()
           if name.startswith(prefix)}
    size = origin.scale.size(origin.image_size)
    k, t = own['xy'].shape[:2]
    _check(k >= 2 and 0 < k * t <= MOST_PLACES)
    tracks = Tracks(_array(own, 'frames', np.int64, (k,)),
                    _array(own, 'xy', float, (k, t, 2), most=2.0 * max(size), nan=True), size,
                    _array(own, 'stamps_ns', np.int64, (k,)))
    structure = Structure(
        _array(own, 'rotations', float, (k, 3, 3), most=2.0),
        _array(own, 'translations', float, (k, 3), most=FARTHEST),
        _array(own, 'points', float, (t, 3), most=FARTHEST_POINT, nan=True),
        _array(own, 'registered', bool, (k,)), _array(own, 'used', bool, (k, t)))
    start = _start(own, '', size)
    rivals: list[Start] = []
    while f'rival{len(rivals)}.camera' in own:
        rivals.append(_start(own, f'rival{len(rivals)}.', size))
    scene = Scene(TurnId.at(center), tracks, structure, start.camera, start.profile,
                  tuple(rivals))
    _check(len(scene.starts) == 1 + len(rivals))
    for ascending in (tracks.frames, tracks.stamps_ns):
        _check((ascending[1:] > ascending[:-1]).all())
    _check((np.isnan(tracks.xy[:, :, 0]) == np.isnan(tracks.xy[:, :, 1])).all())
    rotations, used = structure.rotations[structure.registered], structure.used
    products = rotations @ rotations.transpose(0, 2, 1)
    _check(len(rotations) >= 2 and np.abs(products - np.eye(3)).max() < ORTHOGONAL
           and np.linalg.det(rotations).min() > 0)
    # a scene that is anywhere near what it is made from, with the camera that it was made with
    _check(used.any() and tracks.seen[used].all()
           and errors_px(scene, start.camera)[used].max() < max(size))
    return scene


def _start(own: Arrays, prefix: str, size: tuple[int, int]) -> Start:
    model = str(_array(own, f'{prefix}camera_model', str, ()))
    _check(model in MODELS)
    params = _array(own, f'{prefix}camera', float, (len(MODELS[model].names()),))
    focal, centre = params[:2] / size[0], params[2:4] / size
    _check(focal.min() >= LEAST_FOCAL and focal.max() <= MOST_FOCAL
           and np.abs(centre - 0.5).max() <= 1 and np.abs(params[4:]).max() <= MOST_COEFFICIENT)
    count = np.size(own[f'{prefix}ratios'])
    ratios = _array(own, f'{prefix}ratios', float, (count,))
    costs = _array(own, f'{prefix}costs', float, (count,))
    observations = int(_array(own, f'{prefix}observations', np.int64, ()))
    _check(0 < count <= MOST_RATIOS and (np.diff(ratios) > 0).all() and ratios[0] > 0
           and costs.min() >= 0 and 0 < observations <= MOST_PLACES)
    return Start(Profile(ratios, costs, observations), camera_of(model, size, params))


def _array(data: Arrays, name: str, kind: Any, shape: tuple[int, ...], most: float = 1e9,
           nan: bool = False) -> npt.NDArray[Any]:
    """Return an array of this kind and shape, or raise ValueError.

    most: of the amounts of real numbers, which are finite; nan: they may be NaN, too.
    """
    array, same = data[name], np.dtype(kind).kind
    if array.dtype.kind != same or array.shape != shape:
        raise ValueError(f'{name} has type {array.dtype} and shape {array.shape}')
    if same == 'f' and not ((np.abs(array) <= most) | (np.isnan(array) & nan)).all():
        raise ValueError(f'{name} is not finite or is too large')
    return array if same == 'U' else array.astype(kind)


def _real(value: Any, most: float = 1e9) -> float:
    _check(type(value) in (int, float) and -most <= value <= most)
    return float(value)


def _count(value: Any) -> int:
    _check(type(value) is int and 0 <= value <= 10**9)
    return int(value)


def _hexadecimal(value: Any) -> str:
    _check(isinstance(value, str) and re.fullmatch('[0-9a-f]{0,64}', value) is not None)
    return str(value)


def _check(holds: Any) -> None:
    if not holds:
        raise ValueError(INVALID)
