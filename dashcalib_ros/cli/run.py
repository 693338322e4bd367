"""dashcalib run: a recorded drive -> calibration.yaml, result.json, report.html."""
from __future__ import annotations

import argparse
from datetime import datetime, timezone

from dashcalib_ros.cli import exit_codes
from dashcalib_ros.cli.drive import calibrate
from dashcalib_ros.cli.settings import read_config, read_mask
from dashcalib_ros.cli.terminal import Stages, show, show_text, warn
from dashcalib_ros.frames import open_frames
from dashcalib_ros.report import output_folder, write_results
from dashcalib_ros.report.tables import summary


def run(args: argparse.Namespace) -> int:
    """Calibrate, write the results, show them; return the verdict's exit code."""
    config = read_config(args)
    mask = read_mask(args.mask)
    source = open_frames(args.input, topic=args.topic, fps=args.fps)
    with output_folder(args.out):
        with Stages() as stages:
            calibration = calibrate(source, config, mask, args.verbose, stages)
        written = write_results(calibration, args.out, created=now())
    warn(calibration.warnings)
    show(summary(calibration))
    show_text('written: ' + ', '.join(map(str, written)))
    return exit_codes.of_verdict(calibration.verdict.level)


def now() -> str:
    """Return the time as calibration.yaml's provenance has it."""
    return datetime.now(timezone.utc).isoformat(timespec='seconds')
