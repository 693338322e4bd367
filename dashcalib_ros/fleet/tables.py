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
from dataclasses import dataclass
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
from dashcalib_ros.solve.evidence import LEAST_SPAN_K
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
    **dict.fromkeys(('camera', 'camera_model', 'verdict', 'verdict_alone', 'model'), 'text'),
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
    'other_mode': 'flag', **dict.fromkeys(
        ('drift_percent_per_year', 'drift_sigma', 'percent_per_kelvin', 'sigma_per_kelvin'),
        'real'),
    **dict.fromkeys(('reasons', 'reason_codes', 'warnings'), 'texts'), 'folder': 'text'}
CLIP_COLUMNS = {
    'row': 'number',
    **dict.fromkeys(('clip', 'camera', 'camera_model', 'status', 'reason', 'code'), 'text'),
    'width': 'number', 'height': 'number', 'frames': 'number', 'seconds': 'real',
    **dict.fromkeys(('turns', 'scenes', 'turns_used'), 'number'),
    **dict.fromkeys(('fx', 'sigma_fx_noise', 'sigma_fx_so_far', 'time', 'temperature_c'),
                    'real'),
    'content': 'text', 'file': 'text', 'warnings': 'texts'}


def camera_row(solved: Solved, final: Final, clips: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the row of a camera. clips: the rows of its clips."""
    c, estimate = final.calibration, solved.estimate
    row = {
        **failed_row(solved.camera, solved.camera_model, clips), 'verdict': c.verdict.level,
        'verdict_alone': solved.calibration.verdict.level,
        'width': c.image_size[0] or None, 'height': c.image_size[1] or None,
        'reprojection_error_px': c.reprojection_error_px, 'prior_units': final.prior_units,
        'prior_share': final.prior_share, 'prior_note': final.prior_note,
        'other_mode': final.other_mode, 'reasons': [*map(str, c.verdict.reasons)],
        'reason_codes': list(c.verdict.codes), 'warnings': [*map(str, c.warnings)]}
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


def failed_row(camera: str, camera_model: str, clips: Sequence[Mapping[str, Any]],
               why: Exception | str = '') -> dict[str, Any]:
    """Return the row of a camera without a result: of its clips, and why there is none."""
    drift = drift_of(clips)
    count = Counter(row['status'] for row in clips)
    return {
        **dict.fromkeys(CAMERA_COLUMNS), 'camera': camera, 'camera_model': camera_model or None,
        'verdict': 'refused', 'verdict_alone': 'refused', 'clips': len(clips),
        'clips_used': count['used'], 'clips_left_out': count['left out'],
        'clips_unreadable': count['unreadable'], 'turns': sum(row['turns'] for row in clips),
        'turns_used': sum(row['turns_used'] for row in clips),
        'seconds': float(sum(row['seconds'] for row in clips)), 'prior_units': 0,
        'prior_share': 0.0, 'prior_note': '', 'other_mode': False,
        **({} if drift is None else drift.columns),
        'reasons': [coded(why, LONGEST)], 'reason_codes': [code_of(why)], 'warnings': [],
        'folder': camera_folder(camera)}


def camera_folder(camera: str) -> str:
    """Return the folder of a camera's files; different names never share one."""
    return f'cameras/{folder_name(camera)}'


def folder_name(name: str) -> str:
    """Return the name of a folder for a name; different names never share one."""
    plain = re.sub(r'[^A-Za-z0-9._-]+', '_', name).strip('._')[:80]
    return name if plain == name and not HASHED.search(name) else f'{plain}-{hash_of([name])}'


def clip_rows(camera: str, camera_model: str, clips: Sequence[tuple[Row, ClipResult]],
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
        # videos count from 0, which is not a date
        time = next((time for time in (row.time_s, result.time)
                     if time is not None and time > DATES_S), None)
        found.append({
            **vars(result), 'row': row.number, 'clip': row.clip, 'camera': camera,
            'camera_model': camera_model or None, 'status': status, 'reason': reason, 'code': code,
            'turns_used': share.used, 'fx': share.fx, 'sigma_fx_noise': share.fx_sigma,
            'sigma_fx_so_far': share.sigma_so_far, 'time': time,
            'temperature_c': row.temperature_c})
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


@dataclass(frozen=True)
class FleetDrift:
    """A line through the fx of a camera's clips, by their times and temperatures.

    fx: at the middle of both, with its sigma in percent; year: since 1970, and temperature_c: of
    that middle, None where temperatures do not count. size, sigma: (k,) percent of fx per year
    and, where they count, per kelvin.
    """

    fx: float
    sigma_percent: float
    year: float
    temperature_c: float | None
    size: tuple[float, ...]
    sigma: tuple[float, ...]

    @property
    def columns(self) -> dict[str, float]:
        """Return the columns of the table of cameras."""
        return {**dict(zip(('drift_percent_per_year', 'percent_per_kelvin'), self.size,
                           strict=False)),
                **dict(zip(('drift_sigma', 'sigma_per_kelvin'), self.sigma, strict=False))}

    def at(self, year: float) -> tuple[float, float]:
        """Return by how many percent fx is off at a time, and its sigma, at that temperature."""
        since = year - self.year
        return self.size[0] * since, float(np.hypot(self.sigma_percent, self.sigma[0] * since))


def drift_of(clips: Sequence[Mapping[str, Any]]) -> FleetDrift | None:
    """Return how the fx of a camera's clips changes; None without dates.

    A line through the fx of each clip alone, weighted; sigma grows with the scatter about it.
    Where half of the clips have temperatures, and these differ, those clips count, and what the
    temperature explains is not a drift.
    """
    known = [row for row in clips if row['sigma_fx_noise'] and row['time'] is not None]
    warm = [row for row in known if row['temperature_c'] is not None]
    by_temperature = len(warm) > max(LEAST_CLIPS, len(known) / 2 - 1) and np.ptp(
        [row['temperature_c'] for row in warm]) >= LEAST_SPAN_K
    known = warm if by_temperature else known
    if len({row['time'] for row in known}) < LEAST_CLIPS:
        return None
    fx, sigma = (np.array([row[key] for row in known]) for key in ('fx', 'sigma_fx_noise'))
    ways = np.array([(row['time'] / YEAR_S, row['temperature_c'] if by_temperature else 0.0)
                     for row in known])[:, :1 + by_temperature]
    weight = 1 / sigma**2
    middle, mean = np.average(ways, axis=0, weights=weight), np.average(fx, weights=weight)
    ways -= middle
    if np.linalg.matrix_rank(ways) < ways.shape[1]:
        return None  # the later, the warmer: nothing tells one from the other
    covariance = np.linalg.inv(ways.T * weight @ ways)
    slopes = covariance @ (ways.T @ (weight * (fx - mean)))
    left = float(np.sum(weight * (fx - mean - ways @ slopes)**2))
    scatter = max(left / (len(known) - 1 - len(slopes)), 1.0)
    percent = 100 / mean
    return FleetDrift(
        float(mean), float(percent * np.sqrt(scatter / weight.sum())), float(middle[0]),
        float(middle[1]) if by_temperature else None, tuple((percent * slopes).tolist()),
        tuple((percent * np.sqrt(scatter * np.diag(covariance))).tolist()))


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
