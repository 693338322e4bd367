"""The fleet's tables: a row a camera, a row a clip; the same results give the same bytes.

Parquet with pyarrow, without it JSON Lines, and CSV; DuckDB reads all.
"""
from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dashcalib_ros.camera import calibrated_models
from dashcalib_ros.fleet.fuse import ClipShare
from dashcalib_ros.fleet.manifest import Row
from dashcalib_ros.fleet.solved import Final
from dashcalib_ros.fleet.storage import Folder, has
from dashcalib_ros.fleet.tasks import ClipResult, camera_folder
from dashcalib_ros.judge.calibration import ANGLES, Mount
from dashcalib_ros.reconstruct.scene_file import DATES_S
from dashcalib_ros.report.result import plain_values

CAMERAS, CLIPS = 'cameras', 'clips'
PARAMETERS = tuple(dict.fromkeys(name for model in calibrated_models() for name in model.names()))
YEAR_S = 365.25 * 86400
# clips at different times from which a drift is told
LEAST_CLIPS = 3


def camera_row(camera: str, make: str, final: Final | None, failure: str,
               clips: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a camera's row. final: None where it failed; clips: the rows of its clips."""
    c = None if final is None else final.calibration
    drift, drift_sigma = _drift(clips)
    named = {} if c is None or c.camera is None else c.camera.named
    sigma = {} if c is None or c.sigma is None else c.sigma
    alone = {} if final is None or final.sigma_alone is None else final.sigma_alone
    shutter = None if c is None else c.rolling_shutter
    picture = None if c is None else c.sigma_px
    return {
        'camera': camera, 'make': make or None,
        'verdict': 'refused' if c is None else c.verdict.level,
        'verdict_alone': 'refused' if final is None else final.verdict_alone,
        'model': None if c is None or c.camera is None else c.camera.model,
        'width': None if c is None or not c.image_size[0] else c.image_size[0],
        'height': None if c is None or not c.image_size[1] else c.image_size[1],
        **{name: named.get(name) for name in PARAMETERS},
        **{f'sigma_{name}': sigma.get(name) for name in PARAMETERS},
        **{f'sigma_{name}_alone': alone.get(name) for name in PARAMETERS},
        'sigma_px': None if picture is None else picture.rms,
        'sigma_px_worst': None if picture is None else picture.worst,
        'readout_ms': None if shutter is None else shutter.readout_ms,
        'reprojection_error_px': None if c is None else c.reprojection_error_px,
        **_mount(None if c is None else c.mount),
        'clips': len(clips), **{f'clips_{name}': _count(clips, status) for name, status in (
            ('used', 'used'), ('left_out', 'left out'), ('unreadable', 'unreadable'))},
        'turns': sum(row['turns'] for row in clips),
        'turns_used': sum(row['turns_used'] for row in clips),
        'seconds': float(sum(row['seconds'] for row in clips)),
        'prior_units': 0 if final is None else final.prior_units,
        'prior_share': 0.0 if final is None else final.prior_share,
        'prior_note': '' if final is None else final.prior_note,
        'other_mode': False if final is None else final.other_mode,
        'drift_percent_per_year': drift, 'drift_sigma': drift_sigma,
        'reasons': [failure] if c is None else list(c.verdict.reasons),
        'warnings': [] if c is None else list(c.warnings), 'folder': camera_folder(camera)}


def _mount(mount: Mount | None) -> dict[str, Any]:
    """Return how the camera sits on the car, by columns; None where that is not known."""
    return {'mount_verdict': None if mount is None else mount.verdict, **{
        name: value for key in (*ANGLES, 'height_m') for name, value in (
            (f'mount_{key}', None if mount is None else getattr(mount, key)),
            (f'sigma_mount_{key}', None if mount is None else mount.sigma[key]))}}


def clip_row(row: Row, camera: str, make: str, result: ClipResult, share: ClipShare | None
             ) -> dict[str, Any]:
    """Return a clip's row."""
    size = result.image_size or (None, None)
    used = share.used if share else 0
    return {
        'row': row.number, 'clip': row.clip, 'camera': camera, 'make': make or None,
        **dict(zip(('status', 'reason'), _status(result, share), strict=True)),
        'width': size[0], 'height': size[1], 'frames': result.frames, 'seconds': result.seconds,
        'turns': result.turns, 'scenes': result.scenes, 'turns_used': used,
        'fx': share.fx if share else None, 'fx_sigma': share.fx_sigma if share else None,
        'time': _date(row, result),
        'content': result.content or None, 'file': result.file or None,
        'warnings': list(result.warnings)}


def _date(row: Row, result: ClipResult) -> float | None:
    """Return when the clip was recorded; videos count from 0, which is no date."""
    times = [time_s for time_s in (row.time_s, result.time_s) if time_s is not None]
    return next((time_s for time_s in times if time_s > DATES_S), None)


def _status(result: ClipResult, share: ClipShare | None) -> tuple[str, str]:
    if not result.file:
        return 'unreadable', result.problem
    if share is not None and share.left_out:
        return 'left out', share.left_out
    if share is not None and share.used:
        return 'used', ''
    if not result.turns:
        return 'no turn', 'the car does not turn, or does not move'
    if not result.scenes:
        return 'no scene', f'none of its {result.turns} turns could be reconstructed'
    return 'not needed', 'other turns of the camera are used'


def _count(clips: Sequence[Mapping[str, Any]], status: str) -> int:
    return sum(row['status'] == status for row in clips)


def _drift(clips: Sequence[Mapping[str, Any]]) -> tuple[float | None, float | None]:
    """Return by how much fx changes in a year, %, and its sigma; None without dates.

    A line through what each clip alone says, weighted; sigma grows with the scatter about it.
    """
    known = [(row['time'], row['fx'], row['fx_sigma']) for row in clips
             if row['fx_sigma'] and row['time'] is not None]
    if len({time for time, _, _ in known}) < LEAST_CLIPS:
        return None, None
    time, fx, sigma = np.array(known).T
    weight = 1 / sigma**2
    years = (time - np.average(time, weights=weight)) / YEAR_S
    mean = float(np.average(fx, weights=weight))
    variance = 1 / float(np.sum(weight * years**2))
    slope = variance * float(np.sum(weight * years * (fx - mean)))
    scatter = float(np.sum(weight * (fx - mean - slope * years)**2)) / (len(known) - 2)
    percent = 100 / mean
    return percent * slope, percent * float(np.sqrt(variance * max(scatter, 1.0)))


def write_table(folder: Folder, name: str, rows: Sequence[Mapping[str, Any]],
                schema: Mapping[str, str]) -> tuple[str, str]:
    """Write a table, and as CSV, too; return the files' names. schema: each column's type."""
    text = io.StringIO()
    csv.writer(text, lineterminator='\n').writerows([schema, *(
        ['; '.join(value) if isinstance(value, (list, tuple)) else value
         for value in (_plain(row[key]) for key in schema)] for row in rows)])
    folder.write(f'{name}.csv', text.getvalue().encode('utf-8', 'replace'))
    return _write_typed(folder, name, rows, schema), f'{name}.csv'


def _write_typed(folder: Folder, name: str, rows: Sequence[Mapping[str, Any]],
                 schema: Mapping[str, str]) -> str:
    if has('pyarrow') is None:
        text = ''.join(json.dumps(plain_values(row), ensure_ascii=False, allow_nan=False) + '\n'
                       for row in rows)
        folder.write(f'{name}.jsonl', text.encode('utf-8', 'replace'))
        return f'{name}.jsonl'
    import pyarrow as arrow
    from pyarrow import parquet
    types = {'text': arrow.string(), 'real': arrow.float64(), 'number': arrow.int64(),
             'flag': arrow.bool_(), 'texts': arrow.list_(arrow.string())}
    columns = {key: arrow.array([_plain(row[key]) for row in rows], types[kind])
               for key, kind in schema.items()}
    data = io.BytesIO()
    parquet.write_table(arrow.table(columns), data, compression='zstd')
    folder.write(f'{name}.parquet', data.getvalue())
    return f'{name}.parquet'


def _plain(value: Any) -> Any:
    """Return a value that Parquet can hold: names of files may be no Unicode."""
    if isinstance(value, str):
        return value.encode('utf-8', 'replace').decode()
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return value if not isinstance(value, float) or np.isfinite(value) else None


_WORDS = ('camera', 'make', 'verdict', 'verdict_alone', 'mount_verdict', 'model', 'prior_note',
          'folder', 'clip', 'status', 'reason', 'content', 'file')
_NUMBERS = ('width', 'height', 'clips', 'clips_used', 'clips_left_out', 'clips_unreadable',
            'turns', 'turns_used', 'prior_units', 'row', 'frames', 'scenes')


def _types(columns: Sequence[str]) -> dict[str, str]:
    kinds = {**dict.fromkeys(_WORDS, 'text'), **dict.fromkeys(_NUMBERS, 'number'),
             'other_mode': 'flag', 'reasons': 'texts', 'warnings': 'texts'}
    return {name: kinds.get(name, 'real') for name in columns}


CLIP_COLUMNS = _types(tuple(clip_row(Row(0, '', ''), '', '', ClipResult(''), None)))
CAMERA_COLUMNS = _types(tuple(camera_row('', '', None, '', ())))
