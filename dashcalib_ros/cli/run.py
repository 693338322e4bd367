"""dashcalib run: a recorded drive -> calibration.yaml, result.json, report.html."""
from __future__ import annotations

import argparse
from datetime import datetime, timezone

from dashcalib_ros.cli import exit_codes
from dashcalib_ros.cli.drive import calibrate
from dashcalib_ros.cli.settings import read_config
from dashcalib_ros.cli.terminal import Stages, show, show_text, summary_of_files, warn
from dashcalib_ros.frames.mask_file import read_mask
from dashcalib_ros.inputs import open_frames
from dashcalib_ros.judgement import Calibration
from dashcalib_ros.report import Written, output_folder, write_results
from dashcalib_ros.report.files import ACCEPTED
from dashcalib_ros.report.tables import summary


def run(args: argparse.Namespace) -> int:
    """Calibrate, write the results, show them; return the verdict's exit code."""
    config = read_config(args)
    mask = None if args.mask is None else read_mask(args.mask)
    source = open_frames(args.input, topic=args.topic, fps=args.fps)
    if args.write_bag is not None:
        from dashcalib_ros.bags.camera_info import check_bag
        check_bag(args.input, source.topic, args.write_bag)
    with output_folder(args.out):
        with Stages() as stages:
            calibration = calibrate(source, config, mask, args.verbose, stages)
        written = write_results(calibration, args.out, created=now())
    warn((*calibration.warnings, *set_aside_lines(written)))
    with summary_of_files():
        show(summary(calibration))
        show_text('written: ' + ', '.join(map(str, written.files)))
    if args.write_bag is not None:
        _write_bag(args, str(source.topic), calibration)
    return exit_codes.of_verdict(calibration.verdict.level)


def _write_bag(args: argparse.Namespace, topic: str, calibration: Calibration) -> None:
    from dashcalib_ros.bags.camera_info import camera_info_topic, write_bag
    if calibration.verdict.level != 'accepted':
        warn([f'no bag was written: the calibration is {calibration.verdict.level}, not accepted'])
        return
    assert calibration.camera is not None
    count = write_bag(args.input, topic, calibration.camera, args.write_bag,
                      calibration.config.rectified)
    with summary_of_files():
        show_text(f'written: {args.write_bag} with {count} messages on '
                  f'{camera_info_topic(topic)}')


def set_aside_lines(written: Written) -> tuple[str, ...]:
    """Return a warning if an earlier calibration was set aside."""
    if written.set_aside is None:
        return ()
    old = written.set_aside.with_name(ACCEPTED)
    return (f'the calibration that was in {old} is now {written.set_aside}',)


def now() -> str:
    """Return the time as calibration.yaml's provenance has it."""
    return datetime.now(timezone.utc).isoformat(timespec='seconds')
