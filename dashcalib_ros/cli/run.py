"""dashcalib run: a recorded drive -> calibration.yaml, result.json, report.html."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path

from rich.text import Text

from dashcalib_ros.cli.arguments import exit_code
from dashcalib_ros.cli.drive import calibrate, open_drive, read_config, read_sensors
from dashcalib_ros.cli.terminal import Screen, Stages, warn
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import FrameSource
from dashcalib_ros.judge import Calibration
from dashcalib_ros.report import Written, output_folder, result_json, write_results
from dashcalib_ros.report.files import ACCEPTED
from dashcalib_ros.report.tables import conclusion, next_step, summary
from dashcalib_ros.standard_streams import write_stdout


def run(args: argparse.Namespace) -> int:
    """Calibrate, write the results, show them; return the verdict's exit code."""
    config = read_config(args)
    source, mask = open_drive(args)
    motion = read_sensors(args)
    if args.write_bag is not None:
        _check_bag(args, source)
    with output_folder(args.out):
        with Stages(args.quiet) as stages:
            calibration = calibrate(source, config, mask, args.verbose, stages, motion)
        written = write_results(calibration, args.out, created=now())
    warn((*calibration.warnings, *set_aside_lines(written)))
    if args.json:
        write_stdout(result_json(calibration).rstrip('\n'))
    screen = Screen(args.quiet, to_stderr=bool(args.json))
    screen.show(conclusion(calibration.verdict))
    screen.show(summary(calibration))
    screen.show(Text(files_line(args.out, written.files)))
    if args.write_bag is not None:
        _write_bag(args, str(source.topic), calibration, screen)
    screen.show(next_step(calibration.verdict))
    return exit_code(calibration.verdict.level)


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
    screen.show(Text(f'written: {args.write_bag} with {count} messages on '
                     f'{camera_info_topic(topic)}'))


def files_line(folder: Path, files: Sequence[Path]) -> str:
    """Return a line that tells which files are in the output folder now."""
    return f'written to {folder}: {", ".join(file.name for file in files)}'


def set_aside_lines(written: Written) -> tuple[str, ...]:
    """Return a warning if an earlier calibration was set aside."""
    if written.set_aside is None:
        return ()
    old = written.set_aside.with_name(ACCEPTED)
    return (f'the calibration that was in {old} is now {written.set_aside}',)


def now() -> str:
    """Return the time as calibration.yaml's provenance has it."""
    return datetime.now(timezone.utc).isoformat(timespec='seconds')
