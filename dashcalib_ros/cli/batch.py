"""dashcalib batch: a fleet's clips -> a calibration for each camera, and tables of all."""
from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, field

from rich.text import Text

from dashcalib_ros.cli.arguments import ACCEPTED, NOT_ENOUGH
from dashcalib_ros.cli.drive import read_config
from dashcalib_ros.cli.terminal import Screen, Stages, warn
from dashcalib_ros.config import Config
from dashcalib_ros.errors import counted
from dashcalib_ros.fleet.batch import Camera, Fleet, problems, shard_of
from dashcalib_ros.fleet.batch import batch as calibrate_fleet
from dashcalib_ros.fleet.engine import Engine, OneWorker, RayEngine
from dashcalib_ros.fleet.manifest import Row, by_camera, read_manifest
from dashcalib_ros.fleet.storage import Folder
from dashcalib_ros.fleet.tasks import ClipResult, Effort
from dashcalib_ros.standard_streams import folded, write_stderr

# problems that are shown; the table has all
SHOWN = 10
EFFORT = 'effort.json'


def batch(args: argparse.Namespace) -> int:
    """Calibrate every camera of the manifest; return the exit code."""
    config = read_config(args)
    shard = None if args.shard is None else shard_of(args.shard)
    rows = read_manifest(args.manifest, args.group_by)
    cameras = list(by_camera(rows).values())
    mine = cameras if shard is None else cameras[shard[0] - 1::shard[1]]
    # before hours of work, and not after them
    Folder(args.out).write('.writable', b'')
    Folder(args.out).remove('.writable')
    progress = _Progress(sum(len(each) for each in mine), Screen(args.quiet), Stages(args.quiet))
    if not args.quiet:  # before workers start, which takes a while
        write_stderr(folded(
            f'dashcalib: {counted(progress.clips, "clip")} of {counted(len(mine), "camera")}; '
            f'Ctrl-C keeps what is done in {args.out}, and the same command goes on'))
    engine = _engine(args, config)
    try:
        with progress.stages:
            fleet = calibrate_fleet(rows, args.out, config, engine, shard, progress.tell)
    except KeyboardInterrupt:
        warn([f'{progress.done} of {counted(progress.clips, "clip")} done, and kept in '
              f'{args.out}: the same command goes on'])
        raise
    finally:
        engine.close()
    name = EFFORT if shard is None else f'effort-{shard[0]}-of-{shard[1]}.json'
    Folder(args.out).write(name, progress.effort_json())
    _summarise(fleet, args.out, progress.screen)
    return ACCEPTED if fleet.all_well else NOT_ENOUGH


def _engine(args: argparse.Namespace, config: Config) -> Engine:
    if args.address is None and (args.workers == 1 or args.shard is not None):
        return OneWorker(config.fleet.attempts)
    return RayEngine(config.fleet.attempts, config.fleet.memory_mb, args.workers, args.address)


def _summarise(fleet: Fleet, out: str, screen: Screen) -> None:
    found = list(problems(fleet))
    lines = [_problem(row, why) for row, why in found[:SHOWN]]
    if len(found) > SHOWN:
        lines.append(f'{len(found) - SHOWN} more clips could not be read: see the table of clips')
    warn(lines)
    verdicts = [camera.verdict for camera in fleet.cameras if camera.name]
    counts = ', '.join(f'{verdicts.count(level)} {level}'
                       for level in ('accepted', 'weak', 'refused'))
    if fleet.files:
        screen.show(Text(f'written to {out}: ' + ', '.join(fleet.files)))
    screen.show(Text(f'{counted(len(verdicts), "camera")}: {counts}; '
                     f'{counted(len(found), "clip")} could not be read'))


def _problem(row: Row, why: str) -> str:
    clip = f' ({row.clip})' if row.clip else ''
    return f'row {row.number}{clip}: {why}'


@dataclass
class _Progress:
    """Shows rate and time left, and each camera as it is solved; adds up what tasks took."""

    clips: int
    screen: Screen
    stages: Stages
    started: float = field(default_factory=time.monotonic)
    done: int = 0
    read: int = 0
    video_s: float = 0.0
    cpu_s: dict[str, float] = field(default_factory=lambda: {'gather': 0.0, 'solve': 0.0})
    peak_mb: float = 0.0

    def tell(self, camera: Camera, clip: ClipResult | None, effort: Effort | None) -> None:
        """Take the news of a clip, or of a camera that is solved."""
        if effort is not None:
            self.cpu_s['solve' if clip is None else 'gather'] += effort.cpu_s
            self.peak_mb = max(self.peak_mb, effort.peak_mb)
        if clip is None:
            if effort is None or not effort.again:
                self.screen.show(Text(f'{camera.name}: {camera.verdict}'))
            return
        self.done += 1
        if effort is not None and not effort.again:
            self.read += 1
            self.video_s += clip.seconds
        self._show()

    def _show(self) -> None:
        passed = time.monotonic() - self.started
        rate = self.read / max(passed, 1e-9)
        left = (self.clips - self.done) / rate if rate else 0.0
        note = (f'{self.done} of {self.clips} clips, {60 * rate:.0f} a minute, '
                f'{self.video_s / max(passed, 1e-9):.1f} s of video a second, '
                f'{_duration(left)} left')
        self.stages.show('clips', self.done / max(self.clips, 1), note)

    def effort_json(self) -> bytes:
        """Return what the run took, for people who plan larger ones."""
        return (json.dumps({
            'wall_s': time.monotonic() - self.started, 'clips_read': self.read,
            'video_s': self.video_s, 'gather_cpu_s': self.cpu_s['gather'],
            'solve_cpu_s': self.cpu_s['solve'], 'peak_mb_of_a_worker': self.peak_mb},
            indent=2) + '\n').encode()


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f'{seconds:.0f} s'
    return f'{seconds / 60:.0f} min' if seconds < 7200 else f'{seconds / 3600:.1f} h'
