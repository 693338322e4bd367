"""dashcalib demo: a rendered drive with a known lens, calibrated from a real ROS 2 bag."""
from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter

from rich.text import Text

from dashcalib_ros.camera import Radial, camera_of
from dashcalib_ros.cli.arguments import exit_code
from dashcalib_ros.cli.drive import calibrate, read_config
from dashcalib_ros.cli.run import files_line, now, set_aside_lines
from dashcalib_ros.cli.terminal import Screen, Stages, warn
from dashcalib_ros.demo import demo_drive, render_to_bag
from dashcalib_ros.errors import OutputError
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.report import (
    NamedCamera,
    calibrated_camera,
    compare,
    output_folder,
    write_results,
    write_text,
)
from dashcalib_ros.report.files import TRUTH
from dashcalib_ros.report.tables import against_truth, conclusion, next_step, summary


def demo(args: argparse.Namespace) -> int:
    """Render, calibrate, compare with the truth; return the verdict's exit code."""
    started = perf_counter()
    config = read_config(args)
    drive = demo_drive(config.seed)
    with output_folder(args.out) as out:
        with Stages(args.quiet) as stages, _bag_path(out, args.keep_bag) as bag:
            stages.show('rendering the drive')
            render_to_bag(drive, bag)
            calibration = calibrate(open_frames(bag), config, None, args.verbose, stages)
        calibration = dataclasses.replace(calibration, input_name=f'demo drive {config.seed}')
        size = calibration.image_size
        truth = NamedCamera('truth', camera_of(Radial.model, size, list(drive.truth.values())))
        written = write_results(calibration, out, created=now(), truth=truth)
        values = {**drive.truth, 'width': size[0], 'height': size[1]}
        write_text(out / TRUTH, json.dumps(values, allow_nan=False) + '\n')
    warn((*calibration.warnings, *set_aside_lines(written)))
    files = [*written.files, out / TRUTH, *([out / 'bag'] if args.keep_bag else [])]
    screen = Screen(args.quiet)
    screen.show(conclusion(calibration.verdict))
    screen.show(summary(calibration))
    if calibration.camera is None:
        screen.show(Text('no estimate to compare with the truth'))
    else:
        screen.show(Text('\nagainst the truth'))
        screen.show(against_truth(compare(calibrated_camera(calibration), truth)))
    screen.show(Text(files_line(out, files)))
    screen.show(Text(f'rendered and calibrated in {perf_counter() - started:.0f} s'))
    screen.show(next_step(calibration.verdict))
    return exit_code(calibration.verdict.level)


@contextmanager
def _bag_path(out: Path, keep: bool) -> Iterator[Path]:
    if keep:
        if (out / 'bag').exists():
            raise OutputError(f'{out / "bag"} exists; remove it or choose another --out')
        yield out / 'bag'
        return
    with tempfile.TemporaryDirectory(prefix='dashcalib-demo-') as folder:
        yield Path(folder) / 'bag'
