# SPDX-License-Identifier: Apache-2.0
"""dashcalib check: whether a calibration explains a drive."""
from __future__ import annotations

import argparse
from collections.abc import Sequence

from dashcalib_ros.cli.arguments import ACCEPTED, NOT_ENOUGH, WRONG, UsageError
from dashcalib_ros.cli.drive import open_drive, read_config
from dashcalib_ros.cli.terminal import Stages, print_json, show, warn
from dashcalib_ros.errors import InputError, counted
from dashcalib_ros.formats.load import load_with_faults
from dashcalib_ros.input.inputs import fits_bag
from dashcalib_ros.input.motion import SensorStream
from dashcalib_ros.input.motion_files import bag_motion, is_motion, read_motion
from dashcalib_ros.input.poses import Poses, read_poses
from dashcalib_ros.judge import Check, Odometry, path_files, with_faults
from dashcalib_ros.report import answer_dict, check_writable, write_text
from dashcalib_ros.report.compare import mount_dict
from dashcalib_ros.report.tables import TextTable, labelled, line
from dashcalib_ros.report.wording import mounts_text
from dashcalib_ros.session import check_drive, in_order
from dashcalib_ros.standard_streams import write_stdout

EXIT_CODES = {'right': ACCEPTED, 'differs': ACCEPTED, 'wrong': WRONG, 'cannot tell': NOT_ENOUGH}
# what the poses show, by its name in the JSON
MEASURED = {'rotation_deg': ('rotation error, degrees', 1.0),
            'rotation_deg_per_100m': ('the same, in 100 m', 1.0),
            'scale_drift': ('change of scale within a turn, %', 100.0)}


def check(args: argparse.Namespace) -> int:
    """Calibrate the drive, ask it about the calibration; return the answer's exit code."""
    config = read_config(args)
    if not args.input:
        # a bag's own camera_info, beside its pictures
        if not fits_bag(args.calibration):
            raise UsageError('E-INPUT-MISSING',
                             'INPUT, the drive, is missing: only a bag has its calibration beside '
                             'its pictures; see dashcalib check --help')
        args.input = [str(args.calibration)]
        named = load_with_faults(args.calibration, args.topic)
        drive = open_drive(args)
    else:
        with in_order(args.calibration, args.input):
            drive = open_drive(args)
            named = load_with_faults(args.calibration, size=drive.source.first_size)
    if args.mounting and named.mount is None:
        raise UsageError('E-MOUNT-UNKNOWN',
                         f'{named.name} has no mounting of the camera: use a result.json or '
                         f'calibration.yaml that dashcalib run has written')
    poses, track = _poses(args)
    warn(poses.warnings if poses else ())
    if args.out is not None:
        if args.poses is None:
            raise UsageError('E-OUT-WITHOUT-POSES',
                             '--out is for the paths that --poses compares; add --poses FILE')
        check_writable(args.out)
    with Stages(args.quiet) as stages:
        checked = check_drive(drive, named, config, stages, poses, track, args.verbose)
    found, motion = with_faults(checked.check, named.faults), checked.odometry
    calibration, changes = checked.calibration, checked.changes
    warn((*named.warnings, *drive.source.warnings, *calibration.warnings,
          *(track.warnings if track else ())))
    now, before = calibration.mount, named.mount
    if args.json:
        print_json(answer_dict(found, changes, motion, mount_dict(now, before)))
    else:
        _show(found, motion, changes)
        if now is not None and before is not None:
            show(line(f'- {mounts_text(now, before)}'))
        elif args.mounting:
            show(line('- mounting: this drive does not determine it; record a longer straight '
                      'stretch'))
        show(line(f'next: {found.next_step}'))
    if motion is not None and args.out is not None:
        for name, text in path_files(motion).items():
            write_text(args.out / name, text)
        if not args.json:
            write_stdout(f'written: {args.out}: the paths as TUM files, which evo compares')
    if args.mounting and EXIT_CODES[found.answer] == ACCEPTED and (
            now is None or before is None or now.moved_from(before)):
        return NOT_ENOUGH if now is None else WRONG
    return EXIT_CODES[found.answer]


def _poses(args: argparse.Namespace) -> tuple[Poses | None, SensorStream | None]:
    """Return the poses that --poses has, or the GPS track: it waits for the pictures' stamps."""
    path = args.poses
    if path is None:
        return None, None
    is_bag = path.exists() and fits_bag(path)
    if not is_bag and not is_motion(path):
        return read_poses(path), None
    track = bag_motion([path], {'gps': args.gps}, args.topic) if is_bag else read_motion(path)
    if track is None or track.position is None:
        why = '; '.join(() if track is None else map(str, track.warnings))
        raise InputError('E-NO-GPS-TRACK',
                         f'{path} has no GPS track{why and f" ({why})"}: use one with positions '
                         f'(NavSatFix, GPX), or poses in the format of KITTI, TUM or EuRoC')
    return None, track


def _show(found: Check, motion: Odometry | None, changes: Sequence[str]) -> None:
    show(labelled('answer', found.answer))
    for reason in (*found.reasons, *changes):
        show(line(f'- {reason}'))
    if motion is None:
        return
    medians = motion.medians()
    rows = [(text, *(f'{unit * medians[key][name]:.3f}' for name in motion.names))
            for key, (text, unit) in MEASURED.items()]
    show(TextTable((f'median of {counted(len(motion.turns), "turn")}', *motion.names), rows))
