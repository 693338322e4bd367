# SPDX-License-Identifier: Apache-2.0
"""Our own files: result.json, strict JSON, and calibration.yaml, ROS's with one extra block.

Both have the same values by the same names. What reads a camera takes what there is, also of older
versions; what reads a whole calibration wants all that such a file has.
"""
from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dashcalib_ros.arrays import Floats, plain_values
from dashcalib_ros.camera import MODELS, Camera, Radial
from dashcalib_ros.camera.field import BASIS, Field
from dashcalib_ros.camera.field import TERMS as FIELD_TERMS
from dashcalib_ros.camera.other import OtherLens
from dashcalib_ros.config import RENAMED, Config
from dashcalib_ros.detect import Bend, TurnId
from dashcalib_ros.errors import DashcalibError, InputError, Notice, one_line
from dashcalib_ros.formats import opencv, ros
from dashcalib_ros.formats.plausible import check_lens
from dashcalib_ros.formats.values import (
    Cameras,
    Data,
    read_number,
    read_pair,
    read_sigma,
    read_size,
    unknown_model,
)
from dashcalib_ros.judge import CalibrationData, TurnSummary, Verdict
from dashcalib_ros.judge.calibration import (
    ANGLES,
    CameraAt,
    Condition,
    Drift,
    Known,
    LensField,
    Mount,
    Part,
    Shutter,
    Stabiliser,
    StoredTurnSummary,
    Witness,
    Witnesses,
)
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.limits import JSON_BYTES, parse_json, parse_yaml, path_of, read_text
from dashcalib_ros.solve.solution import LeftOut
from dashcalib_ros.solve.spread import PictureSigma

T = TypeVar('T')
# arrays of a calibration that stand among the details
COVARIANCES = ('covariance', 'picture_covariance')


def result_dict(calibration: CalibrationData) -> dict[str, Any]:
    """Return the content of result.json: plain dicts, lists, text, and finite numbers or None."""
    c = calibration
    plain: dict[str, Any] = plain_values({
        'verdict': c.verdict.level,
        'reasons': c.verdict.reasons,
        'image_size': c.image_size,
        'intrinsics': c.intrinsics,
        'sigma': c.sigma,
        'turns': [_turn_dict(turn) for turn in c.turns],
        'frames': c.frames,
        'reprojection_error_px': c.reprojection_error_px,
        'timing': c.timing,
        'seed': c.config.seed,
        'versions': c.versions,
        'config': c.config.flat(),
        'reason_codes': c.verdict.codes,
        'sigma_px': c.sigma_px,
        'camera_model': None if c.camera is None else c.camera.model,
        'stored_turns': [_turn_dict(turn) for turn in c.stored_turns],
        'rolling_shutter': c.rolling_shutter,
        'stabiliser': c.stabiliser,
        'field': None if c.field is None else {
            'rms_px': c.field.rms_px, 'worst_px': c.field.worst_px, 'used': c.field.used,
            'sigma_px': c.field.sigma_px, 'basis': BASIS,
            'coefficients': c.field.field.coefficients},
        'mount': _mount_dict(c.mount),
        'held_out': [_held_out_dict(turn) for turn in c.held_out],
        'straight_lines': c.straight_lines,
        'witnesses': c.witnesses,
        'known': c.known,
        'drift': c.drift,
        'temperature_c': c.temperature_c,
        'intrinsics_at': c.intrinsics_at,
        'parts': c.parts,
        'input': c.input_name,
        'part': c.part,
        'warnings': c.warnings,
        'warning_codes': codes_of(c.warnings),
        'masked_fraction': None if c.mask is None else 1.0 - float(np.mean(c.mask)),
        'details': c.details | {name: getattr(c, name) for name in COVARIANCES
                                if getattr(c, name) is not None},
        'conditions': c.verdict.conditions,
    })
    return plain


def result_json(calibration: CalibrationData) -> str:
    """Return result.json's text; the same calibration gives the same text."""
    return json.dumps(result_dict(calibration), indent=2, allow_nan=False,
                      ensure_ascii=False) + '\n'


def load_calibration(path: str | os.PathLike[str]) -> CalibrationData:
    """Read a result: see Calibration.load(). Settings that are unknown here are left out."""
    place = path_of(path)
    place = place / 'result.json' if place.is_dir() else place
    text = read_text(place, JSON_BYTES)
    if text.lstrip().startswith('{'):
        data = values = parse_json(text, str(place))
        missing = [key for key in ('verdict', 'image_size', 'intrinsics') if key not in data]
        if missing:
            raise InputError('E-NO-RESULT-FILE',
                             f'{place} is not a result.json of dashcalib: it has no '
                             f'{missing[0]!r}; use the file that dashcalib run wrote')
    else:
        data = parse_yaml(text, str(place))
        if not _has_block(data):
            raise InputError('E-OTHER-CALIBRATION', f'{place} is not a calibration of dashcalib; '
                             f'use load_camera() for it')
        values = {**data[ros.OWN],
                  'image_size': [data.get('image_width'), data.get('image_height')]}
    camera = None if values.get('verdict') == 'refused' else _read(data, place).camera
    try:
        return calibration_of(values, camera)
    except (KeyError, TypeError, ValueError, AttributeError, DashcalibError) as error:
        raise InputError('E-CALIBRATION-DAMAGED',
                         f'{place} is damaged ({one_line(error)}); calibrate again') from error


def calibration_of(data: Data, camera: Camera | None) -> CalibrationData:
    """Return the calibration that result_dict() gave these values."""
    def made(kind: type[Any], values: Mapping[str, Any] | None, **more: Any) -> Any:
        return None if values is None else kind(**more, **{
            ('stamp_s' if key == 'stamp' else key): _frozen(item) for key, item in values.items()})

    known = Config().flat()
    settings = {RENAMED.get(name, name): value for name, value in data.get('config', {}).items()}
    config = Config().replace({name: value for name, value in settings.items() if name in known})
    held_out = [LeftOut(
        TurnId.stored(place) if turn['center'] is None else TurnId.at(turn['center']),
        turn['px'], turn['sigma_px'], turn['others_sigma_px'])
        for place, turn in enumerate(data.get('held_out', ()))]
    details = dict(data.get('details', {}))
    covariance, of_picture = (
        None if (rows := details.pop(name, None)) is None else np.array(rows, np.float64)
        for name in COVARIANCES)
    field, size = data.get('field'), (data['image_size'][0], data['image_size'][1])
    sigma = data.get('sigma')
    return CalibrationData(
        verdict=Verdict(data['verdict'], _notices(data, 'reasons', 'reason_codes'), tuple(
            Condition(**each) for each in data.get('conditions', ()))),
        image_size=size, camera=camera,
        sigma=None if sigma is None else {name: math.nan if value is None else float(value)
                                          for name, value in sigma.items()},
        turns=tuple(made(TurnSummary, turn) for turn in data.get('turns', ())),
        frames=data.get('frames', 0), reprojection_error_px=data.get('reprojection_error_px'),
        timing=dict(data.get('timing', {})), versions=dict(data.get('versions', {})),
        config=config.replace({'seed': data.get('seed', config.seed)}),
        input_name=data.get('input', ''), part=_frozen(data.get('part')),
        warnings=_notices(data, 'warnings', 'warning_codes'),
        details=details, covariance=covariance, picture_covariance=of_picture, stored_turns=tuple(
            made(StoredTurnSummary, turn, id=TurnId.stored(place))
            for place, turn in enumerate(data.get('stored_turns', ()))),
        rolling_shutter=made(Shutter, data.get('rolling_shutter')),
        sigma_px=made(PictureSigma, data.get('sigma_px')),
        stabiliser=made(Stabiliser, data.get('stabiliser')),
        field=None if field is None else LensField(
            Field(size, np.array(field['coefficients'], np.float64)), _counts(field),
            field['rms_px'], field['worst_px'], field['sigma_px']),
        mount=_readable(_mount, data.get('mount')),
        held_out=tuple(held_out), straight_lines=made(Bend, data.get('straight_lines')),
        witnesses=Witnesses(**{name: made(Witness, each) for name, each
                               in (data.get('witnesses') or {}).items()}),
        known=tuple(made(Known, each) for each in data.get('known', ())),
        drift=made(Drift, data.get('drift')), temperature_c=data.get('temperature_c'),
        intrinsics_at=tuple(made(CameraAt, each) for each in data.get('intrinsics_at', ())),
        parts=tuple(made(Part, {**each, 'sigma_px': made(PictureSigma, each['sigma_px'])})
                    for each in data.get('parts', ())))


def _frozen(value: Any) -> Any:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _held_out_dict(turn: LeftOut) -> dict[str, Any]:
    # a stored turn has no place in this drive
    center = turn.turn.number if turn.turn.of_this_drive else None
    return {'center': center, 'px': turn.px, 'sigmas': turn.sigmas, 'sigma_px': turn.sigma_px,
            'others_sigma_px': turn.others_sigma_px}


def codes_of(notices: Iterable[Notice]) -> list[str]:
    """Return the codes of warnings or reasons."""
    return [notice.code for notice in notices]


def _notices(data: Any, texts: str, codes: str) -> tuple[Notice, ...]:
    """Return what a file's lists of texts and of codes hold; older files have no codes."""
    lines = [str(line) for line in data.get(texts, ())]
    return tuple(map(Notice, [*map(str, data.get(codes, ())), *[''] * len(lines)], lines))


def _mount_dict(mount: Mount | None) -> dict[str, Any] | None:
    return None if mount is None else {
        **plain_values(mount), 'reason_codes': codes_of(mount.reasons)}


def _turn_dict(turn: TurnSummary | StoredTurnSummary) -> dict[str, Any]:
    values = dataclasses.asdict(turn)
    # a stored turn's id has a meaning in this run only
    return {('stamp' if key == 'stamp_s' else key): item for key, item in values.items()
            if key != 'id' and (key, item) != ('clip', '')}


def calibration_yaml(calibration: CalibrationData, camera_name: str = ros.CAMERA_NAME,
                     created: str | None = None) -> str:
    """Return the YAML text of an accepted or weak calibration, at full precision.

    created: the time, as ISO 8601 text; without it, the same calibration gives the same text.
    Raises ConfigError for a camera name that the drivers would refuse, ValueError without
    intrinsics.
    """
    ros.check_camera_name(camera_name)
    if calibration.camera is None or not np.isfinite(calibration.camera.params).all():
        raise ValueError('a calibration without finite intrinsics has no calibration.yaml')
    content = ros.document(calibration.camera, camera_name, calibration.config.rectified)
    return ros.yaml_text({**content, ros.OWN: _provenance(calibration, created)})


def _provenance(calibration: CalibrationData, created: str | None) -> dict[str, Any]:
    block: dict[str, Any] = plain_values({
        'verdict': calibration.verdict.level,
        'reasons': calibration.verdict.reasons,
        'reason_codes': calibration.verdict.codes,
        'camera_model': None if calibration.camera is None else calibration.camera.model,
        'sigma': calibration.sigma,
        'turns_used': calibration.turns_used,
        'reprojection_error_px': calibration.reprojection_error_px,
        'input': calibration.input_name,
        'seed': calibration.config.seed,
        'versions': calibration.versions,
        **{name: value for name in ('part', 'drift', 'temperature_c')
           if (value := getattr(calibration, name)) is not None},
        **({} if calibration.mount is None else {'mount': _mount_dict(calibration.mount)}),
    })
    return block if created is None else {**block, 'created': created}


def cameras(data: Any, path: Path) -> Cameras:
    """Return the camera of a result.json or calibration.yaml; see formats/table.py."""
    known = isinstance(data, dict) and {'verdict', 'image_size'} <= data.keys()
    return {'': partial(_read, data, path)} if known or _has_block(data) else {}


def _has_block(data: Any) -> bool:
    return opencv.has_matrix(data) and isinstance(data.get(ros.OWN), dict)


def _read(data: Data, path: Path) -> NamedCamera:
    """Return the camera, with what else the file says about it; all of that may be missing."""
    if _has_block(data):
        values, found = data[ros.OWN], opencv.read(data, path)
    else:
        values, found = data, NamedCamera(str(path), _intrinsics(data, path))
    if isinstance(found, OtherLens):
        raise unknown_model(found.model, path)
    camera, verdict = found.camera, values.get('verdict')
    sigma = read_sigma(values.get('sigma'), camera)
    return dataclasses.replace(
        found, sigma=sigma, verdict=None if verdict is None else str(verdict),
        covariance=_covariance(values.get('details'), camera, sigma),
        sigma_px=_readable(_sigma_px, values.get('sigma_px')),
        field=_used_field(values.get('field'), camera.image_size),
        mount=_readable(_mount, values.get('mount')),
        readout_ms=_readable(_readout_ms, values.get('rolling_shutter')),
        drift=_readable(_drift, values.get('drift')),
        temperature_c=_readable(lambda of: read_number(of, 'temperature_c', path), values))


def _intrinsics(data: Data, path: Path) -> Camera:
    given = data.get('intrinsics')
    if not given:
        raise _no_intrinsics(str(path), data['verdict'], data.get('reasons'))
    name = data.get('camera_model', Radial.model)
    if not isinstance(name, str) or name not in MODELS:
        raise unknown_model(name, path)
    if not isinstance(given, dict):
        raise InputError('E-CALIBRATION-MISSING',
                         f'{path} has no intrinsics; use a complete calibration')
    size = read_size(*read_pair(data, 'image_size', path), path=path)
    camera = MODELS[name].of(
        size, [read_number(given, each, path) for each in MODELS[name].names()])
    check_lens(camera, path)
    return camera


def _no_intrinsics(name: str, verdict: Any, reasons: Any) -> InputError:
    known = '; '.join(map(str, reasons)) if isinstance(reasons, (list, tuple)) else ''
    return InputError('E-NO-INTRINSICS',
                      f'{name} has no intrinsics to compare, its verdict is {verdict}'
                      + (f': {known}' if known else '') + '; calibrate a drive with more turns')


def calibrated_camera(calibration: CalibrationData, name: str = 'estimate') -> NamedCamera:
    """Return the camera of a calibration. Raises InputError when it was refused."""
    if calibration.camera is None:
        raise _no_intrinsics(name, calibration.verdict.level, calibration.verdict.main_reasons)
    shutter, field = calibration.rolling_shutter, calibration.field
    covariance, of_picture = calibration.covariance, calibration.picture_covariance
    if of_picture is not None:
        # it may have further parameters behind the camera's
        count = len(calibration.camera.params)
        covariance = of_picture[:count, :count]
    return NamedCamera(name, calibration.camera, calibration.sigma, calibration.verdict.level,
                       covariance, calibration.sigma_px,
                       field.field if field is not None and field.used else None,
                       mount=calibration.mount,
                       readout_ms=None if shutter is None else shutter.readout_ms,
                       drift=calibration.drift, temperature_c=calibration.temperature_c)


def _covariance(details: Any, camera: Camera, sigma: Mapping[str, float] | None
                ) -> Floats | None:
    """Return the covariance in result.json's details, None where there is none that can be one.

    That of the picture may be of the wider model's parameters: the camera's own come first. Files
    of 0.2.0 have the correlations only, which say nearly the same.
    """
    data, count = details if isinstance(details, Mapping) else {}, len(camera.params)
    try:
        covariance = np.array(data.get('picture_covariance'), np.float64)
        if covariance.ndim == 2:
            covariance = covariance[:count, :count]
        if 'picture_covariance' not in data and sigma is not None:
            each = [sigma[name] for name in camera.names()]
            covariance = (np.array(data['covariance'], np.float64) if 'covariance' in data else
                          np.array(data.get('correlation'), np.float64) * np.outer(each, each))
        if covariance.shape == (count, count) and np.isfinite(covariance).all():
            np.linalg.cholesky(covariance)
            return covariance
    except (TypeError, ValueError, np.linalg.LinAlgError):
        pass
    return None


def _counts(field: Mapping[str, Any]) -> bool:
    """Return whether a field is used; files of 0.2.0 call those below their sigma used, too."""
    try:
        return field.get('used') is True and not field['rms_px'] < field['sigma_px']
    except (KeyError, TypeError):
        return True


def _used_field(data: Any, image_size: tuple[int, int]) -> Field | None:
    if not isinstance(data, Mapping) or not _counts(data):
        return None
    try:
        coefficients = np.array(data['coefficients'], np.float64)
    except (KeyError, TypeError, ValueError):
        coefficients = np.zeros(0)
    if coefficients.shape != (2, len(FIELD_TERMS)) or not np.isfinite(coefficients).all():
        raise InputError('E-CALIBRATION-FIELD',
                         'its field has no coefficients that can be read; calibrate again')
    return Field(image_size, coefficients)


def _readable(read: Callable[[Any], T], data: Any) -> T | None:
    """Return what a part of a file says; None where it is missing or cannot be read."""
    try:
        return read(data)
    except (AttributeError, KeyError, IndexError, TypeError, ValueError, InputError):
        return None


def _mount(data: Any) -> Mount:
    def known(values: Any, name: str) -> float | None:
        return None if values[name] is None else read_number(values, name, '')

    travel = [float(value) for value in data['travel_px']]
    return Mount('accepted' if data['verdict'] == 'accepted' else 'weak',
                 _notices(data, 'reasons', 'reason_codes'),
                 read_number(data, 'yaw_left_deg', ''), read_number(data, 'pitch_up_deg', ''),
                 known(data, 'roll_right_deg'), known(data, 'height_m'),
                 {name: known(data['sigma'], name) for name in (*ANGLES, 'height_m')},
                 (travel[0], travel[1]), read_number(data, 'travel_sigma_px', ''),
                 read_number(data, 'straight_m', ''),
                 known({'moved_s': None, **data}, 'moved_s'))


def _drift(data: Any) -> Drift:
    def known(name: str) -> float | None:
        return None if data.get(name) is None else read_number(data, name, '')

    return Drift(read_number(data, 'fx_percent_per_hour', ''), read_number(data, 'sigma', ''),
                 read_number(data, 'from_first_to_last_percent', ''),
                 known('fx_percent_per_kelvin'), known('sigma_per_kelvin'), known('from_c'),
                 known('to_c'))


def _sigma_px(data: Any) -> PictureSigma:
    return PictureSigma(*(read_number(data, key, '') for key in ('rms', 'worst')))


def _readout_ms(data: Any) -> float:
    return read_number(data, 'readout_ms', '')
