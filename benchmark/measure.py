# SPDX-License-Identifier: Apache-2.0
"""What every benchmark here needs: errors, a process of its own for each measurement, files."""
from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

# what tests and benchmarks share; who imports of it imports this module before
sys.path.append(str(Path(__file__).resolve().parents[1] / 'testing'))
from mapping import is_fisheye, mapping_error, model_of
from result_tables import commit as commit
from result_tables import keep_table as keep_table
from result_tables import table as table

from dashcalib_ros import Calibrator, Config
from dashcalib_ros.arrays import plain_values
from dashcalib_ros.detect import Turn
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.errors import DashcalibError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.motion import SensorStream
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.judge.conclude import conclude, evidence_of_detection
from dashcalib_ros.reconstruct import load as load_engine
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve import solve
from dashcalib_ros.workers.child import ChildWorker
from dashcalib_ros.workers.pool import ScenePool
from dashcalib_ros.workers.worker import Progress

KEYS = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2')
# of all models; k1 and k2 of a fisheye are not those of the others
ALL_KEYS = (*KEYS, 'p1', 'p2', 'k3', 'k4')
FALSE_PERCENT = 3.0
SAMPLE_S = 0.25


class Seeds(argparse.Action):
    """Takes numbers and ranges: 0 1 2, 4000-4029."""

    def __call__(self, parser: argparse.ArgumentParser, given: argparse.Namespace, values: Any,
                 option: str | None = None) -> None:
        """Keep the numbers."""
        ends = [(first, last or first) for first, _, last in (
            text.partition('-') for text in values)]
        setattr(given, self.dest, [n for first, last in ends
                                   for n in range(int(first), int(last) + 1)])


OPTIONS: dict[str, dict[str, Any]] = {
    'seeds': {'nargs': '+', 'action': Seeds, 'default': [0, 1, 2], 'metavar': 'N or FIRST-LAST'},
    'drives': {'nargs': '+', 'metavar': 'NAME', 'help': 'default: all'},
    'data': {'type': Path, 'help': 'a folder with the recorded drives'},
    'cache': {'type': Path, 'help': 'where rendered pictures are kept'},
    'out': {'type': Path, 'default': Path('measured')},
    'results': {'action': 'store_true', 'help': 'write the table into benchmark/results/, too'},
    'again': {'action': 'store_true', 'help': 'run what has a row, too'},
}


@dataclass(frozen=True)
class Outcome:
    """What became of a function. value: what it returned; failure: why it did not, or ''.

    seconds: wall clock, starting the process included. peak_mb: proportional set size of the
    process and all its children together.
    """

    value: Any
    failure: str
    seconds: float
    peak_mb: float


def isolated(function: Callable[..., Any], *arguments: Any, limit_s: float = 3600.0) -> Outcome:
    """Run a module-level function in a spawned process, which may abort, hang or hoard memory."""
    context = multiprocessing.get_context('spawn')
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(sender, function, arguments))
    started = time.monotonic()
    process.start()
    sender.close()
    assert process.pid is not None
    peak, value, failure = 0.0, None, ''
    try:
        while not receiver.poll(SAMPLE_S):
            peak = max(peak, memory_mb(process.pid))
            if time.monotonic() - started > limit_s:
                failure = f'not done after {limit_s:.0f} s'
                break
        else:
            try:
                value, failure = receiver.recv()
            except EOFError:
                process.join()
                failure = f'the process died (exit code {process.exitcode})'
        return Outcome(value, failure, time.monotonic() - started, peak)
    finally:
        for pid in (*_descendants(process.pid), process.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.join()


def _answer(sender: Connection, function: Callable[..., Any], arguments: Sequence[Any]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        sender.send((function(*arguments), ''))
    except Exception as error:
        sender.send((None, f'{type(error).__name__}: {error}'))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def memory_mb(pid: int) -> float:
    """Return what a process and its children have resident, shared pages by their share, MB."""
    total = 0
    for member in (pid, *_descendants(pid)):
        with contextlib.suppress(OSError):
            for line in Path(f'/proc/{member}/smaps_rollup').read_text().splitlines():
                if line.startswith('Pss:'):
                    total += int(line.split()[1])
    return total / 1024


def processor_s() -> float:
    """Return the processor time of this process and its children, also of those that ended, s."""
    ticks = 0
    for member in (os.getpid(), *_descendants(os.getpid())):
        with contextlib.suppress(OSError):
            fields = Path(f'/proc/{member}/stat').read_text().rpartition(')')[2].split()
            ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf('SC_CLK_TCK')


def unit_s() -> float:
    """Return the processor time of a fixed piece of work, s: COLMAP's SIFT of 40 pictures.

    One machine is half as fast again from one hour to the next; in units, figures compare. It is
    run in a process of its own, with one thread.
    """
    outcome = isolated(_sift)
    if outcome.failure:
        raise RuntimeError(outcome.failure)
    return float(outcome.value)


def _sift() -> float:
    import zlib  # noqa: F401  before pycolmap

    import cv2
    import numpy as np
    import pycolmap
    pycolmap.logging.minloglevel = 2
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    sift, rng = pycolmap.Sift(options, pycolmap.Device.cpu), np.random.default_rng(0)
    pictures = [cv2.GaussianBlur(rng.integers(0, 256, (240, 320), np.uint8), (0, 0), 3.0)
                for _ in range(40)]
    before = time.process_time()
    for picture in pictures:
        sift.extract(np.asarray(picture, np.uint8))
    return time.process_time() - before


def _descendants(pid: int) -> list[int]:
    children: dict[int, list[int]] = {}
    for stat in Path('/proc').glob('[0-9]*/stat'):
        with contextlib.suppress(OSError):
            parent = int(stat.read_text().rpartition(')')[2].split()[1])
            children.setdefault(parent, []).append(int(stat.parent.name))
    found = list(children.get(pid, []))
    for child in found:
        found += children.get(child, [])
    return found


class Stopwatch:
    """Seconds by the stage that is under way; the first one has begun."""

    def __init__(self, stage: str, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[str, float] = {}
        self._clock = clock
        self._stage, self._since = stage, clock()

    def enter(self, stage: str, share: float = 0.0) -> None:
        """Begin another stage; takes what a calibration's progress is told."""
        now = self._clock()
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now


def calibrate(frames: Iterable[Frame], config: Config, motion: SensorStream | None = None
              ) -> tuple[CalibrationData, dict[str, float]]:
    """Return the calibration, and the seconds of each stage.

    decode: getting the frames; push: all of detection, with waiting for scenes; then whatever
    stages calibrate() names. total: without decode.
    """
    watch = Stopwatch('decode')
    with Calibrator(config) as calibrator:
        if motion is not None:
            calibrator.sense(motion)
        for frame in frames:
            watch.enter('push')
            calibrator.push(frame)
            watch.enter('decode')
        watch.enter('conclude')
        result = calibrator.calibrate(watch.enter)
        watch.enter('closing')
    seconds = {**watch.seconds, 'total': sum(watch.seconds.values()) - watch.seconds['decode']}
    return result, {name: round(value, 2) for name, value in seconds.items()}


def reconstructed(detection: Detection, turns: Sequence[Turn], config: Config) -> list[Scene]:
    """Return the scenes of these turns, the best first; processes start cold."""
    pool = ScenePool(config, lambda: ChildWorker(threads=config.workers),
                     partial(load_engine, config.reconstruct.used))
    try:
        for turn in turns:
            pool.submit(turn, detection.valid())
        pool.wait(lambda: not pool.unbuilt())
        built = pool.scenes()
    finally:
        pool.close()
    return [scene for turn in turns if (scene := built[turn.id]) is not None]


def solved(detection: Detection, scenes: Sequence[Scene], config: Config,
           tell: Progress = lambda stage, share: None) -> CalibrationData:
    """Return what these scenes say together; tell: is called as each stage begins."""
    worker = ChildWorker()
    try:
        solution = worker.call(solve, scenes, config, progress=tell)
        tell('judging', 0.0)
        return conclude(solution, evidence_of_detection(detection, scenes), config)
    finally:
        # its processor time counts for the stages as long as it lives
        worker.close()


def errors(estimate: Mapping[str, Any], truth: Mapping[str, Any],
           sigma: Mapping[str, float] | None = None,
           known: Sequence[str] = ALL_KEYS) -> dict[str, Any]:
    """Return error (estimate - truth), percent (absolute, None where the truth is 0) and z.

    They are of the parameters that both have, and left out where one is a fisheye and the other
    is not. known: which of the truth's parameters are good enough to compare with.
    """
    found: dict[str, Any] = {'estimate': {key: estimate[key] for key in ALL_KEYS
                                          if key in estimate}}
    if sigma is not None:
        found['sigma'] = {key: sigma[key] for key in found['estimate'] if key in sigma}
    if is_fisheye(estimate) != is_fisheye(truth):
        return found
    off = {key: value - truth[key] for key, value in found['estimate'].items()
           if key in truth and key in known}
    found |= {'error': off,
              'percent': {key: 100 * abs(value / truth[key]) if abs(truth[key]) > 1e-9 else None
                          for key, value in off.items()}}
    if sigma is not None:
        found['z'] = {key: value / sigma[key] for key, value in off.items() if sigma.get(key)}
    return found


def summarised(result: CalibrationData, truth: Mapping[str, Any],
               known: Sequence[str] = ALL_KEYS) -> dict[str, Any]:
    """Return a calibration as a row of results; known: see errors()."""
    row: dict[str, Any] = {
        'verdict': result.verdict.level, 'reasons': [*map(str, result.verdict.reasons)],
        'frames': result.frames, 'turns_used': sum(turn.used for turn in result.turns),
        'turns': [[turn.center, turn.used, turn.yaw_deg] for turn in result.turns],
        'misfits': [turn.misfit for turn in result.turns], 'timing': result.timing,
        'truth_model': model_of(truth), 'warnings': [*map(str, result.warnings)],
        # of an older calibration there is none
        'fixed_camera': {kind: found['strength'] for kind, found in
                         result.details.get('fixed_camera', {}).items()}}
    if result.camera is not None and result.intrinsics is not None:
        estimate = {**result.intrinsics, 'model': result.camera.model}
        row |= errors(estimate, truth, result.sigma, known)
        row['model'] = result.camera.model
        row['mapping_px'] = mapping_error(estimate, truth, result.image_size)
        # an older calibration has none
        row['sigma_px'] = getattr(result, 'sigma_px', None)
    return dict(plain_values(row))


def error_cells(row: Mapping[str, Any]) -> list[str]:
    """Return the errors of KEYS as cells: percent of the truth, or 'abs' where that is 0."""
    cells = []
    for key in KEYS:
        if key not in row.get('error', {}):
            cells.append('')
        elif row['percent'][key] is None:
            cells.append(f'{abs(row["error"][key]):.3f} abs')
        else:
            cells.append(f'{row["percent"][key]:.2f}')
    return cells


def mapping_cell(row: Mapping[str, Any]) -> str:
    """Return the mapping error as a cell, px."""
    error = row.get('mapping_px')
    return '' if error is None else f'{error:.2f}'


def load(path: Path) -> dict[str, Any]:
    """Return the results that are there already."""
    return dict(json.loads(path.read_text())) if path.exists() else {}


def done(row: Mapping[str, Any] | None) -> bool:
    """Return whether a row needs not be measured again; one that failed is tried anew."""
    return row is not None and row.get('verdict') != 'failed'


def save(path: Path, data: Mapping[str, Any]) -> None:
    """Write results; an interrupted run leaves the former file or the new one, whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix('.new')
    fresh.write_text(json.dumps(plain_values(data), indent=1) + '\n')
    fresh.replace(path)


def parser_with(doc: str | None, *options: str, drives: Iterable[str] = (),
                seeds: Iterable[int] | None = None) -> argparse.ArgumentParser:
    """Return a parser with --out, --results and some more of the OPTIONS that benchmarks share.

    doc: the module's. drives, seeds: the defaults.
    """
    # a script's own option of the same name counts
    parser = argparse.ArgumentParser(description=(doc or '').split('\n')[0],
                                     conflict_handler='resolve')
    for option in dict.fromkeys((*options, 'out', 'results')):
        parser.add_argument(f'--{option}', **OPTIONS[option])
    if drives:
        parser.set_defaults(drives=list(drives))
    if seeds is not None:
        parser.set_defaults(seeds=list(seeds))
    return parser


def complain(error: DashcalibError | str) -> None:
    """Say on stderr what went wrong, and go on."""
    print(error, file=sys.stderr, flush=True)
