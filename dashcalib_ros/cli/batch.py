# SPDX-License-Identifier: Apache-2.0
"""dashcalib batch: a fleet's clips -> a calibration for each camera, and tables of all."""
from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

from dashcalib_ros.cli.arguments import ACCEPTED, NOT_ENOUGH
from dashcalib_ros.cli.drive import read_config
from dashcalib_ros.cli.terminal import Screen, Stages, print_json, warn
from dashcalib_ros.config import Config
from dashcalib_ros.errors import Notice, counted
from dashcalib_ros.fleet.batch import Camera, cameras_of, problems, shard_of
from dashcalib_ros.fleet.batch import batch as calibrate_fleet
from dashcalib_ros.fleet.clips import ClipResult
from dashcalib_ros.fleet.engine import Engine, LocalEngine, RayEngine
from dashcalib_ros.fleet.manifest import Row, read_manifest
from dashcalib_ros.fleet.overview import LEVELS, duration
from dashcalib_ros.fleet.storage import joined, masked, remove, write
from dashcalib_ros.report.tables import line
from dashcalib_ros.standard_streams import write_stderr
from dashcalib_ros.workers.child import ChildWorker

# problems that are shown; the table has all
SHOWN = 10


def batch(args: argparse.Namespace) -> int:
    """Calibrate every camera of the manifest; return the exit code."""
    config = read_config(args)
    shard = shard_of(args.shard or '1/1')
    cameras = cameras_of(read_manifest(args.manifest, args.group_by), shard)
    # before hours of work, and not after them
    probe, out = joined(args.out, '.writable'), masked(args.out)
    write(probe, b'yes\n')
    remove(probe)
    progress = _Progress(sum(len(each.rows) for each in cameras),
                         Screen(args.quiet, to_stderr=args.json), Stages(args.quiet))
    if not args.quiet:  # before workers start, which takes a while
        write_stderr(
            f'dashcalib: {counted(progress.clips, "clip")} of {counted(len(cameras), "camera")}; '
            f'after Ctrl-C, the same command continues from what is in {out}')
    with closing(_engine(args, config)) as engine:
        try:
            with progress.stages:
                files, rigs = calibrate_fleet(cameras, args.out, config, engine,
                                              args.shard is None, progress.tell)
        except KeyboardInterrupt:
            warn([Notice('E-BATCH-INTERRUPTED', f'{progress.done} of '
                         f'{counted(progress.clips, "clip")} are done and kept in {out}: the '
                         f'same command continues from there')])
            raise
    name = '' if args.shard is None else f'-{shard[0]}-of-{shard[1]}'
    write(joined(args.out, f'effort{name}.json'), progress.effort_json(engine))
    if files:
        progress.screen.show(line(f'written to {out}: ' + ', '.join(files)))
    if args.json:
        print_json({**_as_dict(cameras, files), 'rigs': rigs})
    for name, verdicts in rigs.items():
        progress.screen.show(line(f'rig {name}: ' + (verdicts if isinstance(verdicts, str) else (
            ', '.join(f'{camera} {level}' for camera, level in verdicts.items())))))
    return _summarise(cameras, progress.screen)


def _engine(args: argparse.Namespace, config: Config) -> Engine:
    settings = config.fleet
    if args.address is not None:
        return RayEngine(settings.attempts, settings.memory_mb, args.address)
    # one a core, while memory lasts
    memory_mb = os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') // 2**20
    most = max(1, min(os.cpu_count() or 1, memory_mb // settings.memory_mb))
    count = 1 if args.shard is not None else args.workers or most
    return LocalEngine(settings.attempts, [ChildWorker() for _ in range(count)])


def _summarise(cameras: Sequence[Camera], screen: Screen) -> int:
    found = list(problems(cameras))
    for row, why in found[:SHOWN]:
        write_stderr(f'dashcalib: warning: {_problem(row, why)}')
    if len(found) > SHOWN:
        warn([Notice('E-CLIPS-UNREADABLE', f'{len(found) - SHOWN} more clips could not be read; '
                     f'the table of clips lists them')])
    verdicts = [camera.verdict for camera in cameras if camera.name]
    counts = ', '.join(f'{verdicts.count(level)} {level}' for level in LEVELS)
    screen.show(line(f'{counted(len(verdicts), "camera")}: {counts}; '
                     f'{counted(len(found), "clip")} could not be read'))
    return NOT_ENOUGH if found or 'refused' in verdicts else ACCEPTED


def _as_dict(cameras: Sequence[Camera], files: Sequence[str]) -> dict[str, Any]:
    return {'cameras': {camera.name: camera.verdict for camera in cameras if camera.name},
            'not_read': [{'row': row.number, 'clip': row.clip, 'why': why}
                         for row, why in problems(cameras)],
            'files': list(files)}


def _problem(row: Row, why: str) -> str:
    clip = f' ({row.clip})' if row.clip else ''
    # a name's own line ends must not begin a line
    return ' '.join(f'row {row.number}{clip}: {why}'.split())


@dataclass
class _Progress:
    clips: int
    screen: Screen
    stages: Stages
    started: float = field(default_factory=time.monotonic)
    done: int = 0
    read: int = 0
    video_s: float = 0.0

    def tell(self, camera: Camera, clip: ClipResult | None) -> None:
        if clip is None:
            if camera.own is None or not camera.own.again:
                self.screen.show(line(f'{camera.name}: {camera.verdict}'))
            return
        self.done += 1
        if not clip.again:
            self.read += 1
            self.video_s += clip.seconds
        self._show()

    def _show(self) -> None:
        passed = time.monotonic() - self.started
        rate = self.read / max(passed, 1e-9)
        left = (self.clips - self.done) / rate if rate else 0.0
        note = (f'{self.done} of {self.clips} clips, {60 * rate:.0f} a minute, '
                f'{self.video_s / max(passed, 1e-9):.1f} s of video a second, '
                f'{duration(left)} left')
        self.stages.show('clips', self.done / max(self.clips, 1), note)

    def effort_json(self, engine: Engine) -> bytes:
        gather_s = engine.cpu_s['gather_clip']
        return (json.dumps({
            'wall_s': time.monotonic() - self.started, 'clips_read': self.read,
            'video_s': self.video_s, 'gather_cpu_s': gather_s,
            'solve_cpu_s': sum(engine.cpu_s.values()) - gather_s,
            'peak_mb_of_a_worker': engine.peak_mb}, indent=2) + '\n').encode()
