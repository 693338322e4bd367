"""What other programs rely on: result.json, strict JSON, and calibration.yaml; and a check's JSON.

calibration.yaml is the file that camera_info_manager, usb_cam, v4l2_camera and others load. Keys,
order and layout are those that camera_calibration_parsers writes. Its parser looks keys up by
name, so it ignores our one extra block, dashcalib, which has sigma and provenance.

OpenCV's FileStorage reads the file, too. Version 4 wants the line %YAML; 4 and 5 want lists that
are indented, texts of 4096 characters at the most, and quotes: 4.2.1 is a broken number to them.
"""
from __future__ import annotations

import dataclasses
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dashcalib_ros.camera import Camera, ros_camera
from dashcalib_ros.camera.camera_info import SAME
from dashcalib_ros.camera.field import BASIS, Field
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Bend, TurnId
from dashcalib_ros.errors import ConfigError, DashcalibError, InputError, one_line, shortened
from dashcalib_ros.judge import Calibration, Check, Odometry, TurnSummary, Verdict
from dashcalib_ros.judge.calibration import (
    LensField,
    Shutter,
    Stabiliser,
    StoredTurnSummary,
    Witness,
    Witnesses,
)
from dashcalib_ros.limits import JSON_BYTES, parse_json, parse_yaml, read_text
from dashcalib_ros.report.camera_file import parse_camera, read_mount
from dashcalib_ros.solve.solution import LeftOut
from dashcalib_ros.solve.spread import PictureSigma


def result_dict(calibration: Calibration) -> dict[str, Any]:
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
        'mount': c.mount,
        'held_out': [_held_out_dict(turn) for turn in c.held_out],
        'straight_lines': c.straight_lines,
        'witnesses': c.witnesses,
        'input': c.input_name,
        'warnings': c.warnings,
        'masked_fraction': None if c.mask is None else 1.0 - float(np.mean(c.mask)),
        'details': c.details,
    })
    return plain


def result_json(calibration: Calibration) -> str:
    """Return result.json's text; the same calibration gives the same text."""
    return json.dumps(result_dict(calibration), indent=2, allow_nan=False,
                      ensure_ascii=False) + '\n'


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Read what save() and `dashcalib run` write: a result.json, its folder, calibration.yaml.

    A result.json has everything but the mask, the turning magnitudes and what the report draws; a
    calibration.yaml has camera, sigma, verdict and versions. Settings that this version does not
    know are left out. Raises InputError; load_camera() reads other files.
    """
    place = Path(path)
    place = place / 'result.json' if place.is_dir() else place
    text = read_text(place, JSON_BYTES)
    if text.lstrip().startswith('{'):
        data = parse_json(text, str(place))
        missing = [key for key in ('verdict', 'image_size', 'intrinsics') if key not in data]
        if missing:
            raise InputError('E-NO-RESULT-FILE',
                             f'{place} is not a result.json of dashcalib: it has no '
                             f'{missing[0]!r}; use the file that dashcalib run wrote')
    else:
        data = parse_yaml(text, str(place))
        own = data.get('dashcalib') if isinstance(data, Mapping) else None
        if not isinstance(own, Mapping):
            raise InputError('E-OTHER-CALIBRATION', f'{place} is not a calibration of dashcalib; '
                             f'use load_camera() for it')
        data = {**own, 'image_size': [data.get('image_width'), data.get('image_height')]}
    refused = data.get('verdict') == 'refused'
    camera = None if refused else parse_camera(text, place).camera
    try:
        return calibration_of(data, camera)
    except (KeyError, TypeError, ValueError, AttributeError, DashcalibError) as error:
        raise InputError('E-CALIBRATION-DAMAGED',
                         f'{place} is damaged ({one_line(error)}); calibrate again') from error


def calibration_of(data: Mapping[str, Any], camera: Camera | None) -> Calibration:
    """Return the calibration that result_dict() gave these values."""
    def made(kind: type[Any], values: Mapping[str, Any] | None, **more: Any) -> Any:
        return None if values is None else kind(**more, **{
            ('stamp_s' if key == 'stamp' else key): _frozen(item) for key, item in values.items()})

    known = Config().flat()
    config = Config().replace({name: value for name, value in data.get('config', {}).items()
                               if name in known})
    held_out = [LeftOut(
        TurnId.stored(place) if turn['center'] is None else TurnId.at(turn['center']),
        turn['px'], turn['sigma_px'], turn['others_sigma_px'])
        for place, turn in enumerate(data.get('held_out', ()))]
    field, size = data.get('field'), (data['image_size'][0], data['image_size'][1])
    sigma = data.get('sigma')
    return Calibration(
        verdict=Verdict(data['verdict'], tuple(data['reasons']),
                        codes=tuple(data.get('reason_codes', ()))),
        image_size=size, camera=camera,
        sigma=None if sigma is None else {name: math.nan if value is None else float(value)
                                          for name, value in sigma.items()},
        turns=tuple(made(TurnSummary, turn) for turn in data.get('turns', ())),
        frames=data.get('frames', 0), reprojection_error_px=data.get('reprojection_error_px'),
        timing=dict(data.get('timing', {})), versions=dict(data.get('versions', {})),
        config=config.replace({'seed': data.get('seed', config.seed)}),
        input_name=data.get('input', ''), warnings=tuple(data.get('warnings', ())),
        details=dict(data.get('details', {})), stored_turns=tuple(
            made(StoredTurnSummary, turn, id=TurnId.stored(place))
            for place, turn in enumerate(data.get('stored_turns', ()))),
        rolling_shutter=made(Shutter, data.get('rolling_shutter')),
        sigma_px=made(PictureSigma, data.get('sigma_px')),
        stabiliser=made(Stabiliser, data.get('stabiliser')),
        field=None if field is None else LensField(
            Field(size, np.array(field['coefficients'], np.float64)), bool(field['used']),
            field['rms_px'], field['worst_px'], field['sigma_px']),
        mount=read_mount(data.get('mount')),
        held_out=tuple(held_out), straight_lines=made(Bend, data.get('straight_lines')),
        witnesses=Witnesses(**{name: made(Witness, said) for name, said
                               in (data.get('witnesses') or {}).items()}))


def _frozen(value: Any) -> Any:
    """Return the value with tuples for its lists."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def plain_values(value: Any) -> Any:
    """Return the value as types of strict JSON; NaN and infinity become None."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (np.ndarray, np.generic)):
        return plain_values(value.tolist())
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain_values({f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
    if isinstance(value, Mapping):
        return {str(key): plain_values(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_values(item) for item in value]
    return str(value)


def _held_out_dict(turn: LeftOut) -> dict[str, Any]:
    # a stored turn has no place in this drive
    center = turn.turn.number if turn.turn.of_this_drive else None
    return {'center': center, 'px': turn.px, 'sigmas': turn.sigmas, 'sigma_px': turn.sigma_px,
            'others_sigma_px': turn.others_sigma_px}


def _turn_dict(turn: TurnSummary | StoredTurnSummary) -> dict[str, Any]:
    values = dataclasses.asdict(turn)
    # a stored turn's id has a meaning in this run only
    return {('stamp' if key == 'stamp_s' else key): item for key, item in values.items()
            if key != 'id'}


def answer_dict(found: Check, changes: Sequence[str], motion: Odometry | None = None,
                mount: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the answer of a drive about a given calibration as types of strict JSON.

    changes: of the camera during the drive, in words. motion: the comparison with true poses.
    mount: how far the mounting is from the calibration's.
    """
    values: dict[str, Any] = plain_values(found) | {'changes': list(changes), 'mount': mount}
    if motion is not None:
        values |= motion.medians()
        values['turns'] = [{'center': turn.turn.number, 'true_deg': turn.angle_deg,
                            'length_m': turn.length_m,
                            'rotation_deg': {name: turn.rotation_deg(name)
                                             for name in motion.names},
                            'scale_drift': {name: turn.scale_drift(name)
                                            for name in motion.names}}
                           for turn in motion.turns]
    return values


CAMERA_NAME = 'dashcam'
# OpenCV's limit is 4096, and an escaped character has up to ten
TEXT_LENGTH = 400


def calibration_yaml(calibration: Calibration, camera_name: str = CAMERA_NAME,
                     created: str | None = None) -> str:
    """Return the YAML text of an accepted or weak calibration, at full precision.

    created: the time, as ISO 8601 text; without it, the same calibration gives the same text.
    Raises ConfigError for a camera name that the drivers would refuse, ValueError without
    intrinsics.
    """
    check_camera_name(camera_name)
    if calibration.camera is None or not np.isfinite(calibration.camera.params).all():
        raise ValueError('a calibration without finite intrinsics has no calibration.yaml')
    document = _document(calibration.camera, camera_name, calibration.config.rectified)
    return yaml_text({**document, 'dashcalib': _provenance(calibration, created)})


def camera_info_yaml(camera: Camera) -> str:
    """Return the YAML text of a camera alone, without a calibration's sigma and provenance."""
    return yaml_text(_document(camera, CAMERA_NAME, SAME))


def _document(camera: Camera, camera_name: str, rectified: str) -> dict[str, Any]:
    c = ros_camera(camera, rectified)
    width, height = camera.image_size
    return {
        'image_width': int(width),
        'image_height': int(height),
        'camera_name': camera_name,
        'camera_matrix': matrix_block(3, 3, c.k),
        'distortion_model': c.distortion_model,
        'distortion_coefficients': matrix_block(1, len(c.d), c.d),
        'rectification_matrix': matrix_block(3, 3, c.r),
        'projection_matrix': matrix_block(3, 4, c.p),
    }


def yaml_text(document: Mapping[str, Any]) -> str:
    """Return a camera_info document as text that ROS's parsers and OpenCV 4 and 5 read."""
    own = {key: _quoted(document[key]) for key in ('dashcalib',) if key in document}
    name = document.get('camera_name')
    if isinstance(name, str) and not name.isidentifier():  # OpenCV: 4k is a broken number
        own['camera_name'] = _Text(name)
    return str(yaml.dump({**document, **own}, Dumper=_Dumper, sort_keys=False,
                         default_flow_style=None, width=2**20, allow_unicode=True,
                         version=(1, 2)))


def check_camera_name(name: str) -> None:
    """Raise ConfigError for a name that camera_info_manager or image_pipeline would not take."""
    if not re.fullmatch(r'[A-Za-z0-9_]+', name):
        raise ConfigError('E-CAMERA-NAME',
                          f'the camera name {name!r} may have only letters, digits and '
                          'underscores: camera_info_manager refuses others')
    if name == 'narrow_stereo':
        raise ConfigError('E-CAMERA-NAME-TAKEN', 'the camera name narrow_stereo belongs to the '
                          'stereo files of image_pipeline; choose another one')


class _Text(str):
    """A text that is written with quotes."""


class _Dumper(yaml.SafeDumper):
    """Writes plain values, texts with quotes, and lists that are indented."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)


_Dumper.add_representer(_Text, lambda dumper, text: dumper.represent_scalar(
    'tag:yaml.org,2002:str', str(text), style='"'))


def _quoted(value: Any) -> Any:
    """Return a value with every text in it, other than keys, as one that is written in quotes."""
    if isinstance(value, str):
        return _Text(shortened(value, TEXT_LENGTH))
    if isinstance(value, Mapping):
        return {key: _quoted(each) for key, each in value.items()}
    return [_quoted(each) for each in value] if isinstance(value, (list, tuple)) else value


def matrix_block(rows: int, cols: int, data: Sequence[float]) -> dict[str, Any]:
    """Return a matrix as the document has it."""
    # dt: OpenCV reads the matrix by it, as doubles; the other readers look up what they know
    return {'rows': rows, 'cols': cols, 'dt': 'd', 'data': [float(value) for value in data]}


def _provenance(calibration: Calibration, created: str | None) -> dict[str, Any]:
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
        **({} if calibration.mount is None else {'mount': calibration.mount}),
    })
    return block if created is None else {**block, 'created': created}
