"""result.json: a calibration as strict JSON, the contract other programs rely on."""
from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dashcalib_ros.errors import InputError
from dashcalib_ros.judgement import Calibration, TurnSummary
from dashcalib_ros.judgement.calibration import StoredTurnSummary
from dashcalib_ros.limits import JSON_BYTES, read_text
from dashcalib_ros.limits import parse_json as parse_any_json
from dashcalib_ros.solve.opinions import HeldOut


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
        'sigma_px': c.sigma_px,
        'camera_model': None if c.camera is None else c.camera.model,
        'stored_turns': [_turn_dict(turn) for turn in c.stored_turns],
        'rolling_shutter': c.rolling_shutter,
        'stabiliser': c.stabiliser,
        'held_out': [_held_out_dict(turn) for turn in c.held_out],
        'straight_lines': c.straight_lines,
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


def load_result(path: str | Path) -> dict[str, Any]:
    """Read a result.json. Raises InputError if it is not one."""
    return parse_result(read_text(Path(path), JSON_BYTES), path)


def parse_result(text: str, path: str | Path) -> dict[str, Any]:
    """Parse result.json's text; path is for messages only."""
    data = parse_json(text, path)
    missing = [key for key in ('verdict', 'image_size', 'intrinsics') if key not in data]
    if missing:
        raise InputError(f'{path} is no result.json of dashcalib: it has no {missing[0]!r}; '
                         'give the file that dashcalib run wrote')
    return data


def parse_json(text: str, path: str | Path) -> dict[str, Any]:
    """Parse the text of a JSON object; raises InputError."""
    data = parse_any_json(text, str(path))
    if not isinstance(data, dict):
        raise InputError(f'{path} holds no JSON object; give a result.json or a truth file')
    return data


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
    if isinstance(value, (set, frozenset)):
        return sorted((plain_values(item) for item in value), key=str)
    return str(value)


def _held_out_dict(turn: HeldOut) -> dict[str, Any]:
    # a stored turn has no place in this drive
    center = turn.turn.number if turn.turn.of_this_drive else None
    return {'center': center, 'px': turn.px, 'sigmas': turn.sigmas, 'sigma_px': turn.sigma_px,
            'others_sigma_px': turn.others_sigma_px}


def _turn_dict(turn: TurnSummary | StoredTurnSummary) -> dict[str, Any]:
    values = dataclasses.asdict(turn)
    # a stored turn's id has a meaning in this run only
    return {('stamp' if key == 'stamp_s' else key): item for key, item in values.items()
            if key != 'id'}
