# SPDX-License-Identifier: Apache-2.0
"""rig.json: the cameras of one car, where each sits, and what they see together."""
from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dashcalib_ros.arrays import plain_values
from dashcalib_ros.errors import ConfigError, InputError, Notice, one_line
from dashcalib_ros.formats import calibrators, colmap, photogrammetry, urdf
from dashcalib_ros.formats.ours import codes_of
from dashcalib_ros.formats.values import Placed
from dashcalib_ros.judge.calibration import CalibrationData
from dashcalib_ros.limits import JSON_BYTES, parse_json, path_of, read_text
from dashcalib_ros.rig.placed import PlacedCamera, RigCalibration, Visible
from dashcalib_ros.rig.witness import Epipolar

RIG = 'rig.json'


def rig_dict(rig: RigCalibration) -> dict[str, Any]:
    """Return the content of rig.json: dicts, lists, text, finite numbers and None."""
    plain: dict[str, Any] = plain_values({
        'base': rig.base,
        'cameras': {name: {**vars(camera), 'visible': vars(camera.visible),
                           'reason_codes': codes_of(camera.reasons)}
                    for name, camera in rig.cameras.items()},
        'witness': {'epipolar_px': {f'{a}-{b}': vars(found)
                                    for (a, b), found in rig.witness.items()}},
        'warnings': rig.warnings, 'warning_codes': codes_of(rig.warnings)})
    return plain


def rig_json(rig: RigCalibration) -> str:
    """Return rig.json's text."""
    return json.dumps(rig_dict(rig), indent=2, allow_nan=False, ensure_ascii=False) + '\n'


# by the names of the files beside rig.json: the cameras that have a place, the base first
RIG_FORMATS: Mapping[str, Callable[[Sequence[Placed]], str]] = {
    'rig.urdf': urdf.write_rig,
    'static_transforms.sh': urdf.write_rig_transforms,
    'camchain.yaml': calibrators.write_kalibr_rig,
    'rig_config.json': colmap.write_rig,
    'transforms.json': photogrammetry.write_nerfstudio_rig}


def placed_cameras(rig: RigCalibration, calibrations: Mapping[str, CalibrationData]
                   ) -> list[Placed]:
    """Return the cameras of a rig that have a place, the base first, for RIG_FORMATS."""
    found = []
    for name in sorted(rig.cameras, key=rig.base.__ne__):
        camera, calibration = rig.cameras[name], calibrations[name]
        if camera.rotation is None:
            continue
        found.append(Placed(
            name, calibration.camera, camera.rotation,
            None if camera.translation_m is None else np.array(camera.translation_m),
            calibration.mount if name == rig.base else None,
            f'{name}: {camera.verdict}, rotation sigma {camera.rotation_sigma_deg} degrees, '
            + ('its translation is not known' if camera.translation_m is None else
               f'translation sigma {camera.translation_sigma_m} m')))
    return found


def rig_files(rig: RigCalibration, cameras: Sequence[Placed]
              ) -> tuple[dict[str, str], tuple[Notice, ...]]:
    """Return RIG_FORMATS and rig.json by their names, and which of them cannot be written."""
    found, missing = {}, []
    for name, write in RIG_FORMATS.items():
        try:
            found[name] = write(cameras)
        except ConfigError as error:
            missing.append(Notice(error.code, f'{name} is not written: {error}'))
    return {**found, RIG: rig_json(rig)}, tuple(missing)


def _place(path: str | os.PathLike[str]) -> Path:
    place = path_of(path)
    return place / RIG if place.is_dir() else place


def is_rig(path: str | os.PathLike[str]) -> bool:
    """Return whether path is a rig.json, by its content, or a folder with one."""
    try:
        data = parse_json(read_text(_place(path), JSON_BYTES), str(path))
    except (InputError, OSError):
        return False
    return isinstance(data, dict) and {'base', 'cameras', 'witness'} <= data.keys()


def load_rig(path: str | os.PathLike[str]) -> RigCalibration:
    """Read where the cameras of a car sit from path: a rig.json, or its folder.

    Raises InputError for what is not a rig.json.
    """
    place = _place(path)
    return parse_rig(read_text(place, JSON_BYTES), str(place))


def parse_rig(text: str, place: str) -> RigCalibration:
    """Return what the text of a rig.json says; place: where it is from. Raises InputError."""
    data = parse_json(text, place)
    try:
        cameras = {str(name): _camera(values) for name, values in data['cameras'].items()}
        names = {f'{a}-{b}': (a, b) for a in cameras for b in cameras}
        if data['base'] not in cameras:
            raise ValueError(f'its base {data["base"]!r} is none of its cameras')
        return RigCalibration(
            data['base'], cameras,
            {names[pair]: Epipolar(found['matches'], found['median'], found['cells_rms'])
             for pair, found in data['witness']['epipolar_px'].items()},
            _notices(data, 'warnings', 'warning_codes'))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError('E-RIG-FILE', f'{place} is not a rig.json of dashcalib, or damaged '
                         f'({one_line(error)}); use the file that dashcalib rig wrote') from error


def _camera(values: dict[str, Any]) -> PlacedCamera:
    visible = values['visible']
    return PlacedCamera(
        str(values['calibration']), values['verdict'],
        _three(values['rotation_deg']), _three(values['rotation_sigma_deg']),
        _three(values['translation_m']), _three(values['translation_sigma_m']),
        values['time_offset_s'], values['time_sigma_s'],
        Visible(tuple(visible['rotation']), tuple(visible['translation']), visible['clock']),
        _notices(values, 'reasons', 'reason_codes'))


def _three(values: Any) -> tuple[float, float, float] | None:
    if values is None:
        return None
    x, y, z = map(float, values)
    return x, y, z


def _notices(data: dict[str, Any], texts: str, codes: str) -> tuple[Notice, ...]:
    return tuple(map(Notice, data.get(codes, ()), data.get(texts, ())))
