"""dashcalib run, turns (detection only) and demo (a rendered drive with a known lens)."""
from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from time import perf_counter

from rich.console import Group, RenderableType
from rich.text import Text

from dashcalib_ros.camera import Radial, camera_of
from dashcalib_ros.cli.arguments import ACCEPTED, exit_code
from dashcalib_ros.cli.drive import open_drive, read_config
from dashcalib_ros.cli.terminal import Screen, Stages, show, warn
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.errors import InputError, OutputError, counted
from dashcalib_ros.input import FrameSource
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.judge import Calibration
from dashcalib_ros.report import (
    NamedCamera,
    Written,
    calibrated_camera,
    compare,
    output_folder,
    result_json,
    write_results,
    write_text,
)
from dashcalib_ros.report.files import ACCEPTED as ACCEPTED_FILE
from dashcalib_ros.report.files import TRUTH
from dashcalib_ros.report.result import plain_values
from dashcalib_ros.report.tables import (
    TextTable,
    against_truth,
    conclusion,
    line,
    next_step,
    summary,
)
from dashcalib_ros.session import Drive, calibrate_drive, feed
from dashcalib_ros.standard_streams import write_stdout
from dashcalib_ros.whole_files import temporary_folder


def run(args: argparse.Namespace) -> int:
    """Calibrate, write the results, show them; return the verdict's exit code."""
    config = read_config(args)
    drive = open_drive(args)
    screen = Screen(args.quiet, to_stderr=bool(args.json))
    with output_folder(args.out):
        if args.write_bag is not None:
            _check_bag(args, drive.source)
        with Stages(args.quiet) as stages:
            calibration = calibrate_drive(drive, config, stages, args.verbose)
        try:
            written = write_results(calibration, args.out, created=now())
        except OutputError:
            # a full disk must not hide what an hour of work has found
            _tell(args, calibration, screen, Written(()))
            raise
    _tell(args, calibration, screen, written)
    if args.write_bag is not None:
        _write_bag(args, str(drive.source.topic), calibration, screen)
    screen.show(next_step(calibration.verdict))
    return exit_code(calibration.verdict.level)


def _tell(args: argparse.Namespace, calibration: Calibration, screen: Screen, written: Written
          ) -> None:
    _warn(calibration, written)
    if args.json:
        write_stdout(result_json(calibration).rstrip('\n'))
    files = [_files(args.out, written.files)] if written.files else []
    screen.show(conclusion(calibration.verdict), summary(calibration), *files)


def _check_bag(args: argparse.Namespace, source: FrameSource) -> None:
    from dashcalib_ros.input.bag_write import check_bag
    if len(args.input) > 1 or source.name != str(Path(args.input[0])):
        raise InputError('--write-bag copies one bag: calibrate with all of them, then run it on '
                         'each bag alone')
    check_bag(args.input[0], source.topic, args.write_bag)


def _write_bag(args: argparse.Namespace, topic: str, calibration: Calibration, screen: Screen
               ) -> None:
    from dashcalib_ros.input.bag_write import camera_info_topic, write_bag
    if calibration.verdict.level != 'accepted':
        warn([f'no bag was written: the calibration is {calibration.verdict.level}, not accepted'])
        return
    assert calibration.camera is not None
    count = write_bag(args.input[0], topic, calibration.camera, args.write_bag,
                      calibration.config.rectified)
    screen.show(line(f'written: {args.write_bag} with {count} messages on '
                     f'{camera_info_topic(topic)}'))


def _files(folder: Path, files: Sequence[Path]) -> Text:
    """Return a line that tells which files are in the output folder now."""
    return line(f'written to {folder}: {", ".join(file.name for file in files)}')


def _warn(calibration: Calibration, written: Written) -> None:
    """Print the calibration's warnings, and whether an earlier one was set aside."""
    warn(calibration.warnings)
    if written.set_aside is not None:
        old = written.set_aside.with_name(ACCEPTED_FILE)
        warn([f'the calibration that was in {old} is now {written.set_aside}'])


def now() -> str:
    """Return the time as calibration.yaml's provenance has it."""
    return datetime.now(timezone.utc).isoformat(timespec='seconds')


COLUMNS = ('at s', 'frame', 'from', 'to', 'images', 'prominence')
PROMINENCE = ('prominence: how far a turn stands out from the driving before and after it, as a '
              'share of the picture width; frames are counted from 0')


def turns(args: argparse.Namespace) -> int:
    """List the turns found, best first. The exit code is 0, also if there are none."""
    config = read_config(args)
    drive = open_drive(args)
    source, detection = drive.source, Detection(config, drive.mask)
    with Stages(args.quiet) as stages:
        frames = feed(detection, drive, stages)
    detection.finish()
    found = detection.turns()
    warn((*source.warnings, *detection.warnings()))
    if args.json:
        write_stdout(json.dumps(plain_values({
            'input': source.name, 'frames': frames,
            'turns': [{'center': turn.center, 'first': turn.first, 'last': turn.last,
                       'stamp': turn.stamp_s, 'prominence': turn.prominence,
                       'images': turn.images} for turn in found],
            'warnings': (*source.warnings, *detection.warnings())}), indent=2, allow_nan=False))
        return ACCEPTED
    if found:
        show(TextTable(COLUMNS, [
            (f'{turn.stamp_s - detection.start_s:.1f}', str(turn.center), str(turn.first),
             str(turn.last), str(turn.images), f'{turn.prominence:.4f}') for turn in found]))
        show(line(PROMINENCE))
    show(Group(*map(line, _conclusion(len(found), config.turns.wanted, frames))))
    return ACCEPTED


def _conclusion(found: int, wanted: int, frames: int) -> tuple[str, str]:
    """Return what there is, and what to do next."""
    return (f'{found} of {counted(wanted, "turn")} wanted, in {counted(frames, "frame")}',
            'next: dashcalib run, with the same INPUT' if found else
            'next: record a drive with turns at crossings, in daylight')


def demo(args: argparse.Namespace) -> int:
    """Render, calibrate, compare with the truth; return the verdict's exit code."""
    from dashcalib_ros.demo import demo_drive, render_to_bag
    started = perf_counter()
    config = read_config(args)
    drive = demo_drive(config.seed)
    with output_folder(args.out) as out:
        with Stages(args.quiet) as stages, _bag_path(out, args.keep_bag) as bag:
            stages.show('rendering the drive')
            render_to_bag(drive, bag)
            calibration = calibrate_drive(Drive(open_frames(bag)), config, stages, args.verbose)
        calibration = dataclasses.replace(calibration, input_name=f'demo drive {config.seed}')
        size = calibration.image_size
        truth = NamedCamera('truth', camera_of(Radial.model, size, list(drive.truth.values())))
        written = write_results(calibration, out, created=now(), truth=truth)
        values = {**drive.truth, 'width': size[0], 'height': size[1]}
        write_text(out / TRUTH, json.dumps(values, allow_nan=False) + '\n')
    _warn(calibration, written)
    compared: list[RenderableType] = [line('no estimate to compare with the truth')]
    if calibration.camera is not None:
        compared = [line(''), line('against the truth'),
                    against_truth(compare(calibrated_camera(calibration), truth))]
    files = [*written.files, out / TRUTH, *([out / 'bag'] if args.keep_bag else [])]
    Screen(args.quiet).show(
        conclusion(calibration.verdict), summary(calibration), *compared, _files(out, files),
        line(f'rendered and calibrated in {perf_counter() - started:.0f} s'),
        next_step(calibration.verdict))
    return exit_code(calibration.verdict.level)


@contextmanager
def _bag_path(out: Path, keep: bool) -> Iterator[Path]:
    if keep:
        if (out / 'bag').exists():
            raise OutputError(f'{out / "bag"} exists; remove it or choose another --out')
        yield out / 'bag'
        return
    with temporary_folder() as folder:
        yield folder / 'bag'
