#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What `dashcalib batch` must show; one command for all of it, or for a part.

    python benchmark/fleet.py [lost] [clips] [prior] [speed] [real] [--videos N]
                              [--seeds N ...] [--data DIR] [--cache DIR] [--out DIR] [--results]

lost: 200 clips of 20 cameras on two Ray nodes; one node is killed, then the driver; are the tables
those of one process, byte for byte? clips: five one-turn clips against the drive they were cut
from. prior: thirty units with one bend each, and three that are zoomed. speed: clips and seconds
of video per core-second, with 1 and 2 workers. real: the same of the recorded drives in --data,
with one. Writes DIR/fleet.json.
"""
from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from drives import pictures_of
from measure import commit, keep_table, load, parser_with, save, table
from real import DRIVES
from views import View, Viewed

from dashcalib_ros.config import Config
from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.fleet import lens_prior, solved
from dashcalib_ros.fleet.fuse import fuse
from dashcalib_ros.input import Frame

# without distortion, and wide enough for the lenses it is seen through
STREET_LENS = Lens.of(800, 450, 90.0)
MODEL = Lens(640, 360, 420.0, 420.4, 322.0, 177.0, -0.10, 0.02)
RATE = 10.0


def street(seed: int, cache: Path) -> tuple[Drive, list[Frame]]:
    """Return a drive of five turns and its pictures, rendered at the first call."""
    drive = Drive(STREET_LENS, DriveSpec(rate=RATE, turns=5, seed=seed))
    return drive, list(pictures_of(drive, cache))


def unit_of(rng: np.random.Generator, factor: float = 1.0) -> Lens:
    """Return a unit of the model: 1 % of spread in the focal length, its own centre."""
    focal = factor * (1 + 0.01 * rng.standard_normal())
    return replace(MODEL, fx=MODEL.fx * focal, fy=MODEL.fy * focal,
                   cx=MODEL.cx + 3 * rng.standard_normal(),
                   cy=MODEL.cy + 3 * rng.standard_normal())


def cuts(drive: Drive) -> list[tuple[int, int]]:
    """Return the first frame and the one after the last of clips with one turn each."""
    middles = [(one + other) // 2 for one, other in zip(
        drive.turn_centers, drive.turn_centers[1:], strict=False)]
    return list(zip([0, *middles], [*middles, len(drive)], strict=True))


def write_clip(path: Path, frames: Sequence[Frame], lens: Lens) -> Path:
    """Write frames of a street, seen through a lens, as a video."""
    if path.exists():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    making = path.with_suffix('.new.avi')
    video = cv2.VideoWriter(str(making), cv2.VideoWriter.fourcc(*'MJPG'), RATE,
                            (lens.width, lens.height))
    video.set(cv2.VIDEOWRITER_PROP_QUALITY, 97)
    for frame in Viewed(View(path.stem, lens), frames, STREET_LENS):
        video.write(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR))
    video.release()
    making.rename(path)
    return path


def fleet(folder: Path, cache: Path, videos: int) -> Path:
    """Make 200 clips of 20 cameras of two models, 0 to 3 turns each; return the manifest.

    So many cameras have four videos each; the clips of the others are gathered turns, made from
    points with exact truth. One clip in 40 cannot be read.
    """
    rng = np.random.default_rng(16)
    rows = [*_video_rows(folder, cache, videos, rng),
            *_made_rows(folder, 200 - 4 * videos, 20 - videos, rng)]
    for n, row in enumerate(rows):
        if n % 40 == 39:
            bad = folder / f'bad/{n}.avi'
            bad.parent.mkdir(parents=True, exist_ok=True)
            bad.write_bytes(b'' if n % 80 == 39 else b'no video' * 100)
            row['clip'] = str(bad.relative_to(folder))
    manifest = folder / 'fleet.csv'
    with manifest.open('w', newline='') as stream:
        writer = csv.DictWriter(stream, ['clip', 'camera', 'camera_model'])
        writer.writeheader()
        writer.writerows(rows)
    return manifest


def _video_rows(folder: Path, cache: Path, cameras: int, rng: np.random.Generator
                ) -> Iterator[dict[str, str]]:
    for camera in range(cameras):
        lens = unit_of(rng)
        drive, frames = street(1 + camera % 2, cache)
        one_turn = cuts(drive)
        first = camera // 2 % 2
        parts = [one_turn[first], one_turn[first + 1], (one_turn[first + 2][0],
                                                        one_turn[first + 3][1]),
                 (0, max(drive.turn_centers[0] - 35, 10))]
        for n, (begin, end) in enumerate(parts):
            path = write_clip(folder / f'videos/{camera}-{n}.avi', frames[begin:end], lens)
            yield {'clip': str(path.relative_to(folder)), 'camera': f'v{camera:02}',
                   'camera_model': 'north'}


def _made_rows(folder: Path, count: int, cameras: int, rng: np.random.Generator
               ) -> Iterator[dict[str, str]]:
    from fleet_made import clip_of, lens_of, written
    lenses = [lens_of(1 + 0.01 * rng.standard_normal()) for _ in range(cameras)]
    for n in range(count):
        camera, turns = n % cameras, int(rng.integers(0, 4))
        yaws = (rng.choice([-1, 1], turns) * rng.uniform(50, 100, turns)).tolist()
        path = folder / f'made/{n}.npz'
        if not path.exists():
            written(clip_of(lenses[camera], yaws, world=10 * n, tracks=60, keyframes=7), path)
        yield {'clip': str(path.relative_to(folder)), 'camera': f'm{camera:02}',
               'camera_model': 'south' if camera % 2 else 'north'}


def bends(seed: int, units: int = 30, zooms: Sequence[float] = (1.15, 0.8, 1.4)
          ) -> list[tuple[Any, float, Any]]:
    """Return the lens, the zoom and one bend's clip of each unit of a model.

    Bends of 5 to 9 degrees, noise of 0.8 px, 3 % of outliers: each knows fx to 5 or 6 %.
    """
    from fleet_made import clip_of, lens_of
    from synthetic import SIZE

    from dashcalib_ros.camera import Radial
    rng, found = np.random.default_rng(seed), []
    for n, zoom in enumerate([*[1.0] * units, *zooms]):
        factor = zoom * (1 + 0.01 * rng.standard_normal())
        lens = replace(lens_of(factor), k1=-0.28 + 0.003 * rng.standard_normal(),
                       cx=407 + 4 * rng.standard_normal(), cy=219 + 4 * rng.standard_normal())
        yaw = float(rng.uniform(5, 9)) * (-1) ** n
        start = Radial.centred(SIZE, 520.0 * zoom, -0.25)
        found.append((lens, zoom, clip_of(
            lens, [yaw], 10000 * seed + n, start=start, noise_px=0.8, tracks=110, keyframes=12,
            outliers=0.03)))
    return found


# every result of the fleet, whoever made it
TABLES = ('cameras.parquet', 'clips.parquet', 'overview.html')
LIMIT_S = 3600.0
# turns of a camera: the part `lost` is about files, and has many cameras
FEWER = ('--set', 'fleet.turns=6')
# of `prior`; its settings were chosen on 1 to 4 and 11 to 16
SEEDS = (21, 22, 23, 24, 25, 26, 27, 28)
# of `real`: folder, pictures, images a second where they do not say
RECORDED = (*((drive.name, drive.pictures, drive.fps or '') for drive in DRIVES),
            ('carnd', 'drive.mp4', ''))


@dataclass(frozen=True)
class Asked:
    """What the parts are asked: see the options."""

    videos: int
    seeds: Sequence[int]
    cache: Path
    data: Path | None


def command(manifest: Path, out: Path, *options: str) -> list[str]:
    """Return the command of a batch."""
    return [sys.executable, '-m', 'dashcalib_ros', 'batch', str(manifest), '--out', str(out),
            *options]


def run(manifest: Path, out: Path, *options: str) -> dict[str, Any]:
    """Run a batch to its end; return what it took."""
    shutil.rmtree(out, ignore_errors=True)
    return again(manifest, out, *options)


def again(manifest: Path, out: Path, *options: str) -> dict[str, Any]:
    """Run a batch where another one may have been; return what it took."""
    done = subprocess.run(command(manifest, out, *options), capture_output=True, text=True,
                          check=False, timeout=LIMIT_S)
    if done.returncode not in (0, 3):
        raise RuntimeError(done.stdout + done.stderr)
    effort: dict[str, Any] = json.loads((out / 'effort.json').read_text())
    return effort


def lost(work: Path, asked: Asked) -> dict[str, Any]:
    """Kill a node and the driver; compare the tables with those of one process."""
    from ray.cluster_utils import Cluster
    manifest = fleet(work / 'fleet', asked.cache, asked.videos)
    alone, together = work / 'alone', work / 'together'
    reference = run(manifest, alone, '--workers', '1', *FEWER)
    shutil.rmtree(together, ignore_errors=True)
    started = time.monotonic()
    cluster = Cluster(initialize_head=True, head_node_args={'num_cpus': 0,
                                                            'include_dashboard': False})
    try:
        memory = 8 * 2**30
        nodes = [cluster.add_node(num_cpus=1, memory=memory) for _ in range(2)]
        options = ('--address', cluster.address, *FEWER)
        driver = subprocess.Popen(command(manifest, together, *options))
        _wait_for(together, 8, driver)
        cluster.remove_node(nodes[1], allow_graceful=False)
        at_node = _gathered(together)
        _wait_for(together, 40, driver)
        driver.send_signal(signal.SIGKILL)
        driver.wait()
        at_driver = _gathered(together)
        cluster.add_node(num_cpus=1, memory=memory)
        effort = again(manifest, together, *options)
    finally:
        cluster.shutdown()
    shards = work / 'shards'
    shutil.rmtree(shards, ignore_errors=True)
    for n in (1, 2, 3):
        subprocess.run(command(manifest, shards, '--shard', f'{n}/3', *FEWER), check=False,
                       capture_output=True)
    merged = again(manifest, shards, '--workers', '1', *FEWER)
    rows = _clips(alone / 'clips.parquet')
    return {'clips': len(rows), 'different_rows': len({row['row'] for row in rows}),
            'status': _counted(row['status'] for row in rows),
            'done_when_node_died': at_node, 'done_when_driver_died': at_driver,
            'read_after_that': effort['clips_read'],
            'equal': {name: _same(alone / name, together / name) for name in TABLES},
            'equal_of_shards': {name: _same(alone / name, shards / name) for name in TABLES},
            'read_by_the_merge': merged['clips_read'], 'alone_s': reference['wall_s'],
            'together_s': time.monotonic() - started}


def _gathered(out: Path) -> int:
    return sum(1 for _ in (out / 'clips').rglob('*.json'))


def _wait_for(out: Path, count: int, driver: subprocess.Popen[bytes]) -> None:
    while _gathered(out) < count and driver.poll() is None:
        time.sleep(0.2)


def _same(one: Path, other: Path) -> bool:
    return one.read_bytes() == other.read_bytes()


def _clips(path: Path) -> list[dict[str, Any]]:
    from pyarrow import parquet
    rows: list[dict[str, Any]] = parquet.read_table(path).to_pylist()
    return rows


def _counted(values: Any) -> dict[str, int]:
    found: dict[str, int] = {}
    for value in values:
        found[value] = found.get(value, 0) + 1
    return found


def clips(work: Path, asked: Asked) -> list[dict[str, Any]]:
    """Compare five one-turn clips with the drive that they were cut from."""
    found = []
    for seed in (1, 2):
        drive, frames = street(seed, asked.cache)
        lens = unit_of(np.random.default_rng(seed))
        folder = work / f'street{seed}'
        shutil.rmtree(folder, ignore_errors=True)
        for n, (begin, end) in enumerate(cuts(drive)):
            write_clip(folder / f'cut-{n}.avi', frames[begin:end], lens)
        write_clip(folder / 'whole-0.avi', frames, lens)
        out = work / f'street{seed}-out'
        run(folder, out, '--workers', '1', '--group-by', '(cut|whole)-')
        for name in ('whole', 'cut'):
            result = json.loads((out / 'cameras' / name / 'result.json').read_text())
            found.append({'street': seed, 'clips': name, 'verdict': result['verdict'],
                          'error': {key: value - lens.truth[key]
                                    for key, value in result['intrinsics'].items()
                                    if key in lens.truth},
                          'fx': lens.fx, 'sigma': result['sigma'],
                          'sigma_px': result['sigma_px']['rms']})
    return found


def prior(work: Path, asked: Asked) -> list[dict[str, Any]]:
    """Give thirty units with one bend each the prior of their model, and throw out the zoomed.

    They are known to have no stabiliser: else a bend so gentle says nothing to other units.
    """
    config = Config().replace({'intrinsics.profile_tracks': 60, 'known.stabiliser': 'no'})
    found = []
    for seed in asked.seeds:
        units = [(lens, zoom, fuse(f'u{n:02}', 'model', {'bend': clip}, config))
                 for n, (lens, zoom, clip) in enumerate(bends(seed))]
        known = [unit for _, _, result in units if (unit := solved.unit_of(result))]
        priors = lens_prior.priors(known, config.fleet)
        rows = []
        for lens, zoom, result in units:
            final = solved.final_of(result, priors.get(result.camera))
            row = {'zoom': zoom, 'prior': bool(final.prior_units), 'thrown': final.other_mode}
            if result.estimate is not None:
                row['alone'] = result.estimate.camera.fx / lens.fx - 1
                row['sigma_alone'] = result.estimate.sigma['fx'] / lens.fx
            if final.prior_units and final.calibration.camera and final.calibration.sigma:
                row['with'] = final.calibration.camera.fx / lens.fx - 1
                row['sigma'] = final.calibration.sigma['fx'] / lens.fx
                row['share'] = final.prior_share
            rows.append(row)
        found.append({'seed': seed, 'units': rows})
    return found


def speed(work: Path, asked: Asked) -> dict[str, Any]:
    """Measure clips and seconds of video per core-second, with one worker and with two."""
    folder = work / 'speed'
    shutil.rmtree(folder, ignore_errors=True)
    for camera in range(asked.videos):
        drive, frames = street(1 + camera % 2, asked.cache)
        lens = unit_of(np.random.default_rng(camera))
        for n, (begin, end) in enumerate(cuts(drive)):
            write_clip(folder / f'{camera}-{n}.avi', frames[begin:end], lens)
    found: dict[str, Any] = {}
    for workers in (1, 2):
        out = work / f'speed-{workers}'
        found[str(workers)] = run(folder, out, '--workers', str(workers), '--group-by', '(\\d+)-')
    size = sum(path.stat().st_size for path in (work / 'speed-1/gathered').rglob('*.npz'))
    found['gathered_bytes_per_minute'] = size / (found['1']['video_s'] / 60)
    found['efficiency'] = found['1']['wall_s'] / (2 * found['2']['wall_s'])
    return found


def real(work: Path, asked: Asked) -> dict[str, Any]:
    """Measure the recorded drives, each as one clip of a camera, with one worker."""
    if asked.data is None:
        return {}
    work.mkdir(parents=True, exist_ok=True)
    found = {}
    for name, pictures, fps in RECORDED:
        manifest = work / f'{name}.csv'
        manifest.write_text(f'clip,camera,fps\n{asked.data / name / pictures},{name},{fps}\n')
        found[name] = run(manifest, work / f'real-{name}', '--workers', '1')
    return found


def report(found: Mapping[str, Any]) -> str:
    """Return the tables."""
    parts = []
    if 'lost' in found:
        parts.append(_lost_text(found['lost']))
    if 'clips' in found:
        parts.append('## A rendered street, whole and as five clips with one turn each\n' + table(
            ['street', 'clips', 'verdict', 'fx error %', 'sigma %', 'cx error px', 'sigma',
             'k1 error', 'sigma', 'sigma over the picture px'],
            [[str(row['street']), {'whole': 'one, five turns', 'cut': 'five, one turn each'}[
                row['clips']], row['verdict'], *_pair(row, 'fx', 100 / row['fx'], 3),
              *_pair(row, 'cx', 1, 2), *_pair(row, 'k1', 1, 4), f'{row["sigma_px"]:.2f}']
             for row in found['clips']]))
    if 'prior' in found:
        parts.append('## The prior of a model: thirty units, one bend each, without a stabiliser\n'
                     'Three more are zoomed.\n\n' + table(
            ['seed', 'units with a prior', 'median error of fx alone %', 'in the end %', 'ratio',
             'within 2 sigma alone', 'those with a prior', 'zoomed, without one'],
            [[str(each['seed']), *_prior_row(each['units'])] for each in found['prior']]
            + [['all', *_prior_row([unit for each in found['prior'] for unit in each['units']])]]))
    if found.get('real'):
        parts.append('## Effort of recorded drives\n' + table(
            ['drive', 'video, s', 'gather, core-s', 'solve, core-s', 's of video per core-s'],
            [[name, f'{effort["video_s"]:.0f}', f'{effort["gather_cpu_s"]:.1f}',
              f'{effort["solve_cpu_s"]:.1f}', f'{effort["video_s"] / _core_s(effort):.1f}']
             for name, effort in found['real'].items()]))
    if 'speed' in found:
        one, efficiency = found['speed']['1'], found['speed']['efficiency']
        parts.append('## Effort of one-turn clips of 640x360\n' + table(
            ['clips', 'video, s', 'gather, core-s', 'solve, core-s', 's of video per core-s',
             'clips per core-s', 'efficiency of two workers', 'MB of a worker',
             'gathered, kB a minute'],
            [[str(one['clips_read']), f'{one["video_s"]:.0f}', f'{one["gather_cpu_s"]:.1f}',
              f'{one["solve_cpu_s"]:.1f}', f'{one["video_s"] / _core_s(one):.1f}',
              f'{one["clips_read"] / _core_s(one):.2f}', f'{efficiency:.2f}',
              f'{max(found["speed"][n]["peak_mb_of_a_worker"] for n in "12"):.0f}',
              f'{found["speed"]["gathered_bytes_per_minute"] / 1e3:.0f}']]))
    return '\n\n'.join(parts)


def _lost_text(lost: Mapping[str, Any]) -> str:
    """Return what became of the tables when a node and the driver were killed."""
    same = {True: 'equal', False: 'different'}
    status = ', '.join(f'{count} {name}' for name, count in lost['status'].items())
    return (f'## {lost["clips"]} clips on two Ray nodes: one is killed, then the driver\n'
            f'{lost["different_rows"]} rows ({status}); {lost["done_when_node_died"]} were done '
            f'when the node died, {lost["done_when_driver_died"]} when the driver died, '
            f'{lost["read_after_that"]} were read after that.\n\n' + table(
                ['against one process, byte for byte', *TABLES],
                [[name, *(same[lost[key][each]] for each in TABLES)] for name, key in (
                    ('one node, then the driver killed', 'equal'),
                    ('three shards, merged', 'equal_of_shards'))]))


def _core_s(effort: Mapping[str, Any]) -> float:
    return float(effort['gather_cpu_s'] + effort['solve_cpu_s'])


def _pair(row: Mapping[str, Any], name: str, factor: float, digits: int) -> tuple[str, str]:
    return (f'{factor * row["error"][name]:+.{digits}f}',
            f'{factor * row["sigma"][name]:.{digits}f}')


def _prior_row(units: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the figures of all sound units; one without a prior keeps its own estimate."""
    known = [unit for unit in units if unit['zoom'] == 1 and 'alone' in unit]
    given = [unit for unit in known if 'with' in unit]
    zoomed = [unit for unit in units if unit['zoom'] != 1]
    alone = 100 * float(np.median([abs(unit['alone']) for unit in known]))
    after = 100 * float(np.median([abs(unit.get('with', unit['alone'])) for unit in known]))
    inside = [np.mean([abs(unit[key]) < 2 * unit[sigma] for unit in found] or [np.nan])
              for key, sigma, found in (('alone', 'sigma_alone', known), ('with', 'sigma', given))]
    return [f'{len(given)} of {len(known)}', f'{alone:.2f}', f'{after:.2f}',
            f'{after / alone:.2f}', *(f'{100 * share:.0f} %' for share in inside),
            f'{sum(not unit["prior"] for unit in zoomed)} of {len(zoomed)}']


PARTS = {'lost': lost, 'clips': clips, 'prior': prior, 'speed': speed, 'real': real}


def main() -> None:
    """Measure what is asked for."""
    parser = parser_with(__doc__, 'data', 'cache', 'seeds', 'again', seeds=SEEDS)
    parser.add_argument('parts', nargs='*', metavar='PART', help=f'of {", ".join(PARTS)}')
    parser.add_argument('--videos', type=int, default=4,
                        help='cameras with videos, in `lost` and `speed`')
    arguments = parser.parse_args()
    if unknown := set(arguments.parts) - set(PARTS):
        parser.error(f'there is no part {", ".join(sorted(unknown))}; choose of '
                     f'{", ".join(PARTS)}')
    for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ[name] = '1'
    path = arguments.out / 'fleet.json'
    found = load(path)
    with tempfile.TemporaryDirectory() as passing:
        asked = Asked(arguments.videos, arguments.seeds, arguments.cache or Path(passing),
                      arguments.data)
        for part in arguments.parts or PARTS:
            if part in found and not arguments.again:
                continue
            found |= {part: PARTS[part](arguments.out / 'fleet', asked),
                      'commits': {**found.get('commits', {}), part: commit()}}
            save(path, found)
    keep_table('fleet', report(found), arguments, found['commits'].values())


if __name__ == '__main__':
    main()
