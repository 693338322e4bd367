# SPDX-License-Identifier: Apache-2.0
"""Straight lines as a second witness: rendered drives with exact truth, and a real drive.

    python benchmark/lines.py --seeds 0 1 --cache /tmp/cache --data ../shared/data

Rendered: a picture each second through lenses that are known, seen by the true camera and by
spoiled ones. Whole: rendered drives whose solution check.py keeps in the cache: how far lines and
result are apart.
Real: KITTI odometry 03, with the dataset's own K and with ours; two drives with the cameras that
others measured. Rows go to lines.json; --results writes the tables into benchmark/results/.
"""
from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from drives import BY_NAME, _key, drive_of
from measure import commit, complain, keep_table, load, parser_with, save, table
from solutions import solution_path, solved_drive
from wide import WIDE, wide_drive_of

from dashcalib_ros import Calibrator, Config, open_frames
from dashcalib_ros.camera import Brown, Camera, Radial, camera_of
from dashcalib_ros.demo import Drive
from dashcalib_ros.detect import Bend, LineCollector, Lines, bend
from dashcalib_ros.input import Frame
from dashcalib_ros.input.scale import Scale

SPOILED = 0.03
OTHERS = (('carnd', 'drive.mp4', None), ('ntu_campus', 'images', 3.0))
NOTHING_TO_SEE = ('straight on', 'parked', 'at a light, others moving', 'parked at night',
                  'turning on the spot')


def made(name: str, seed: int) -> Drive:
    """Return a rendered drive of drives.py or wide.py."""
    return wide_drive_of(name, seed) if name in WIDE else drive_of(BY_NAME[name], seed)


def true_camera(drive: Drive) -> Camera:
    """Return the camera of a rendered drive."""
    truth = drive.truth
    model = truth.get('model', Radial.model)
    params = [value for key, value in truth.items() if key not in ('model', 'width', 'height')]
    return camera_of(str(model), (drive.lens.width, drive.lens.height), params)


def with_more_k1(camera: Camera, more: float) -> Camera:
    """Return the camera with a k1 that is higher by so much."""
    named = camera.named
    return camera.with_params([*{**named, 'k1': named['k1'] + more}.values()])


def each_second(drive: Drive, cache: Path) -> Iterator[Frame]:
    """Yield a frame each second, rendered once and kept as pictures."""
    folder = cache / f'{_key(drive)}.seconds'
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(0, len(drive), max(1, round(drive.spec.rate))):
        path = folder / f'{index:06}.png'
        if not path.exists():
            cv2.imwrite(str(path), drive.frame(index).image)
        picture = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        yield Frame(index, drive.stamp_ns(index), picture)


def found_lines(frames: Iterable[Frame], config: Config) -> tuple[Lines, float]:
    """Return the lines of frames as they are resized, and the seconds that finding them took."""
    collector, seconds = LineCollector(), 0.0
    for frame in frames:
        small = Scale.of(frame.size, config).frame(frame)
        started = time.perf_counter()
        collector.push(small.image, small.stamp_ns)
        seconds += time.perf_counter() - started
    return collector.lines(), seconds


def rendered_row(name: str, seed: int, cache: Path) -> dict[str, Any]:
    """Return what lines say about the true camera of a drive, and of spoiled ones."""
    drive, config = made(name, seed), Config()
    camera = true_camera(drive)
    scale = Scale.of(camera.image_size, config)
    lines, _ = found_lines(each_second(drive, cache), config)
    lines = lines.within(scale.mask(~drive.overlay.mask))
    small = camera.resized(1 / scale.px, scale.size(camera.image_size))
    return {name: _plain(bend(lines, with_more_k1(small, off)))
            for name, off in (('true', 0.0), ('more', SPOILED), ('less', -SPOILED))}


def whole_row(name: str, seed: int, cache: Path) -> dict[str, Any]:
    """Return what lines say about the calibration of a drive that check.py has solved."""
    found = solved_drive(name, seed, cache).calibration
    lines = found.straight_lines
    return {'verdict': found.verdict.level, 'reasons': [*map(str, found.verdict.reasons)],
            'lines': _plain(lines), 'sigmas': None if lines is None else lines.sigmas}


def kitti_rows(data: Path, config: Config) -> dict[str, Any]:
    """Return what lines say about KITTI's K, our camera and its spoiled ones; and the cost."""
    path = data / 'kitti03'
    with Calibrator(config) as calibrator:
        for frame in open_frames(path / 'bag'):
            calibrator.push(frame)
        found = calibrator.calibrate()
    assert found.camera is not None and found.straight_lines is not None
    lines, seconds = found_lines(open_frames(path / 'bag'), config)
    # these pictures are used at full size
    lines = lines.within(found.mask)
    truth = json.loads((path / 'truth.json').read_text())
    theirs = camera_of(Radial.model, found.image_size, [truth[key] for key in Radial.names()])
    cameras = {"KITTI's K": theirs, 'ours': found.camera,
               **{f'ours, k1 {off:+.2f}': with_more_k1(found.camera, off)
                  for off in (SPOILED, -SPOILED)}}
    rows = {name: _plain(bend(lines, camera)) for name, camera in cameras.items()}
    return {'cameras': rows, 'verdict': found.verdict.level, 'seconds': seconds,
            'total': found.timing['total'], 'sigmas': found.straight_lines.sigmas,
            'camera_sigma': found.straight_lines.camera_sigma}


def other_rows(data: Path, config: Config) -> dict[str, Any]:
    """Return what lines say about cameras that others measured, and these without distortion."""
    rows = {}
    for name, drive, fps in OTHERS:
        folder = data / name
        truth = json.loads((folder / 'truth.json').read_text())
        size = truth['width'], truth['height']
        camera = Brown.of(size, [truth.get(key, 0.0) for key in Brown.names()])
        lines, _ = found_lines(open_frames(folder / drive, fps=fps), config)
        scale = Scale.of(size, config)
        plain = camera.without_distortion()
        for text, each in (('as measured', camera), ('no distortion', plain)):
            small = each.resized(1 / scale.px, scale.size(size))
            rows[f'{name}, {text}'] = _plain(bend(lines, small))
    return rows


def _plain(found: Bend | None) -> dict[str, Any] | None:
    return None if found is None else asdict(found)


def written(results: Mapping[str, Any]) -> str:
    """Return the tables of benchmark/results/lines.md."""
    parts = []
    rows = {name: row for name, row in results.get('rendered', {}).items() if row['true']}
    if rows:
        away = [abs(row['true']['k1']) / row['true']['sigma'] for row in rows.values()]
        seen = [abs(row[spoiled]['k1']) > 2 * row[spoiled]['sigma']
                for row in rows.values() for spoiled in ('more', 'less') if row[spoiled]]
        parts += [
            table(('drive, seed', 'lines', 'bend px', 'k1 asked, true camera', 'in sigmas',
                   f'k1 +{SPOILED}: asked', f'k1 -{SPOILED}: asked'),
                  [_rendered_cells(name, row) for name, row in rows.items()]),
            f'{sum(each <= 2 for each in away)} of {len(away)} true cameras within two sigma; '
            f'{sum(seen)} of {len(seen)} spoiled ones seen at two sigma. Measured at '
            f'{results["rendered_commit"]}.']
    if results.get('whole'):
        parts += [
            table(('drive, seed', 'verdict', 'lines', 'k1 asked of the result', 'sigma, lines',
                   "sigma, the result's", 'both apart, sigmas'),
                  [_whole_cells(name, row) for name, row in results['whole'].items()]),
            f'Measured at {results["whole_commit"]}.']
    if results.get('kitti03'):
        kitti = results['kitti03']
        parts += [
            _real_table('KITTI 03', kitti['cameras']),
            f'With the sigma of our camera, '
            f'{kitti["camera_sigma"]:.4f}, ours and the lines are {kitti["sigmas"]:.1f} sigma '
            f'apart ({kitti["verdict"]}). Finding the lines takes {kitti["seconds"]:.1f} s of '
            f'{kitti["total"]:.0f} s. Measured at {results["kitti03_commit"]}.']
    if results.get('others'):
        parts += [_real_table('drive, camera', results['others']),
                  f'Measured at {results["others_commit"]}.']
    return '\n\n'.join(parts) + '\n'


def _real_table(title: str, rows: Mapping[str, Any]) -> str:
    return table((title, 'lines', 'bend px', 'k1 asked', 'in sigmas', 'moves the picture by, px'),
                 [(name, str(row['lines']), f'{row["bend_px"]:.3f}', _asked(row),
                   f'{abs(row["k1"]) / row["sigma"]:.1f}', f'{row["picture_px"]:.1f}')
                  for name, row in rows.items() if row])


def _rendered_cells(name: str, row: Mapping[str, Any]) -> Sequence[str]:
    true = row['true']
    return (name, str(true['lines']), f'{true["bend_px"]:.3f}', _asked(true),
            f'{abs(true["k1"]) / true["sigma"]:.1f}',
            *(_asked(row[spoiled]) if row[spoiled] else '' for spoiled in ('more', 'less')))


def _whole_cells(name: str, row: Mapping[str, Any]) -> Sequence[str]:
    lines = row['lines']
    if lines is None:
        return name, row['verdict'], 'too few', '', '', '', ''
    return (name, row['verdict'], str(lines['lines']), f'{lines["k1"]:+.4f}',
            f'{lines["sigma"]:.4f}', f'{lines["camera_sigma"]:.4f}', f'{row["sigmas"]:.1f}')


def _asked(row: Mapping[str, Any]) -> str:
    return f'{row["k1"]:+.4f} ± {row["sigma"]:.4f}'


def main() -> None:
    """Measure what is asked for; rows that are there are kept."""
    parser = parser_with(__doc__, 'seeds', 'drives', 'data', 'cache', 'again')
    options = parser.parse_args()
    file, config = options.out / 'lines.json', Config()
    results = load(file)
    cache = options.cache or options.out / 'pictures'
    names = [name for name in (*BY_NAME, *WIDE) if name not in NOTHING_TO_SEE]
    wanted = names if options.drives is None else options.drives
    for kind, row_of in (('rendered', rendered_row), ('whole', whole_row)):
        rows = results.setdefault(kind, {})
        for seed in options.seeds:
            for name in wanted:
                key = f'{name}, {seed}'
                if kind == 'whole' and not solution_path(name, seed, cache).exists():
                    continue
                if options.again or key not in rows:
                    rows[key] = row_of(name, seed, cache)
                    results[f'{kind}_commit'] = commit()
                    save(file, results)
                    complain(f'{kind} {key} {rows[key]}')
    for name, rows_of in (('others', other_rows), ('kitti03', kitti_rows)):
        if options.data and (options.again or name not in results):
            results |= {name: rows_of(options.data, config), f'{name}_commit': commit()}
            save(file, results)
    keep_table('lines', written(results), options,
               [said for key, said in results.items() if key.endswith('commit')])


if __name__ == '__main__':
    main()
