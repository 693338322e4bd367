# SPDX-License-Identifier: Apache-2.0
"""The fleet's tables: a row a camera, a row a clip; the same results give the same bytes.

Parquet with pyarrow, without it JSON Lines, and CSV; DuckDB reads all.
"""
from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dashcalib_ros.arrays import plain_values
from dashcalib_ros.camera import calibrated_models
from dashcalib_ros.errors import Notice, code_of, coded, counted, visible
from dashcalib_ros.fleet.clips import LONGEST, ClipResult, hash_of
from dashcalib_ros.fleet.manifest import Row
from dashcalib_ros.fleet.solved import ClipShare, Final, Solved
from dashcalib_ros.fleet.storage import has, joined, write
from dashcalib_ros.judge.calibration import ANGLES
from dashcalib_ros.store.scene_file import DATES_S

PARAMETERS = tuple(dict.fromkeys(name for model in calibrated_models() for name in model.names()))
MOUNT = (*ANGLES, 'height_m')
YEAR_S = 365.25 * 86400
# clips at different times that a drift needs
LEAST_CLIPS = 3
# the end of a camera's folder whose name is not the camera's
HASHED = re.compile(r'-[0-9a-f]{32}$')

# how a text begins that a spreadsheet runs
FORMULA = ('=', '+', '-', '@')

# each column's type
CAMERA_COLUMNS = {
    **dict.fromkeys(('camera', 'make', 'verdict', 'verdict_alone', 'model'), 'text'),
    **dict.fromkeys(('width', 'height'), 'number'),
    **dict.fromkeys(PARAMETERS, 'real'),
    **{f'sigma_{name}': 'real' for name in PARAMETERS},
    **{f'sigma_{name}_alone': 'real' for name in PARAMETERS},
    **dict.fromkeys(('sigma_px', 'sigma_px_worst', 'readout_ms', 'reprojection_error_px'), 'real'),
    'mount_verdict': 'text',
    **{f'{of}mount_{name}': 'real' for name in MOUNT for of in ('', 'sigma_')},
    **dict.fromkeys(('clips', 'clips_used', 'clips_left_out', 'clips_unreadable', 'turns',
                     'turns_used'), 'number'),
    'seconds': 'real', 'prior_units': 'number', 'prior_share': 'real', 'prior_note': 'text',
    'other_mode': 'flag', 'drift_percent_per_year': 'real', 'drift_sigma': 'real',
    **dict.fromkeys(('reasons', 'reason_codes', 'warnings'), 'texts'), 'folder': 'text'}
CLIP_COLUMNS = {
    'row': 'number',
    **dict.fromkeys(('clip', 'camera', 'make', 'status', 'reason', 'code'), 'text'),
    'width': 'number', 'height': 'number', 'frames': 'number', 'seconds': 'real',
    **dict.fromkeys(('turns', 'scenes', 'turns_used'), 'number'),
    **dict.fromkeys(('fx', 'sigma_fx_noise', 'sigma_fx_so_far', 'time'), 'real'),
    'content': 'text', 'file': 'text', 'warnings': 'texts'}


def camera_row(solved: Solved, final: Final, clips: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the row of a camera. clips: the rows of its clips."""
    c, estimate = final.calibration, solved.estimate
    row = {
        **failed_row(solved.camera, solved.make, clips), 'verdict': c.verdict.level,
        'verdict_alone': solved.calibration.verdict.level,
        'width': c.image_size[0] or None, 'height': c.image_size[1] or None,
        'reprojection_error_px': c.reprojection_error_px, 'prior_units': final.prior_units,
        'prior_share': final.prior_share, 'prior_note': final.prior_note,
        'other_mode': final.other_mode, 'reasons': list(c.verdict.reasons),
        'reason_codes': list(c.verdict.codes), 'warnings': list(c.warnings)}
    if estimate is not None:
        row.update({f'sigma_{name}_alone': sigma for name, sigma in estimate.sigma.items()})
    if c.camera is not None and c.sigma is not None:
        row.update({'model': c.camera.model, **c.camera.named})
        row.update({f'sigma_{name}': sigma for name, sigma in c.sigma.items()})
    if c.sigma_px is not None:
        row.update({'sigma_px': c.sigma_px.rms, 'sigma_px_worst': c.sigma_px.worst})
    if c.rolling_shutter is not None:
        row['readout_ms'] = c.rolling_shutter.readout_ms
    if c.mount is not None:
        row['mount_verdict'] = c.mount.verdict
        row.update({f'mount_{name}': getattr(c.mount, name) for name in MOUNT})
        row.update({f'sigma_mount_{name}': c.mount.sigma[name] for name in MOUNT})
    return row


def failed_row(camera: str, make: str, clips: Sequence[Mapping[str, Any]],
               why: Exception | str = '') -> dict[str, Any]:
    """Return the row of a camera without a result: of its clips, and why there is none."""
    drift, drift_sigma = _drift(clips)
    count = Counter(row['status'] for row in clips)
    return {
        **dict.fromkeys(CAMERA_COLUMNS), 'camera': camera, 'make': make or None,
        'verdict': 'refused', 'verdict_alone': 'refused', 'clips': len(clips),
        'clips_used': count['used'], 'clips_left_out': count['left out'],
        'clips_unreadable': count['unreadable'], 'turns': sum(row['turns'] for row in clips),
        'turns_used': sum(row['turns_used'] for row in clips),
        'seconds': float(sum(row['seconds'] for row in clips)), 'prior_units': 0,
        'prior_share': 0.0, 'prior_note': '', 'other_mode': False,
        'drift_percent_per_year': drift, 'drift_sigma': drift_sigma,
        'reasons': [coded(why, LONGEST)], 'reason_codes': [code_of(why)], 'warnings': [],
        'folder': camera_folder(camera)}


def camera_folder(camera: str) -> str:
    """Return the folder of a camera's files; different names never share one."""
    return f'cameras/{folder_name(camera)}'


def folder_name(name: str) -> str:
    """Return the name of a folder for a name; different names never share one."""
    plain = re.sub(r'[^A-Za-z0-9._-]+', '_', name).strip('._')[:80]
    return name if plain == name and not HASHED.search(name) else f'{plain}-{hash_of([name])}'


def clip_rows(camera: str, make: str, clips: Sequence[tuple[Row, ClipResult]],
              shares: Mapping[str, ClipShare]) -> list[dict[str, Any]]:
    """Return the rows of a camera's clips. shares: by name; a clip named twice counts once."""
    first: dict[str, int] = {}
    found = []
    for row, result in clips:
        share = shares.get(row.name, ClipShare())
        if result.file and first.setdefault(row.name, row.number) != row.number:
            share = ClipShare.without(Notice(
                'E-CLIP-REPEATED', f'is the same clip as in row {first[row.name]}'))
        status, reason, code = _status(result, share)
        # videos count from 0, which is no date
        time = next((time for time in (row.time_s, result.time)
                     if time is not None and time > DATES_S), None)
        found.append({
            **vars(result), 'row': row.number, 'clip': row.clip, 'camera': camera,
            'make': make or None, 'status': status, 'reason': reason, 'code': code,
            'turns_used': share.used, 'fx': share.fx, 'sigma_fx_noise': share.fx_sigma,
            'sigma_fx_so_far': share.sigma_so_far, 'time': time})
    return found


def _status(result: ClipResult, share: ClipShare) -> tuple[str, str, str]:
    if not result.file:
        return 'unreadable', result.problem, result.code
    if share.left_out:
        return 'left out', share.left_out, share.code
    if share.used:
        return 'used', '', ''
    if result.scenes:
        return 'not needed', 'other turns of the camera are used', ''
    why = Notice('E-NO-SCENE', f'none of its {counted(result.turns, "turn")} could be '
                 f'reconstructed') if result.turns else Notice(
        'E-NO-TURN', 'the car does not turn, or does not move')
    return 'no scene' if result.turns else 'no turn', coded(why), why.code


def _drift(clips: Sequence[Mapping[str, Any]]) -> tuple[float | None, float | None]:
    """Return by how much fx changes in a year, %, and its sigma; None without dates.

    A line through the fx of each clip alone, weighted; sigma grows with the scatter about it.
    """
    known = [(row['time'], row['fx'], row['sigma_fx_noise']) for row in clips
             if row['sigma_fx_noise'] and row['time'] is not None]
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


def write_table(out: str, name: str, rows: Sequence[Mapping[str, Any]],
                columns: Mapping[str, str]) -> tuple[str, ...]:
    """Write a table into a folder, also as CSV; return the files' names. columns: their types."""
    plain = [{key: _plain(row[key]) for key in columns} for row in rows]
    text = io.StringIO()
    csv.writer(text, lineterminator='\n').writerows([columns, *(
        [_cell('; '.join(value) if isinstance(value, list) else value) for value in row.values()]
        for row in plain)])
    typed = {f'{name}.parquet': _parquet(plain, columns)} if has('pyarrow') else {
        f'{name}.jsonl': ''.join(json.dumps(row, ensure_ascii=False) + '\n' for row in plain
                                 ).encode()}
    files = {**typed, f'{name}.csv': text.getvalue().encode()}
    for file, data in files.items():
        write(joined(out, file), data)
    return tuple(files)


def _parquet(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> bytes:
    import pyarrow as arrow
    from pyarrow import parquet
    types = {'text': arrow.string(), 'real': arrow.float64(), 'number': arrow.int64(),
             'flag': arrow.bool_(), 'texts': arrow.list_(arrow.string())}
    table = arrow.table({key: arrow.array([row[key] for row in rows], types[kind])
                         for key, kind in columns.items()})
    data = io.BytesIO()
    parquet.write_table(table, data, compression='zstd')
    return data.getvalue()


def _cell(value: Any) -> Any:
    """Return a value that is one cell to every program, and text to a spreadsheet."""
    if not isinstance(value, str):
        return value
    text = visible(value)
    return f"'{text}" if text.startswith(FORMULA) else text


def _plain(value: Any) -> Any:
    """Return a value that all tables can hold: names of files may be no Unicode."""
    if isinstance(value, str):
        return value.encode('utf-8', 'replace').decode()
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return plain_values(value)
