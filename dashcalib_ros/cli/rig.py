# SPDX-License-Identifier: Apache-2.0
"""dashcalib rig: several cameras of one car, and where each sits."""
from __future__ import annotations

import argparse
from pathlib import Path

from dashcalib_ros.cli.arguments import ACCEPTED, NOT_ENOUGH, UsageError
from dashcalib_ros.cli.drive import read_config
from dashcalib_ros.cli.run import now
from dashcalib_ros.cli.terminal import Screen, Stages, warn
from dashcalib_ros.formats.rig import RIG, RIG_FORMATS, placed_cameras, rig_files, rig_json
from dashcalib_ros.report import output_folder, write_results, write_text
from dashcalib_ros.report.files import REPORT
from dashcalib_ros.report.rig import rig_html, rig_lines, witness_lines
from dashcalib_ros.report.tables import line
from dashcalib_ros.rig_session import Rig, open_camera, rig_of_drives
from dashcalib_ros.standard_streams import write_stdout


def rig(args: argparse.Namespace) -> int:
    """Place the cameras, write rig.json and their results; return the exit code."""
    config, inputs = read_config(args), named(args.cameras)
    clock = args.base or next(iter(inputs))
    drives = {name: open_camera(path, args.fps, args.motion if name == clock else None)
              for name, path in inputs.items()}
    screen = Screen(args.quiet, to_stderr=args.json)
    with output_folder(args.out):
        with Stages(args.quiet) as stages:
            found = rig_of_drives(drives, args.base, config, stages, match=args.match)
        write_rig(found, args.out)
    warn((*found.rig.warnings, *(
        reason for camera in found.rig.cameras.values() for reason in camera.reasons)))
    if args.json:
        write_stdout(rig_json(found.rig).rstrip('\n'))
    screen.show(*(line(text) for text in rig_lines(found.rig.cameras)),
                *map(line, witness_lines(found.rig)),
                line(f'written to {args.out}: {RIG}, {REPORT}, {", ".join(RIG_FORMATS)} and a '
                     f'folder for each camera'))
    return ACCEPTED if found.rig.accepted else NOT_ENOUGH


def named(cameras: list[str]) -> dict[str, str]:
    """Return the inputs by the cameras' names. Raises UsageError."""
    found: dict[str, str] = {}
    for each in cameras:
        name, equals, path = each.partition('=')
        if not equals or not path or not name.replace('-', '_').isidentifier():
            raise UsageError('E-RIG-ARGUMENT', f'{each!r} is not like front=front.mp4')
        if name in found:
            raise UsageError('E-RIG-NAME-TWICE', f'two cameras are called {name}: give each a '
                                                 f'name of its own')
        found[name] = path
    return found


def write_rig(found: Rig, out: Path) -> None:
    """Write rig.json, the same for other programs, and each camera's results in its folder."""
    for name, calibration in found.calibrations.items():
        write_results(calibration, out / name, created=now())
    cameras = placed_cameras(found.rig, found.calibrations)
    files, missing = rig_files(found.rig, cameras)
    warn(missing)
    for name in RIG_FORMATS.keys() - files.keys():
        (out / name).unlink(missing_ok=True)
    for name, text in {REPORT: rig_html(found.rig, cameras), **files}.items():
        write_text(out / name, text)
