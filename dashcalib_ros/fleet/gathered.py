"""What is kept of a clip: its turns' scenes, without pictures, in one .npz file.

The format (docs/fleet.md): an array `about` with a JSON text, and for each scene the arrays of a
stored turn (turn_store.py) under `turnN.`; those of the starts of other kinds of lenses under
`turnN.rivalM.`. Tracks are float32: 0.0001 px at 1440 px. No pickle is read or written.
"""
from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dashcalib_ros.camera import MODELS, camera_of
from dashcalib_ros.errors import InputError, one_line
from dashcalib_ros.frames.scale import Scale
from dashcalib_ros.reconstruction.scene import Profile, Scene, Start
from dashcalib_ros.turn_store import StoredTurn, arrays_in, turn_arrays, turn_of
from dashcalib_ros.turns.turn import TurnId

# a changed layout needs a new number
FORMAT = 1
SUFFIX = '.npz'
# bytes of a file, and of its arrays in memory; a turn has a few hundred thousand
LARGEST, LARGEST_UNPACKED = 2**26, 2**28
# arrays that lose nothing as float32
SHORTENED = ('xy',)


@dataclass(frozen=True)
class GatheredTurn:
    """A turn that was found. prominence, yaw_deg: as in result.json.

    scene: whether it could be reconstructed.
    """

    center: int
    stamp_s: float
    prominence: float
    scene: bool
    yaw_deg: float | None = None


@dataclass(frozen=True)
class Gathered:
    """A clip after the first two stages.

    content, settings: hashes of what it was made from. image_size: (width, height) of the input;
    scale: how it was resized. frames, seconds: of the clip. turns: all that were found, in the
    order of time; scenes: of those that were reconstructed, by the frame of their centre.
    """

    content: str
    settings: str
    image_size: tuple[int, int]
    scale: Scale
    frames: int
    seconds: float
    turns: tuple[GatheredTurn, ...]
    scenes: Mapping[int, Scene]
    warnings: tuple[str, ...] = ()


def encoded(gathered: Gathered) -> bytes:
    """Return the file's bytes; the same turns give the same bytes."""
    about = {'format': FORMAT, **{name: value for name, value in asdict(
        replace(gathered, scenes={})).items() if name != 'scenes'}}
    arrays: dict[str, npt.NDArray[Any]] = {'about': np.asarray(json.dumps(about, sort_keys=True))}
    for n, turn in enumerate(gathered.turns):
        if turn.scene:
            scene = gathered.scenes[turn.center]
            stored = turn_arrays(StoredTurn(scene, turn.stamp_s, turn.prominence))
            for name, values in {**stored, **_rivals(scene)}.items():
                short = name in SHORTENED
                arrays[f'turn{n}.{name}'] = values.astype(np.float32) if short else values
    data = io.BytesIO()
    np.savez_compressed(data, allow_pickle=False, **arrays)
    return data.getvalue()


def decoded(data: bytes, name: str) -> Gathered:
    """Return what a file's bytes hold; raises InputError, in which `name` names the file."""
    try:
        arrays = arrays_in(io.BytesIO(data), len(data), LARGEST, LARGEST_UNPACKED)
        about = json.loads(str(arrays['about']))
        if about['format'] != FORMAT:
            raise ValueError(f'it has format {about["format"]}, this version has {FORMAT}')
        turns = tuple(GatheredTurn(**turn) for turn in about['turns'])
        scenes = {turn.center: _scene(arrays, f'turn{n}.', turn.center)
                  for n, turn in enumerate(turns) if turn.scene}
        width, height = (int(side) for side in about['image_size'])
        gathered = Gathered(
            str(about['content']), str(about['settings']), (width, height),
            Scale(int(about['scale']['shrink']), int(about['scale']['enlarge'])),
            int(about['frames']), float(about['seconds']), turns, scenes,
            tuple(str(line) for line in about['warnings']))
        if any(scene.tracks.image_size != gathered.scale.size(gathered.image_size)
               for scene in scenes.values()):
            raise ValueError('its numbers are no valid scene')
        return gathered
    except Exception as error:  # damaged files raise errors of all kinds
        raise InputError(f'{name} is no file of gathered turns ({one_line(error, 120)}); remove '
                         f'it, and its clip is read again') from error


def _rivals(scene: Scene) -> dict[str, npt.NDArray[Any]]:
    found: dict[str, npt.NDArray[Any]] = {}
    for m, start in enumerate(scene.rivals):
        for name, value in {
                'ratios': start.profile.ratios, 'costs': start.profile.costs,
                'observations': start.profile.observations, 'camera': start.camera.params,
                'camera_model': start.camera.model}.items():
            found[f'rival{m}.{name}'] = np.asarray(value)
    return found


def _scene(arrays: Mapping[str, npt.NDArray[Any]], prefix: str, center: int) -> Scene:
    own = {name.removeprefix(prefix): values for name, values in arrays.items()
           if name.startswith(prefix)}
    scene = turn_of(own).scene
    rivals: list[Start] = []
    size = scene.tracks.image_size
    while f'rival{len(rivals)}.camera' in own:
        at = f'rival{len(rivals)}.'
        model, params = str(own[f'{at}camera_model']), own[f'{at}camera'].astype(float)
        if model not in MODELS or params.shape != (len(MODELS[model].names()),):
            raise ValueError(f'{model} is no camera model')
        profile = Profile(own[f'{at}ratios'].astype(float), own[f'{at}costs'].astype(float),
                          int(own[f'{at}observations']))
        if not (np.isfinite(params).all() and len(profile.ratios) == len(profile.costs)
                and (np.diff(profile.ratios) > 0).all() and profile.ratios[0] > 0):
            raise ValueError('its numbers are no valid start')
        rivals.append(Start(profile, camera_of(model, size, params)))
    return replace(scene, turn=TurnId.at(center), rivals=tuple(rivals))
